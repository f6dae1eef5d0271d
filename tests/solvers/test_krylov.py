"""Flexible GMRES against dense solves."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from opfem.solvers.krylov import fgmres
from tests.tolerances import ROUNDOFF, SOLVER

N = 60
RTOL = SOLVER / 10


@pytest.fixture(scope="module")
def system():
    """A matrix without symmetry whose field of values stays right of zero, and a right-hand side of shape (3, 20)."""
    rng = np.random.default_rng(0)
    A = 2.0 * np.eye(N) + 0.12 * rng.standard_normal((N, N))
    return A, rng.standard_normal((3, N // 3))


@partial(jax.jit, static_argnames=("basis", "max_iterations"))
def solve(A, M, b, rtol, basis, max_iterations=400):
    def times(matrix):
        return lambda v: (matrix @ v.reshape(-1)).reshape(v.shape)

    return fgmres(times(A), times(M), b, rtol, basis, max_iterations)


def relative_residual(A, x, b):
    return np.linalg.norm(b.ravel() - A @ np.ravel(x)) / np.linalg.norm(b)


@pytest.mark.parametrize("basis", [60, 7], ids=["one cycle", "restarts"])
def test_solution_equals_a_dense_solve(system, basis):
    A, b = system
    assert not np.allclose(A, A.T, atol=0.1)
    result = solve(jnp.array(A), jnp.eye(N), jnp.array(b), RTOL, basis)
    expected = np.linalg.solve(A, b.ravel()).reshape(b.shape)
    np.testing.assert_allclose(result.x, expected, atol=SOLVER * np.abs(expected).max())
    assert (result.iterations > basis) == (basis == 7)


@pytest.mark.parametrize("basis", [60, 7])
@pytest.mark.parametrize("rtol", [1e-2, 1e-5, 1e-9])
def test_reported_residual_is_the_true_one_and_small_enough(system, basis, rtol):
    A, b = system
    result = solve(jnp.array(A), jnp.eye(N), jnp.array(b), rtol, basis)
    true = relative_residual(A, result.x, b)
    # A residual of rtol itself loses its digits to b; what is left is rounding of b.
    np.testing.assert_allclose(result.relative_residual, true, rtol=ROUNDOFF / rtol, atol=0)
    assert true <= 2 * rtol


def test_tighter_tolerance_takes_more_iterations(system):
    A, b = system
    counts = [int(solve(jnp.array(A), jnp.eye(N), jnp.array(b), rtol, 60).iterations) for rtol in (1e-2, 1e-5, 1e-9)]
    assert counts[0] < counts[1] < counts[2] <= N


def test_an_exact_preconditioner_in_float32_needs_two_iterations(system):
    A, b = system
    M = jnp.array(np.linalg.inv(A), jnp.float32)
    result = solve(jnp.array(A), M, jnp.array(b), RTOL, 60)
    assert result.iterations <= 2
    assert relative_residual(A, result.x, b) <= 2 * RTOL


def test_stops_at_the_first_restart_after_max_iterations_and_says_so(system):
    A, b = system
    result = solve(jnp.array(A), jnp.eye(N), jnp.array(b), 1e-12, 5, max_iterations=8)
    assert result.iterations == 10
    true = relative_residual(A, result.x, b)
    assert true > 1e-6
    np.testing.assert_allclose(result.relative_residual, true, 1e6 * ROUNDOFF)


def test_residual_falls_as_the_dense_least_squares_problem_does(system):
    """After k directions, |b - A x| is the smallest over the Krylov space of the preconditioned matrix."""
    A, b = system
    M = np.diag(np.linspace(0.5, 2.0, N))
    for k in (1, 4, 9):
        result = solve(jnp.array(A), jnp.array(M), jnp.array(b), 1e-12, k, max_iterations=k)
        directions = [b.ravel()]
        for _ in range(k - 1):
            directions.append(A @ M @ directions[-1])
            directions[-1] /= np.linalg.norm(directions[-1])
        AZ = A @ M @ np.stack(directions, axis=1)
        best = np.linalg.norm(b.ravel() - AZ @ np.linalg.lstsq(AZ, b.ravel(), rcond=None)[0]) / np.linalg.norm(b)
        # The directions are kept in float32, so the space is not exactly Krylov's.
        np.testing.assert_allclose(result.relative_residual, best, 1e-5)


def test_a_zero_right_hand_side_has_a_zero_solution(system):
    A, b = system
    result = solve(jnp.array(A), jnp.eye(N), jnp.zeros_like(b), RTOL, 7)
    np.testing.assert_array_equal(result.x, 0.0)
    assert result.iterations == 0
    assert result.relative_residual == 0.0


def test_an_eigenvector_is_solved_by_one_direction(system):
    """The basis breaks down where the answer is exact, and nothing is divided by zero."""
    _, b = system
    result = solve(jnp.diag(jnp.full(N, 4.0)), jnp.eye(N), jnp.array(b), RTOL, 7)
    assert np.isfinite(result.x).all()
    np.testing.assert_allclose(result.x, b / 4, atol=SOLVER)
    assert result.iterations <= 2


def test_vmap_equals_a_loop(system):
    """Lanes that converge early wait for the others without changing."""
    A, b = system
    matrices = jnp.stack([jnp.array(A), jnp.diag(jnp.full(N, 4.0))])
    sides = jnp.stack([jnp.array(b), 3.0 * jnp.array(b)])
    lanes = jax.vmap(lambda m, v: solve(m, jnp.eye(N), v, RTOL, 7))(matrices, sides)
    for k in range(2):
        alone = solve(matrices[k], jnp.eye(N), sides[k], RTOL, 7)
        np.testing.assert_allclose(lanes.x[k], alone.x, atol=10 * SOLVER)
        assert lanes.iterations[k] == alone.iterations
