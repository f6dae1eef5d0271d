"""States under loads that follow one another, and their derivatives by numbers of the experiment.

Solves and derivatives are few compiled programs, driven from the host: those of the traction fit. The solves of a load
path are linearised once; each number then takes one linear solve per solve.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..inverse.forward import ForwardSolve, forward_solve
from ..inverse.parameters import with_numbers
from ..model import Imprint, Load, Palpation, Traction
from ..model.mesh import LayerMesh
from ..solvers import Newton, Solution
from ..solvers.compiling import QuickJit
from ..solvers.derivative import Handed, Slot, Solve, linearise, push
from ..solvers.discretise import discretise
from ..solvers.equilibrium import Problem
from ..solvers.solution import is_failure

# Relative residual of the derivative's linear solves, and of each of their corrections, in float32. The increment
# between two states is a fiftieth of what each of them moves with a number, and a change of all moduli by one factor
# leaves it as it is: solved to 1e-5, its derivative by each modulus is 0.3 % off, which hides what a force says of it.
_RTOL, _CORRECTION_RTOL = 1e-7, 1e-4

Numbers = Mapping[str, Array]


class LoadedState(eqx.Module):
    """What observations see of a solved state.

    Attributes:
        mesh: The mesh.
        positions: Reference positions of the nodes [mm].
        displacement: Displacement of the nodes [mm].
        force: Force on the layer at the sample [N].
    """

    mesh: LayerMesh
    positions: Float[Array, "3 mz my mx"]
    displacement: Float[Array, "3 mz my mx"]
    force: Float[Array, "3"]


class LoadPath(NamedTuple):
    """States under loads that follow one another.

    Attributes:
        palpation: The experiment, before its numbers are set.
        numbers: Its numbers, by path.
        solves: Forward solve of each load.
        solver: Settings of the solves.
    """

    palpation: Palpation
    numbers: Numbers
    solves: list[ForwardSolve]
    solver: Newton

    @property
    def reached(self) -> bool:
        """Whether all loads were reached; else the last solve failed, and none followed."""
        return bool(self.solves[-1].end.state.fraction >= 1.0)

    @property
    def failure(self) -> str:
        """Which state was not reached."""
        return f"state {len(self.solves) - 1} reached {float(self.solves[-1].end.state.fraction):.0%} of its load"

    def states(self) -> list[LoadedState]:
        """Return what observations see of each state."""
        return [
            _loaded(self.palpation, self.numbers, one.problem, one.solves[-1], *_handed(one.solves[-1]))
            for one in self.solves
        ]

    def changes(self, directions: Sequence[Numbers]) -> list[LoadedState]:
        """Compute the change of each state along directions of the numbers, stacked, to a few 1e-4."""
        handed: list[Handed | None] = [None] * len(directions)
        changes, load_before = [], None
        for one in self.solves:
            slots = [Slot(solve, linearise(one.problem, solve), jnp.asarray(_CORRECTION_RTOL)) for solve in one.solves]
            along = []
            for place, direction in enumerate(directions):
                moved, rest = _of_problem(self.palpation, self.numbers, direction, one.load, load_before, self.solver)
                before = push(one.problem, slots[:-1], moved, handed[place] or rest, self.solver, _RTOL)
                end = push(one.problem, slots[-1:], moved, before, self.solver, _RTOL)
                at = self.palpation, self.numbers, direction, one.problem, one.solves[-1]
                along.append(_of_loaded(*at, moved, before, end))
                handed[place] = end
            changes.append(jax.tree.map(lambda *each: jnp.stack(each), *along))
            load_before = one.load
        return changes

    def solutions(self) -> tuple[Solution, ...]:
        """Return the solutions."""
        return tuple(one.solution(self.solver) for one in self.solves)


class SolvedStates(NamedTuple):
    """States that a function of the user's solves.

    Attributes:
        function: From numbers by name to solutions.
        numbers: The numbers.
        solved: The solutions.
    """

    function: Callable[[dict[str, Array]], tuple[Solution, ...]]
    numbers: dict[str, Array]
    solved: tuple[Solution, ...]

    @property
    def reached(self) -> bool:
        """Whether all solves succeeded."""
        return not any(bool(is_failure(one.result)) for one in self.solved)

    @property
    def failure(self) -> str:
        """Which state was not reached."""
        number, one = next((n, one) for n, one in enumerate(self.solved) if is_failure(one.result))
        return f"state {number} reached {float(one.last_converged.load_fraction):.0%} of its load"

    def states(self) -> list[LoadedState]:
        """Return what observations see of each state."""
        return [_seen(one) for one in self.solved]

    def changes(self, directions: Sequence[Numbers]) -> list[LoadedState]:
        """Compute the change of each state along directions of the numbers, stacked, by derivatives of the function."""

        def along(direction):
            def states(numbers):
                return [_seen(one) for one in self.function(numbers)]

            return jax.jvp(states, (self.numbers,), (direction,))[1]

        return jax.vmap(along)(jax.tree.map(lambda *each: jnp.stack(each), *directions))

    def solutions(self) -> tuple[Solution, ...]:
        """Return the solutions."""
        return self.solved


def _seen(one: Solution) -> LoadedState:
    return LoadedState(one.palpation.mesh(), one.positions, one.displacement, one.stats["force_sample"])


def can_follow(loads: Sequence[Load]) -> bool:
    """Return whether derivatives by linear solves of one correction are accurate under these loads.

    They are not where displacements are prescribed; a corrected approach solves once more from the last state.
    """

    def follows(load: Load) -> bool:
        return isinstance(load, Traction) or (isinstance(load, Imprint) and not load.correct_approach)

    return all(follows(load) for load in loads)


def follow(palpation: Palpation, loads: Sequence[Load], numbers: Numbers, solver: Newton) -> LoadPath:
    """Solve states under loads that follow one another.

    Args:
        palpation: The experiment.
        loads: The loads, in order.
        numbers: Numbers of the experiment, by path.
        solver: Settings.
    """
    solver = solver.as_leaves()
    solves: list[ForwardSolve] = []
    for load in loads:
        solves.append(forward_solve(with_numbers(palpation, numbers), load, solver, solves[-1] if solves else None))
        if solves[-1].end.state.fraction < 1.0:
            break
    return LoadPath(palpation, numbers, solves, solver)


def _handed(solve: Solve) -> tuple[Handed, Handed]:
    """Return what a solve starts from, and what it hands on."""
    before, after = (Handed(state.unknowns, state.histories) for state in (solve.before, solve.after))
    return before, after


@QuickJit
def _of_problem(
    palpation: Palpation, numbers: Numbers, direction: Numbers, load: Load, load_before: Load | None, solver: Newton
) -> tuple[Problem, Handed]:
    """Compute the change of the discretised problem, and of its state at rest, with changes of the numbers."""

    def problem(numbers):
        laid = discretise(with_numbers(palpation, numbers), load, load_before, solver.face_rule)
        rest = laid.initial_state()
        return eqx.filter(laid, eqx.is_inexact_array), Handed(rest.unknowns, rest.histories)

    return jax.jvp(problem, (numbers,), (direction,))[1]


@QuickJit
def _loaded(
    palpation: Palpation, numbers: Numbers, problem: Problem, solve: Solve, before: Handed, end: Handed
) -> LoadedState:
    """Evaluate what observations see at the end of a solve."""
    u, mean_stress = before.unknowns
    start = dataclasses.replace(solve.before, u=u, mean_stress=mean_stress, histories=before.histories)
    forces = problem.reactions(problem.forces(end.unknowns, solve.after.fraction, start))
    mesh = with_numbers(palpation, numbers).mesh()
    return LoadedState(mesh, problem.positions, end.unknowns.u, forces.applied.sample.total)


@QuickJit
def _of_loaded(
    palpation: Palpation,
    numbers: Numbers,
    direction: Numbers,
    problem: Problem,
    solve: Solve,
    moved: Problem,
    before: Handed,
    end: Handed,
) -> LoadedState:
    """Compute its change with changes of the numbers, of the problem, of the state before, and of the end."""

    def loaded(numbers, varied, before, end):
        return _loaded(palpation, numbers, eqx.combine(varied, problem), solve, before, end)

    at = (numbers, eqx.filter(problem, eqx.is_inexact_array), *_handed(solve))
    return jax.jvp(loaded, at, (direction, moved, before, end))[1]
