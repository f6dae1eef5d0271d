"""Sweeps on the workers of a dask client, each a process of its own."""

import os
import signal
import threading
import time
import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op

distributed = pytest.importorskip("distributed", reason="needs opfem[cluster]")

AXES = {"a": np.linspace(0.1, 2.0, 6), "b": np.linspace(0.0, 1.0, 5)}


def wave(a, b):
    return {
        "wave": jnp.sin(a + b),
        "precision": jnp.finfo(jnp.asarray(a).dtype).bits,
        "root": jnp.sqrt(a - 0.2),
    }


@pytest.fixture(scope="module")
def client():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of ports and of threads that dask itself uses
        cluster = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
        with cluster, distributed.Client(cluster) as client:
            yield client


pytestmark = pytest.mark.filterwarnings("default")  # dask warns of its own closing connections


def bare(data):
    return data.drop_vars("wall_time")


@pytest.mark.parametrize(("mode", "size"), [("map", 1), ("map", 4), ("vmap", 4), ("call", 1)])
def test_workers_give_what_this_process_gives(client, mode, size):
    function = wave if mode != "call" else (lambda a, b: {"wave": float(np.sin(a + b))})
    there = op.sweep(function, AXES, execution=op.Cluster(client, size, mode))
    here = op.sweep(function, AXES, execution=op.Batch(size, mode))
    assert bare(there).identical(bare(here))
    if mode != "call":
        assert (there.precision == 64).all()
        assert (there.status == "nonfinite").sum() == 5


def test_what_a_function_captured_keeps_its_digits(client):
    shift = jnp.asarray(1.0 / 3.0)
    data = op.sweep(lambda a: {"moved": shift + a}, {"a": [0.0]}, execution=op.Cluster(client, mode="map"))
    assert data.moved.item() == 1.0 / 3.0


def test_what_cannot_be_traced_is_called(client):
    data = op.sweep(lambda a: len(str(float(a))), {"a": [1.0, 1.25]}, execution=op.Cluster(client))
    np.testing.assert_array_equal(data["value"], [3, 4])


def test_a_lost_worker_loses_nothing(client, tmp_path):
    def slow(a, b):
        time.sleep(0.2)
        return float(np.sin(a + b))

    def kill():
        while len(list((tmp_path / "out" / "points").glob("*.npz"))) < 3:
            time.sleep(0.01)
        victim = next(iter(client.run(os.getpid).values()))
        os.kill(victim, signal.SIGKILL)
        killed.append(victim)

    killed: list[int] = []
    killer = threading.Thread(target=kill)
    killer.start()
    data = op.sweep(slow, AXES, out=tmp_path / "out", execution=op.Cluster(client, mode="call"))
    killer.join()
    assert killed
    assert (data.status == "successful").all()
    np.testing.assert_array_equal(data.slow, np.sin(np.add.outer(AXES["a"], AXES["b"])))


def test_a_sweep_begun_here_ends_there(client, tmp_path):
    whole = op.sweep(wave, AXES, out=tmp_path / "out", execution=op.Batch(4, "map"))
    for file in sorted((tmp_path / "out" / "points").glob("*.npz"))[::2]:
        file.unlink()
    assert bare(op.sweep(wave, AXES, out=tmp_path / "out", execution=op.Cluster(client))).identical(bare(whole))
