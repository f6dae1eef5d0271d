"""`fit_traction`: the traction that explains measured maps, with its uncertainty (route B)."""

import dataclasses
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PRNGKeyArray

from .._checks import as_leaf
from ..measurement import ThicknessMap
from ..mechanics.face import tributary_area
from ..model import Contact, Palpation
from ..optimise.conjugate_gradients import QuasiNewtonInverse, plus
from ..optimise.gauss_newton import GaussNewton, PreconditionedDescent
from ..solvers import ConvergenceError, Solution
from ..solvers.compiling import compiled_meanwhile
from ..solvers.progress import Progress
from ..solvers.solve import require_float64
from .discrepancy import next_factor
from .elastic_foundation import Imprinted, solve_imprints
from .inputs import as_tuple, check_inputs, presses, stacked, state_objective
from .jacobian import Point, programs
from .model_error import FollowedError, can_halve, followed_error
from .objective import Objective, interface_displacement, normal_traction
from .observations import AxialDisplacement, ForceReading
from .parameters import AbstractNumberPrior
from .preconditioner import Unknowns, fit_normal
from .prior import AbstractPrior, on_nodes
from .result import FitError, FitStatus, TractionFit
from .settings import FitSettings
from .uncertainty import (
    MAX_ITERATIONS,
    Posterior,
    local_size,
    number_covariance,
    pressure_deviations,
    resolution,
    root_mean_square,
    transmitting,
)
from .warm_start import from_linear_estimate, from_normal

# Shown on the progress line during compilation.
_COMPILES = "the programs of a fit, about a minute the first time"
_COMPILES_HALF = "the solver on half the mesh, about 10 s the first time"
# Limits of CG iterations, without and with a fitted lateral traction (`FitSettings.cg_steps`).
_CG_STEPS, _CG_STEPS_LATERAL = 60, 300
# Change of the residuals at which a fit has converged, without and with fitted numbers (`FitSettings.rtol`).
_RTOL, _RTOL_NUMBERS = 3e-2, 1e-2


def fit_traction(
    palpation: Palpation,
    thickness: ThicknessMap | Sequence[ThicknessMap],
    prior: AbstractPrior,
    *,
    parameters: Mapping[str, AbstractNumberPrior] | None = None,
    forces: ForceReading | Sequence[ForceReading] | None = None,
    inside: AxialDisplacement | Sequence[AxialDisplacement] | None = None,
    lateral: AbstractPrior | ArrayLike | Literal["imprint", "friction"] = "imprint",
    settings: FitSettings = FitSettings(),
    **changed: Any,
) -> TractionFit:
    """Find the traction on the interface that explains measured maps.

    Nonlinear least squares over misfit and priors, by Gauss–Newton through the nonlinear solve with its friction
    history. The normal traction is fitted; the lateral one is that of an imprint of the map unless `lateral` is
    given. An elastic foundation, at rest near this imprint, stabilises the forward solves.

    Args:
        palpation: The experiment; its sample a `Contact`, its elements hexahedra.
        thickness: The measured map under load, with its `std`; masked pixels are ignored. Or a sequence of maps on one
            pixel grid, each under another load from zero: each has its own traction, fitted numbers are shared.
        prior: Prior of the normal traction: `Matern`, `Tikhonov` or `TotalVariation`.
        parameters: Priors of numbers of the experiment that are fitted as well, by path, such as
            {"window.friction": LogNormal(0.15, 0.5)}, or "refractive_index" [-] (over the one that both maps were
            scaled with) and "l0_offset" [mm]. A narrow prior propagates the uncertainty of a known number.
        forces: Measured force under each map.
        inside: Displacements inside the layer under each map.
        lateral: "imprint": that of an imprint of the map, which includes the push of a steep surface along its
            normal, 14 % of the normal traction on the published coin. "friction": the sample's friction alone, as under
            a `Traction`; also where no imprint is solved, or the material or the sample's friction are fitted, which
            change the imprint. Or a known lateral traction `(2, ny+1, nx+1)` [MPa]. Or the prior of each component,
            which is then fitted; a thickness map identifies it poorly, see `stats["lateral_informed"]` of the fit.
        settings: Options and tuning, see `FitSettings`.
        **changed: Single settings by name, such as `draws=32`, in place of those in `settings`.

    Returns:
        The fit. A warning names possible causes where χ² shows that the map contradicts the model.

    Raises:
        ValueError: If the sample is no `Contact`, a map's std is missing or not positive, no pixel of a map lies on
            the layer, the prior's length is below the mesh, a parameter is unknown, or numbers are float32.
        TypeError: For the name of an unknown setting.
        FitError: If the fit fails and `throw` is True.
    """
    settings = settings.changed(**changed)
    maps = as_tuple(thickness)
    parameters = dict(sorted((parameters or {}).items()))  # the order of every PyTree
    if not isinstance(lateral, (AbstractPrior, str)):
        lateral = as_leaf(lateral, "fit_traction.lateral", "MPa")
    inputs = {"palpation": palpation, "thickness": maps, "prior": prior, "parameters": parameters, "lateral": lateral}
    require_float64("fit_traction", **inputs, forces=forces, inside=inside, solver=settings.solver.as_leaves())
    check_inputs(palpation, maps, prior, lateral, parameters, as_tuple(inside))
    readings = stacked("forces", forces, len(maps)), stacked("inside", inside, len(maps))
    objective = state_objective(palpation, maps, prior, parameters, *readings, lateral, settings)
    with Progress(settings.progress) as bar:
        bar.stage("imprint", compiles=_COMPILES)
        run = _Run(objective, settings, bar)
        given = None if settings.start is None else from_normal(settings.start, objective)
        with compiled_meanwhile(programs(objective, objective.white(objective.surfaces.surface))):
            imprinted = solve_imprints(palpation, objective.surfaces, settings.solver) if presses(settings) else None
        takes_lateral = isinstance(lateral, str) and objective.known_lateral is not None
        reached = _fit_with_fallbacks(run, imprinted, takes_lateral, given)
        if not _failed(reached) and settings.hyperparameters != "given":
            reached = _with_chosen_prior(run, reached)
        if settings.throw and _failed(reached):
            raise FitError(f"The fit stopped after {run.solves} forward solves. {FitStatus[reached.result]}")
        fit = _result(reached, run, several=not isinstance(thickness, ThicknessMap))
    # The discrepancy principle aims at a χ² above its optimum.
    judged = bool(fit.result == FitStatus.successful) and settings.hyperparameters != "discrepancy"
    if judged and fit.reduced_chi2 > 1.0 and fit.advice():
        warnings.warn(fit.advice(), stacklevel=2)
    return fit


class _Reached(NamedTuple):
    """State of the iteration at its end."""

    white: Unknowns
    residuals: dict[str, Any]
    point: Point
    posterior: Posterior
    result: FitStatus


def _failed(reached: _Reached) -> bool:
    return bool(reached.result != FitStatus.successful)


def _in_contact(reached: _Reached, palpation: Palpation, least: float) -> Array:
    """Return whether the layer is in contact with its window under every map; True for a bonded one."""
    if not isinstance(palpation.window, Contact):
        return jnp.asarray(True)
    area = tributary_area(palpation.mesh().positions()[:, -1])
    mean = jnp.sum(normal_traction(reached.residuals) * area, axis=(1, 2)) / jnp.sum(area)
    return jnp.all(mean > least * palpation.layer.material.shear)


class _Run:
    """A fit in progress: objective, settings, and counts of its work."""

    def __init__(self, objective: Objective, settings: FitSettings, bar: Progress):
        self.objective, self.settings, self.bar = objective, settings, bar
        self.key = jax.random.key(0) if settings.key is None else settings.key
        self.solves, self.iterations, self.steps = 0, 0, 0

    def fit(self, white: Unknowns) -> _Reached:
        """Iterate from unknowns until the fit converges or fails."""
        objective, settings = self.objective, self.settings
        limit = _CG_STEPS if objective.lateral is None else _CG_STEPS_LATERAL
        rtol = _RTOL_NUMBERS if objective.parameters else _RTOL
        descent = PreconditionedDescent(
            fit_normal(objective.palpation, objective.surfaces, objective.prior),
            jnp.asarray(settings.cg_rtol),
            jnp.asarray(limit if settings.cg_steps is None else settings.cg_steps),
            jnp.asarray(settings.cg_negligible),
            jnp.asarray(objective.infeasible),
        )
        # `atol` is a property, which optimistix declares as an argument.
        gauss_newton = GaussNewton(  # pyright: ignore[reportCallIssue]
            rtol=jnp.asarray(rtol if settings.rtol is None else settings.rtol),
            descent=descent,
            search=settings.line_search,
        )
        state = gauss_newton.begin(white)
        result = FitStatus.max_steps_reached
        for _ in range(settings.max_steps):
            white, state = gauss_newton.advance(self._evaluate, white, state)
            self.solves += 1
            inner = self.iterations + int(state.descent_state.iterations)
            loss, left = float(state.f_info.as_min()), float(state.descent_state.change)
            self.bar.show(
                f"step {self.solves}, misfit {loss:.5g}, {inner} inner iterations, remaining change {left:.2g}"
            )
            result = _status(state, gauss_newton.converged(state), settings.stall)
            if result != FitStatus.max_steps_reached:
                break
        self.iterations += int(state.descent_state.iterations)
        self.steps += state.num_accepted_steps
        J = state.f_info.jac
        posterior = Posterior(white, J, QuasiNewtonInverse(descent.precondition(J), state.descent_state.iterated))
        return _Reached(white, state.f_info.residual, state.aux["point"], posterior, result)

    def _evaluate(self, white: Unknowns) -> tuple[dict[str, Any], dict[str, Any], Callable]:
        point = Point(self.objective, white)
        return (
            point.residuals,
            {"in_equilibrium": point.in_equilibrium, "within_max_path": point.within_max_path, "point": point},
            point.jacobian,
        )


def _status(state: Any, done: Array, stall: float) -> FitStatus:
    """Return the status of a fit; `max_steps_reached` while it iterates."""
    if not jnp.all(state.aux["within_max_path"]):
        return FitStatus.too_many_increments
    if not jnp.all(state.aux["in_equilibrium"]):
        return FitStatus.no_equilibrium
    if not all(jnp.all(jnp.isfinite(v)) for v in (state.f_info.as_min(), *jax.tree.leaves(state.y_eval))):
        return FitStatus.nonfinite
    if done:
        return FitStatus.successful
    return FitStatus.stalled if state.search_state.step_size < stall else FitStatus.max_steps_reached


def _near(run: _Run, imprinted: Imprinted, takes_lateral: bool) -> Objective:
    """Put the elastic foundation to rest at the imprints, and apply their lateral traction."""
    objective, palpation = run.objective, run.objective.palpation
    stiffness = run.settings.foundation_stiffness * palpation.layer.material.shear
    foundation = dataclasses.replace(
        objective.foundation,
        stiffness=stiffness / jnp.mean(palpation.mesh().thickness),
        normal=-imprinted.traction[:, 2],
        uz=imprinted.uz,
    )
    lateral = imprinted.traction[:, :2] if takes_lateral else objective.known_lateral
    return dataclasses.replace(objective, foundation=foundation, known_lateral=lateral)


def _transmitting(run: _Run, given: Unknowns) -> Unknowns:
    """Find unknowns under which the foundation transmits the traction of given ones, to first order."""
    run.solves += 1
    point = Point(run.objective, given)
    missing = run.objective.applied(given) - normal_traction(point.residuals)
    return plus(given, transmitting(point.jacobian(), given, run.objective, missing)[0])


def _initial_guesses(objective: Objective, given: Unknowns | None) -> Iterator[Unknowns]:
    """Yield initial unknowns under a dead load, the most promising first."""
    yield from_linear_estimate(objective) if given is None else given
    if objective.prior.mean is not None:
        # No equilibrium exists under the linear estimate: start from the prior's mean.
        yield jax.tree.map(jnp.zeros_like, objective.white(objective.surfaces.surface))


def _fit_with_fallbacks(
    run: _Run, imprinted: Imprinted | None, takes_lateral: bool, given: Unknowns | None
) -> _Reached:
    """Fit on the elastic foundation, if imprints are solved; under a dead load where that fails."""
    objective = run.objective
    if takes_lateral:
        objective = dataclasses.replace(objective, known_lateral=None)  # of the dead load, without imprint
    if imprinted is not None:
        run.objective = _near(run, imprinted, takes_lateral)
        normal = run.objective.foundation.normal
        reached = run.fit(run.objective.white(normal) if given is None else _transmitting(run, given))
        if not _failed(reached) and not bool(_in_contact(reached, objective.palpation, run.settings.contact_pressure)):
            # The layer has lifted off its window, and the foundation alone balances the load.
            reached = reached._replace(result=FitStatus.no_equilibrium)
        if not _failed(reached) or bool(reached.result == FitStatus.max_steps_reached):
            return reached
    for white in _initial_guesses(objective, given):
        run.objective = objective
        reached = run.fit(white)
        if not _failed(reached) or bool(reached.result == FitStatus.max_steps_reached):
            break
    return reached


def _draw(posterior: Posterior, key: PRNGKeyArray):
    """Draw deviations of unknowns, normal tractions [MPa] and interface [mm]; and degrees of freedom of the maps."""
    white, residuals, iterations = posterior.draw(key)
    return (
        white,
        normal_traction(residuals),
        interface_displacement(residuals),
        jnp.sum(residuals["maps"] ** 2),
        iterations,
    )


def _with_chosen_prior(run: _Run, reached: _Reached) -> _Reached:
    """Alternate between hyper-parameters and fits, each from the last optimum, until they converge."""
    settings, spacing = run.settings, run.objective.palpation.mesh().spacing
    factor, tried = 0.0, []  # log factor of the standard deviation
    for _ in range(settings.hyperparameter_fits):
        objective, prior = run.objective, run.objective.prior
        normal = normal_traction(reached.residuals)
        if settings.hyperparameters == "evidence":
            keys = jax.random.split(run.key, settings.draws)
            around = [_draw(reached.posterior, one)[1] for one in keys]
            mean = on_nodes(prior, normal.shape[1:])
            samples = (normal + jnp.stack(around) - mean).reshape(-1, *mean.shape)
            chosen, change = prior.maximum_likelihood(samples, spacing, objective.palpation.extent)
        else:
            reduced = float(jnp.sum(reached.residuals["maps"] ** 2) / jnp.sum(objective.surfaces.informed))
            tried.append((factor, np.log(max(reduced, 1e-12))))
            target = next_factor(tried)
            change, chosen, factor = abs(target - factor), prior.scaled(np.exp(target - factor)), target
        run.objective = eqx.tree_at(lambda m: m.prior, objective, chosen)
        same = run.objective.white(objective.applied(reached.white))
        reached = run.fit(same._replace(numbers=reached.white.numbers, lateral=reached.white.lateral))
        if change < settings.hyperparameter_rtol or _failed(reached):
            break
    return reached


def _missed(run: _Run, reached: _Reached, solutions: list[Solution]) -> FollowedError:
    """Estimate the mesh error; 0 where it cannot be estimated, or a `model_std` is given."""
    if run.settings.model_std is None and can_halve(run.objective.palpation.elements):
        run.bar.stage("mesh error", compiles=_COMPILES_HALF)
        with suppress(ConvergenceError):
            return followed_error(reached.posterior, run.objective, solutions)
    nothing = jax.tree.map(jnp.zeros_like, reached.residuals)
    return FollowedError(jnp.zeros(()), normal_traction(nothing), interface_displacement(nothing))


def _result(reached: _Reached, run: _Run, several: bool) -> TractionFit:
    objective, draws = run.objective, run.settings.draws
    solutions = [path.solution(objective.solver) for path in reached.point.paths]
    deviations, moves, whites, dof, iterations, cut_short = [], [], [], [], 0, 0
    keys = jax.random.split(run.key, draws)
    with ThreadPoolExecutor(max_workers=run.settings.draws_at_once) as pool:
        drawn = pool.map(lambda one: _draw(reached.posterior, one), keys)
        for count, (white, normal, move, determined, steps) in enumerate(drawn):
            deviations.append(normal)
            moves.append(move)
            whites.append(white)
            dof.append(determined)
            iterations += int(steps)
            cut_short += int(steps) >= MAX_ITERATIONS
            run.bar.show(f"posterior, draw {count + 1} of {draws}", (count + 1) / draws)
    deviations = jnp.stack(deviations)
    pressures = pressure_deviations(solutions, deviations, jnp.stack(moves))
    missed, of_normal, of_interface = _missed(run, reached, solutions)
    normal_error = local_size(of_normal)
    pressure_error = local_size(pressure_deviations(solutions, of_normal[None], of_interface[None])[0])
    residual = reached.point.heights - objective.surfaces.surface
    points, widths = resolution(reached.posterior, objective)
    solution = jax.tree.map(lambda *v: jnp.stack(v), *solutions)

    def one_or_all(v):
        return v if several else jax.tree.map(lambda leaf: leaf[0], v)

    return TractionFit(
        solution=one_or_all(solution),
        pressure_std=one_or_all(jnp.hypot(root_mean_square(pressures), pressure_error)),
        normal_std=one_or_all(jnp.hypot(root_mean_square(deviations), normal_error)),
        mesh_std=one_or_all(pressure_error),
        chi2=jnp.sum(reached.residuals["maps"] ** 2),
        effective_dof=jnp.mean(jnp.stack(dof)),
        observed=jnp.sum(objective.surfaces.informed),
        residual=one_or_all(residual),
        resolution_points=points,
        resolution_width=one_or_all(widths),
        deviations=deviations if several else deviations[:, 0],
        number_covariance=number_covariance(reached.posterior),
        objective=objective,
        posterior=reached.posterior,
        stats={
            "forward_solves": run.solves,
            "gauss_newton_steps": run.steps,
            "inner_iterations": run.iterations,
            "posterior_iterations": iterations,
            "draws": draws,
            "draws_cut_short": cut_short,
            "std_error": 1.0 / (2.0 * draws) ** 0.5,
            "representation_rms": jnp.sqrt(jnp.mean(objective.surfaces.representation_rms**2)),
            "model_std": objective.surfaces.model_std[0],
            "mesh_error": missed,
            "misfit_rms": jnp.sqrt(jnp.mean(residual**2)),
            **objective.informed(whites),
        },
        result=reached.result,
    )
