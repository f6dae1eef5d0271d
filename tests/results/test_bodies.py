"""What is read from the solution of a virtual experiment: labelled data, summary, interior fields, an OCT scene."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests import tolerances as tol


@pytest.fixture(scope="module")
def dataset(truth):
    return op.to_xarray(truth)


def test_the_layer_is_labelled_as_in_a_palpation(dataset, truth):
    assert np.array_equal(dataset.pressure, truth.pressure)
    assert np.array_equal(dataset.displacement, truth.layer.displacement)
    assert np.array_equal(dataset.stress_zz, truth.layer.stress[2, 2, -1])
    assert np.array_equal(dataset.window_pressure, truth.window.pressure)
    assert np.array_equal(dataset.thickness, truth.thickness.values)
    moved = truth.positions[0, -1] + truth.displacement[0, -1]
    np.testing.assert_allclose(dataset.x_current, moved, rtol=tol.ROUNDOFF)


def test_the_sample_is_labelled_on_its_own_grid(dataset, truth):
    assert dict(dataset.sizes) == {
        "component": 3, "direction": 3, "lateral": 2, "x": 7, "y": 7, "z": 3, "x_image": 7, "y_image": 7,
        "x_element": 6, "y_element": 6, "z_element": 2, "x_sample": 6, "y_sample": 6, "z_sample": 5,
        "x_sample_element": 5, "y_sample_element": 5, "z_sample_element": 4,
    }  # fmt: skip
    assert np.array_equal(dataset.sample_displacement, truth.sample.displacement)
    assert np.array_equal(dataset.sample_height, truth.sample.positions[2])
    assert np.array_equal(dataset.sample_element_stress, truth.sample.stress)
    assert np.array_equal(dataset.plate_pressure, truth.plate.pressure)
    assert dataset.plate_traction.dims == ("component", "y_sample", "x_sample")
    np.testing.assert_allclose(dataset.x_sample, np.linspace(0, 2, 6), rtol=tol.ROUNDOFF)
    np.testing.assert_allclose(dataset.y_sample_element, np.arange(0.2, 2, 0.4), rtol=tol.ROUNDOFF)
    assert set(np.unique(dataset.sample_shear_modulus)) == {6e-3, 4e-2}
    assert all(dataset[name].attrs["units"] for name in dataset if name not in ("newton_steps",))


def test_the_record_says_what_was_pressed_together(dataset):
    sample = json.loads(dataset.attrs["sample"])
    assert sample["class"] == "Sample"
    ((where, law),) = sample["inclusions"]
    assert where == {"class": "Cylinder", "centre": [0.8, 1.1], "radius": 0.45, "depth": [0.2, 0.7]}
    assert law["c10"] == 2e-2
    assert json.loads(dataset.attrs["load"]) == {"class": "Compression", "approach": 0.2}
    assert json.loads(dataset.attrs["plate"])["friction"] == 0.15
    assert dataset.attrs["sample_elements"].tolist() == [5, 5, 4]
    assert dataset.attrs["plate_height"] == pytest.approx(1.5)
    assert dataset.attrs["status"] == "successful"
    assert "plate" in dataset.force_plate.attrs["long_name"]


def test_the_dataset_survives_a_file(dataset, tmp_path):
    op.write_netcdf(dataset, tmp_path / "truth.nc")
    again = op.read_netcdf(tmp_path / "truth.nc")
    assert again.equals(dataset)
    assert again.attrs["sample"] == dataset.attrs["sample"]


def test_interior_fields_of_both_bodies(truth):
    dataset = op.to_xarray(truth, interior=True)
    for name, fields in (("", op.layer_fields(truth)), ("sample_", op.sample_fields(truth))):
        F = np.asarray(fields.deformation_gradient)
        assert (np.linalg.det(np.moveaxis(F, (0, 1), (-2, -1))) > 0).all()
        assert np.array_equal(dataset[f"{name}stress"], fields.at_nodes(fields.stress))
        assert (dataset[f"{name}energy_density"] > 0).any()
        np.testing.assert_allclose(
            fields.element_mean(fields.stress), dataset[f"{name or 'layer_'}element_stress"], tol.SOLVER, 1e-12
        )


def test_the_summary_balances_window_and_plate(truth):
    numbers = op.summary(truth)
    assert numbers["force_plate_N"] == truth.stats["force_plate"].tolist()
    assert numbers["force_imbalance_percent"] < 1e-4
    assert numbers["status"] == "successful"
    assert numbers["pressure_max_kPa"] == pytest.approx(1e3 * float(truth.pressure.max()))
    assert json.loads(json.dumps(numbers, allow_nan=False)) == numbers


def test_an_oct_scene_shows_the_layers_thickness(truth):
    surface, thickness = op.oct_scene(truth).surface, truth.thickness
    x, y = jnp.meshgrid(thickness.x[1:-1], thickness.y[1:-1])
    off = np.asarray(surface.sample(x, y) - thickness.values[1:-1, 1:-1])
    # Splines through the moved nodes and facets differ by an eighth of the bend between nodes.
    bend = max(np.abs(np.diff(thickness.values, 2, axis=axis)).max() for axis in (0, 1))
    assert np.abs(off).max() < 2.0 * bend / 8.0


def test_batched_solutions_are_refused(truth):
    many = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), truth)
    with pytest.raises(ValueError, match="to_xarray takes one solution"):
        op.to_xarray(many)
