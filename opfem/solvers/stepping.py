"""Load stepping: increments with cut-back and growth, snap-through, and release of the in-plane hold.

One `attempt` is one equilibrium solve, accepted or not, as a pure function of its state. The solve loops over it on
the host (progress, interruption) or inside a trace.

Snap-through with viscous regularisation: at a limit point (a bulging side folds onto the window, an edge slips over a
ridge) no load increment is small enough. Viscous forces then stabilise solves at the full increment, and the viscosity
decreases as the motion decays. Only states without viscosity are accepted.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ..mechanics.unfused import unfused
from .equations import AbstractProblem, State
from .hold_release import HoldRelease
from .increments import Increments, Trial
from .load_path import Path, Recorded
from .newton import IncrementResult, Newton, solve_increment
from .snap_through import SnapThrough
from .solution import RESULTS
from .tangent import Unknowns

# Linear solves of an increment that was cut end at this part of `krylov_rtol`: with 3e-2 throughout, a layer of which
# three quarters are lifted off fails at 85 % of its load (problem 108 of `benchmarks/robustness.py`), and with a third
# of it a sample that slides off fails at 80 % (problem 44).
_CUT_KRYLOV = 0.1


class Stepping(NamedTuple):
    """State of the load stepping.

    Attributes:
        state: Last converged state.
        before: Initial state of its solve.
        origin: Initial state of the next solve: `state`, or a viscous one during a snap-through.
        increments: Load increments.
        hold: Release of the in-plane hold.
        snap: Snap-through.
        path: Load path to `origin`.
        newton: Newton steps of all increments.
        krylov: Preconditioner applications of all increments.
        residual: Relative residual of the last converged state.
    """

    state: State
    before: State
    origin: State
    increments: Increments
    hold: HoldRelease
    snap: SnapThrough
    path: Path
    newton: Array
    krylov: Array
    residual: Array


def begin(state: State, settings: Newton, with_path: bool) -> Stepping:
    """Start at a converged state."""
    dtype = state.fraction.dtype
    none, zero = jnp.zeros((), int), jnp.zeros((), dtype)
    return Stepping(
        state=state,
        before=state,
        origin=state,
        increments=Increments.begin(settings, dtype),
        hold=HoldRelease.begin(),
        snap=SnapThrough.begin(dtype),
        path=Path.begin(state.unknowns, zero, settings.max_path if with_path else None),
        newton=none,
        krylov=none,
        residual=zero,
    )


def unfinished(s: Stepping) -> Array:
    """Return whether the load stepping continues."""
    pending = s.hold.is_pending(s.state.hold_active)
    return ~s.increments.failed & ((s.state.fraction < 1.0) | pending | (s.increments.missed_gap > 0))


def attempt(problem: AbstractProblem, s: Stepping, settings: Newton) -> Stepping:
    """Solve one load increment, or one viscous solve of a snap-through; restore the last state if it fails."""
    increment = s.increments.ahead(s.state.fraction)
    fraction = s.state.fraction + increment
    hold_active = s.hold.is_active(s.state.hold_active)
    snapping = (s.snap.viscosity > 0) | (s.origin.fraction > s.state.fraction)
    guess = _extrapolated(problem, s, increment, hold_active, snapping)
    viscous = eqx.tree_at(lambda p: p.viscosity, problem, s.snap.viscosity)
    krylov_rtol = jnp.where(s.increments.is_cut(settings), _CUT_KRYLOV, 1.0) * settings.krylov_rtol
    limited = eqx.tree_at(
        lambda n: [n.rtol, n.max_steps, n.krylov_rtol], settings, [*s.snap.limits(settings), krylov_rtol]
    )
    result = solve_increment(viscous, s.origin, guess, fraction, hold_active, limited)
    trial = Trial(
        increment=increment,
        hold_active=hold_active,
        snapping=snapping,
        converged=result.converged,
        steps=result.steps,
        furthest=_furthest(result.state.u, s.origin.u),
        missed_gap=problem.missed_gap(s.origin, result.state),
        no_gap=settings.rtol * problem.element_depth,
    )
    return _updated(problem, s, trial, result, settings)


def _extrapolated(
    problem: AbstractProblem, s: Stepping, increment: Array, hold_active: Array, snapping: Array
) -> Unknowns:
    """Extrapolate the last increment linearly; during a snap-through start from the last viscous state."""
    span = s.state.fraction - s.before.fraction
    ahead = jnp.where((span > 0) & ~snapping, increment / jnp.where(span > 0, span, 1.0), 0.0)
    moved = jax.tree.map(jnp.subtract, s.state.unknowns, s.before.unknowns)
    moved = moved._replace(u=problem.project(moved.u, hold_active))
    return jax.tree.map(lambda v, d: v + ahead * d, s.origin.unknowns, moved)


def _updated(
    problem: AbstractProblem, s: Stepping, trial: Trial, result: IncrementResult, settings: Newton
) -> Stepping:
    """Accept the state of a solve, continue a snap-through from it, or restore the last state."""
    scalars = s._replace(state=None, before=None, origin=None, path=s.path._replace(solves=None))
    next_s, (accepted, snaps, extended) = unfused(_decided, scalars, trial, settings)
    state, before = _where(accepted, (result.state, s.origin), (s.state, s.before))
    solve = Recorded(result.state.unknowns, result.state.fraction, trial.hold_active, s.snap.viscosity)
    return next_s._replace(
        state=state,
        before=before,
        origin=_where(snaps, _where(trial.converged, result.state, s.origin), state),
        hold=next_s.hold.balanced(problem.hold_balances(result.forces, result.state), accepted),
        path=next_s.path._replace(solves=s.path.written(solve, extended)),
        newton=s.newton + result.steps,
        krylov=s.krylov + result.krylov,
        residual=jnp.where(accepted, result.residual, s.residual),
    )


def _decided(s: Stepping, trial: Trial, settings: Newton) -> tuple[Stepping, tuple[Array, Array, Array]]:
    """Decide the next step from the scalars of one equilibrium solve (`unfused`, so that they are computed once).

    Returns:
        `Stepping` without states and derived quantities; whether the state is accepted, whether a snap-through
        continues, and whether the path is extended.
    """
    full = jnp.asarray(1.0 / settings.increments)
    accepted = trial.converged & (s.snap.viscosity == 0)
    snap, snaps = s.snap.next(trial, accepted, full)
    lost = ~accepted & ~snaps
    hold, lost_hold = s.hold.next(trial, lost, full)
    increments = s.increments.next(trial, accepted, lost, lost_hold, full, settings)
    path, extended = s.path.next(accepted, snaps, trial.converged)
    return s._replace(snap=snap, hold=hold, increments=increments, path=path), (accepted, snaps, extended)


def _where(condition: Array, new, old):
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def _furthest(u: PyTree, before: PyTree) -> Array:
    """Compute the largest displacement along one axis [mm]."""
    moves = jax.tree.map(lambda u, before: jnp.max(jnp.abs(u - before)), u, before)
    return functools.reduce(jnp.maximum, jax.tree.leaves(moves))


def outcome(s: Stepping) -> RESULTS:
    """Return the status of the solve."""
    failure = RESULTS.where(s.increments.exhausted, RESULTS.max_increments_reached, RESULTS.increment_too_small)
    failure = RESULTS.where(
        jnp.stack([jnp.all(jnp.isfinite(u)) for u in jax.tree.leaves(s.state.u)]).all(), failure, RESULTS.nonfinite
    )
    success = RESULTS.where(s.state.hold_active & s.hold.slides, RESULTS.slides_off, RESULTS.successful)
    return RESULTS.where(s.state.fraction >= 1.0, success, failure)
