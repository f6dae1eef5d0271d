"""What `fit_parameters` minimises: residuals of observed states by white numbers, on one mesh.

Where the experiment is known, a coarser mesh estimates the error of computed values, which then weighs the residuals
and widens the covariance.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..inverse.parameters import AbstractNumberPrior, with_numbers
from ..measurement.oct import AxialIncrement
from ..model import Load, Palpation
from ..solvers import Newton, Solution, solve
from .loaded_states import LoadedState, LoadPath, SolvedStates, can_follow, follow
from .result import SCALE
from .state_residuals import residual

# Elements of the mesh over those of the coarser one, along each axis. On 15×15×6 elements increments are 1.2 to 2.6 nm
# off for frictions up to 0.2, and 7.8 nm for 0.3 and 0.2; estimated from 10×10×4 as 2.0 to 4.6, and 10.8 nm.
_COARSER = 1.5

Experiment = Callable[[dict[str, Array]], tuple[Solution, ...]] | tuple[Palpation, Sequence[Load]]


@dataclasses.dataclass(frozen=True)
class Objective:
    """Residuals of an experiment's states by white numbers, their Jacobian, and the covariance that follows.

    Attributes:
        experiment: The experiment.
        pairs: Observations, each with the number of its state.
        priors: Priors of the numbers, by name.
        model: For each observation, the standard deviation of computed values over that of the measured ones [-].
        solver: Settings of the solves.
        errors: Estimated mesh error of each observation's computed values, over the same [-]; none: not estimated.
    """

    experiment: Experiment
    pairs: list[tuple[int, Any]]
    priors: dict[str, AbstractNumberPrior]
    model: list[Array]
    solver: Newton
    errors: tuple[Array, ...] = ()

    def numbers(self, white: Array) -> dict[str, Array]:
        """Return the numbers by name."""
        return {name: prior.number(white[place]) for place, (name, prior) in enumerate(self.priors.items())}

    def of_experiment(self, white: Array) -> dict[str, Array]:
        """Return the numbers of the experiment by name: all but the scale."""
        return {name: one for name, one in self.numbers(white).items() if name != SCALE}

    def solve(self, white: Array) -> LoadPath | SolvedStates:
        """Solve the states in sequence."""
        numbers = self.of_experiment(white)
        if callable(self.experiment):
            return SolvedStates(self.experiment, numbers, tuple(self.experiment(numbers)))
        palpation, loads = self.experiment
        if can_follow(loads):
            return follow(palpation, loads, numbers, self.solver)
        solved = functools.partial(_solved, palpation, loads, self.solver)
        return SolvedStates(solved, numbers, solved(numbers))

    def over_noise(self, white: Array, states: Sequence[LoadedState]) -> list[Array]:
        """Compute computed minus measured values of each observation over the noise [-]."""
        factor = self.numbers(white).get(SCALE, jnp.ones(()))
        return [residual(observed, state, states, factor) for state, observed in self.pairs]

    def parts(self, white: Array, states: Sequence[LoadedState]) -> list[Array]:
        """Compute the residuals of each observation [-]."""
        return [
            one / jnp.hypot(1.0, model) for one, model in zip(self.over_noise(white, states), self.model, strict=True)
        ]

    def residuals(self, white: Array, states: Sequence[LoadedState]) -> Array:
        """Compute all residuals, those of the priors last [-]."""
        return jnp.concatenate([*self.parts(white, states), white])

    def jacobian(self, white: Array, path: LoadPath | SolvedStates) -> Array:
        """Compute the derivative of the residuals by the white numbers."""
        basis, states = jnp.eye(white.size), path.states()
        moving = [one for name, one in zip(self.priors, basis, strict=True) if name != SCALE]
        changes = path.changes([jax.jvp(self.of_experiment, (white,), (one,))[1] for one in moving])
        if SCALE in self.priors:  # the last one; no state depends on it
            changes = jax.tree.map(lambda change: jnp.pad(change, [(0, 1)] + [(0, 0)] * (change.ndim - 1)), changes)

        def column(one, changes):
            return jax.jvp(self.residuals, (white, states), (one, changes))[1]

        return jax.vmap(column, out_axes=1)(basis, changes)

    def covariances(self, J: Array) -> tuple[Array, Array]:
        """Compute the covariance of the white numbers without the mesh error, and that of their changes with it.

        The estimate is more certain in its size than in its pattern. Where its parts have opposite effects on a number,
        the change with all of it is too small: the changes with its part in each region are added, as if independent.
        """
        inverse = jnp.linalg.inv(J.T @ J)
        if not self.errors:
            return inverse, jnp.zeros_like(inverse)
        regions = []
        for place, ((_, observed), one) in enumerate(zip(self.pairs, self.errors, strict=True)):
            region = jnp.full(one.size, 8 * place)
            if isinstance(observed, AxialIncrement):  # octants
                upper = observed.points > jnp.median(observed.points, axis=0)
                region += upper.astype(int) @ jnp.array([1, 2, 4])
            regions.append(region)
        errors = [one / jnp.hypot(1.0, model) for one, model in zip(self.errors, self.model, strict=True)]
        change = inverse @ J[: -len(inverse)].T * jnp.concatenate(errors)
        each = jax.ops.segment_sum(change.T, jnp.concatenate(regions), 8 * len(regions))
        whole = jnp.sum(each, axis=0)
        return inverse, each.T @ each + whole * whole[:, None]

    def covariance(self, J: Array) -> Array:
        """Compute the posterior covariance of the white numbers."""
        without, mesh = self.covariances(J)
        return without + mesh

    def on_coarser_mesh(self) -> "Objective | None":
        """Return the objective on fewer elements; None where a function solves, or there are none to leave out."""
        if callable(self.experiment):
            return None
        palpation, loads = self.experiment
        even = 2 if palpation.element == "tet10" else 1
        elements = tuple(even * int(np.ceil(n / (_COARSER * even))) for n in palpation.elements)
        if elements == palpation.elements:
            return None
        return dataclasses.replace(self, experiment=(dataclasses.replace(palpation, elements=elements), loads))

    def weighted(
        self, other: "Objective", white: Array, here: LoadPath | SolvedStates, there: LoadPath | SolvedStates
    ) -> "Objective":
        """Return the objective with the mesh error among its weights, by Richardson extrapolation of second order.

        Args:
            other: The objective on another mesh.
            white: The point of the estimate.
            here: States there.
            there: The same on the other mesh; where they are not reached, the objective stays as it is.
        """
        if not there.reached:
            return self
        assert not callable(self.experiment)
        assert not callable(other.experiment)
        count, others = (np.prod(palpation.elements) for palpation in (self.experiment[0], other.experiment[0]))
        share = 1.0 - float(count / others) ** (2.0 / 3.0)
        values = zip(self.over_noise(white, here.states()), other.over_noise(white, there.states()), strict=True)
        errors = tuple((a - b) / share for a, b in values)
        return dataclasses.replace(self, errors=errors, model=[jnp.sqrt(jnp.mean(one**2)) for one in errors])


def _solved(
    palpation: Palpation, loads: Sequence[Load], solver: Newton, numbers: dict[str, Array]
) -> tuple[Solution, ...]:
    palpation = with_numbers(palpation, numbers)
    states: list[Solution] = []
    for load in loads:
        start = states[-1] if states else None
        states.append(solve(palpation, load, solver, start=start, throw=False, progress=False))
    return tuple(states)
