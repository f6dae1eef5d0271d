"""The deformed layer in a .vtu file."""

import os

import numpy as np
import pytest
import pyvista

import opfem as op
from tests import tolerances as tol


@pytest.fixture(scope="module")
def written(solution, tmp_path_factory):
    path = tmp_path_factory.mktemp("vtu") / "result.vtu"
    op.write_vtu(op.to_xarray(solution), path)
    return pyvista.read(path)


def test_is_the_deformed_layer(written, solution):
    assert written.n_cells == 6 * 6 * 2
    assert set(written.celltypes) == {pyvista.CellType.HEXAHEDRON}
    current = np.asarray(solution.positions + solution.displacement).reshape(3, -1).T
    np.testing.assert_allclose(written.points, current, rtol=tol.ROUNDOFF, atol=tol.ROUNDOFF)
    np.testing.assert_array_equal(written["displacement_mm"], np.asarray(solution.displacement).reshape(3, -1).T)


def test_cells_are_right_side_out(written, solution):
    """Volumes are positive, and their sum is that of the layer, compressed by a few per cent."""
    volumes = written.compute_cell_sizes(length=False, area=False)["Volume"]
    assert volumes.min() > 0
    assert volumes.sum() == pytest.approx(2.0 * 2.0 * 0.5, rel=0.1)


def test_faces(written, solution):
    top = np.isfinite(written["pressure_MPa"])
    assert np.array_equal(written["pressure_MPa"][top].reshape(7, 7), solution.pressure)
    assert np.array_equal(written["window_pressure_MPa"][:49].reshape(7, 7), solution.window.pressure)
    assert np.array_equal(written["traction_MPa"][top].T.reshape(3, 7, 7), solution.traction)
    assert np.array_equal(written["contact_status"][top].reshape(7, 7), solution.contact_status)
    assert written["displacement_mm"][top, 2].max() < 0
    np.testing.assert_array_equal(written.points[:49, 2] < 0.1, True)


def test_stress_lies_in_the_top_cells(written, solution):
    stress = written["stress_zz_MPa"].reshape(2, 6, 6)
    assert np.isnan(stress[0]).all()
    assert np.array_equal(stress[1], solution.stress_zz)
    heights = written.cell_centers().points[:, 2].reshape(2, 6, 6)
    assert (heights[1] > heights[0]).all()


def test_errors(tmp_path, solution, failed_solution):
    with pytest.raises(ValueError, match=r"must end in \.vtu"):
        op.write_vtu(op.to_xarray(solution), tmp_path / "a.vtk")
    with pytest.raises(ValueError, match="needs a converged solution"):
        op.write_vtu(op.to_xarray(failed_solution), tmp_path / "a.vtu")
    assert os.listdir(tmp_path) == []


def test_a_series_lists_its_states_in_order(tmp_path, solution):
    """As ParaView reads it: names relative to the .pvd file, times that rise, each file the state itself."""
    data = op.to_xarray(solution)
    op.write_pvd([data, data.assign(displacement=0.5 * data.displacement)], tmp_path / "run.pvd", times=[0.5, 2.0])
    assert sorted(os.listdir(tmp_path)) == ["run.pvd", "run_000.vtu", "run_001.vtu"]
    series = pyvista.PVDReader(tmp_path / "run.pvd")
    assert series.time_values == [0.5, 2.0]
    series.set_active_time_value(2.0)
    half = np.asarray(solution.positions + 0.5 * solution.displacement).reshape(3, -1).T
    np.testing.assert_allclose(series.read()[0].points, half, rtol=tol.ROUNDOFF, atol=tol.ROUNDOFF)


@pytest.mark.parametrize(("states", "times"), [(0, None), (2, [1.0]), (2, [1.0, 1.0])])
def test_a_series_needs_one_rising_time_for_each_state(tmp_path, solution, states, times):
    with pytest.raises(ValueError, match="one rising time for each"):
        op.write_pvd([op.to_xarray(solution)] * states, tmp_path / "run.pvd", times)
    assert os.listdir(tmp_path) == []


@pytest.fixture(scope="module")
def both(truth, tmp_path_factory):
    path = tmp_path_factory.mktemp("vtu") / "truth.vtu"
    op.write_vtu(op.to_xarray(truth, interior=True), path)
    return pyvista.read(path)


def test_bodies_lie_where_they_have_moved(both, truth):
    assert both["body"].tolist() == 72 * [0] + 100 * [1]
    for points, body in ((both.points[:147], truth.layer), (both.points[147:], truth.sample)):
        current = np.asarray(body.positions + body.displacement).reshape(3, -1).T
        np.testing.assert_allclose(points, current, rtol=tol.ROUNDOFF, atol=tol.ROUNDOFF)
    volumes = both.compute_cell_sizes(length=False, area=False)["Volume"]
    assert volumes.min() > 0


def test_each_body_has_its_own_arrays(both, truth):
    layer, sample = both.extract_points(np.arange(147)), both["displacement_mm"][147:]
    assert layer.n_points == 147
    np.testing.assert_array_equal(sample, np.asarray(truth.sample.displacement).reshape(3, -1).T)
    plate = np.isfinite(both["plate_pressure_MPa"])
    assert np.flatnonzero(plate).tolist() == list(range(147 + 144, 147 + 180))
    np.testing.assert_array_equal(both["plate_pressure_MPa"][plate].reshape(6, 6), truth.plate.pressure)
    assert (both["contact_status"][147:] == -1).all()
    assert (both["plate_contact_status"][:147] == -1).all()
    stress = both["element_stress_MPa"]
    np.testing.assert_array_equal(stress[72:].T.reshape(3, 3, 4, 5, 5), truth.sample.stress)
    assert np.isnan(both["shear_modulus_MPa"][:72]).all()
    assert set(np.unique(both["shear_modulus_MPa"][72:])) == {6e-3, 4e-2}
    assert np.isfinite(both["stress_MPa"]).all()
