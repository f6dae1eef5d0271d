"""`fit_parameters`: friction, moduli and offsets from observations of plates or imprints pressed into the layer.

States are solved in sequence, each from the previous one. Levenberg–Marquardt steps of optimistix fit a few white
numbers, on the host, so that all states share the solver's compiled programs. The Jacobian is dense, a column per
number. First steps are on a coarser mesh, whose difference to the experiment's estimates the mesh error; the standard
deviations of the numbers include its effect.
"""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..inverse.observations import ForceReading, SideBulge
from ..inverse.parameters import AbstractNumberPrior, Normal, check_parameters
from ..inverse.result import FitError
from ..measurement import ThicknessMap
from ..measurement.oct import AxialIncrement
from ..model import Contact
from ..solvers import Newton
from ..solvers.progress import Progress
from ..solvers.solve import require_float64
from .levenberg_marquardt import Optimum, minimise, undamped_step
from .loaded_states import LoadPath, SolvedStates
from .objective import Experiment, Objective
from .result import SCALE, ParameterFit
from .state_residuals import source_of

# Shown on the progress line during compilation.
_COMPILES = "the solver, about 10 s the first time"
_COMPILES_DERIVATIVE = "the solver's derivative, about 15 s the first time"
_INSENSITIVE = 1e-3  # norm of a Jacobian column over the largest one, below which the data do not depend on a number
# Points of the priors, the best of which is the second start. From the medians 0.15 and 0.05, the fit of frictions 0.3
# and 0.2 ends in a local optimum without friction at the sample. The best as the first start is no better: 0.2 and 0.08
# then end at 0.56 and 0.
_STARTS = 8
_UNEXPLAINED = 2.0  # mean squared residual above which the fit is repeated from the second start
_IDENTICAL = 1e-10  # mm: states that differ by less are identical, to solver tolerance


def fit_parameters(
    experiment: Experiment,
    observations: Sequence[Any],
    parameters: Mapping[str, AbstractNumberPrior],
    *,
    scale: AbstractNumberPrior | None = None,
    model_std: float | None = None,
    solver: Newton = Newton(rtol=1e-7, krylov_rtol=1e-3),
    rtol: float = 0.05,
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
        scale: Prior of the factor of increments, fitted as "scale" where there are any; None: of mean 1 and of the
            largest `scale_std` of the increments.
        model_std: Standard deviation of computed increments due to the mesh [mm]. None: the mesh error of all computed
            values is estimated from one of two thirds of the elements along each axis, on which the fit begins. It is 0
            where a function solves, and on a single element.
        solver: Settings of the solves. A looser `rtol` changes increments by as much as the phase resolves; a looser
            `krylov_rtol` cuts the increments of stiff penalties (`HardOverclosure`).
        rtol: Error of the numbers over their standard deviations at which the fit has converged [-]. Where no step
            reduces the misfit any more, up to 2 suffices and is added to the standard deviations.
        max_steps: Limit of steps, shortened ones included.
        throw: Whether to raise where the fit does not converge.
        progress: Whether to show progress on a terminal, in a notebook or in a log.

    Raises:
        ValueError: For invalid observations or parameters.
        FitError: If a state cannot be solved at the priors' medians, or the fit does not converge and `throw`.
    """
    pairs = _pairs(observations)
    if not callable(experiment):
        require_float64("fit_parameters", palpation=experiment[0])
        check_parameters("fit_parameters", experiment[0], parameters)
    increments = [observed for _, observed in pairs if isinstance(observed, AxialIncrement)]
    if scale is None and increments:
        scale = Normal(1.0, max(float(one.scale_std) for one in increments))
    priors = {**parameters, **({SCALE: scale} if scale is not None and increments else {})}
    model = [_ratio(observed, model_std) for _, observed in pairs]
    fit = Objective(experiment, pairs, priors, model, solver)
    coarse = fit.on_coarser_mesh() if model_std is None else None
    with Progress(progress) as bar:
        bar.stage("states at the priors' medians", compiles=_COMPILES)
        white = jnp.zeros(len(priors))
        path = (coarse or fit).solve(white)
        if coarse and not path.reached:
            warnings.warn(
                "fit_parameters: the states cannot be solved on a coarser mesh, so that the standard deviations do not "
                "include the error of the mesh. Give it as model_std [mm].",
                stacklevel=2,
            )
            coarse, path = None, fit.solve(white)
        _check_first(pairs, path)
        bar.stage("fit of numbers", compiles=_COMPILES_DERIVATIVE)
        fitted = _minimised(fit, coarse, white, path, rtol, max_steps, bar)
        if not fitted.found.converged or float(jnp.mean(fitted.found.residual**2)) > _UNEXPLAINED:
            bar.stage("points of the priors")
            white, path = _other_start(coarse or fit, bar)
            bar.stage("fit from the best of them")
            other = _minimised(fit, coarse, white, path, rtol, max_steps, bar)
            steps = fitted.found.steps + other.found.steps
            fitted = min(fitted, other, key=lambda one: (not one.found.converged, one.found.misfit))
            fitted = fitted._replace(found=fitted.found._replace(steps=steps))
    found = fitted.found
    if throw and not found.converged:
        why, remedy = f"within max_steps={max_steps} steps", "Raise the limit"
        if found.stalled:
            why, remedy = "though no step reduces the misfit any more", _remedy_of_stall(experiment)
        if not fitted.path.reached:
            why, remedy = f"on the mesh of the experiment: {fitted.path.failure}", "Take a finer mesh"
        raise FitError(
            f"fit_parameters did not converge {why}. {remedy}, or centre the priors closer to the true values."
        )
    return _result(*fitted)


class _Fitted(NamedTuple):
    """A fit with its weights, its optimum, and the states there on the experiment's mesh."""

    fit: Objective
    found: Optimum
    path: LoadPath | SolvedStates


def _minimised(
    fit: Objective,
    coarse: Objective | None,
    white: Array,
    path: LoadPath | SolvedStates,
    rtol: float,
    max_steps: int,
    bar: Progress,
) -> _Fitted:
    """Minimise on a coarser mesh first, then on the experiment's, with the mesh error among the weights of both.

    Args:
        fit: The fit on the experiment's mesh.
        coarse: The same on a coarser one; None: steps are on the experiment's alone.
        white: The first point.
        path: States there, on the coarser mesh if there is one.
        rtol: Error of the numbers over their standard deviations at which it ends [-].
        max_steps: Limit of steps.
        bar: Progress.
    """
    steps = 0
    if coarse is not None:
        bar.stage("mesh error", compiles=_COMPILES)
        coarse = coarse.weighted(fit, white, path, fit.solve(white))
        bar.stage("fit on a coarser mesh", compiles=_COMPILES_DERIVATIVE)
        start = minimise(coarse, white, path, rtol, max_steps, bar)
        bar.stage("mesh error")
        white, path, steps = start.white, fit.solve(start.white), start.steps
        if not path.reached:
            return _Fitted(coarse, start._replace(converged=False), path)
        fit = fit.weighted(coarse, white, path, start.path)
    bar.stage("fit of numbers", compiles=_COMPILES_DERIVATIVE)
    found = minimise(fit, white, path, rtol, max_steps - steps, bar)
    return _Fitted(fit, found._replace(steps=steps + found.steps), found.path)


def _other_start(objective: Objective, bar: Progress) -> tuple[Array, LoadPath | SolvedStates]:
    """Return the point of lowest misfit among a few that are spread over the priors, with its states.

    The scale stays at its median: its prior is narrow, but moves all increments by more than their noise.
    """
    spread = jnp.asarray([name != SCALE for name in objective.priors], float)
    best, least, states = jnp.zeros_like(spread), np.inf, None
    for number, point in enumerate(spread * _spread_over_normal(_STARTS, spread.size)):
        path = objective.solve(point)
        misfit = float(jnp.sum(objective.residuals(point, path.states()) ** 2)) if path.reached else np.inf
        bar.show(f"point {number + 1} of {_STARTS}, misfit {misfit:.5g}")
        if misfit < least:
            best, least, states = point, misfit, path
    return best, states or objective.solve(best)


def _spread_over_normal(count: int, size: int) -> Array:
    """Spread points evenly over independent standard normal numbers, by Roberts' low-discrepancy sequence.

    Its generator is the root of `g**(size + 1) = g + 1`.
    """
    g = 2.0
    for _ in range(50):
        g = (1.0 + g) ** (1.0 / (size + 1))
    steps = jnp.arange(1, count + 1)[:, None] * g ** -jnp.arange(1.0, size + 1.0)
    return jax.scipy.stats.norm.ppf((0.5 + steps) % 1.0)


def _ratio(observed: Any, model_std: float | None) -> Array:
    """Return the standard deviation of computed values over that of the measured ones [-]."""
    if model_std is None or not isinstance(observed, AxialIncrement):
        return jnp.zeros(())
    return model_std / observed.std


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


def _remedy_of_stall(experiment: Experiment) -> str:
    """Say what makes computed values smooth in the numbers: multipliers of exact contact update at full load."""
    faces = () if callable(experiment) else (experiment[0].window, experiment[0].sample)
    if any(isinstance(face, Contact) and face.law.exact for face in faces):
        return "Press by a penalty, HardOverclosure(exact=False)"
    return "Solve with a smaller rtol"


def _check_first(pairs: list[tuple[int, Any]], path: LoadPath | SolvedStates) -> None:
    if not path.reached:
        raise FitError(f"fit_parameters: a state cannot be solved with the priors' medians: {path.failure}.")
    states = path.states()
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


def _result(fit: Objective, found: Optimum, path: LoadPath | SolvedStates) -> ParameterFit:
    white, J, names = found.white, found.J, tuple(fit.priors)
    data = J[: -len(names)]
    columns = np.asarray(jnp.sqrt(jnp.sum(data**2, axis=0)))
    covariance, mesh_covariance = fit.covariances(J)
    if found.stalled:
        step = undamped_step(found.residual, J)
        mesh_covariance += step * step[:, None]
    by_source: dict[str, list[Array]] = {}
    for (_, observed), values in zip(fit.pairs, fit.parts(white, found.path.states()), strict=True):
        by_source.setdefault(source_of(observed), []).append(values)
    return ParameterFit(
        names=names,
        priors=fit.priors,
        white=white,
        white_covariance=covariance,
        white_mesh_covariance=mesh_covariance,
        insensitive=tuple(np.array(names)[columns <= _INSENSITIVE * columns.max()].tolist()),
        residuals={name: jnp.concatenate(values) for name, values in by_source.items()},
        solutions=path.solutions(),
        converged=found.converged,
        steps=found.steps,
    )
