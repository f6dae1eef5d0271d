"""From a traction to the displacement: on the host with a cheap Jacobian, or traced with exact derivatives."""

from typing import NamedTuple

import equinox as eqx
import jax
from jaxtyping import Array, Float

from ..model import Palpation, Traction
from ..solvers import Solution
from ..solvers.derivative import Handed, Slot, Solve, follow_path, linearise, pull, push
from ..solvers.discretise import discretise
from ..solvers.equilibrium import Problem
from ..solvers.newton import Newton
from ..solvers.solution import judged
from ..solvers.solve import compiled_attempt, finish, prepare
from ..solvers.stepping import Stepping, attempt, begin, unfinished

Field = Float[Array, "3 mz my mx"]


class Pressed(NamedTuple):
    """The layer under a traction.

    Attributes:
        u: Displacement of its nodes [mm].
        reached: Load fraction that the solve reached [-].
    """

    u: Field
    reached: Array


class Way(NamedTuple):
    """How the layer went under a traction.

    Attributes:
        palpation: The experiment.
        load: The traction.
        problem: Both, discretised.
        end: Where the solve ended.
        solves: Those that led there.
    """

    palpation: Palpation
    load: Traction
    problem: Problem
    end: Stepping
    solves: list[Solve]

    def solution(self, solver: Newton) -> Solution:
        """Return the solution, first finding it where the solve was given up because of its length."""
        return judged(finish(self.problem, to_the_end(self.problem, self.end, solver), self.palpation, self.load))


def press(palpation: Palpation, load: Traction, solver: Newton) -> Way:
    """Solve under a traction, one increment after the other, by the program that every solve of this mesh shares.

    It ends where the solves are more than `Newton.max_path`, those on the way through a snap included.

    Args:
        palpation: The experiment.
        load: The traction.
        solver: Settings.
    """
    problem, s = prepare(palpation, load, None, solver, None, False)
    solves: list[Solve] = []
    while bool(unfinished(s)) and int(s.length) <= solver.max_path:
        before, s = s, compiled_attempt(problem, s, solver)
        if int(s.length) > int(before.length):
            solves.append(Solve(before.origin, s.origin, before.viscosity))
        else:
            del solves[int(s.length) :]
    return Way(palpation, load, problem, s, solves[: int(s.kept)])


def to_the_end(problem: Problem, s: Stepping, solver: Newton) -> Stepping:
    """Go on with a solve until it ends."""
    while bool(unfinished(s)):
        s = compiled_attempt(problem, s, solver)
    return s


class Linearised(eqx.Module):
    """The derivative of the displacement by the problem, first order and to 1e-4.

    Attributes:
        problem: The problem.
        slots: The solves that led to the displacement, linearised.
        solver: Settings of the solve.
    """

    problem: Problem
    slots: list[Slot]
    solver: Newton

    @classmethod
    def along(cls, way: Way, solver: Newton) -> "Linearised":
        """Linearise a way, one solve after the other."""
        return cls(way.problem, [Slot(solve, linearise(way.problem, solve)) for solve in way.solves], solver)

    def push(self, moved: Problem, first: Handed) -> Field:
        """Multiply a change of the problem, and of what the first solve starts from, with it."""
        return push(self.problem, self.slots, moved, first, self.solver).unknowns.u

    def pull(self, weights: Field) -> Problem:
        """Multiply weights of the displacement with its transpose by the load."""
        return pull(self.problem, self.slots, of_load(self.problem), weights, self.solver)


def of_load(problem: Problem) -> Problem:
    """Tell which numbers of a problem depend on the traction."""
    none = jax.tree.map(lambda _: False, problem)
    return eqx.tree_at(lambda p: (p.dead[1], p.contacts.sample.imposed.end), none, (True, True))


def press_exactly(palpation: Palpation, load: Traction, solver: Newton) -> Pressed:
    """Solve under a traction inside a trace; derivatives of any order, to 1e-10."""
    problem = discretise(palpation, load, None, solver.face_rule)
    start = begin(problem.initial_state(), solver, True)
    frozen, settings = jax.lax.stop_gradient((problem, solver))

    def goes_on(s):
        return unfinished(s) & (s.length <= settings.max_path)

    end = jax.lax.while_loop(goes_on, lambda s: attempt(frozen, s, settings), jax.lax.stop_gradient(start))
    assert end.path is not None
    _, state = follow_path(problem, start.state, end.path, end.kept, settings)
    return Pressed(state.u, end.state.fraction)
