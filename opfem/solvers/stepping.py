"""Load stepping: increments with cut-back and growth, and the release of the in-plane hold.

One `attempt` is one load increment tried, accepted or not, as a pure function of its carry; the
solve loops over it on the host (progress, interruption) or inside a trace.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .equilibrium import Problem, State
from .newton import Newton, solve_increment
from .solution import RESULTS

# Friction takes over from the hold when it can carry the hold's force with this much to spare.
_RELEASE_MARGIN = 0.5
# Without the hold, an increment is cut down to this share of its full size before the hold returns.
_LEAST_RELEASED = 0.2
# A lateral force below this share of the normal one counts as balanced.
_BALANCED = 1e-4


class Stepping(NamedTuple):
    """Progress of a solve.

    Attributes:
        state: Last converged state.
        before: The converged state that its increment started from.
        increment: Next load increment [-].
        attempts: Increments tried.
        increments: Increments accepted.
        newton: Newton steps of all increments.
        krylov: Preconditioner applications of all increments.
        residual: Relative residual of the last converged state.
        can_release: Whether friction could carry what the hold carries.
        release_failed: Whether a try without the hold failed.
        slides: Whether the hold carries a lateral force at the last converged state.
        failed: Whether the solve has given up.
        fractions: Load fraction of every accepted increment, NaN beyond.
    """

    state: State
    before: State
    increment: Float[Array, ""]
    attempts: Array
    increments: Array
    newton: Array
    krylov: Array
    residual: Array
    can_release: Array
    release_failed: Array
    slides: Array
    failed: Array
    fractions: Float[Array, " attempts"]


def begin(state: State, settings: Newton) -> Stepping:
    """Start at a converged state."""
    zero, no = jnp.zeros((), int), jnp.asarray(False)
    dtype = state.u.dtype
    return Stepping(
        state,
        state,
        (1.0 / settings.increments) * jnp.ones((), dtype),
        zero,
        zero,
        zero,
        zero,
        jnp.zeros((), dtype),
        no,
        no,
        no,
        no,
        jnp.full(settings.max_increments, jnp.nan, dtype),
    )


def unfinished(s: Stepping) -> Array:
    """Tell whether another increment is to be tried."""
    releasable = s.state.held & s.can_release & ~s.release_failed
    return ~s.failed & ((s.state.fraction < 1.0) | releasable)


def attempt(problem: Problem, s: Stepping, settings: Newton) -> Stepping:
    """Try one load increment; keep it if it converges, else return to the last state."""
    left = 1.0 - s.state.fraction
    increment = jnp.where(left < 1.01 * s.increment, left, s.increment)
    fraction = s.state.fraction + increment
    held = (s.state.held & ~(s.can_release & ~s.release_failed)) | s.release_failed
    span = s.state.fraction - s.before.fraction
    ahead = jnp.where(span > 0, increment / jnp.where(span > 0, span, 1.0), 0.0)
    guess = s.state.u + ahead * (s.state.u - s.before.u)
    result = solve_increment(problem, s.state, guess, fraction, held, settings)
    ok = result.converged
    can_release, slides = _hold_balance(problem, s.state, result.state)
    # Without the hold and without convergence: cut the increment a few times, then take the hold back.
    lost_hold = ~ok & ~held & (increment < _LEAST_RELEASED / settings.increments)
    cut = jnp.where(lost_hold, increment, 0.5 * increment)
    grown = jnp.minimum(1.5 * s.increment, 1.0 / settings.increments)
    grown = jnp.where(result.steps <= settings.max_steps // 2, grown, s.increment)
    chosen = jax.tree.map(lambda new, old: jnp.where(ok, new, old), (result.state, s.state), (s.state, s.before))
    attempts = s.attempts + 1
    return Stepping(
        state=chosen[0],
        before=chosen[1],
        increment=jnp.where(ok, grown, cut),
        attempts=attempts,
        increments=s.increments + ok,
        newton=s.newton + result.steps,
        krylov=s.krylov + result.krylov,
        residual=jnp.where(ok, result.residual, s.residual),
        can_release=jnp.where(ok, can_release, s.can_release),
        release_failed=s.release_failed | lost_hold,
        slides=jnp.where(ok, slides, s.slides),
        failed=~ok & ~lost_hold & (cut < settings.min_increment) | (attempts >= settings.max_increments),
        fractions=jnp.where((jnp.arange(settings.max_increments) == s.increments) & ok, fraction, s.fractions),
    )


def _hold_balance(problem: Problem, before: State, state: State) -> tuple[Array, Array]:
    """Compare what the hold carries with what friction could, and with the normal force."""
    forces = problem.reactions(problem.forces(state.u, state.fraction, before))
    hold = problem.hold_force(forces, state.held)
    X = problem.positions[:2, 0]
    arm = X - jnp.mean(X, axis=(1, 2), keepdims=True)
    radius = jnp.mean(jnp.sqrt(jnp.sum(arm**2, axis=0)))
    lateral = jnp.sum(hold, axis=(1, 2))
    moment = jnp.sum(arm[0] * hold[1] - arm[1] * hold[0]) / radius
    carried = jnp.sqrt(jnp.sum(lateral**2)) + jnp.abs(moment)
    capacity = jnp.zeros((), carried.dtype)
    for face, force in ((problem.window, forces.window), (problem.sample, forces.sample)):
        if face is not None:
            capacity = capacity + face.contact.friction * jnp.abs(jnp.sum(force[2]))
    normal = jnp.abs(jnp.sum(forces.sample[2]))
    return (capacity > 0) & (carried <= _RELEASE_MARGIN * capacity), carried > _BALANCED * normal


def outcome(s: Stepping) -> RESULTS:
    """Name how the solve ended."""
    stopped = s.attempts >= s.fractions.shape[0]
    failure = RESULTS.where(stopped, RESULTS.max_increments_reached, RESULTS.increment_too_small)
    failure = RESULTS.where(jnp.all(jnp.isfinite(s.state.u)), failure, RESULTS.nonfinite)
    success = RESULTS.where(s.state.held & s.slides, RESULTS.slides_off, RESULTS.successful)
    return RESULTS.where(s.state.fraction >= 1.0, success, failure)
