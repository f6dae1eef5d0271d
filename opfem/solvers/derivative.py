"""Derivatives of a solve: through its path, one implicit function per solve.

Adaptive loops have no reverse mode. The increments are solved without derivatives and recorded. A scan of fixed length
then differentiates each recorded solve by the implicit function theorem, at one linear solve, forward or transposed.
The friction history couples one solve to the next.

`follow_path` provides derivatives of any order. `linearised`, `push` and `pull` serve least squares, with many products
of one Jacobian: they store the tangents, solve to the accuracy that this needs, and share one compiled program.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array

from ..mechanics.boundary import Bodies
from .compiling import QuickJit
from .equations import AbstractProblem, State
from .equilibrium import Forces, Problem
from .load_path import Recorded
from .newton import Newton, solve_tangent
from .stencil import Nodal
from .tangent import AbstractTangent, Tangent, Unknowns

# Relative residual of the linear solves, in float64, and the limit of corrections.
_RTOL = 1e-10
_MOST_CORRECTIONS = 12
# Relative residual of each correction, in float32: two of them usually suffice.
_CORRECTION_RTOL = 1e-5
# Relative residual of linear solves where the Jacobian is kept, in float32: of the last solve of a path, of those
# before, and the largest that is accepted. With 3e-4 for all, forward and transposed products through the elastic
# foundation of a fit differ so much that CGLS may diverge. Solves before the last act on the end of the path through
# friction only: at 1e-3, products of the coin on 40×40×4 elements change by 2e-4, and a posterior draw takes 56 instead
# of 72 s on a busy core.
_KEPT_RTOL = 3e-5
_KEPT_EARLIER_RTOL = 1e-3
_KEPT_MOST = 1e-2


def follow_path(
    problem: AbstractProblem, start: State, path: Recorded, length: Array, settings: Newton
) -> tuple[State, State]:
    """Repeat recorded solves, differentiably.

    Returns:
        The last state but one, and the last. Their derivatives are NaN where the path was too long to
        record or a linear solve does not converge.
    """
    settings = eqx.tree_at(lambda n: n.krylov_rtol, settings, jnp.asarray(_CORRECTION_RTOL))
    is_known = length <= path.fraction.shape[0]

    def solved(slowed: AbstractProblem, state: State, solve: Recorded) -> Unknowns:
        def tangent_solve(matvec, b):
            def solver(transposed):
                def solved(A, c):
                    tangent = slowed.tangent(solve.x, solve.fraction, state, None, transposed)
                    if transposed:
                        A = _transposed_product(slowed, solve.x, solve.fraction, state, solve.hold_active)
                    from_left = transposed and slowed.left_transpose
                    return _solve(slowed, tangent, from_left, solve.hold_active, A, c, is_known, settings)

                return solved

            return jax.lax.custom_linear_solve(matvec, b, solver(False), solver(True))

        return jax.lax.custom_root(
            lambda x: slowed.balance(x, solve.fraction, state, solve.hold_active),
            solve.x,
            lambda _, x: x,
            tangent_solve,
        )

    def one(states, solve: Recorded):
        _, state = states
        slowed = eqx.tree_at(lambda p: p.viscosity, problem, solve.viscosity)
        x = solved(slowed, state, solve)
        forces = slowed.forces(x, solve.fraction, state)
        return state, slowed.advance(x, solve.fraction, state, solve.hold_active, forces)

    def step(states, slot):
        index, solve = slot
        return jax.lax.cond(index < length, one, lambda states, _: states, states, solve), None

    slots = (jnp.arange(path.fraction.shape[0]), path)
    return jax.lax.scan(jax.checkpoint(step, prevent_cse=False), (start, start), slots)[0]


class Handed(NamedTuple):
    """State that one solve of a path passes to the next, or its derivative."""

    unknowns: Unknowns
    histories: Bodies  # of SlipHistory


class Solve(NamedTuple):
    """One solve of a path: the states before and after, and the viscosity [-]."""

    before: State
    after: State
    viscosity: Array


class Slot(NamedTuple):
    """One solve of a path, the tangent of its equilibrium, and the tolerance of its linear solves [-]."""

    solve: Solve
    tangent: Tangent
    rtol: Array


@QuickJit
def linearise(problem: Problem, solve: Solve) -> Tangent:
    """Assemble tangent and multigrid of one solve, so that a product costs little more than a linear solve."""
    before, after, viscosity = solve
    slowed = eqx.tree_at(lambda p: p.viscosity, problem, viscosity)
    return slowed.tangent(after.unknowns, after.fraction, before)


def linearised(problem: Problem, solves: Sequence[Solve]) -> list[Slot]:
    """Linearise the solves of a path."""
    pairs = [*((solve, _KEPT_EARLIER_RTOL) for solve in solves[:-1]), *((solve, _KEPT_RTOL) for solve in solves[-1:])]
    return [Slot(solve, linearise(problem, solve), jnp.asarray(rtol)) for solve, rtol in pairs]


def push(
    problem: Problem, slots: Sequence[Slot], moved: Problem, first: Handed, settings: Newton, rtol: float | None = None
) -> Handed:
    """Compute the change of the path's end, by default to 3e-4, by one linear solve per slot.

    That suffices for loads only: one solve is not accurate for changes of prescribed displacements.

    Args:
        problem: The problem.
        slots: The path.
        moved: Change of the problem; None for constant leaves.
        first: Change of the initial state.
        settings: Settings of the solve.
        rtol: Relative residual to which linear solves are repeated (iterative refinement); outside of traces only.
    """

    def through(change: Handed, slot: Slot) -> Handed:
        off = _off_balance(problem, slot.solve, moved, change)
        step = _solve_kept(problem, slot, off, jnp.asarray(False), settings)
        for _ in range(0 if rtol is None else _MOST_CORRECTIONS):
            left, relative = _remaining(problem, slot.solve, off, step)
            if not relative > rtol:
                break
            more = _solve_kept(problem, slot, left, jnp.asarray(False), settings)
            step = jax.tree.map(jnp.add, step, more)
        return _hand_on(problem, slot.solve, moved, change, step)

    return _through(through, first, slots)


def pull(problem: Problem, slots: Sequence[Slot], varies: Problem, weights: Nodal, settings: Newton) -> Problem:
    """Compute the transposed product: from weights of the last displacement to weights of the problem.

    Args:
        problem: The problem.
        slots: The path.
        varies: Mask of the problem's variable numbers.
        weights: Weights of the displacement.
        settings: Settings of the solve.
    """

    def through(carry: tuple[Problem, Handed], slot: Slot) -> tuple[Problem, Handed]:
        so_far, of_step = _pull_hand_on(problem, slot.solve, *carry)
        step = _solve_kept(problem, slot, of_step, jnp.asarray(True), settings)
        return _pull_off_balance(problem, slot.solve, *so_far, step)

    nothing = jax.tree.map(jnp.zeros_like, eqx.filter(problem, varies))
    if not slots:
        return nothing
    after = slots[-1].solve.after
    last = jax.tree.map(jnp.zeros_like, Handed(after.unknowns, after.histories))
    last = last._replace(unknowns=last.unknowns._replace(u=weights))
    return _through(through, (nothing, last), slots, reverse=True)[0]


def programs(
    problem: Problem, solve: Solve, moved: Problem, first: Handed, varies: Problem, settings: Newton
) -> list[tuple[QuickJit, tuple]]:
    """List the programs of `linearise`, `push` and `pull`, with arguments of their shapes, to compile them early."""
    tangent = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), eqx.filter_eval_shape(linearise, problem, solve))
    step, yes, varied = solve.after.unknowns, jnp.asarray(True), eqx.filter(problem, varies)
    return [
        (linearise, (problem, solve)),
        (_solve_kept, (problem, Slot(solve, tangent, jnp.asarray(_KEPT_RTOL)), step, yes, settings)),
        (_off_balance, (problem, solve, moved, first)),
        (_hand_on, (problem, solve, moved, first, step)),
        (_pull_hand_on, (problem, solve, varied, first)),
        (_pull_off_balance, (problem, solve, varied, first, step)),
    ]


def _through(function: Callable, carry: Any, slots: Sequence[Slot], reverse: bool = False) -> Any:
    """Loop over slots on the host, by one compiled program; by a scan where values are traced."""
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((carry, slots))) and slots:
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *slots)
        return jax.lax.scan(lambda carry, slot: (function(carry, slot), None), carry, stacked, reverse=reverse)[0]
    for slot in reversed(slots) if reverse else slots:
        carry = function(carry, slot)
    return carry


class _Equations:
    """The equations of one solve, as functions of the variable numbers of the problem and of the initial state."""

    def __init__(self, problem: Problem, solve: Solve, varied: Problem):
        varies = jax.tree.map(lambda leaf: leaf is not None, varied, is_leaf=lambda leaf: leaf is None)
        self.problem = eqx.tree_at(lambda p: p.viscosity, problem, solve.viscosity)
        self.solve = solve
        self.at = eqx.filter(problem, varies), Handed(solve.before.unknowns, solve.before.histories)

    def _start(self, handed: Handed) -> State:
        u, mean_stress = handed.unknowns
        return dataclasses.replace(self.solve.before, u=u, mean_stress=mean_stress, histories=handed.histories)

    def balance(self, varied: Problem, handed: Handed) -> Unknowns:
        """Compute the residual at the solved state."""
        after = self.solve.after
        problem = eqx.combine(varied, self.problem)
        return problem.balance(after.unknowns, after.fraction, self._start(handed), after.hold_active)

    def hand_on(self, varied: Problem, handed: Handed, x: Unknowns) -> Handed:
        """Compute the state passed to the next solve."""
        after = self.solve.after
        # Forces enter the work only, and nothing depends on the work.
        forces = Forces(jnp.zeros_like(x.u), None, after.applied, None, jnp.ones(()))
        state = eqx.combine(varied, self.problem).advance(
            x, after.fraction, self._start(handed), after.hold_active, forces
        )
        return Handed(x, state.histories)


@QuickJit
def _off_balance(problem: Problem, solve: Solve, moved: Problem, change: Handed) -> Unknowns:
    """Compute the negative change of the residual at the solved state: right-hand side of the linear solve."""
    equations = _Equations(problem, solve, moved)
    return jax.tree.map(jnp.negative, jax.jvp(equations.balance, equations.at, (moved, change))[1])


@QuickJit
def _remaining(problem: Problem, solve: Solve, off: Unknowns, step: Unknowns) -> tuple[Unknowns, Array]:
    """Compute what a step leaves of a right-hand side, and its relative size."""
    after = solve.after
    slowed = eqx.tree_at(lambda p: p.viscosity, problem, solve.viscosity)

    def balance(x):
        return slowed.balance(x, after.fraction, solve.before, after.hold_active)

    left = jax.tree.map(jnp.subtract, off, jax.jvp(balance, (after.unknowns,), (step,))[1])
    size = problem.size(off)
    return left, problem.size(left) / jnp.where(size > 0, size, 1.0)


@QuickJit
def _hand_on(problem: Problem, solve: Solve, moved: Problem, change: Handed, step: Unknowns) -> Handed:
    """Compute the change of the state passed to the next solve."""
    equations = _Equations(problem, solve, moved)
    at = (*equations.at, solve.after.unknowns)
    return jax.jvp(equations.hand_on, at, (moved, change, step))[1]


@QuickJit
def _pull_hand_on(
    problem: Problem, solve: Solve, so_far: Problem, weights: Handed
) -> tuple[tuple[Problem, Handed], Unknowns]:
    """Compute the transposed product of `_hand_on`."""
    equations = _Equations(problem, solve, so_far)
    pulled = jax.vjp(equations.hand_on, *equations.at, solve.after.unknowns)[1](weights)
    of_problem, of_handed, of_step = pulled
    return (jax.tree.map(jnp.add, so_far, of_problem), of_handed), of_step


@QuickJit
def _pull_off_balance(
    problem: Problem, solve: Solve, so_far: Problem, of_handed: Handed, step: Unknowns
) -> tuple[Problem, Handed]:
    """Compute the transposed product of `_off_balance`."""
    equations = _Equations(problem, solve, so_far)
    pulled = jax.vjp(equations.balance, *equations.at)[1](step)
    return jax.tree.map(jnp.subtract, (so_far, of_handed), pulled)


@QuickJit
def _solve_kept(problem: Problem, slot: Slot, b: Unknowns, transposed: Array, settings: Newton) -> Unknowns:
    """Solve with a stored tangent or its transpose, by one program; NaN where that fails.

    Both use left preconditioning, which the transpose requires (`solve_tangent`).
    """
    settings = eqx.tree_at(lambda n: n.krylov_rtol, settings, slot.rtol)
    tangent = slot.tangent
    tangent = jax.tree.map(lambda new, old: jnp.where(transposed, new, old), tangent.transposed(), tangent)
    x, remaining = _correction(problem, tangent, True, slot.solve.after.hold_active, b, settings)
    return jax.tree.map(lambda v: jnp.where(remaining <= _KEPT_MOST, v, jnp.nan), x)


def _solve(
    problem: AbstractProblem,
    tangent: AbstractTangent,
    from_left: bool,
    hold_active: Array,
    matvec,
    b: Unknowns,
    is_known: Array,
    settings: Newton,
) -> Unknowns:
    """Solve with the tangent of equilibrium, or its transpose, by iterative refinement of float32 solves; else NaN.

    With left preconditioning the norm is that of the preconditioned residual, a displacement (`solve_tangent`).
    """

    def measure(r: Unknowns) -> tuple[Array, Unknowns | None]:
        if not from_left:
            return problem.size(r), None
        inside = problem.inside(r, hold_active)
        move = problem.precondition(tangent, inside.scaled(problem.stress_scale), hold_active)
        pushed = problem.size(move.scaled(1.0 / problem.stress_scale))
        return problem.size(
            r._replace(u=jax.tree.map(jnp.subtract, r.u, inside.u))
        ) + problem.typical_stiffness * pushed, move

    # Each pass computes the residual of the previous one and corrects it, so that each product is compiled once.
    def correct(carry):
        x, target, _, count = carry
        r = jax.tree.map(jnp.subtract, b, matvec(x))
        size, move = measure(r)
        target = jnp.where(count == 0, _RTOL * size, target)

        def corrected():
            change, _ = _correction(problem, tangent, from_left, hold_active, r, settings, move)
            return jax.tree.map(jnp.add, x, change)

        solved = size <= target
        return jax.lax.cond(solved, lambda: x, corrected), target, solved, count + 1

    def unfinished(carry):
        _, _, solved, count = carry
        return ~solved & (count <= _MOST_CORRECTIONS)

    nothing = jax.tree.map(jnp.zeros_like, b)
    start = nothing, jnp.zeros_like(problem.typical_stiffness), jnp.asarray(False), 0
    x, _, solved, _ = jax.lax.while_loop(unfinished, correct, start)
    return jax.tree.map(lambda v: jnp.where(solved & is_known, v, jnp.nan), x)


def _transposed_product(problem: AbstractProblem, x: Unknowns, fraction: Array, state: State, hold_active: Array):
    """Make the product with the transposed tangent of equilibrium.

    The tangent of the internal force is symmetric, so that forward mode computes its product, in half the time.
    """
    frozen = problem.own_forces(x, state).own

    def own(x: Unknowns) -> Unknowns:
        return problem.own_forces(x, state).own

    def others(x: Unknowns) -> Unknowns:
        return problem.balance(x, fraction, state, hold_active, problem.own_forces(x, state).with_own(frozen))

    def multiply(v: Unknowns) -> Unknowns:
        inside = v._replace(u=problem.admissible(v.u, hold_active))
        return jax.tree.map(jnp.add, jax.jvp(own, (x,), (inside,))[1], jax.vjp(others, x)[1](v)[0])

    return multiply


def _correction(
    problem: AbstractProblem,
    tangent: AbstractTangent,
    from_left: bool,
    hold_active: Array,
    r: Unknowns,
    settings: Newton,
    preconditioned: Unknowns | None = None,
) -> tuple[Unknowns, Array]:
    """Solve once with the tangent of equilibrium, in float32; also return the remaining relative residual."""
    inside = problem.inside(r, hold_active)
    result = solve_tangent(problem, tangent, inside, hold_active, settings, from_left, preconditioned)
    change = problem.inside(result.x, hold_active)
    # Prescribed displacements and the active hold: rows of their penalty.
    k = problem.typical_stiffness
    placed = jax.tree.map(lambda change, r, inside: change + (r - inside) / k, change.u, r.u, inside.u)
    return change._replace(u=placed), result.relative_residual
