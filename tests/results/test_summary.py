"""The short summary: its units, its weights, and that JSON can hold it."""

import json

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.results import summary_rows
from opfem.results.fields import node_areas
from tests import tolerances as tol

UNITS = ("_count", "_ratio", "_relative", "_percent", "_N", "_kPa", "_um", "_mm2")


@pytest.fixture(scope="module")
def numbers(solution):
    return op.summary(solution)


def test_every_key_states_its_unit(numbers):
    words = {"status", "status_message", "warnings"}
    assert [key for key in numbers.keys() - words if not key.endswith(UNITS)] == []
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
    assert numbers["pressure_mean_touching_kPa"] * 1e-3 * area == pytest.approx(-numbers["force_sample_N"][2], rel=0.05)


def test_areas_of_a_tilted_plane():
    x, y = np.meshgrid(np.linspace(0, 3, 4), np.linspace(0, 2, 3))
    areas = node_areas(x, y, 0.75 * x)
    assert areas.sum() == pytest.approx(6 * 1.25, rel=tol.ROUNDOFF)
    assert areas[1, 1] == pytest.approx(1.25, rel=tol.ROUNDOFF)
    assert areas[0, 0] == pytest.approx(1.25 / 4, rel=tol.ROUNDOFF)


def with_status(solution, status):
    return eqx.tree_at(lambda s: s.sample.status, solution, status)


def test_areas_are_those_of_the_deformed_interface(solution):
    """One open corner node and one sticking inner node; the areas add up to that of the triangulated interface."""
    status = jnp.full_like(solution.contact_status, 2).at[0, 0].set(0).at[3, 3].set(1)
    numbers = op.summary(with_status(solution, status))
    x, y, z = np.asarray(solution.positions + solution.displacement)[:, -1]
    areas = node_areas(x, y, z)
    assert numbers["open_area_mm2"] == pytest.approx(areas[0, 0], rel=tol.ROUNDOFF)
    assert numbers["stick_area_mm2"] == pytest.approx(areas[3, 3], rel=tol.ROUNDOFF)
    assert numbers["contact_area_mm2"] == pytest.approx(areas.sum() - areas[0, 0], rel=tol.ROUNDOFF)
    # Confined silicone bulges at its free sides.
    assert 4.0 < numbers["window_contact_area_mm2"] < 5.0


def test_mean_pressure_is_over_the_touching_area(solution):
    """Pressure is zero where nothing touches; leaving that area out raises the mean."""
    open_half = jnp.arange(7) >= 4
    status = jnp.where(open_half, 0, solution.contact_status)
    half = eqx.tree_at(lambda s: s.sample.pressure, with_status(solution, status), solution.pressure * ~open_half)
    whole, numbers = op.summary(solution), op.summary(half)
    x, y, z = np.asarray(solution.positions + solution.displacement)[:, -1]
    area, pressure = node_areas(x, y, z)[:, :4], 1e3 * np.asarray(solution.pressure)[:, :4]
    expected = np.sum(area * pressure) / np.sum(area)
    assert numbers["pressure_mean_touching_kPa"] == pytest.approx(expected, rel=tol.ROUNDOFF)
    assert numbers["pressure_mean_touching_kPa"] > 0.6 * whole["pressure_mean_touching_kPa"]
    assert ("mean pressure over the touching area", f"{expected:.3g}", "kPa") in summary_rows(numbers)


def test_where_nothing_touches_there_is_no_mean(solution):
    numbers = op.summary(with_status(solution, jnp.zeros_like(solution.contact_status)))
    assert numbers["pressure_mean_touching_kPa"] is None
    assert numbers["residual_rms_um"] is None
    assert numbers["contact_area_mm2"] == 0.0
    assert ("mean pressure over the touching area", "none touches", "kPa") in summary_rows(numbers)


def test_residual_is_against_the_measured_map(solution, loaded):
    """A map that is thicker by 10 µm everywhere leaves a residual of 10 µm, but for that of the solve itself."""
    thicker = op.ThicknessMap(loaded.values + 0.01, extent=loaded.extent, mask=loaded.mask)
    own, other = (op.summary(solution, measured)["residual_rms_um"] for measured in (None, thicker))
    assert own == op.summary(solution, loaded)["residual_rms_um"] < 3.0
    assert other == pytest.approx(10.0, abs=own)


def test_failure_is_null(failed_solution):
    numbers = op.summary(failed_solution)
    json.dumps(numbers, allow_nan=False)
    assert numbers["status"] != "successful"
    assert 0 < numbers["load_reached_percent"] < 100
    assert numbers["pressure_max_kPa"] is None
    assert numbers["open_area_mm2"] is None
    assert numbers["residual_rms_um"] is None
    assert numbers["warnings"] == []
    assert numbers["force_sample_N"] == [None, None, None]


def test_pixels_beyond_the_unloaded_layer_have_no_compression(solution, numbers):
    """The layer bulges by 43 to 48 µm; a wider map, in steps of 20 µm, has pixels over the bulge."""
    wide = op.ThicknessMap(jnp.full((111, 111), 0.45), extent=(2.2, 2.2), origin=(-0.1, -0.1))
    found = op.summary(solution, wide)
    assert found["compression_mean_percent"] == pytest.approx(numbers["compression_mean_percent"], rel=0.05)
    assert found["compression_max_percent"] == pytest.approx(numbers["compression_max_percent"], rel=0.01)
