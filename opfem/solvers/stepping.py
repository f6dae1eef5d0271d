"""Load stepping: increments with cut-back and growth, snap-through, and release of the in-plane hold.

One `attempt` is one equilibrium solve, accepted or not, as a pure function of its state. The solve loops over it on
the host (progress, interruption) or inside a trace.

Snap-through with viscous regularisation: at a limit point (a bulging side folds onto the window, an edge slips over a
ridge) no load increment is small enough. Viscous forces then stabilise solves at the full increment, and the viscosity
decreases as the motion decays. Only states without viscosity are accepted.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from ..mechanics.unfused import unfused
from .equations import AbstractProblem, HoldBalance, State
from .newton import Newton, solve_increment
from .solution import RESULTS
from .tangent import Unknowns

# The hold is released when friction can balance its force with this margin.
_RELEASE_MARGIN = 0.5
# Without the hold, an increment is cut down to this share of its full size before the hold is restored.
_LEAST_RELEASED = 0.2
# Increments cut down to this share of their full size are tried in the viscous medium, unless they
# are already below the second share.
_SNAP_SHARES = (0.26, 0.05)
# Viscosity of the medium: first, changed by this factor, counted as none below, given up above.
_FIRST_VISCOSITY = 1.5
_VISCOSITY_FACTOR = 3.0
_NO_VISCOSITY = 1e-6
_MOST_VISCOSITY = 100.0
# Relative residual that is enough on the way, over that of a result, and most Newton steps for it.
_VISCOUS_RTOL = 10.0
_VISCOUS_STEPS = 12
# Solves of one snap before it is given up.
_SNAP_SOLVES = 80
# Tolerance of gaps of hard contact over the size of an element: 1 nm, the resolution of the phase of OCT; and the
# relative reduction of the gap by an increment at full load that another one must follow.
_NO_GAP = 1e-5
_LEAST_SETTLING = 0.5
# A lateral force below this share of the normal one is balanced to round-off.
_BALANCED = 1e-4


class Path(NamedTuple):
    """Load path: equilibrium solves that led to a state, in arrays of fixed length."""

    x: Unknowns
    fraction: Float[Array, " n"]
    hold_active: Bool[Array, " n"]
    viscosity: Float[Array, " n"]


class Stepping(NamedTuple):
    """State of the load stepping.

    Attributes:
        state: Last converged state.
        before: Initial state of its solve.
        origin: Initial state of the next solve: `state`, or a viscous one during a snap-through.
        viscosity: Viscosity of the next solve, zero except during a snap-through [-].
        speed: Viscosity times the largest displacement of the last viscous solve [mm].
        increment: Next load increment [-].
        snap_solves: Solves of the current snap-through.
        attempts: Solves tried.
        increments: Increments accepted.
        newton: Newton steps of all increments.
        krylov: Preconditioner applications of all increments.
        residual: Relative residual of the last converged state.
        can_release: Whether friction could balance the hold force.
        release_failed: Whether an increment without the hold failed.
        slides: Whether the hold force has a lateral component at the last converged state.
        missed_gap: Gap or penetration of hard contact at the last converged state that more increments can
            reduce [mm].
        failed: Whether the solve has failed.
        exhausted: Whether the limit of increments was reached.
        path: Load path to `origin`, for derivatives; None without derivatives.
        length: Number of solves of `path` that led to `origin`.
        kept: Number of them that led to `state`.
    """

    state: State
    before: State
    origin: State
    viscosity: Float[Array, ""]
    speed: Float[Array, ""]
    increment: Float[Array, ""]
    snap_solves: Array
    attempts: Array
    increments: Array
    newton: Array
    krylov: Array
    residual: Array
    can_release: Array
    release_failed: Array
    slides: Array
    missed_gap: Float[Array, ""]
    failed: Array
    exhausted: Array
    path: Path | None
    length: Array
    kept: Array


def begin(state: State, settings: Newton, with_path: bool) -> Stepping:
    """Start at a converged state."""
    dtype = state.fraction.dtype
    none, zero, no = jnp.zeros((), int), jnp.zeros((), dtype), jnp.asarray(False)
    slot = Path(state.unknowns, zero, no, zero)
    path = jax.tree.map(lambda v: jnp.zeros((settings.max_path, *v.shape), v.dtype), slot)
    return Stepping(
        state=state,
        before=state,
        origin=state,
        viscosity=zero,
        speed=zero,
        increment=(1.0 / settings.increments) * jnp.ones((), dtype),
        snap_solves=none,
        attempts=none,
        increments=none,
        newton=none,
        krylov=none,
        residual=zero,
        can_release=no,
        release_failed=no,
        slides=no,
        missed_gap=zero,
        failed=no,
        exhausted=no,
        path=path if with_path else None,
        length=none,
        kept=none,
    )


def unfinished(s: Stepping) -> Array:
    """Return whether the load stepping continues."""
    releasable = s.state.hold_active & s.can_release & ~s.release_failed
    return ~s.failed & ((s.state.fraction < 1.0) | releasable | (s.missed_gap > 0))


def attempt(problem: AbstractProblem, s: Stepping, settings: Newton) -> Stepping:
    """Solve one load increment, or one viscous solve of a snap-through; restore the last state if it fails."""
    left = 1.0 - s.state.fraction
    increment = jnp.where(left < 1.01 * s.increment, left, s.increment)
    fraction = s.state.fraction + increment
    hold_active = (s.state.hold_active & ~(s.can_release & ~s.release_failed)) | s.release_failed
    snapping = (s.viscosity > 0) | (s.origin.fraction > s.state.fraction)
    span = s.state.fraction - s.before.fraction
    ahead = jnp.where((span > 0) & ~snapping, increment / jnp.where(span > 0, span, 1.0), 0.0)
    moved = jax.tree.map(jnp.subtract, s.state.unknowns, s.before.unknowns)
    moved = moved._replace(u=problem.project(moved.u, hold_active))
    guess = jax.tree.map(lambda v, d: v + ahead * d, s.origin.unknowns, moved)
    slowed = eqx.tree_at(lambda p: p.viscosity, problem, s.viscosity)
    on_the_way = (_VISCOUS_RTOL * settings.rtol, _VISCOUS_STEPS)
    limits = [
        jnp.where(s.viscosity > 0, *both) for both in zip(on_the_way, (settings.rtol, settings.max_steps), strict=True)
    ]
    result = solve_increment(
        slowed, s.origin, guess, fraction, hold_active, eqx.tree_at(lambda n: [n.rtol, n.max_steps], settings, limits)
    )
    can_release, slides = _hold_balance(problem.hold_balances(result.forces, result.state))
    missed_gap = problem.missed_gap(s.origin, result.state)
    none = s._replace(state=None, before=None, origin=None, path=None)
    trial = _Trial(
        increment=increment,
        hold_active=hold_active,
        snapping=snapping,
        converged=result.converged,
        steps=result.steps,
        furthest=_furthest(result.state.u, s.origin.u),
        missed_gap=missed_gap,
        no_gap=_NO_GAP * problem.element_depth,
    )
    next_s, (accepted, goes_on, moves_on) = unfused(_decided, none, trial, settings)
    state, before = _where(accepted, (result.state, s.origin), (s.state, s.before))
    origin = _where(goes_on, _where(trial.converged, result.state, s.origin), state)
    solved = Path(result.state.unknowns, fraction, hold_active, s.viscosity)
    return next_s._replace(
        state=state,
        before=before,
        origin=origin,
        newton=s.newton + result.steps,
        krylov=s.krylov + result.krylov,
        residual=jnp.where(accepted, result.residual, s.residual),
        can_release=jnp.where(accepted, can_release, s.can_release),
        slides=jnp.where(accepted, slides, s.slides),
        path=None if s.path is None else _recorded(s, moves_on, solved),
    )


class _Trial(NamedTuple):
    """Outcome of one equilibrium solve: see `Stepping`, `attempt` and `IncrementResult`."""

    increment: Array
    hold_active: Array
    snapping: Array
    converged: Array
    steps: Array
    furthest: Array
    missed_gap: Array
    no_gap: Array


def _decided(s: Stepping, trial: _Trial, settings: Newton) -> tuple[Stepping, tuple[Array, Array, Array]]:
    """Decide the next step from the scalars of one equilibrium solve (`unfused`, so that they are computed once).

    Returns:
        `Stepping` without states and derived quantities; whether the state is accepted, whether a snap-through
        continues, and whether the path is extended.
    """
    full = 1.0 / settings.increments
    ok, steps, increment = trial.converged, trial.steps, trial.increment
    accepted = ok & (s.viscosity == 0)

    viscosity, speed = _next_viscosity(s, trial)
    begins = ~ok & ~trial.snapping & (increment <= _SNAP_SHARES[0] * full) & (increment > _SNAP_SHARES[1] * full)
    viscosity = jnp.where(begins, _FIRST_VISCOSITY, viscosity)
    going = (viscosity <= _MOST_VISCOSITY) & (s.snap_solves < _SNAP_SOLVES)
    goes_on = begins | (trial.snapping & ~accepted & going)
    lost = ~accepted & ~goes_on
    # Without the hold and without convergence: cut the increment a few times, then restore the hold.
    lost_hold = lost & ~trial.hold_active & (increment < _LEAST_RELEASED * full)
    cut = jnp.where(lost & ~lost_hold, 0.5 * increment, increment)
    grown = jnp.minimum(1.5 * s.increment, full)
    grown = jnp.where(steps <= settings.max_steps // 2, grown, s.increment)

    moves_on = accepted | (goes_on & ok)
    length = jnp.where(moves_on, s.length + 1, jnp.where(goes_on, s.length, s.kept))
    settles = (increment > 0) | (trial.missed_gap < _LEAST_SETTLING * s.missed_gap)
    missed_gap = jnp.where(settles & (trial.missed_gap > trial.no_gap), trial.missed_gap, 0.0)
    attempts = s.attempts + 1
    exhausted = attempts >= settings.max_increments
    stepping = s._replace(
        viscosity=jnp.where(goes_on, viscosity, 0.0),
        speed=speed,
        increment=jnp.where(accepted, grown, cut),
        snap_solves=jnp.where(goes_on, s.snap_solves + 1, 0),
        attempts=attempts,
        increments=s.increments + accepted,
        release_failed=s.release_failed | lost_hold,
        missed_gap=jnp.where(accepted, missed_gap, s.missed_gap),
        failed=lost & ~lost_hold & (cut < settings.min_increment) | exhausted,
        exhausted=exhausted,
        length=length,
        kept=jnp.where(accepted, length, s.kept),
    )
    return stepping, (accepted, goes_on, moves_on)


def _recorded(s: Stepping, moves_on: Array, solve: Path) -> Path:
    """Append one solve to the path, if it is extended."""

    def write(slots, value):
        value = jnp.where(moves_on, value, slots[jnp.minimum(s.length, slots.shape[0] - 1)])
        return jax.lax.dynamic_update_index_in_dim(slots, value, s.length, axis=0)

    return jax.tree.map(write, s.path, solve)


def _next_viscosity(s: Stepping, trial: _Trial) -> tuple[Array, Array]:
    """Increase the viscosity after a failed viscous solve; decrease it where the motion decays."""
    ok, steps = trial.converged, trial.steps
    speed = s.viscosity * trial.furthest
    dies_out = (speed < s.speed) & (steps <= _VISCOUS_STEPS // 2)
    easily = steps <= _VISCOUS_STEPS // 4
    factor = jnp.where(easily, _VISCOSITY_FACTOR**2, _VISCOSITY_FACTOR)
    thinner = jnp.where(dies_out | (steps == 0), s.viscosity / factor, s.viscosity)
    thinner = jnp.where(thinner < _NO_VISCOSITY, 0.0, thinner)
    thicker = _VISCOSITY_FACTOR * jnp.maximum(s.viscosity, _NO_VISCOSITY)
    viscosity = jnp.where(ok, thinner, thicker)
    return jnp.where(trial.snapping, viscosity, 0.0), jnp.where(ok & trial.snapping, speed, 0.0)


def _where(condition: Array, new, old):
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def _furthest(u: PyTree, before: PyTree) -> Array:
    """Compute the largest displacement along one axis [mm]."""
    moves = jax.tree.map(lambda u, before: jnp.max(jnp.abs(u - before)), u, before)
    return functools.reduce(jnp.maximum, jax.tree.leaves(moves))


def _hold_balance(bodies: Sequence[HoldBalance]) -> tuple[Array, Array]:
    """Return whether friction could balance the hold force of every body, and whether that force exceeds round-off."""
    can = [(body.capacity > 0) & (body.hold <= _RELEASE_MARGIN * body.capacity) for body in bodies]
    slides = [body.hold > _BALANCED * body.normal for body in bodies]
    return functools.reduce(jnp.logical_and, can), functools.reduce(jnp.logical_or, slides)


def outcome(s: Stepping) -> RESULTS:
    """Return the status of the solve."""
    failure = RESULTS.where(s.exhausted, RESULTS.max_increments_reached, RESULTS.increment_too_small)
    failure = RESULTS.where(
        jnp.stack([jnp.all(jnp.isfinite(u)) for u in jax.tree.leaves(s.state.u)]).all(), failure, RESULTS.nonfinite
    )
    success = RESULTS.where(s.state.hold_active & s.slides, RESULTS.slides_off, RESULTS.successful)
    return RESULTS.where(s.state.fraction >= 1.0, success, failure)
