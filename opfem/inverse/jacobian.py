"""The residuals of a fit and their Jacobian, by few compiled programs driven from the host.

A solve under a traction, the tangent of an increment, and the products of an increment with a change and with weights
are one program each: steps of the fit, inner iterations, draws and all else that is asked of the Jacobian share them.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..model import Palpation, Traction
from ..solvers import derivative
from ..solvers.compiling import QuickJit
from ..solvers.derivative import Handed, Solve
from ..solvers.discretise import discretise
from ..solvers.equilibrium import Problem
from ..solvers.solve import compiled_attempt, finish, prepare
from .conjugate_gradients import dot, plus
from .forward import Linearised, of_load, press
from .misfit import Misfit
from .preconditioner import Unknowns


class Point:
    """The residuals at one point.

    Attributes:
        ways: How the layer went under the load of each map.
        residuals: Standardised residuals by source.
        heights: Of the interface under each load [mm].
        carried: Whether the layer carries every load.
        followed: Whether derivatives follow all increments.
    """

    def __init__(self, misfit: Misfit, white: Unknowns):
        """Solve under the loads that unknowns stand for."""
        solver, maps = misfit.solver, jnp.arange(white.normal.shape[0])
        self.ways = [press(*_experiment(misfit, white, i), solver=solver) for i in maps]
        self._at = _At(
            misfit,
            white,
            jnp.stack([way.end.state.u for way in self.ways]),
            jnp.stack([way.end.state.fraction for way in self.ways]),
        )
        self.residuals, self.heights = _residuals(self._at)
        self.carried = bool(jnp.all(self._at.reached >= 1.0))
        self.followed = all(int(way.end.kept) <= solver.max_path for way in self.ways)

    def jacobian(self) -> "Jacobian":
        """Linearise here."""
        lines = [Linearised.along(way, self._at.misfit.solver) for way in self.ways]
        J = Jacobian(self._at, lines, self.residuals, [])
        nothing = jax.tree.map(jnp.zeros_like, self._at.white)
        ones = [{**nothing.numbers, name: jnp.ones(())} for name in nothing.numbers]
        return dataclasses.replace(J, of_numbers=[J.mv(nothing._replace(numbers=one)) for one in ones])


class _At(NamedTuple):
    misfit: Misfit
    white: Unknowns
    u: Float[Array, "maps 3 mz my mx"]
    reached: Float[Array, " maps"]


class Jacobian(eqx.Module):
    """The derivative of the residuals by white unknowns, known by its products.

    Attributes:
        at: The point.
        maps: Derivative of the displacement under each load.
        residuals: Residuals at the point.
        of_numbers: Derivative by each fitted number: with it, transposed products go without transposed derivatives by
            geometry and material.
    """

    at: _At
    maps: list[Linearised]
    residuals: dict[str, Any]
    of_numbers: list[dict[str, Any]]

    def mv(self, change: Unknowns) -> dict[str, Any]:
        """Multiply with a change of the unknowns."""
        moved = [
            line.push(*_of_problem(self.at, change, i)) for i, line in zip(self._numbered(), self.maps, strict=True)
        ]
        return _of_residuals(self.at, change, jnp.stack(moved))

    def transposed_mv(self, weights: dict[str, Any]) -> Unknowns:
        """Multiply weights of the residuals with the transpose."""
        weighted, of_u = _pulled_to_u(self.at, weights)
        for i, line in zip(self._numbered(), self.maps, strict=True):
            weighted = _pulled_to_white(self.at, line.pull(of_u[i]), i, weighted)
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
        """Multiply with it."""
        return self.jacobian.transposed_mv(weights)


def programs(misfit: Misfit, white: Unknowns) -> list[tuple[QuickJit, tuple]]:
    """List what a fit compiles, the longest first, with arguments of the right shapes, to compile it early."""
    i, maps = jnp.arange(1)[0], white.normal.shape[0]
    palpation, load = _experiment(misfit, white, i)
    problem, start = prepare(palpation, load, None, misfit.solver, None, False)
    u, reached = jnp.stack([start.state.u] * maps), jnp.stack([start.state.fraction] * maps)
    at = _At(misfit, white, u, reached)
    (residuals, _), (moved, first) = _zeros(_residuals, at), _zeros(_of_problem, at, white, i)
    solve = Solve(start.origin, start.origin, start.viscosity)
    varies = of_load(problem)
    return [
        (compiled_attempt, (problem, start, misfit.solver)),
        *derivative.programs(problem, solve, moved, first, varies, misfit.solver),
        (finish, (problem, start, palpation, load)),
        (_pulled_to_u, (at, residuals)),
        (_of_residuals, (at, white, u)),
        (_residuals, (at,)),
        (_of_problem, (at, white, i)),
        (_pulled_to_white, (at, eqx.filter(problem, varies), i, white._replace(numbers={}))),
    ]


def _zeros(function: Callable, *arguments: Any) -> Any:
    return jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), eqx.filter_eval_shape(function, *arguments))


@QuickJit
def _experiment(misfit: Misfit, white: Unknowns, i: Array) -> tuple[Palpation, Traction]:
    return misfit.experiment(white), misfit.load(white, i)


@QuickJit
def _residuals(at: _At) -> tuple[dict[str, Any], Array]:
    return at.misfit.residuals(at.white, at.u, at.reached)


@QuickJit
def _of_problem(at: _At, change: Unknowns, i: Array) -> tuple[Problem, Handed]:
    """Compute the change of a map's problem, and of what its first solve starts from."""

    def problem(white):
        laid = _laid(at.misfit, white, i)
        start = laid.initial_state()
        varies = of_load(laid) if not white.numbers else jax.tree.map(eqx.is_inexact_array, laid)
        return eqx.filter(laid, varies), Handed(start.unknowns, start.histories)

    return jax.jvp(problem, (at.white,), (change,))[1]


@QuickJit
def _of_residuals(at: _At, change: Unknowns, moved: Array) -> dict[str, Any]:
    """Compute the change of the residuals with the unknowns and with the displacement."""
    return jax.jvp(lambda w, u: at.misfit.residuals(w, u, at.reached)[0], (at.white, at.u), (change, moved))[1]


@QuickJit
def _pulled_to_u(at: _At, weights: dict[str, Any]) -> tuple[Unknowns, Array]:
    """Multiply with the transpose of `_of_residuals`, but for fitted numbers."""

    def residuals(white, u):
        return at.misfit.residuals(white._replace(numbers=at.white.numbers), u, at.reached)[0]

    return jax.vjp(residuals, at.white._replace(numbers={}), at.u)[1](weights)


@QuickJit
def _pulled_to_white(at: _At, weights: Problem, i: Array, so_far: Unknowns) -> Unknowns:
    """Multiply with the transpose of `_of_problem`, but for fitted numbers."""

    def problem(white):
        laid = _laid(at.misfit, white._replace(numbers=at.white.numbers), i)
        return eqx.filter(laid, of_load(laid))

    return plus(so_far, jax.vjp(problem, at.white._replace(numbers={}))[1](weights)[0])


def _laid(misfit: Misfit, white: Unknowns, i: Array) -> Problem:
    return discretise(misfit.experiment(white), misfit.load(white, i), None, misfit.solver.face_rule)
