"""Decisions of the load stepping by scalars alone: increments, snap-through, release of the hold, load path."""

import jax.numpy as jnp
import pytest

import opfem as op
from opfem.solvers.hold_release import HoldRelease
from opfem.solvers.increments import Increments, Trial
from opfem.solvers.load_path import Path
from opfem.solvers.snap_through import SnapThrough

SETTINGS = op.Newton(increments=4).as_leaves()
YES, NO = jnp.asarray(True), jnp.asarray(False)
FULL = jnp.asarray(0.25)


def trial(**changes):
    """A converged increment of quarter load in three steps, without contact gap."""
    numbers = {"increment": 0.25, "hold_active": False, "snapping": False, "converged": True, "steps": 3}
    numbers |= {"furthest": 0.01, "missed_gap": 0.0, "no_gap": 1e-6}
    return Trial(**{name: jnp.asarray(value) for name, value in (numbers | changes).items()})


def increments(size=0.25, **changes):
    start = Increments.begin(SETTINGS, jnp.dtype(float))._replace(size=jnp.asarray(size))
    return start._replace(**{name: jnp.asarray(value) for name, value in changes.items()})


def test_increment_is_cut_after_a_failure_and_grows_to_full_size_after_easy_solves():
    failed = increments().next(trial(converged=False), NO, YES, NO, FULL, SETTINGS)
    assert failed.size == 0.125
    assert (failed.attempts, failed.accepted) == (1, 0)
    easy = failed.next(trial(increment=0.125), YES, NO, NO, FULL, SETTINGS)
    assert easy.size == 0.1875
    assert easy.next(trial(increment=0.1875), YES, NO, NO, FULL, SETTINGS).size == 0.25
    hard = failed.next(trial(increment=0.125, steps=int(SETTINGS.max_steps)), YES, NO, NO, FULL, SETTINGS)
    assert hard.size == 0.125


def test_last_increment_takes_the_rest_of_the_load():
    assert increments().ahead(jnp.asarray(0.748)) == pytest.approx(0.252)
    assert increments().ahead(jnp.asarray(0.7)) == 0.25


def test_solve_fails_below_the_smallest_increment_and_at_the_limit_of_attempts():
    small = increments(size=float(SETTINGS.min_increment))
    lost = small.next(trial(increment=float(SETTINGS.min_increment), converged=False), NO, YES, NO, FULL, SETTINGS)
    assert lost.failed
    assert not lost.exhausted
    last = increments(attempts=int(SETTINGS.max_increments) - 1).next(trial(), YES, NO, NO, FULL, SETTINGS)
    assert last.failed
    assert last.exhausted


def test_increments_at_full_load_repeat_while_the_gap_falls():
    open_ = increments().next(trial(missed_gap=1e-3), YES, NO, NO, FULL, SETTINGS)
    assert open_.missed_gap == 1e-3
    again = open_.next(trial(increment=0.0, missed_gap=4e-4), YES, NO, NO, FULL, SETTINGS)
    assert again.missed_gap == 4e-4
    assert again.next(trial(increment=0.0, missed_gap=3.5e-4), YES, NO, NO, FULL, SETTINGS).missed_gap == 0.0


def test_snap_through_begins_at_small_increments_and_its_viscosity_decays_to_zero():
    snap = SnapThrough.begin(jnp.dtype(float))
    failed = trial(increment=0.06, converged=False)
    assert not snap.next(trial(converged=False), NO, FULL)[1]  # a whole increment is cut first
    snap, continues = snap.next(failed, NO, FULL)
    assert continues
    assert snap.viscosity == 1.5
    assert snap.limits(SETTINGS) == (10.0 * SETTINGS.rtol, 12)
    higher, continues = snap.next(failed._replace(snapping=YES), NO, FULL)
    assert continues
    assert higher.viscosity == 4.5
    furthest, values = 0.1, []
    while snap.viscosity > 0:
        furthest *= 0.5
        snap, continues = snap.next(trial(snapping=True, furthest=furthest, steps=1), NO, FULL)
        values.append(float(snap.viscosity))
        assert continues
    assert values == sorted(values, reverse=True)
    ended, continues = snap.next(trial(snapping=True, steps=1), YES, FULL)
    assert not continues
    assert ended.solves == 0


def test_snap_through_is_given_up_at_the_largest_viscosity():
    snap = SnapThrough(jnp.asarray(99.0), jnp.asarray(0.0), jnp.asarray(3))
    ended, continues = snap.next(trial(snapping=True, converged=False), NO, FULL)
    assert not continues
    assert ended.viscosity == 0.0


def test_hold_is_released_where_friction_suffices_and_restored_after_cuts():
    hold = HoldRelease.begin()._replace(can_release=YES)
    assert hold.is_pending(YES)
    assert not hold.is_active(YES)
    kept, restored = hold.next(trial(converged=False), YES, FULL)
    assert not restored
    back, restored = kept.next(trial(converged=False, increment=0.04), YES, FULL)
    assert restored
    assert back.is_active(NO)
    assert not back.is_pending(YES)


def test_path_grows_by_viscous_solves_and_returns_to_its_converged_part():
    path = Path(None, jnp.asarray(0), jnp.asarray(0))
    path, extended = path.next(YES, NO, YES)
    assert extended
    assert (path.length, path.kept) == (1, 1)
    path, extended = path.next(NO, YES, YES)
    assert (path.length, path.kept) == (2, 1)
    path, extended = path.next(NO, YES, NO)
    assert not extended
    assert path.length == 2
    path, _ = path.next(NO, NO, NO)
    assert (path.length, path.kept) == (1, 1)
