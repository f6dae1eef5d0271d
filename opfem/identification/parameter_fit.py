"""`fit_parameters`: friction, moduli and offsets from observations of plates or imprints pressed into the layer.

States are solved in sequence, each from the previous one. optimistix's Levenberg–Marquardt method fits a few white
numbers; its steps run on the host, so that all states share the solver's compiled programs.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from .._device import make_room
from ..inverse.observations import ForceReading, SideBulge
from ..inverse.parameters import AbstractNumberPrior, Normal, check_parameters, with_numbers
from ..inverse.result import FitError
from ..measurement import ThicknessMap
from ..measurement.oct import AxialIncrement
from ..model import Load, Palpation
from ..solvers import Newton, Solution, solve
from ..solvers.progress import Progress
from ..solvers.solution import is_failure
from ..solvers.solve import require_float64
from .state_residuals import residual, source_of

SCALE = "scale"
"""Name of the common factor of all increments: wavelength over refractive index, relative to the assumed ratio."""

# Shown on the progress line during compilation.
_COMPILES = "the solver, about 10 s the first time"
_COMPILES_DERIVATIVE = "the solver's derivative, about a minute the first time"
_STICK = 1  # status of a contact point
_INSENSITIVE = 1e-3  # norm of a Jacobian column over the largest one, below which the data do not depend on a number
_PRIOR_DOMINATED = 0.7  # posterior over prior standard deviation: the data halve the variance below it
_CORRELATED = 0.95  # correlation above which two numbers are identified only in combination
_CHI2 = 2.0  # per datum, above which the model does not explain a source
_IDENTICAL = 1e-10  # mm: states that differ by less are identical, to solver tolerance

Experiment = Callable[[dict[str, Array]], tuple[Solution, ...]] | tuple[Palpation, Sequence[Load]]


class ParameterFit(eqx.Module):
    """Numbers of an experiment fitted to observations.

    Attributes:
        names: Names of the fitted numbers; static.
        priors: Their priors, by name.
        white: Their values as standard normal numbers of their priors, in the order of `names` [-].
        numbers: Their values, by name.
        covariance: Posterior covariance of the numbers, in the order of `names`.
        prior_share: Posterior over prior standard deviation of the white number, by name [-].
        insensitive: Names of numbers that the observations do not depend on; static.
        residuals: Standardised residuals by source: "phase", "force", "thickness", "bulge" [-].
        solutions: The states at the optimum.
        converged: Whether the fit converged; static.
        steps: Number of steps; static.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    priors: dict[str, AbstractNumberPrior]
    white: Float[Array, " k"]
    numbers: dict[str, Array]
    covariance: Float[Array, "k k"]
    prior_share: dict[str, Array]
    insensitive: tuple[str, ...] = eqx.field(static=True)
    residuals: dict[str, Float[Array, " _"]]
    solutions: tuple[Solution, ...]
    converged: bool = eqx.field(static=True)
    steps: int = eqx.field(static=True)

    @property
    def std(self) -> dict[str, Array]:
        """Standard deviations by name."""
        return dict(zip(self.names, jnp.sqrt(jnp.diag(self.covariance)), strict=True))

    @property
    def correlation(self) -> Float[Array, "k k"]:
        """Correlation of the numbers [-]."""
        std = jnp.sqrt(jnp.diag(self.covariance))
        return self.covariance / std / std[:, None]

    def intervals(self, coverage: float = 0.95) -> dict[str, tuple[float, float]]:
        """Compute credible intervals of the numbers, by name.

        Args:
            coverage: Probability of an interval [-].
        """
        half = float(jax.scipy.stats.norm.ppf(0.5 + 0.5 * coverage))
        found = {}
        for name, white in zip(self.names, self.white, strict=True):
            ends = (self.priors[name].number(white + sign * half * self.prior_share[name]) for sign in (-1.0, 1.0))
            low, high = map(float, ends)
            found[name] = low, high
        return found

    @property
    def chi2(self) -> dict[str, Array]:
        """Sum of squared residuals by source [-]."""
        return {name: jnp.sum(values**2) for name, values in self.residuals.items()}

    def advice(self) -> list[str]:
        """Name poorly identified numbers and sources that the model does not explain."""
        said = []
        for name in self.names:
            if name != SCALE and (name in self.insensitive or float(self.prior_share[name]) > _PRIOR_DOMINATED):
                said.append(f"{name} is prior-dominated: the observations do not identify it.")
        correlation = np.asarray(self.correlation)
        for a in range(len(self.names)):
            for b in range(a):
                if abs(correlation[a, b]) > _CORRELATED:
                    said.append(
                        f"{self.names[b]} and {self.names[a]} are identified only in combination (correlation "
                        f"{correlation[a, b]:+.2f}). Mid-depth data do not separate two frictions: observe all depths, "
                        "or the force."
                    )
        for name, values in self.residuals.items():
            free = max(values.size - len(self.names), 1)
            if float(jnp.sum(values**2)) > _CHI2 * free and values.size > 1:
                said.append(
                    f"χ² of {name} is {float(jnp.sum(values**2)) / free:.1f} a datum: the model cannot explain it. Is "
                    "a fixed number wrong, such as the bulk modulus, or the mesh too coarse (model_std)?"
                )
        for face, name in (("window", "window.friction"), ("sample", "sample.friction")):
            status = np.stack([np.asarray(getattr(one, face).status) for one in self.solutions])
            if name in self.names and np.all(status <= _STICK):
                low = float(self.numbers[name] - 1.645 * self.std[name])
                said.append(f"The layer sticks to the {face} everywhere: friction is above {max(low, 0.0):.3g} (95 %).")
        return said


def fit_parameters(
    experiment: Experiment,
    observations: Sequence[Any],
    parameters: Mapping[str, AbstractNumberPrior],
    *,
    scale: AbstractNumberPrior = Normal(1.0, 0.01),
    model_std: float = 0.0,
    solver: Newton = Newton(rtol=1e-7),
    rtol: float = 1e-3,
    max_steps: int = 30,
    throw: bool = True,
    progress: bool = True,
) -> ParameterFit:
    """Fit numbers of an experiment to observations of its loaded states.

    Args:
        experiment: `(palpation, loads)`, the loads applied in sequence; or a function that returns the solved states
            from the numbers by name.
        observations: `AxialIncrement`s, which include their states; and pairs `(state, observation)` of a
            `ThicknessMap`, a `ForceReading` or a `SideBulge` with the number of its state, from 0.
        parameters: Prior of each number, by its path, such as "window.friction", "layer.material.bulk", "l0_offset";
            or by the names that the function expects.
        scale: Prior of the factor of increments, fitted as "scale" where there are any.
        model_std: Standard deviation of computed increments due to the mesh [mm].
        solver: Settings of the solves; a looser `rtol` changes increments by as much as the phase resolves.
        rtol: Change of the white numbers, and relative change of χ², at which the fit has converged.
        max_steps: Limit of steps.
        throw: Whether to raise where the fit does not converge.
        progress: Whether to show progress on a terminal, in a notebook or in a log.

    Raises:
        ValueError: For invalid observations or parameters.
        FitError: If a state cannot be solved at the priors' medians, or the fit does not converge and `throw`.
    """
    pairs = _pairs(observations)
    if not callable(experiment):
        require_float64("fit_parameters", palpation=experiment[0])
        check_parameters(experiment[0], parameters)
    priors = {**parameters}
    if any(isinstance(observed, AxialIncrement) for _, observed in pairs):
        priors[SCALE] = scale
    names = tuple(priors)

    def numbers_of(white: Array) -> dict[str, Array]:
        return {name: priors[name].number(white[place]) for place, name in enumerate(names)}

    def states_of(white: Array) -> tuple[Solution, ...]:
        return _solved(experiment, {name: one for name, one in numbers_of(white).items() if name != SCALE}, solver)

    def parts(white: Array, states: tuple[Solution, ...]) -> list[Array]:
        factor = numbers_of(white).get(SCALE, jnp.ones(()))
        return [residual(observed, state, states, factor, model_std) for state, observed in pairs]

    def residuals(white: Array, _: Any = None) -> tuple[Array, None]:
        return jnp.concatenate([*parts(white, states_of(white)), white]), None

    white = jnp.zeros(len(names))
    with Progress(progress) as bar:
        bar.stage("states at the priors' medians", compiles=_COMPILES)
        states = states_of(white)
        _check_first(pairs, states)
        data = sum(one.size for one in parts(white, states))
        bar.stage("fit of numbers", compiles=_COMPILES_DERIVATIVE)
        white, steps, converged = _least_squares(residuals, white, data, rtol, max_steps, bar)
        if throw and not converged:
            raise FitError(
                f"fit_parameters did not converge within max_steps={max_steps} steps. Raise the limit, or centre the "
                "priors closer to the true values."
            )
        bar.stage("posterior")
        _, along = jax.linearize(lambda w: residuals(w)[0], white)
        J = jax.vmap(along)(jnp.eye(len(names))).T
        states = states_of(white)
    return _fitted(priors, numbers_of, white, J, pairs, parts(white, states), states, converged, steps)


def _pairs(observations: Sequence[Any]) -> list[tuple[int, Any]]:
    pairs = []
    for one in observations:
        state, observed = one if isinstance(one, tuple) else (0, one)
        is_increment = isinstance(observed, AxialIncrement)
        if not is_increment and not isinstance(observed, ThicknessMap | ForceReading | SideBulge):
            raise ValueError(
                "fit_parameters.observations must be AxialIncrement(...), or (state, ThicknessMap | ForceReading | "
                f"SideBulge), got {type(observed).__name__}."
            )
        if not is_increment and not isinstance(one, tuple):
            raise ValueError(
                f"fit_parameters: state the number of the observed state, as (0, {type(observed).__name__}(...)) for "
                "the first."
            )
        pairs.append((state, observed))
    if not pairs:
        raise ValueError("fit_parameters.observations must contain an observation, got none.")
    return pairs


def _solved(experiment: Experiment, numbers: dict[str, Array], solver: Newton) -> tuple[Solution, ...]:
    if callable(experiment):
        return tuple(experiment(numbers))
    palpation, loads = experiment
    palpation = with_numbers(palpation, numbers)
    states: list[Solution] = []
    for load in loads:
        start = states[-1] if states else None
        states.append(solve(palpation, load, solver, start=start, throw=False, progress=False))
    return tuple(states)


def _check_first(pairs: list[tuple[int, Any]], states: tuple[Solution, ...]) -> None:
    for number, state in enumerate(states):
        if bool(is_failure(state.result)):
            raise FitError(
                f"fit_parameters: state {number} cannot be solved with the priors' medians; it reached "
                f"{float(state.last_converged.load_fraction):.0%} of its load."
            )
    for state, observed in pairs:
        wanted = [observed.before, observed.after] if isinstance(observed, AxialIncrement) else [state]
        if not all(0 <= one < len(states) for one in wanted):
            raise ValueError(
                f"fit_parameters: an observation is of state {max(wanted)}; there are {len(states)}, from 0."
            )
        if isinstance(observed, AxialIncrement):
            before, after = (states[one].displacement for one in wanted)
            if float(jnp.max(jnp.abs(after - before))) < _IDENTICAL:
                raise ValueError(
                    f"fit_parameters: states {wanted[0]} and {wanted[1]} are identical; increments need two."
                )


def _least_squares(
    residuals: Any, white: Array, data: int, rtol: float, max_steps: int, bar: Progress
) -> tuple[Array, int, bool]:
    """Run Levenberg–Marquardt on the host: a traced loop would compile the solves of all states as one program."""
    method = optx.LevenbergMarquardt(rtol=rtol, atol=rtol)
    shape = jax.ShapeDtypeStruct((data + white.size,), white.dtype)
    state = method.init(residuals, white, None, {}, shape, None, frozenset())
    for step in range(max_steps):
        white, state, _ = method.step(residuals, white, None, {}, state, frozenset())
        bar.show(f"step {step + 1}, misfit {float(state.f_info.as_min()):.5g}")
        done, _ = method.terminate(residuals, white, None, {}, state, frozenset())
        if bool(done):
            return white, step + 1, True
        make_room()  # every step loads its linearised solves anew
    return white, max_steps, False


def _fitted(priors, numbers_of, white, J, pairs, end, states, converged, steps) -> ParameterFit:
    names = tuple(priors)
    data = J[: J.shape[0] - len(names)]
    columns = np.asarray(jnp.sqrt(jnp.sum(data**2, axis=0)))
    inverse = jnp.linalg.inv(J.T @ J)
    slope = jnp.diag(jax.jacfwd(lambda w: jnp.stack(list(numbers_of(w).values())))(white))
    by_source: dict[str, list[Array]] = {}
    for (_, observed), values in zip(pairs, end, strict=True):
        by_source.setdefault(source_of(observed), []).append(values)
    return ParameterFit(
        names=names,
        priors=priors,
        white=white,
        numbers=numbers_of(white),
        covariance=slope * inverse * slope[:, None],
        prior_share=dict(zip(names, jnp.sqrt(jnp.diag(inverse)), strict=True)),
        insensitive=tuple(np.array(names)[columns <= _INSENSITIVE * columns.max()].tolist()),
        residuals={name: jnp.concatenate(values) for name, values in by_source.items()},
        solutions=states,
        converged=converged,
        steps=steps,
    )
