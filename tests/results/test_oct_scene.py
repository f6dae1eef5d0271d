"""A scene is the solution: its interface, and the motion of its points between two states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op


def stretched(solution, factor):
    """The solution with a displacement that is linear in the reference position."""
    X = solution.positions
    u = jnp.stack([0.05 * factor * X[0], jnp.zeros_like(X[1]), -0.2 * factor * X[2]])
    return jax.tree.map(lambda leaf: u if leaf is solution.displacement else leaf, solution)


def test_surface_passes_through_the_nodes(solution):
    scene = op.oct_scene(solution)
    x, y, z = (part[1:-1, 1:-1] for part in (solution.positions + solution.displacement)[:, -1])
    # Splines in space through splines in the reference: fourth order of an element.
    np.testing.assert_allclose(scene.surface.sample(x, y), z, atol=2e-4)
    assert scene.increment is None


def test_increment_at_spatial_points(solution):
    before, after = stretched(solution, 1.0), stretched(solution, 1.02)
    increment = op.oct_scene(after, before).increment
    x, y, z = np.array([0.3, 1.0, 1.7]), np.array([0.2, 1.1, 1.9]), np.array([0.05, 0.2, 0.35])
    u_x, u_y, u_z = increment(x, y, z)
    # Closed form: x = 1.05 X, z = 0.8 Z in the first state.
    np.testing.assert_allclose(u_x, 0.05 * 0.02 * x / 1.05, atol=1e-8)
    np.testing.assert_allclose(u_y, 0.0, atol=1e-12)
    np.testing.assert_allclose(u_z, -0.2 * 0.02 * z / 0.8, atol=1e-8)


def test_states_of_two_meshes_are_refused(solution):
    other = jax.tree.map(lambda leaf: leaf[:, :, :-1] if leaf is solution.displacement else leaf, solution)
    with pytest.raises(ValueError, match="two states of one mesh"):
        op.oct_scene(solution, other)
