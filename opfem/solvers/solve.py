"""`solve`: a palpation under a load, by implicit statics or explicit dynamics."""

import functools
import warnings
from typing import Any, cast, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._device import memory
from ..model import Compression, Experiment, Imprint, Load, Palpation
from .compiling import QuickJit, compiled_meanwhile, is_traced
from .derivative import follow_path
from .discretise import check_compatible, discretise
from .equations import AbstractProblem, State
from .experiment import discretise_experiment, touching
from .explicit import Explicit, solve_explicit
from .newton import Newton
from .progress import Progress
from .recover import recover
from .recover_experiment import recover_experiment
from .solution import (
    RESULTS,
    AnySolution,
    ConvergenceError,
    ExperimentSolution,
    LastConverged,
    Solution,
    is_failure,
    judged,
)
from .stepping import Stepping, attempt, begin, outcome, unfinished

# Memory of an implicit solve per element [byte]: 1.1 GB on 100 × 100 × 6 elements, 2.6 GB on 200 × 200 × 6.
_BYTES_PER_ELEMENT = 10_000
# Compiling takes as long whatever the mesh.
_COMPILES = "the solver, about 10 s the first time"


@overload
def solve(
    palpation: Palpation,
    load: Load,
    solver: Newton | Explicit = ...,
    *,
    throw: bool = ...,
    start: Solution | None = ...,
    progress: bool = ...,
) -> Solution: ...


@overload
def solve(
    palpation: Experiment,
    load: Compression,
    solver: Newton = ...,
    *,
    throw: bool = ...,
    start: ExperimentSolution | None = ...,
    progress: bool = ...,
) -> ExperimentSolution: ...


def solve(
    palpation: Palpation | Experiment,
    load: Load | Compression,
    solver: Newton | Explicit = Newton(),
    *,
    throw: bool = True,
    start: Solution | ExperimentSolution | None = None,
    progress: bool = True,
) -> Solution | ExperimentSolution:
    """Solve a palpation, or an experiment with a deformable sample, under a load.

    Args:
        palpation: A `Palpation`, or an `Experiment`.
        load: `Imprint`, `Traction` or `Displacement` of a palpation; `Compression` of an experiment.
        solver: Method and settings: `Newton` (implicit statics) or `Explicit` (dynamics).
        throw: Raise where the solve fails. False: return NaN fields, the status in `result`
            and the last converged state in `last_converged`.
        start: Continue from this solution, with its friction history.
        progress: Show progress on a terminal, in a notebook or, for long solves, on stderr; never inside jit.

    Returns:
        The solution. `stats` contains `newton_steps`, `krylov_steps`, `increments`, `attempts`, `residual` (unbalanced
        force over contact force), `load_fraction`, `strain_energy` and `friction_dissipation` [N mm], `force_sample`,
        `force_window`, `force_hold` `(3,)` [N] on the layer, `moment_sample`, `moment_window`, `moment_hold` `(3,)` [N
        mm] about the origin, `work_sample`, `work_window` [N mm] done on the layer along the increments, `approach` and
        `max_penetration` and `side_overlap` [mm], `min_volume_ratio` [-], `min_stretch` and `max_stretch` (principal
        stretches, without volume change) and `unstable_stretch` [-] (stretch at which the material law becomes
        unstable, 0 if it is stable over the stretches reached). With a law from `calibrate` `beyond_calibration` [-]:
        relative excess of stretches over those of the tests, 0 within them. Of an experiment `force_sample` is that on
        the layer at its interface, `force_plate` and `work_plate` are the plate's on the sample.

    Raises:
        ValueError: If load and palpation are incompatible, or numbers are float32.
        ConvergenceError: If the solve fails and `throw` is True.
    """
    load_start = None if start is None else start.load
    check_compatible(palpation, load, load_start)
    if isinstance(solver, Explicit):
        if not isinstance(palpation, Palpation):
            raise ValueError("Explicit solves a Palpation, got an Experiment. Take Newton().")
        solution = judged(solve_explicit(palpation, cast(Any, load), solver, cast(Any, start), progress))
        return _raise_on_failure(solution, is_traced(solution)) if throw else solution
    solver = solver.as_leaves()
    first = None if start is None else start.last_converged.state
    if first is not None and not isinstance(first, State):
        raise ValueError("Newton continues what Newton solved, but start comes from Explicit. Use one solver for both.")
    require_float64("Newton", palpation=palpation, load=load, start=first, solver=solver)
    traced = is_traced((palpation, load, load_start, first, solver))
    run = _run_differentiable if traced else _run_with_progress
    if not traced:
        _check_memory(palpation)
    with Progress(progress and not traced) as bar:
        bar.stage("solver", compiles=_COMPILES)
        problem, initial = prepare(palpation, load, load_start, solver, first, traced)
        with compiled_meanwhile([] if traced else [(finish, (problem, initial, palpation, load))]):
            stepping = run(problem, initial, solver, bar)
        if isinstance(load, Imprint) and load.correct_approach:
            problem, stepping = _correct_approach(palpation, load, solver, problem, stepping, run, bar)
        bar.stage("fields")
        solution = judged(finish(problem, stepping, palpation, load))
    return _raise_on_failure(solution, traced) if throw else solution


def _check_memory(palpation: Palpation | Experiment) -> None:
    """Warn before a solve that needs more memory than is available."""
    elements = float(np.sum(np.prod(np.atleast_2d(palpation.elements), axis=1)))  # of one body, or of both
    needed, there = _BYTES_PER_ELEMENT * elements, memory()
    if there is not None and needed > there:
        warnings.warn(
            f"{elements:.3g} elements need about {needed / 1e9:.2g} GB of memory, there are {there / 1e9:.2g} GB. The "
            "machine may become slow or end the program: take fewer elements.",
            stacklevel=3,
        )


@functools.partial(QuickJit, once=True)
def prepare(palpation, load, load_start, solver, state: State | None, traced: bool) -> tuple[AbstractProblem, Stepping]:
    """Discretise a palpation or an experiment under a load, and initialise the load stepping at a state or at rest."""
    if isinstance(palpation, Experiment):
        problem = discretise_experiment(palpation, load, load_start, solver.face_rule)
    else:
        problem = discretise(palpation, load, load_start, solver.face_rule)
    initial = problem.initial_state()
    if state is None:
        stepping = begin(initial, solver, traced)
        if isinstance(palpation, Experiment):
            stepping = stepping._replace(before=touching(problem, initial, stepping.increments.size))
        return problem, stepping
    if jax.tree.structure(state) != jax.tree.structure(initial):
        raise ValueError(
            "A solve continues on the same faces, with the same kind of load: start has other contact, friction or "
            "mean stress than palpation and load. A Traction with lateral=[MPa] and without stiffness=[MPa/mm] does "
            "not rub; one with stiffness, or without lateral, does. Start from a solution of the same kind, or from "
            "none."
        )
    restarted = eqx.tree_at(lambda s: s.fraction, state, jnp.zeros_like(state.fraction))
    return problem, begin(restarted, solver, traced)


compiled_attempt = QuickJit(attempt)
_compiled_follow_path = QuickJit(follow_path)


def _run_with_progress(problem: AbstractProblem, stepping: Stepping, solver: Newton, bar: Progress) -> Stepping:
    while bool(unfinished(stepping)):
        stepping = compiled_attempt(problem, stepping, solver)
        fraction, snaps = float(stepping.state.fraction), ", snapping" if bool(stepping.snap.viscosity > 0) else ""
        bar.show(f"load {100 * fraction:.0f} %, {int(stepping.newton)} Newton steps{snaps}", fraction, estimate=True)
    return stepping


def _run_differentiable(problem: AbstractProblem, stepping: Stepping, solver: Newton, bar: Progress) -> Stepping:
    frozen, start, settings = jax.lax.stop_gradient((problem, stepping, solver))
    if is_traced((frozen, start, settings)):
        end = jax.lax.while_loop(unfinished, lambda s: attempt(frozen, s, settings), start)
    else:  # differentiated, but not part of a larger program
        end = _run_with_progress(frozen, start, settings, bar)
    assert end.path.solves is not None
    before, state = _compiled_follow_path(problem, stepping.state, end.path.solves, end.path.kept, settings)
    return end._replace(before=before, state=state, path=end.path._replace(solves=None))


def _correct_approach(palpation, load, solver, problem, stepping, run, bar) -> tuple[AbstractProblem, Stepping]:
    """Shift the rigid surface by the approach that its pressure causes, and solve again from this state."""
    for _ in range(2):
        offset = palpation.sample.law.zero_pressure_clearance - _approach(problem, stepping, load)
        shifted = eqx.tree_at(lambda p: p.contacts.sample.offset, problem, offset)
        # The surface moves by the approach only: one increment at the full load.
        again = begin(stepping.state, solver, run is _run_differentiable)
        state = eqx.tree_at(lambda s: s.fraction, stepping.state, 1.0 - again.increments.size)
        again = again._replace(
            state=state,
            before=state,
            origin=state,
            hold=again.hold._replace(can_release=stepping.hold.can_release, failed=stepping.hold.failed),
        )
        problem, stepping = shifted, _with_work_of(stepping, run(shifted, again, solver, bar))
    return problem, stepping


def _with_work_of(first: Stepping, second: Stepping) -> Stepping:
    """Add the counts of a first solve to those of a second one."""
    counts = second.increments._replace(
        attempts=first.increments.attempts + second.increments.attempts,
        accepted=first.increments.accepted + second.increments.accepted,
    )
    return second._replace(increments=counts, newton=first.newton + second.newton, krylov=first.krylov + second.krylov)


@QuickJit
def _approach(problem: Any, s: Stepping, load: Load) -> Array:
    return recover(problem, s.before, s.state, load).stats["approach"]


@QuickJit
def finish(problem: Any, s: Stepping, palpation: Any, load: Any) -> Any:
    """Build the solution from the final state of the load stepping."""
    ok = s.state.fraction >= 1.0
    counts = {
        "newton_steps": s.newton,
        "krylov_steps": s.krylov,
        "increments": s.increments.accepted,
        "attempts": s.increments.attempts,
        "residual": s.residual,
        "load_fraction": s.state.fraction,
    }

    def kept(field):
        return jnp.where(ok, field, jnp.nan) if jnp.issubdtype(field.dtype, jnp.inexact) else field

    last = LastConverged(s.state.unknowns.u, s.state.fraction, s.state)
    if isinstance(palpation, Experiment):
        return _finish_experiment(problem, s, palpation, load, counts, kept, last)
    fields = recover(problem, s.before, s.state, load)
    result = outcome(s)
    counts = {**counts, **fields.stretches}
    public = jax.tree.map(kept, (s.state.u, fields.sample, fields.window, fields.stress_zz, fields.stats))
    displacement, sample, window, stress_zz, stats = public
    return Solution(
        displacement=displacement,
        positions=problem.positions,
        sample=sample,
        window=window,
        thickness=eqx.tree_at(lambda m: m.values, fields.thickness, kept(fields.thickness.values)),
        stress_zz=stress_zz,
        stats={**counts, **stats},
        result=result,
        last_converged=last,
        palpation=palpation,
        load=load,
    )


def _finish_experiment(problem, s: Stepping, experiment, load, counts, kept, last) -> ExperimentSolution:
    fields = recover_experiment(problem, s.before, s.state, experiment, load)
    fields = eqx.tree_at(lambda f: f.thickness.values, fields, kept(fields.thickness.values))
    layer, sample, window, interface, plate, stats = jax.tree.map(
        kept, (fields.layer, fields.sample, fields.window, fields.interface, fields.plate, fields.stats)
    )
    reached = {"min_stretch": fields.layer.min_stretch, "max_stretch": fields.layer.max_stretch}
    return ExperimentSolution(
        layer=layer,
        sample=sample,
        window=window,
        interface=interface,
        plate=plate,
        thickness=fields.thickness,
        stats={**counts, **reached, **stats},
        result=outcome(s),
        last_converged=last,
        experiment=experiment,
        load=load,
    )


def _raise_on_failure(solution: AnySolution, traced: bool) -> AnySolution:
    failed = is_failure(solution.result)
    if traced:
        return solution.result.error_if(solution, failed)
    if bool(failed):
        reached = float(solution.last_converged.load_fraction)
        message = f"The solve stopped at {reached:.1%} of the load. {RESULTS[solution.result]}"
        unstable = float(solution.stats["unstable_stretch"])
        if unstable:
            message += f" The material law loses stability at a stretch of {unstable:.3g}, which elements had reached."
        raise ConvergenceError(message, solution)
    return solution


def require_float64(caller: str, **inputs: Any) -> None:
    """Raise ValueError for the first input whose numbers are not float64, with advice."""
    for name, part in inputs.items():
        for path, leaf in jax.tree_util.tree_leaves_with_path(part):
            if not eqx.is_inexact_array(leaf) or leaf.dtype == jnp.dtype("float64"):
                continue
            if jnp.zeros((), float).dtype == jnp.dtype("float64"):
                advice = "It was made while jax_enable_x64 was off, or cast since; build it again."
            else:
                advice = 'Before building the layer, run jax.config.update("jax_enable_x64", True) once.'
            place = ".".join([name, jax.tree_util.keystr(path, simple=True, separator=".")]).removesuffix(".")
            raise ValueError(f"{caller} needs float64 numbers, got {leaf.dtype} in {place}. {advice}")
