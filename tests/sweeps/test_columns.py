"""A sweep as columns: what is a number a point, its units, its ends, and the table that it makes."""

import csv
import functools

import numpy as np
import pytest

import opfem as op
from opfem.sweeps.columns import columns, csv_bytes

UNITS = {"force": "N", "work": "N mm"}


def pull(force, angle):
    """Work, a vector and a map; where the force is 3 it fails."""
    vector = np.array([np.cos(angle), np.sin(angle), 0.0]) * force
    return {"work": force * (1.0 + angle) if force != 3.0 else np.nan, "pull": vector, "map": np.ones((2, 2))}


@pytest.fixture(scope="module")
def grid():
    axes = {"force": [1.0, 2.0, 3.0], "angle": [0.0, 0.5]}
    return op.sweep(pull, axes, units=UNITS, execution=op.Batch(mode="call"))


def test_columns_of_a_grid_run_as_its_points_do(grid):
    held = columns(grid)
    assert held.shape == (3, 2)
    np.testing.assert_array_equal(held.axes["force"], [1, 1, 2, 2, 3, 3])
    np.testing.assert_array_equal(held.axes["angle"], [0, 0.5, 0, 0.5, 0, 0.5])
    np.testing.assert_allclose(held.outputs["work"], [1, 1.5, 2, 3, np.nan, np.nan])
    assert set(held.outputs) == {"work"}
    assert held.good.tolist() == 4 * [True] + 2 * [False]
    assert held.ends("work") == (0, 3)
    assert (held.at(3), held.title("work")) == ("force 2 N, angle 0.5", "work [N mm]")


def test_columns_of_points_that_form_no_grid():
    points = op.zip_({"force": [2.0, 1.0], "angle": [0.0, 0.5]})
    held = columns(op.sweep(pull, points, units=UNITS, execution=op.Batch(mode="call")))
    assert held.shape is None
    np.testing.assert_array_equal(held.axes["force"], [2, 1])
    assert held.ends("work") == (1, 0)


def test_components_of_a_vector_are_columns(solution):
    """A sweep that keeps the force of a solved layer, which is there already."""

    def force(scale):
        del scale
        return solution

    held = columns(op.sweep(force, {"scale": [1.0, 2.0]}, keep=["force_sample"], execution=op.Batch(mode="call")))
    expected = np.asarray(solution.stats["force_sample"])
    for number, name in enumerate("xyz"):
        np.testing.assert_array_equal(held.outputs[f"force_sample_{name}"], 2 * [expected[number]])
    assert held.units["force_sample_z"] == "N"


def test_numbers_are_read_in_other_units(grid):
    held = columns(grid).read_in({"N": (1e3, "mN")})
    np.testing.assert_array_equal(held.axes["force"], [1e3, 1e3, 2e3, 2e3, 3e3, 3e3])
    np.testing.assert_allclose(held.outputs["work"][:2], [1, 1.5])
    assert held.at(0) == "force 1000 mN, angle 0"


def test_where_every_point_failed_there_are_no_ends(grid):
    assert columns(grid.isel(force=[2])).ends("work") is None


def test_table_has_a_row_for_each_point(tmp_path):
    folder = tmp_path / "sweep"
    run = functools.partial(op.sweep, pull, units=UNITS, execution=op.Batch(mode="call"), out=folder)
    data = run({"force": [1.0, 2.0, 3.0], "angle": [0.0, 0.5]})
    assert (folder / "table.csv").read_bytes() == csv_bytes(data)
    with (folder / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["force [N]", "angle", "work [N mm]", "status", "message", "wall_time [s]"]
    assert [float(row["work [N mm]"]) for row in rows[:4]] == [1.0, 1.5, 2.0, 3.0]
    assert [row["status"] for row in rows] == 4 * ["successful"] + 2 * ["nonfinite"]
