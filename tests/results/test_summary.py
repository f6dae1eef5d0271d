"""The short summary: its units, its weights, and that JSON can hold it."""

import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.results.fields import node_areas
from tests import tolerances as tol

COUNTS = ("_count", "_fraction", "_ratio", "_relative", "_percent", "_N", "_kPa", "_um")


@pytest.fixture(scope="module")
def numbers(solution):
    return op.summary(solution)


def test_every_key_states_its_unit(numbers):
    assert [key for key in numbers if not key.startswith("status") and not key.endswith(COUNTS)] == []
    assert json.loads(json.dumps(numbers, allow_nan=False)) == numbers


def test_units(numbers, solution):
    assert numbers["pressure_max_kPa"] == pytest.approx(1e3 * float(solution.pressure.max()), rel=tol.ROUNDOFF)
    assert numbers["approach_um"] == pytest.approx(1e3 * float(solution.stats["approach"]), rel=tol.ROUNDOFF)
    assert numbers["force_sample_N"] == solution.stats["force_sample"].tolist()
    assert numbers["load_reached_percent"] == 100.0


def test_mean_pressure_carries_the_force(numbers, solution):
    """Mean pressure × projected area is the normal force, but for friction and slopes: some per cent."""
    moved = np.asarray(solution.positions[:2, -1] + solution.displacement[:2, -1])
    area = node_areas(*moved, np.zeros_like(moved[0])).sum()
    assert numbers["pressure_mean_kPa"] * 1e-3 * area == pytest.approx(-numbers["force_sample_N"][2], rel=0.05)


def test_areas_of_a_tilted_plane():
    x, y = np.meshgrid(np.linspace(0, 3, 4), np.linspace(0, 2, 3))
    areas = node_areas(x, y, 0.75 * x)
    assert areas.sum() == pytest.approx(6 * 1.25, rel=tol.ROUNDOFF)
    assert areas[1, 1] == pytest.approx(1.25, rel=tol.ROUNDOFF)
    assert areas[0, 0] == pytest.approx(1.25 / 4, rel=tol.ROUNDOFF)


def test_fractions_are_of_the_area(solution):
    """One open corner of 6 × 6 elements is a quarter of one element."""
    status = jnp.ones_like(solution.contact_status).at[0, 0].set(0).at[3, 3].set(2)
    numbers = op.summary(eqx.tree_at(lambda s: s.sample.status, solution, status))
    assert numbers["open_fraction"] == pytest.approx(0.25 / 36, rel=tol.ROUNDOFF)
    assert numbers["slip_fraction"] == pytest.approx(1 / 36, rel=tol.ROUNDOFF)
    assert numbers["stick_fraction"] + numbers["slip_fraction"] == pytest.approx(numbers["contact_area_fraction"])


def test_failure_is_null(failed_solution):
    numbers = op.summary(failed_solution)
    json.dumps(numbers, allow_nan=False)
    assert numbers["status"] != "successful"
    assert 0 < numbers["load_reached_percent"] < 100
    assert numbers["pressure_max_kPa"] is None
    assert numbers["open_fraction"] is None
    assert numbers["force_sample_N"] == [None, None, None]
