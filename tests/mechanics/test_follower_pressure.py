"""Follower pressure: closed surfaces, virtual work on a volume, and the load stiffness."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from opfem.mechanics.follower_pressure import FollowerPressure
from tests.tolerances import ROUNDOFF
from tests.verification import meshes

PRESSURE = 2e-3


def closed_surface(corners):
    """The boundary of a distorted cube of 2³ hexahedra, in quadrilaterals or triangles."""
    points, cells = meshes.unit_cube(2)
    outside = ((points == 0) | (points == 1)).any(axis=0)
    faces = meshes.boundary_faces(cells, points, lambda X: outside)
    # A face between two cells that lies inside the boundary's nodes counts twice; keep those that count once.
    _, first, counts = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    faces = faces[first[counts == 1]]
    if corners == 3:
        faces = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    x = points + 0.1 * np.random.default_rng(0).uniform(-1, 1, points.shape)
    return jnp.asarray(x), FollowerPressure(jnp.asarray(PRESSURE), faces.astype(np.int32))


def volume(x, load):
    """Volume inside the surface: a third of the flux of x through it, by the forces of a unit pressure."""
    corners = x[:, load.faces]
    if corners.shape[2] == 3:
        return (
            jnp.sum(jnp.einsum("if,if->f", corners[:, :, 0], jnp.cross(corners[:, :, 1], corners[:, :, 2], axis=0))) / 6
        )
    gauss = 0.5 - 0.5 / np.sqrt(3)
    total = 0.0
    for s, t in [(gauss, gauss), (1 - gauss, gauss), (gauss, 1 - gauss), (1 - gauss, 1 - gauss)]:
        N = np.array([(1 - s) * (1 - t), s * (1 - t), s * t, (1 - s) * t])
        along_s = corners @ np.array([t - 1, 1 - t, t, -t])
        along_t = corners @ np.array([s - 1, -s, s, 1 - s])
        total += 0.25 * jnp.sum((corners @ N) * jnp.cross(along_s, along_t, axis=0)) / 3
    return total


def assembled(values, load, nodes):
    total = np.zeros((3, nodes))
    for axis in range(3):
        total[axis] = np.bincount(load.faces.ravel(), np.asarray(values)[..., axis].ravel(), minlength=nodes)
    return total


@pytest.mark.parametrize("corners", [3, 4])
def test_force_on_a_closed_surface(corners):
    """No resultant, no moment, and the force is the pressure times minus the derivative of the volume."""
    x, load = closed_surface(corners)
    forces = assembled(load.forces(x), load, x.shape[1])
    np.testing.assert_allclose(forces.sum(axis=1), 0, rtol=0, atol=ROUNDOFF * PRESSURE)
    np.testing.assert_allclose(np.cross(x.T, forces.T).sum(axis=0), 0, rtol=0, atol=ROUNDOFF * PRESSURE)
    expected = -PRESSURE * jax.grad(lambda x: volume(x, load))(x)
    np.testing.assert_allclose(forces, expected, rtol=0, atol=ROUNDOFF * PRESSURE)


@pytest.mark.parametrize("corners", [3, 4])
def test_stiffness_is_the_derivative_of_the_force(corners):
    x, load = closed_surface(corners)
    K = load.stiffness(x)
    v = jnp.asarray(np.random.default_rng(1).standard_normal(x.shape))
    nodal = jnp.moveaxis(v[:, load.faces], 0, -1)
    change = assembled(jnp.einsum("faibk,fbk->fai", K, nodal), load, x.shape[1])
    step = 1e-5
    ends = [assembled(load.forces(x + s * step * v), load, x.shape[1]) for s in (1, -1)]
    np.testing.assert_allclose(change, (ends[0] - ends[1]) / (2 * step), rtol=0, atol=1e-9 * PRESSURE)
    # On a closed surface pressure has a potential, its volume: the assembled stiffness is symmetric.
    w = jnp.asarray(np.random.default_rng(2).standard_normal(x.shape))
    back = assembled(jnp.einsum("faibk,fbk->fai", K, jnp.moveaxis(w[:, load.faces], 0, -1)), load, x.shape[1])
    assert float(np.sum(w * change)) == pytest.approx(float(np.sum(v * back)), rel=1e-10)


def test_jit_is_eager():
    x, load = closed_surface(4)
    np.testing.assert_allclose(
        eqx.filter_jit(lambda load, x: load.forces(x))(load, x), load.forces(x), rtol=0, atol=ROUNDOFF * PRESSURE
    )
