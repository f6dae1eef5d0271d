"""Maps on the pixels of the measured one: where things lie, what is left out, and the layer's compression."""

import equinox as eqx
import numpy as np
import pytest
from scipy.interpolate import griddata

import opfem as op
from tests import tolerances as tol


@pytest.fixture(scope="module")
def dataset(solution):
    return op.to_xarray(solution)


@pytest.fixture(scope="module")
def maps(dataset, loaded):
    return op.on_pixels(dataset, loaded)


def test_maps_of_the_load_are_those_of_the_dataset(dataset, maps):
    assert maps.sizes == {"y_image": 17, "x_image": 21}
    np.testing.assert_allclose(maps.pressure, dataset.pressure_image, rtol=tol.ROUNDOFF)
    np.testing.assert_allclose(maps.thickness, dataset.thickness, rtol=tol.ROUNDOFF)
    np.testing.assert_allclose(maps.compression, dataset.compression, rtol=tol.ROUNDOFF, atol=1e-14)
    assert op.on_pixels(dataset).equals(maps)


def test_compression_is_one_minus_loaded_over_unloaded(dataset):
    np.testing.assert_allclose(dataset.compression, 1.0 - dataset.thickness / 0.5, rtol=tol.ROUNDOFF, atol=1e-14)
    assert dataset.compression.max() == pytest.approx(0.13, abs=0.01)


def test_compression_reads_the_unloaded_thickness_of_a_wedge_where_the_pixel_is(dataset):
    """L0 rises along x; the layer has moved sideways, L0 has not."""
    wedge = dataset.copy(deep=True)
    wedge["unloaded_thickness"] = dataset.unloaded_thickness * (1.0 + 0.1 * dataset.x)
    maps = op.on_pixels(wedge)
    expected = 1.0 - maps.thickness / (0.5 * (1.0 + 0.1 * maps.x_image))
    np.testing.assert_allclose(maps.compression, expected, rtol=tol.ROUNDOFF, atol=1e-14)


def test_nominal_strain_is_the_change_of_each_columns_height(dataset):
    u = dataset.displacement.sel(component="z")
    np.testing.assert_allclose(dataset.nominal_strain, (u[-1] - u[0]) / 0.5, rtol=tol.ROUNDOFF)
    # At the middle of the bump, where points hardly move sideways, it is the compression.
    middle = dataset.nominal_strain.sel(x=1.2, y=0.8, method="nearest")
    there = dataset.compression.sel(x_image=middle.x_current, y_image=middle.y_current, method="nearest")
    assert -float(middle) == pytest.approx(float(there), abs=0.01)


def test_residual_is_measured_less_computed(maps, loaded):
    assert np.isnan(maps.residual.values[3, 4])
    assert maps.missing.values.sum() == 1
    known = ~np.asarray(loaded.mask)
    expected = (np.asarray(loaded.values) - maps.thickness.values)[known]
    np.testing.assert_allclose(maps.residual.values[known], expected, rtol=tol.ROUNDOFF)


def test_status_is_that_of_the_nearer_nodes(dataset):
    """Oracle: nearest neighbour among the nodes where they have moved; apart from it only along the border."""
    changed = dataset.copy(deep=True)
    changed["contact_status"] = dataset.contact_status.where(dataset.x < 1.1, 0)
    maps = op.on_pixels(changed)
    nodes = np.stack([changed.x_current.values.ravel(), changed.y_current.values.ravel()], axis=1)
    place = tuple(np.meshgrid(maps.x_image, maps.y_image))
    expected = griddata(nodes, changed.contact_status.values.ravel(), place, method="nearest")
    assert (maps.contact_status.values == expected).mean() > 0.95
    assert np.isnan(maps.residual.values[maps.contact_status.values == 0]).all()


def test_a_residual_of_a_fit_counts_everywhere(dataset, loaded):
    """Its interface follows the map where pressure vanishes, too."""
    free = dataset.drop_vars(["imposed_thickness", "missing"])
    free["contact_status"] = dataset.contact_status * 0
    assert np.isfinite(op.on_pixels(free, loaded).residual).sum() == 17 * 21 - 1
    assert "residual" not in op.on_pixels(free)


def test_no_interface_no_numbers(dataset):
    wide = op.ThicknessMap(np.full((5, 5), 0.4), extent=(6.0, 6.0), origin=(-2.0, -2.0))
    maps = op.on_pixels(dataset, wide)
    off = np.isnan(maps.pressure.values)
    assert off.sum() == 24
    assert np.isnan(maps.thickness.values[off]).all()
    assert (maps.contact_status.values[off] == -1).all()


def test_an_experiments_layer_ends_at_its_window(truth):
    """Its thickness is the layer's own, also where the window leaves a gap."""
    lifted = eqx.tree_at(lambda s: s.layer.displacement, truth, truth.layer.displacement.at[2].add(0.01))
    thickness = [op.on_pixels(op.to_xarray(s)).thickness.values for s in (truth, lifted)]
    np.testing.assert_allclose(*thickness, rtol=tol.ROUNDOFF)
