"""Matrix-free Jacobian of a fit's residuals, by few compiled programs driven from the host.

Load stepping, tangent, forward product and transposed product of an increment are one program each. Gauss–Newton steps,
CG iterations and posterior draws share them.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..model import Palpation, Traction
from ..optimise.conjugate_gradients import dot, plus
from ..solvers import derivative
from ..solvers.compiling import QuickJit
from ..solvers.derivative import Handed, Solve
from ..solvers.discretise import discretise
from ..solvers.equilibrium import Problem
from ..solvers.solve import compiled_attempt, finish, prepare
from .forward import Linearised, forward_solve, load_mask
from .objective import Objective
from .preconditioner import Unknowns


class Point:
    """Residuals at one point.

    Attributes:
        paths: Load path under the load of each map.
        residuals: Standardised residuals by source.
        heights: Height of the interface under each load [mm].
        in_equilibrium: Whether an equilibrium exists under every load.
        within_max_path: Whether all load paths are within `Newton.max_path`, the limit of the derivative.
    """

    def __init__(self, objective: Objective, white: Unknowns):
        """Solve under the loads of the unknowns."""
        solver, maps = objective.solver, jnp.arange(white.normal.shape[0])
        self.paths = [forward_solve(*_experiment(objective, white, i), solver=solver) for i in maps]
        self._at = _Evaluated(
            objective,
            white,
            jnp.stack([path.end.state.u for path in self.paths]),
            jnp.stack([path.end.state.fraction for path in self.paths]),
        )
        self.residuals, self.heights = _residuals(self._at)
        self.in_equilibrium = bool(jnp.all(self._at.fraction >= 1.0))
        self.within_max_path = all(int(path.end.path.kept) <= solver.max_path for path in self.paths)

    def jacobian(self) -> "Jacobian":
        """Linearise the residuals."""
        lines = [Linearised.along(path, self._at.objective.solver) for path in self.paths]
        J = Jacobian(self._at, lines, self.residuals, [])
        nothing = jax.tree.map(jnp.zeros_like, self._at.white)
        ones = [{**nothing.numbers, name: jnp.ones(())} for name in nothing.numbers]
        return dataclasses.replace(J, of_numbers=[J.mv(nothing._replace(numbers=one)) for one in ones])


class _Evaluated(NamedTuple):
    objective: Objective
    white: Unknowns
    u: Float[Array, "maps 3 mz my mx"]
    fraction: Float[Array, " maps"]


class Jacobian(eqx.Module):
    """Derivative of the residuals by white unknowns, as products.

    Attributes:
        at: The point and its solved states.
        maps: Derivative of the displacement under each load.
        residuals: Residuals at the point.
        of_numbers: Columns of fitted numbers: transposed products then need no transposed derivative by geometry and
            material.
    """

    at: _Evaluated
    maps: list[Linearised]
    residuals: dict[str, Any]
    of_numbers: list[dict[str, Any]]

    def mv(self, change: Unknowns) -> dict[str, Any]:
        """Compute the change of the residuals with a change of the unknowns."""
        moved = [
            line.push(*_of_problem(self.at, change, i)) for i, line in zip(self._numbered(), self.maps, strict=True)
        ]
        return _of_residuals(self.at, change, jnp.stack(moved))

    def transposed_mv(self, weights: dict[str, Any]) -> Unknowns:
        """Compute the transposed product with weights of the residuals."""
        weighted, of_u = _transposed_to_u(self.at, weights)
        for i, line in zip(self._numbered(), self.maps, strict=True):
            weighted = _transposed_to_white(self.at, line.pull(of_u[i]), i, weighted)
        numbers = {
            name: dot(column, weights) for name, column in zip(self.at.white.numbers, self.of_numbers, strict=True)
        }
        return weighted._replace(numbers=numbers)

    def _numbered(self) -> Array:
        return jnp.arange(len(self.maps))

    @property
    def T(self) -> "Transposed":
        """The transpose."""
        return Transposed(self)

    def in_structure(self) -> Unknowns:
        """Return shapes and types of the unknowns."""
        return jax.eval_shape(lambda: self.at.white)

    def out_structure(self) -> dict[str, Any]:
        """Return shapes and types of the residuals."""
        return jax.eval_shape(lambda: self.residuals)


class Transposed(eqx.Module):
    """The transpose of a `Jacobian`."""

    jacobian: Jacobian

    def mv(self, weights: dict[str, Any]) -> Unknowns:
        """Compute the product."""
        return self.jacobian.transposed_mv(weights)


def programs(objective: Objective, white: Unknowns) -> list[tuple[QuickJit, tuple]]:
    """List the programs of a fit, the longest compilation first, with arguments of their shapes."""
    i, maps = jnp.arange(1)[0], white.normal.shape[0]
    palpation, load = _experiment(objective, white, i)
    problem, start = prepare(palpation, load, None, objective.solver, None, False)
    u, reached = jnp.stack([start.state.u] * maps), jnp.stack([start.state.fraction] * maps)
    at = _Evaluated(objective, white, u, reached)
    (residuals, _), (moved, first) = _zeros(_residuals, at), _zeros(_of_problem, at, white, i)
    solve = Solve(start.origin, start.origin, start.snap.viscosity)
    varies = load_mask(problem)
    return [
        (compiled_attempt, (problem, start, objective.solver)),
        *derivative.programs(problem, solve, moved, first, varies, objective.solver),
        (finish, (problem, start, palpation, load)),
        (_transposed_to_u, (at, residuals)),
        (_of_residuals, (at, white, u)),
        (_residuals, (at,)),
        (_of_problem, (at, white, i)),
        (_transposed_to_white, (at, eqx.filter(problem, varies), i, white._replace(numbers={}))),
    ]


def _zeros(function: Callable, *arguments: Any) -> Any:
    return jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), eqx.filter_eval_shape(function, *arguments))


@QuickJit
def _experiment(objective: Objective, white: Unknowns, i: Array) -> tuple[Palpation, Traction]:
    return objective.experiment(white), objective.load(white, i)


@QuickJit
def _residuals(at: _Evaluated) -> tuple[dict[str, Any], Array]:
    return at.objective.residuals(at.white, at.u, at.fraction)


@QuickJit
def _of_problem(at: _Evaluated, change: Unknowns, i: Array) -> tuple[Problem, Handed]:
    """Compute the change of a map's discretised problem and initial state with the unknowns."""

    def problem(white):
        laid = _discretised(at.objective, white, i)
        start = laid.initial_state()
        varies = load_mask(laid) if not white.numbers else jax.tree.map(eqx.is_inexact_array, laid)
        return eqx.filter(laid, varies), Handed(start.unknowns, start.histories)

    return jax.jvp(problem, (at.white,), (change,))[1]


@QuickJit
def _of_residuals(at: _Evaluated, change: Unknowns, moved: Array) -> dict[str, Any]:
    """Compute the change of the residuals with unknowns and displacement."""
    return jax.jvp(lambda w, u: at.objective.residuals(w, u, at.fraction)[0], (at.white, at.u), (change, moved))[1]


@QuickJit
def _transposed_to_u(at: _Evaluated, weights: dict[str, Any]) -> tuple[Unknowns, Array]:
    """Compute the transposed product of `_of_residuals`, fitted numbers excepted."""

    def residuals(white, u):
        return at.objective.residuals(white._replace(numbers=at.white.numbers), u, at.fraction)[0]

    return jax.vjp(residuals, at.white._replace(numbers={}), at.u)[1](weights)


@QuickJit
def _transposed_to_white(at: _Evaluated, weights: Problem, i: Array, so_far: Unknowns) -> Unknowns:
    """Compute the transposed product of `_of_problem`, fitted numbers excepted."""

    def problem(white):
        laid = _discretised(at.objective, white._replace(numbers=at.white.numbers), i)
        return eqx.filter(laid, load_mask(laid))

    return plus(so_far, jax.vjp(problem, at.white._replace(numbers={}))[1](weights)[0])


def _discretised(objective: Objective, white: Unknowns, i: Array) -> Problem:
    return discretise(objective.experiment(white), objective.load(white, i), None, objective.solver.face_rule)
