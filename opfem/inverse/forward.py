"""Forward solve of a fit: on the host with its first-order derivative, or traced with derivatives of any order."""

import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..model import Load, Palpation, Traction
from ..solvers import Solution
from ..solvers.derivative import Handed, Slot, Solve, follow_path, linearised, pull, push
from ..solvers.discretise import discretise
from ..solvers.equilibrium import Problem
from ..solvers.newton import Newton
from ..solvers.solution import judged
from ..solvers.solve import compiled_attempt, finish, prepare
from ..solvers.stepping import Stepping, attempt, begin, unfinished

Field = Float[Array, "3 mz my mx"]


class TracedState(NamedTuple):
    """State of the layer at the end of a traced solve.

    Attributes:
        u: Displacement of its nodes [mm].
        fraction: Load fraction reached [-].
    """

    u: Field
    fraction: Array


class ForwardSolve(NamedTuple):
    """Forward solve of the layer under a load.

    Attributes:
        palpation: The experiment.
        load: The load.
        problem: The discretised problem.
        end: State of the load stepping at its end.
        solves: Equilibrium solves of the accepted increments.
    """

    palpation: Palpation
    load: Load
    problem: Problem
    end: Stepping
    solves: list[Solve]

    def solution(self, solver: Newton) -> Solution:
        """Return the solution; a solve that stopped at `max_path` is resumed first."""
        return judged(finish(self.problem, resume(self.problem, self.end, solver), self.palpation, self.load))


def forward_solve(palpation: Palpation, load: Load, solver: Newton, start: ForwardSolve | None = None) -> ForwardSolve:
    """Solve under a load, increment by increment, by the program that all solves of this mesh share.

    It stops where the path is longer than `Newton.max_path`, solves of a snap-through included.

    Args:
        palpation: The experiment.
        load: The load.
        solver: Settings.
        start: Solve to continue from; None: from rest.
    """
    before, state = (None, None) if start is None else (start.load, start.end.state)
    problem, s = prepare(palpation, load, before, solver, state, False)
    solves: list[Solve] = []
    while bool(unfinished(s)) and int(s.path.length) <= solver.max_path:
        before, s = s, compiled_attempt(problem, s, solver)
        if int(s.path.length) > int(before.path.length):
            solves.append(Solve(before.origin, s.origin, before.snap.viscosity))
        else:
            del solves[int(s.path.length) :]
    return ForwardSolve(palpation, load, problem, s, solves[: int(s.path.kept)])


def resume(problem: Problem, s: Stepping, solver: Newton) -> Stepping:
    """Continue the load stepping to its end."""
    while bool(unfinished(s)):
        s = compiled_attempt(problem, s, solver)
    return s


class Linearised(eqx.Module):
    """First-order derivative of the displacement by the problem, to 3e-4.

    Attributes:
        problem: The problem.
        slots: Linearised equilibrium solves of the path.
        solver: Settings of the solve.
    """

    problem: Problem
    slots: list[Slot]
    solver: Newton

    @classmethod
    def along(cls, path: ForwardSolve, solver: Newton) -> "Linearised":
        """Linearise the solves of a load path; of those that close gaps of hard contact, the last one.

        On the coin this leaves 9 of 13 solves, and products change by 5e-4.
        """
        pairs = itertools.pairwise(path.solves)
        solves = [solve for solve, after in pairs if not _settle(solve, after)] + path.solves[-1:]
        return cls(path.problem, linearised(path.problem, solves), solver)

    def push(self, moved: Problem, first: Handed) -> Field:
        """Compute the change of the displacement with changes of the problem and of the initial state."""
        return push(self.problem, self.slots, moved, first, self.solver).unknowns.u

    def pull(self, weights: Field) -> Problem:
        """Compute the transposed product: from weights of the displacement to weights of the load."""
        return pull(self.problem, self.slots, load_mask(self.problem), weights, self.solver)


def _settle(solve: Solve, after: Solve) -> bool:
    """Return whether both of two solves in a row close gaps at full load, outside of a snap-through."""
    loads = [solve.before.fraction, solve.after.fraction, after.after.fraction]
    return bool(jnp.all(jnp.stack(loads) >= 1.0) & (solve.viscosity == 0) & (after.viscosity == 0))


def load_mask(problem: Problem) -> Problem:
    """Mark the numbers of a problem that depend on the traction."""
    none = jax.tree.map(lambda _: False, problem)
    return eqx.tree_at(lambda p: (p.dead[1], p.contacts.sample.imposed.end), none, (True, True))


def traced_solve(palpation: Palpation, load: Traction, solver: Newton) -> TracedState:
    """Solve under a traction inside a trace, with derivatives of any order to 1e-10."""
    problem = discretise(palpation, load, None, solver.face_rule)
    start = begin(problem.initial_state(), solver, True)
    frozen, settings = jax.lax.stop_gradient((problem, solver))

    def goes_on(s):
        return unfinished(s) & (s.path.length <= settings.max_path)

    end = jax.lax.while_loop(goes_on, lambda s: attempt(frozen, s, settings), jax.lax.stop_gradient(start))
    assert end.path.solves is not None
    _, state = follow_path(problem, start.state, end.path.solves, end.path.kept, settings)
    return TracedState(state.u, end.state.fraction)
