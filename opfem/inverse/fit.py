"""`fit_traction`: the traction that explains measured maps, with its uncertainty (route B)."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from .._checks import as_leaf
from .._types import ScalarLike
from ..measurement import ThicknessMap
from ..mechanics.face import tributary_area
from ..model import Contact, Palpation
from ..solvers import ConvergenceError, Newton, Solution
from ..solvers.compiling import QuickJit, compiled_meanwhile
from ..solvers.progress import Progress
from ..solvers.solve import require_float64
from .bed import Bed, lay_bed, no_bed
from .conjugate_gradients import Learnt
from .data import AxialDisplacement, ForceReading
from .gauss_newton import GaussNewton, PreconditionedDescent
from .hyperparameters import most_likely, next_factor, rescaled
from .inputs import as_tuple, check_covered, check_inputs, stacked, stacked_maps
from .jacobian import Point, programs
from .misfit import Misfit, carried, moved, number_covariance, pressure_change
from .model_error import can_halve, mesh_error
from .observation import observe
from .parameters import AbstractNumberPrior
from .posterior import MOST_ITERATIONS, Posterior
from .preconditioner import Unknowns, fit_normal
from .prior import AbstractPrior, on_nodes
from .resolution import resolution
from .result import FitError, FitStatus, TractionFit
from .start import from_estimate, from_normal

Choice = Literal["given", "discrepancy", "evidence"]
# Relative gradient of each Gauss–Newton system, what is negligible (`PreconditionedDescent`), and most iterations.
_CG_RTOL = 1e-2
_CG_NEGLIGIBLE = 0.03
_CG_STEPS = 60
# The same with lateral tractions: where the window slips, little holds the layer, and no preconditioner knows it.
_CG_STEPS_LATERAL = 300
# Mean pressure over the shear modulus from which on the layer counts as pressed against its window.
_PRESSED = 1e-4
# Part of a direction below which a fit stalls.
_LEAST_PART = 5e-3
# A non-negative pressure bends towards zero below this part of the shear modulus.
_SOFTNESS = 0.05
# Draws of the posterior at a time: a draw waits for the host between programs of milliseconds. On 20×20×2 elements and
# two busy cores a fit takes 40 s instead of 54.
_DRAWS_AT_ONCE = 2
# What compiles, for the progress line.
_COMPILES = "the programs of a fit, about a minute the first time"
_COMPILES_HALF = "the solver on half the mesh, about 10 s the first time"
# Fits that look for a prior's hyper-parameters: most of them, and the relative change that ends them.
_MOST_CHOICES = 8
_CHOSEN = 0.05


def fit_traction(
    palpation: Palpation,
    thickness: ThicknessMap | Sequence[ThicknessMap],
    prior: AbstractPrior,
    *,
    parameters: Mapping[str, AbstractNumberPrior] | None = None,
    forces: ForceReading | Sequence[ForceReading] | None = None,
    inside: AxialDisplacement | Sequence[AxialDisplacement] | None = None,
    lateral: AbstractPrior | ArrayLike | None = None,
    nonnegative: bool = False,
    model_std: ScalarLike | None = None,
    hyperparameters: Choice = "given",
    start: ArrayLike | None = None,
    solver: Newton = Newton(max_path=12),
    rtol: float = 3e-3,
    max_steps: int = 50,
    draws: int = 16,
    key: PRNGKeyArray | None = None,
    throw: bool = True,
    progress: bool = True,
) -> TractionFit:
    """Find the traction on the interface that explains measured maps.

    Least squares over misfit and priors, by Gauss–Newton through the nonlinear solve with its friction history. The
    normal traction is fitted; the lateral one follows the sample's friction (`Traction`) unless `lateral` is given.
    The layer is pressed by springs near an imprint of the map, so that friction remembers the way of an imprint.

    Args:
        palpation: The experiment; its sample a `Contact`, its elements hexahedra.
        thickness: The measured map under load, with its `std`; masked pixels count for nothing. A sequence of maps
            on one pixel grid, each under another load from zero: each has its own traction, fitted numbers are shared.
        prior: What is known of the normal traction: `Matern`, `Tikhonov` or `TotalVariation`.
        parameters: Numbers of the experiment to fit as well, and what is known of them: by path, such as
            {"window.friction": LogNormal(0.15, 0.5)}, or "refractive_index" [-] (over the one that both maps were
            scaled with) and "l0_offset" [mm]. With a narrow prior: an uncertainty to allow for.
        forces: Reading of the total force under each map.
        inside: Displacements inside the layer under each map.
        lateral: The lateral traction `(2, ny+1, nx+1)` [MPa] where it is known, such as `traction[:2]` of an imprint:
            beside rubbing, a steep surface pushes sideways. Or the prior of each of its components: it is then fitted
            as well. A thickness map says little of it: `stats["lateral_informed"]` of the fit tells how much.
        nonnegative: Keep the pressure above zero.
        model_std: Standard deviation of the computed height [mm], independent from element to element: what the mesh
            misses, above all. Pixels are many, so that without it a coarse mesh is believed more than it deserves.
            None: the root mean square of `mesh_error` under the traction of a first fit, which then goes on; 0 where
            it cannot be estimated, for an odd or small number of elements along an axis. `stats["model_std"]` says it.
        hyperparameters: "given": the prior as it is. "discrepancy": its standard deviation (or weight) so that χ² of
            the map is what its noise makes it, the strongest prior that the data allow. "evidence": standard deviation
            and length so that the data are most likely (Laplace).
        start: Normal traction to start from [MPa], interface nodes `(ny+1, nx+1)` of this mesh or of a coarser one,
            such as the `normal` of a fit that takes minutes less; of each map where there are several. None: that
            of an imprint of the map or, where the layer does not take it, the linear estimate.
        solver: Settings of the forward solve; `max_path` bounds its increments.
        rtol: The fit has settled where the next step would change the residuals by less, over their norm [-]: about
            what is left to go over the posterior's standard deviations.
        max_steps: Most evaluations of the forward solve.
        draws: Draws of the posterior that standard deviations come from.
        key: Random key of the draws; None: always the same.
        throw: Raise where the fit fails. False: return what was reached, with its status.
        progress: Show a bar on a terminal or in a notebook.

    Returns:
        The fit. Where its χ² shows that the map contradicts the model, a warning says what to look at.

    Raises:
        ValueError: If the sample is no `Contact`, a map's std is missing or not positive, no pixel of a map lies on
            the layer, the prior's length is below the mesh, a parameter is unknown, or numbers are float32.
        FitError: If the fit fails and `throw` is True.
    """
    parameters = dict(sorted((parameters or {}).items()))  # as every PyTree has them
    maps = as_tuple(thickness)
    if lateral is not None and not isinstance(lateral, AbstractPrior):
        lateral = as_leaf(lateral, "fit_traction.lateral", "MPa")
    inputs = {"palpation": palpation, "thickness": maps, "prior": prior, "parameters": parameters, "lateral": lateral}
    require_float64("fit_traction", **inputs, forces=forces, inside=inside, solver=solver.as_leaves())
    check_inputs(palpation, maps, prior, lateral, parameters, as_tuple(inside))
    several = not isinstance(thickness, ThicknessMap)
    known_std = as_leaf(0.0 if model_std is None else model_std, "fit_traction.model_std", "mm")
    observations = _observe(palpation.mesh(), *stacked_maps(maps), known_std)
    check_covered(maps, observations)
    misfit = Misfit(
        palpation=palpation,
        observations=observations,
        prior=prior,
        lateral=lateral if isinstance(lateral, AbstractPrior) else None,
        known_lateral=None if isinstance(lateral, AbstractPrior) else lateral,
        parameters=parameters,
        forces=stacked("forces", forces, len(maps)),
        inside=stacked("inside", inside, len(maps)),
        softness=_SOFTNESS * palpation.layer.material.shear if nonnegative else None,
        bed=no_bed(palpation, observations, prior),
        solver=solver.as_leaves(),
    )
    key = jax.random.key(0) if key is None else key
    with Progress(progress) as bar:
        bar.stage("imprint", compiles=_COMPILES)
        run = _Run(misfit, rtol, max_steps, bar)
        given = None if start is None else from_normal(start, misfit)
        with compiled_meanwhile(programs(misfit, misfit.white(observations.surface))):
            bed = None if nonnegative else lay_bed(misfit.bed, palpation, observations, solver)
        reached = _settle(run, bed, given)
        if model_std is None and not _failed(reached):
            reached = _allowing_for_the_mesh(run, reached, maps)
        if not _failed(reached) and hyperparameters != "given":
            reached = _choose(run, reached, hyperparameters, draws, key)
        if throw and _failed(reached):
            raise FitError(f"The fit stopped after {run.solves} forward solves. {FitStatus[reached.result]}")
        fit = _result(reached, run, several, draws, key, bar)
    # The discrepancy principle holds a fit back on purpose.
    judged = bool(fit.result == FitStatus.successful) and hyperparameters != "discrepancy"
    if judged and fit.reduced_chi2 > 1.0 and fit.advice():
        warnings.warn(fit.advice(), stacklevel=2)
    return fit


class _Reached(NamedTuple):
    """Where a fit ended."""

    white: Unknowns
    residuals: dict[str, Any]
    point: Point
    posterior: Posterior
    result: FitStatus


def _failed(reached: _Reached) -> bool:
    return bool(reached.result != FitStatus.successful)


def _pressed(reached: _Reached, palpation: Palpation) -> Array:
    """Tell whether the layer is pressed against its window under every map, or cannot leave it."""
    if not isinstance(palpation.window, Contact):
        return jnp.asarray(True)
    area = tributary_area(palpation.mesh().positions()[:, -1])
    mean = jnp.sum(carried(reached.residuals) * area, axis=(1, 2)) / jnp.sum(area)
    return jnp.all(mean > _PRESSED * palpation.layer.material.shear)


class _Run:
    """A fit in progress: what it fits, and what it has spent."""

    def __init__(self, misfit: Misfit, rtol: float, max_steps: int, bar: Progress):
        self.misfit, self.rtol, self.max_steps, self.bar = misfit, rtol, max_steps, bar
        self.solves, self.iterations, self.steps = 0, 0, 0

    def fit(self, white: Unknowns) -> _Reached:
        """Go on from unknowns until the fit settles or fails."""
        misfit = self.misfit
        descent = PreconditionedDescent(
            fit_normal(misfit.palpation, misfit.observations, misfit.prior),
            jnp.asarray(_CG_RTOL),
            jnp.asarray(_CG_STEPS if misfit.lateral is None else _CG_STEPS_LATERAL),
            jnp.asarray(_CG_NEGLIGIBLE),
            jnp.asarray(misfit.hopeless),
        )
        # `atol` is a property, which optimistix declares as an argument.
        gauss_newton = GaussNewton(rtol=jnp.asarray(self.rtol), descent=descent)  # pyright: ignore[reportCallIssue]
        state = gauss_newton.begin(white)
        result = FitStatus.max_steps_reached
        for _ in range(self.max_steps):
            white, state = gauss_newton.look(self._evaluate, white, state)
            self.solves += 1
            inner = self.iterations + int(state.descent_state.iterations)
            loss, left = float(state.f_info.as_min()), float(state.descent_state.change)
            self.bar.show(f"step {self.solves}, misfit {loss:.5g}, {inner} inner iterations, {left:.2g} to go")
            result = _status(state, gauss_newton.settled(state))
            if result != FitStatus.max_steps_reached:
                break
        self.iterations += int(state.descent_state.iterations)
        self.steps += state.num_accepted_steps
        J = state.f_info.jac
        posterior = Posterior(white, J, Learnt(descent.precondition(J), state.descent_state.iterated))
        return _Reached(white, state.f_info.residual, state.aux["point"], posterior, result)

    def _evaluate(self, white: Unknowns) -> tuple[dict[str, Any], dict[str, Any], Callable]:
        point = Point(self.misfit, white)
        return (
            point.residuals,
            {"carried": point.carried, "followed": point.followed, "point": point},
            point.jacobian,
        )


def _status(state: Any, done: Array) -> FitStatus:
    """Tell how a fit has ended; `max_steps_reached` if it has not."""
    if not jnp.all(state.aux["followed"]):
        return FitStatus.too_many_increments
    if not jnp.all(state.aux["carried"]):
        return FitStatus.not_carried
    if not all(jnp.all(jnp.isfinite(v)) for v in (state.f_info.as_min(), *jax.tree.leaves(state.y_eval))):
        return FitStatus.nonfinite
    if done:
        return FitStatus.successful
    return FitStatus.stalled if state.search_state.step_size < _LEAST_PART else FitStatus.max_steps_reached


def _ways(misfit: Misfit, bed: Bed | None, given: Unknowns | None) -> Iterator[tuple[Bed, Unknowns]]:
    """Go through what a fit may rest on and start from, the most promising first."""
    if bed is not None:
        yield bed, misfit.white(bed.normal) if given is None else given
    yield misfit.bed, from_estimate(misfit) if given is None else given
    if misfit.prior.mean is not None:
        # The estimate pulls and presses harder than the layer takes: start from what the prior expects.
        yield misfit.bed, jax.tree.map(jnp.zeros_like, misfit.white(misfit.observations.surface))


def _settle(run: _Run, bed: Bed | None, given: Unknowns | None) -> _Reached:
    """Fit on springs, if there are any; where that fails under a dead load."""
    misfit = run.misfit
    for used, white in _ways(misfit, bed, given):
        run.misfit = eqx.tree_at(lambda m: m.bed, misfit, used)
        reached = run.fit(white)
        if not _failed(reached) and used is bed and not bool(_pressed(reached, misfit.palpation)):
            # Off its window, the layer rests on the springs alone.
            reached = reached._replace(result=FitStatus.not_carried)
        if not _failed(reached) or bool(reached.result == FitStatus.max_steps_reached):
            break
    return reached


def _allowing_for_the_mesh(run: _Run, reached: _Reached, maps: tuple[ThicknessMap, ...]) -> _Reached:
    """Go on with what the mesh misses counted as noise; as it was where that cannot be estimated."""
    misfit = run.misfit
    if not can_halve(misfit.palpation.elements):
        return reached
    run.bar.stage("mesh error", compiles=_COMPILES_HALF)
    try:
        errors = [mesh_error(way.solution(misfit.solver), misfit.solver) for way in reached.point.ways]
    except ConvergenceError:
        return reached
    model_std = jnp.sqrt(jnp.mean(jnp.stack(errors) ** 2))
    observations = _observe(misfit.palpation.mesh(), *stacked_maps(maps), model_std)
    run.misfit = eqx.tree_at(lambda m: m.observations, misfit, observations)
    return run.fit(reached.white)


_observe = QuickJit(jax.vmap(observe, in_axes=(None, 0, 0, None)))


def _draw(posterior: Posterior, key: PRNGKeyArray):
    """Draw deviations of the unknowns, of normal tractions [MPa] and of the interface [mm]; their share of the data."""
    white, residuals, iterations = posterior.draw(key)
    return white, carried(residuals), moved(residuals), jnp.sum(residuals["maps"] ** 2), iterations


def _choose(run: _Run, reached: _Reached, how: Choice, draws: int, key: PRNGKeyArray) -> _Reached:
    """Fit again under other hyper-parameters, each fit from the last, until they settle."""
    factor, tried = 0.0, []  # logarithm of what the standard deviation was multiplied with
    for _ in range(_MOST_CHOICES):
        misfit, prior = run.misfit, run.misfit.prior
        normal = carried(reached.residuals)
        if how == "evidence":
            around = [_draw(reached.posterior, one)[1] for one in jax.random.split(key, draws)]
            mean = on_nodes(prior, normal.shape[1:])
            chosen, change = most_likely(prior, (normal + jnp.stack(around) - mean).reshape(-1, *mean.shape), misfit)
        else:
            reduced = float(jnp.sum(reached.residuals["maps"] ** 2) / jnp.sum(misfit.observations.informed))
            tried.append((factor, np.log(max(reduced, 1e-12))))
            target = next_factor(tried)
            change, chosen, factor = abs(target - factor), rescaled(prior, np.exp(target - factor)), target
        run.misfit = eqx.tree_at(lambda m: m.prior, misfit, chosen)
        asking = run.misfit.white(misfit.asked(reached.white))
        reached = run.fit(asking._replace(numbers=reached.white.numbers, lateral=reached.white.lateral))
        if change < _CHOSEN or _failed(reached):
            break
    return reached


def _result(reached: _Reached, run: _Run, several: bool, draws: int, key: PRNGKeyArray, bar: Progress) -> TractionFit:
    misfit = run.misfit
    solutions = [way.solution(misfit.solver) for way in reached.point.ways]
    deviations, moves, whites, dof, iterations, cut_short = [], [], [], [], 0, 0
    keys = jax.random.split(key, draws)
    with ThreadPoolExecutor(max_workers=_DRAWS_AT_ONCE) as pool:
        drawn = pool.map(lambda one: _draw(reached.posterior, one), keys)
        for count, (white, normal, move, determined, steps) in enumerate(drawn):
            deviations.append(normal)
            moves.append(move)
            whites.append(white)
            dof.append(determined)
            iterations += int(steps)
            cut_short += int(steps) >= MOST_ITERATIONS
            bar.show(f"posterior, draw {count + 1} of {draws}", (count + 1) / draws)
    deviations = jnp.stack(deviations)
    pressures = _pressure_deviations(solutions, deviations, jnp.stack(moves))
    residual = reached.point.heights - misfit.observations.surface
    points, widths = resolution(reached.posterior, misfit)
    solution = jax.tree.map(lambda *v: jnp.stack(v), *solutions)

    def one_or_all(v):
        return v if several else jax.tree.map(lambda leaf: leaf[0], v)

    return TractionFit(
        solution=one_or_all(solution),
        pressure_std=one_or_all(_rms(pressures)),
        normal_std=one_or_all(_rms(deviations)),
        chi2=jnp.sum(reached.residuals["maps"] ** 2),
        effective_dof=jnp.mean(jnp.stack(dof)),
        observed=jnp.sum(misfit.observations.informed),
        residual=one_or_all(residual),
        resolution_points=points,
        resolution_width=one_or_all(widths),
        deviations=deviations if several else deviations[:, 0],
        number_covariance=number_covariance(reached.posterior),
        misfit=misfit,
        posterior=reached.posterior,
        stats={
            "forward_solves": run.solves,
            "gauss_newton_steps": run.steps,
            "inner_iterations": run.iterations,
            "posterior_iterations": iterations,
            "draws": draws,
            "draws_cut_short": cut_short,
            "std_error": 1.0 / (2.0 * draws) ** 0.5,
            "representation_rms": jnp.sqrt(jnp.mean(misfit.observations.representation_rms**2)),
            "model_std": misfit.observations.model_std[0],
            "misfit_rms": jnp.sqrt(jnp.mean(residual**2)),
            **misfit.informed(whites),
        },
        result=reached.result,
    )


def _pressure_deviations(
    solutions: list[Solution], deviations: Float[Array, "draws maps my mx"], moves: Float[Array, "draws maps 3 my mx"]
) -> Float[Array, "draws maps my mx"]:
    """Turn deviations of the normal traction into those of the pressure on the current area [MPa]."""
    each = [_changes(s, deviations[:, i], moves[:, i]) for i, s in enumerate(solutions)]
    return jnp.stack(each, axis=1)


@QuickJit
def _changes(s: Solution, deviations: Float[Array, "draws my mx"], moves: Float[Array, "draws 3 my mx"]) -> Array:
    def one(change, move):
        return pressure_change(s.palpation, s.traction, s.displacement[:, -1], change, move)

    return jax.vmap(one)(deviations, moves)


def _rms(deviations: Float[Array, "draws maps my mx"]) -> Float[Array, "maps my mx"]:
    return jnp.sqrt(jnp.mean(deviations**2, axis=0))
