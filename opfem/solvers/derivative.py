"""Derivatives of a solve: through its path, one implicit function per solve.

Adaptive loops have no reverse mode. The increments are found without derivatives and recorded; here
they are gone through again at their recorded displacements, in a scan of fixed length. Each
displacement is the root of its own balance, so that its derivative costs one linear solve, forward or
transposed, and friction hands its history on from one to the next.

`follow_path` is for derivatives as users ask for them, of any order. `linearise_path` is for least squares, which
multiply with one Jacobian many times: it keeps the tangents, and solves no more exactly than that needs.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .equilibrium import Problem, State
from .newton import Newton, solve_tangent
from .stepping import Path
from .tangent import Tangent, Unknowns

# Relative residual of the linear solves, in float64, and the corrections that it may take.
_RTOL = 1e-10
_MOST_CORRECTIONS = 12
# Relative residual of each correction, in float32: two of them mostly do.
_CORRECTION_RTOL = 1e-5
# Relative residual of linear solves where the Jacobian is kept, in float32, and the largest that is accepted. At 3e-4,
# products through a fit's springs, forward and transposed, differ so much that its conjugate gradients may diverge.
_KEPT_RTOL = 3e-5
_KEPT_MOST = 1e-2


def follow_path(problem: Problem, start: State, path: Path, length: Array, settings: Newton) -> tuple[State, State]:
    """Go through recorded solves again, differentiably.

    Returns:
        The last state but one, and the last. Their derivatives are NaN where the path was too long to
        record or a linear solve does not converge.
    """
    settings = eqx.tree_at(lambda n: n.krylov_rtol, settings, jnp.asarray(_CORRECTION_RTOL))
    is_known = length <= path.fraction.shape[0]

    def displaced(slowed: Problem, state: State, solve: Path, _):
        def tangent_solve(matvec, b):
            def solver(transposed):
                def solved(A, c):
                    tangent = slowed.tangent(solve.x, solve.fraction, state, None, transposed)
                    if transposed:
                        A = _transposed_product(slowed, solve.x, solve.fraction, state, solve.held)
                    return _solve(slowed, tangent, transposed, solve.held, A, c, is_known, settings)

                return solved

            return jax.lax.custom_linear_solve(matvec, b, solver(False), solver(True))

        return jax.lax.custom_root(
            lambda x: slowed.balance(x, solve.fraction, state, solve.held), solve.x, lambda _, x: x, tangent_solve
        ), None

    return _scan_path(problem, start, (path, None), length, displaced)[0]


def linearise_path(problem: Problem, start: State, path: Path, length: Array, settings: Newton) -> tuple[State, State]:
    """Go through recorded solves again, for `jax.linearize`: first derivatives only, and to 1e-4.

    The tangent and the multigrid of every slot of the path are kept, so that a product with the Jacobian costs
    little more than its linear solves. For loads only: one correction does not carry what a change of prescribed
    displacements does to the rest.

    Returns:
        As `follow_path`.
    """
    settings = eqx.tree_at(lambda n: n.krylov_rtol, settings, jnp.asarray(_KEPT_RTOL))
    is_known = length <= path.fraction.shape[0]
    frozen, first = jax.lax.stop_gradient((problem, start))

    def tangent_of(slowed: Problem, state: State, solve: Path, _):
        return solve.x, slowed.tangent(solve.x, solve.fraction, state)

    _, tangents = _scan_path(frozen, first, (path, None), length, tangent_of)

    def displaced(slowed: Problem, state: State, solve: Path, tangent: Tangent):
        frozen, before = jax.lax.stop_gradient((slowed, state))

        def solver(tangent, transposed):
            def solved(_, b):
                change, remaining = _correction(frozen, tangent, transposed, solve.held, b, settings)
                good = (remaining <= _KEPT_MOST) & is_known
                return jax.tree.map(lambda v: jnp.where(good, v, jnp.nan), change)

            return solved

        def multiply(change):
            return jax.jvp(lambda x: frozen.balance(x, solve.fraction, before, solve.held), (solve.x,), (change,))[1]

        # Zero, but for its derivative: that of the unknowns follows by one linear solve.
        off = slowed.balance(solve.x, solve.fraction, state, solve.held)
        off = jax.tree.map(lambda r: r - jax.lax.stop_gradient(r), off)
        change = jax.lax.custom_linear_solve(multiply, off, solver(tangent, False), solver(tangent.transposed(), True))
        return jax.tree.map(jnp.subtract, solve.x, change), None

    return _scan_path(problem, start, (path, tangents), length, displaced)[0]


def _scan_path(problem: Problem, start: State, slots: tuple[Path, Any], length: Array, displaced) -> tuple:
    """Go through the slots of a path; `displaced` gives each one's unknowns, and what to collect."""

    def one(states, slot):
        _, state = states
        solve, kept = slot
        slowed = eqx.tree_at(lambda p: p.viscosity, problem, solve.viscosity)
        x, collected = displaced(slowed, state, solve, kept)
        forces = slowed.forces(x, solve.fraction, state)
        return (state, slowed.advance(x, solve.fraction, state, solve.held, forces)), collected

    def step(states, slot):
        index, slot = slot
        nothing = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), jax.eval_shape(one, states, slot)[1])
        return jax.lax.cond(index < length, one, lambda states, _: (states, nothing), states, slot)

    indices = jnp.arange(slots[0].fraction.shape[0])
    return jax.lax.scan(jax.checkpoint(step, prevent_cse=False), (start, start), (indices, slots))


def _solve(
    problem: Problem,
    tangent: Tangent,
    transposed: bool,
    held: Array,
    matvec,
    b: Unknowns,
    is_known: Array,
    settings: Newton,
) -> Unknowns:
    """Solve with the tangent of the balance, or its transpose, by corrections in float32; else NaN.

    The residual of a transposed system is measured as the move that it stands for (`solve_tangent`).
    """

    def correct(carry):
        x, r, count = carry
        change, _ = _correction(problem, tangent, transposed, held, r, settings)
        x = jax.tree.map(jnp.add, x, change)
        return x, jax.tree.map(jnp.subtract, b, matvec(x)), count + 1

    def size(r):
        if not transposed:
            return problem.size(r)
        inside = _inside(problem, r, held)
        move = tangent.precondition(inside.scaled(problem.stress_scale)).scaled(1.0 / problem.stress_scale)
        return problem.size(r._replace(u=r.u - inside.u)) + problem.typical_stiffness * problem.size(move)

    def unfinished(carry):
        _, r, count = carry
        return ~(size(r) <= target) & (count < _MOST_CORRECTIONS)

    target = _RTOL * size(b)
    x, r, _ = jax.lax.while_loop(unfinished, correct, (jax.tree.map(jnp.zeros_like, b), b, 0))
    return jax.tree.map(lambda v: jnp.where((size(r) <= target) & is_known, v, jnp.nan), x)


def _transposed_product(problem: Problem, x: Unknowns, fraction: Array, state: State, held: Array):
    """Make the product with the transposed derivative of the balance.

    The layer's own force derives from an energy. Its derivative is symmetric, and a product in forward mode takes
    half as long as one in reverse.
    """
    frozen = problem.own_forces(x, state)

    def own(x: Unknowns) -> Unknowns:
        forces = problem.own_forces(x, state)
        return Unknowns(forces.internal, forces.volume)

    def others(x: Unknowns) -> Unknowns:
        forces = problem.own_forces(x, state)._replace(internal=frozen.internal, volume=frozen.volume)
        return problem.balance(x, fraction, state, held, forces)

    def multiply(v: Unknowns) -> Unknowns:
        inside = v._replace(u=jnp.asarray(problem.free) * problem.project(v.u, held))
        return jax.tree.map(jnp.add, jax.jvp(own, (x,), (inside,))[1], jax.vjp(others, x)[1](v)[0])

    return multiply


def _correction(problem: Problem, tangent: Tangent, transposed: bool, held: Array, r: Unknowns, settings: Newton):
    """Solve with the tangent of the balance once, in float32; also return the relative residual it left."""
    inside = _inside(problem, r, held)
    result = solve_tangent(problem, tangent, inside, held, settings, transposed)
    change = _inside(problem, result.x, held)
    # Supports and held motion: the balance has a spring to where they are prescribed.
    placed = change._replace(u=change.u + (r.u - inside.u) / problem.typical_stiffness)
    return placed, result.relative_residual


def _inside(problem: Problem, r: Unknowns, held: Array) -> Unknowns:
    return r._replace(u=problem.project(jnp.asarray(problem.free) * r.u, held))
