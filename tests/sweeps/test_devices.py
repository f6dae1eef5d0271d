"""Sweeps over two virtual devices, in a process of its own: devices are counted when JAX starts."""

import os
import subprocess
import sys
import textwrap

PROGRAM = """
    import jax, jax.numpy as jnp, numpy as np
    import opfem as op
    jax.config.update("jax_enable_x64", True)
    assert jax.local_device_count() == 2

    def halvings(start, base):
        left, steps = jax.lax.while_loop(lambda c: c[0] > 1e-3, lambda c: (base * c[0], c[1] + 1), (start, 0))
        return {"left": left, "steps": steps, "field": left * jnp.arange(3.0)}

    axes = {"start": np.geomspace(1e-2, 1e6, 7), "base": [0.3, 0.5, 0.9]}
    here = op.sweep(halvings, axes, execution=op.Batch(1, "map")).drop_vars("wall_time")
    for mode in ("map", "vmap"):
        for size in (1, 4, 16):
            there = op.sweep(halvings, axes, execution=op.Devices(size, mode)).drop_vars("wall_time")
            assert there.drop_attrs().identical(here.drop_attrs()), (mode, size)
            assert f'"size": {size}, "devices": 2' in there.attrs["execution"]
    print("same on", jax.local_device_count())
"""


def test_two_devices_give_what_one_gives():
    environment = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", textwrap.dedent(PROGRAM)]
    answer = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout == "same on 2\n"
