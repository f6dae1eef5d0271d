"""What a mesh misses, estimated from half of it."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.inverse.measured_surface import interface_heights


def pressed_on(elements):
    return op.Palpation(
        op.Layer(0.5, op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=0.11732)),
        extent=(1.5, 1.5),
        elements=elements,
        window=op.Contact(op.HardOverclosure(), 0.15),
        sample=op.Contact(op.ExponentialOverclosure(2.0, 0.01), 0.05),
    )


def pressed(elements):
    palpation = pressed_on(elements)
    x, y = (np.asarray(part) for part in palpation.mesh().plane())
    bump = 1e-3 * (2.0 + 2.0 * np.exp(-((x - 0.7) ** 2 + (y - 0.8) ** 2) / 0.15))
    return op.solve(palpation, op.Traction(bump))


@pytest.mark.slow
def test_half_the_mesh_tells_what_the_mesh_misses():
    on_mesh, on_finer = pressed((16, 16, 4)), pressed((32, 32, 8))
    heights = [interface_heights(s.palpation.mesh(), s.displacement[:, -1]) for s in (on_mesh, on_finer)]
    # What is left of the finer mesh's own error is a quarter.
    missed = (heights[0] - heights[1][::2, ::2])[::2, ::2] * 4.0 / 3.0
    estimate = np.asarray(op.mesh_error(on_mesh))
    # Elements of half the mesh are as wide as the bump's flank: size and pattern are right, not every value.
    sizes = np.linalg.norm(estimate), np.linalg.norm(missed)
    assert sizes[0] == pytest.approx(sizes[1], rel=0.3)
    assert np.sum(estimate * missed) > 0.85 * sizes[0] * sizes[1]


def test_what_it_cannot_do_is_refused(solution):
    with pytest.raises(ValueError, match="under a Traction, got Imprint"):
        op.mesh_error(solution)
    load = op.Traction(jnp.zeros((7, 7)))
    with pytest.raises(ValueError, match=r"8 or more along x and y, got \(6, 6, 2\)"):
        op.mesh_error(dataclasses.replace(solution, load=load, palpation=pressed_on((6, 6, 2))))
