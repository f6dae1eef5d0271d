"""Derivatives of a solve: through its path, one implicit function per solve.

Adaptive loops have no reverse mode. The increments are found without derivatives and recorded; here
they are gone through again at their recorded displacements, in a scan of fixed length. Each
displacement is the root of its own balance, so that its derivative costs one linear solve, forward or
transposed, and friction hands its history on from one to the next.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..mechanics.boundary import Bodies
from .equilibrium import Problem, State
from .newton import Newton, solve_tangent
from .stepping import Path
from .tangent import Unknowns

# Relative residual of the linear solves, in float64, and the corrections that it may take.
_RTOL = 1e-10
_MOST_CORRECTIONS = 12
# Relative residual of each correction, in float32.
_CORRECTION_RTOL = 1e-3


def follow_path(problem: Problem, start: State, path: Path, length: Array, settings: Newton) -> tuple[State, State]:
    """Go through recorded solves again, differentiably.

    Returns:
        The last state but one, and the last. Their derivatives are NaN where the path was too long to
        record or a linear solve does not converge.
    """
    slots = path.fraction.shape[0]
    settings = eqx.tree_at(lambda n: n.krylov_rtol, settings, jnp.asarray(_CORRECTION_RTOL))

    def one(states, solve: Path):
        _, state = states
        slowed = eqx.tree_at(lambda p: p.viscosity, problem, solve.viscosity)

        def tangent_solve(tangent, b):
            def solver(transposed):
                return lambda A, c: _solve(slowed, state, solve, A, c, transposed, length <= slots, settings)

            return jax.lax.custom_linear_solve(tangent, b, solver(False), solver(True))

        x = jax.lax.custom_root(
            lambda x: slowed.balance(x, solve.fraction, state, solve.held), solve.x, lambda _, x: x, tangent_solve
        )
        forces = slowed.forces(x, solve.fraction, state)
        return state, slowed.advance(x, solve.fraction, state, solve.held, forces)

    def step(states, slot):
        index, solve = slot
        return jax.lax.cond(index < length, one, lambda states, _: states, states, solve), None

    ends, _ = jax.lax.scan(jax.checkpoint(step, prevent_cse=False), (start, start), (jnp.arange(slots), path))
    return ends


def _solve(
    problem: Problem,
    state: State,
    solve: Path,
    matvec,
    b: Unknowns,
    transposed: bool,
    is_known: Array,
    settings: Newton,
) -> Unknowns:
    """Solve with the tangent of the balance, or its transpose, by corrections in float32; else NaN."""
    tangent = problem.tangent(solve.x, solve.fraction, state, Bodies(), transposed)

    def correct(carry):
        x, r, count = carry
        inside = r._replace(u=problem.project(jnp.asarray(problem.free) * r.u, solve.held))
        change = solve_tangent(problem, tangent, inside, solve.held, settings).x
        u = problem.project(jnp.asarray(problem.free) * change.u, solve.held)
        change = change._replace(u=u + (r.u - inside.u) / problem.typical_stiffness)
        x = jax.tree.map(jnp.add, x, change)
        return x, jax.tree.map(jnp.subtract, b, matvec(x)), count + 1

    def unfinished(carry):
        _, r, count = carry
        return ~(problem.size(r) <= target) & (count < _MOST_CORRECTIONS)

    target = _RTOL * problem.size(b)
    x, r, _ = jax.lax.while_loop(unfinished, correct, (jax.tree.map(jnp.zeros_like, b), b, 0))
    return jax.tree.map(lambda v: jnp.where((problem.size(r) <= target) & is_known, v, jnp.nan), x)
