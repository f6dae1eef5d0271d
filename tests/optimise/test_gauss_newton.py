"""Gauss–Newton steps that learn the curvature of residuals."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest

from opfem.optimise.conjugate_gradients import QuasiNewtonInverse, Secants, least_squares
from opfem.optimise.gauss_newton import GaussNewton, PreconditionedDescent


def test_settles_where_residuals_curve_more_than_gauss_newton_knows():
    """Gauss–Newton alone is at 7e-3 after 60 evaluations: the Hessian is several times its matrix."""
    rng = np.random.default_rng(0)
    A, B, b = (jnp.asarray(rng.standard_normal(shape)) for shape in ((40, 20), (40, 20), (40,)))

    def residuals(y, _):
        return A @ y + 0.5 * (B @ y) ** 2 - 5.0 * b, 0.3 * y

    rtol = jnp.asarray(1e-5)
    descent = PreconditionedDescent(
        lambda J: lambda g: g, jnp.asarray(1e-2), jnp.asarray(60), jnp.asarray(1e-6), jnp.asarray(jnp.inf)
    )
    solver = GaussNewton(rtol, descent)
    solution = optx.least_squares(residuals, solver, jnp.zeros(20), max_steps=45, throw=False)
    assert solution.result == optx.RESULTS.successful

    def half_sum(y):
        return 0.5 * sum(jnp.sum(r**2) for r in residuals(y, None))

    y = solution.value
    newton = jnp.linalg.solve(jax.hessian(half_sum)(y), jax.grad(half_sum)(y))
    assert jnp.all(jnp.linalg.eigvalsh(jax.hessian(half_sum)(y)) > 0)
    assert jnp.linalg.norm(newton) < 1e-3 * jnp.linalg.norm(y)


def test_a_secant_that_makes_a_direction_promise_too_much_is_forgotten():
    """Along (1, 0) the gradient rose across: with that, the matrix is singular but for 1 %."""
    residual, y = jnp.array([1.0, 1.0]), jnp.zeros(2)
    J = lx.IdentityLinearOperator(jax.eval_shape(lambda: residual))
    descent = PreconditionedDescent(
        lambda J: lambda g: g, jnp.asarray(1e-8), jnp.asarray(60), jnp.asarray(0.0), jnp.asarray(jnp.inf)
    )
    start = descent.init(y, None)
    step, change = jnp.array([1.0, 0.0]), jnp.array([0.01, 1.0])
    learnt = start.secants.appended(step, change)
    with_secant = learnt.after(learnt.before(residual)[0], learnt.before(residual)[1])
    assert residual @ with_secant > 100.0 * (residual @ residual)
    came = eqx.tree_at(lambda s: (s.point, s.gradient), start, (y - step, residual - change))
    direction = descent.query(y, optx.FunctionInfo.ResidualJac(residual, J), came)
    assert direction.newton == pytest.approx(np.asarray(residual), rel=1e-3)
    assert jnp.all(direction.secants.step == 0.0)


def test_iterations_precondition_the_next_system():
    """Ten directions stand out; iterations of one system learn them."""
    rng = np.random.default_rng(1)
    size = jnp.asarray(np.concatenate([np.geomspace(5.0, 50.0, 10), 1.0 + 0.1 * rng.random(190)]))
    Q, _ = jnp.linalg.qr(jnp.asarray(rng.standard_normal((200, 200))))
    A, first, second = Q * size @ Q.T, *jnp.asarray(rng.standard_normal((2, 200)))

    def plain(gradient):
        return gradient

    def solve(b, secants=None):
        return least_squares(lambda x: A @ x, lambda r: A.T @ r, plain, b, 1e-2, 100, secants=secants)

    solved = solve(first, Secants.none(first, 60))
    assert solved.iterations == solve(first).iterations
    assert solve(second, solved.secants).iterations < 0.4 * solve(second).iterations  # 2 of 11
    learnt = QuasiNewtonInverse(plain, solved.secants)
    for i in range(10):
        assert jnp.vdot(Q[:, i], learnt(Q[:, i])) == pytest.approx(float(size[i]) ** -2, rel=1e-3)
    assert jnp.vdot(first, learnt(second)) == pytest.approx(float(jnp.vdot(second, learnt(first))), rel=1e-9)
