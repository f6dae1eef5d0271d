"""What `to_xarray` labels: positions, units, orientation and the record of how a result was made."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import griddata

import opfem as op
from opfem.measurement import Step
from opfem.results.dataset import status_name
from opfem.solvers import RESULTS
from tests import tolerances as tol


@pytest.fixture(scope="module")
def dataset(solution):
    return op.to_xarray(solution)


def on_grid(solution, grid):
    """The same solution, looked at on other pixels."""
    return eqx.tree_at(lambda s: (s.thickness, s.load.thickness), solution, (grid, grid))


class TestFields:
    def test_dims(self, dataset):
        shapes = {
            "displacement": ("component", "z", "y", "x"),
            "traction": ("component", "y", "x"),
            "pressure": ("y", "x"),
            "window_pressure": ("y", "x"),
            "stress_zz": ("y_element", "x_element"),
            "thickness": ("y_image", "x_image"),
            "pressure_image": ("y_image", "x_image"),
            "force_sample": ("component",),
            "approach": (),
        }
        assert {name: dataset[name].dims for name in shapes} == shapes
        assert dict(dataset.sizes) == {
            "component": 3, "lateral": 2, "x": 7, "y": 7, "z": 3,
            "x_element": 6, "y_element": 6, "x_image": 21, "y_image": 17,
        }  # fmt: skip

    def test_values_are_the_solutions(self, dataset, solution):
        assert np.array_equal(dataset.pressure, solution.pressure)
        assert np.array_equal(dataset.window_traction, solution.window.traction)
        assert np.array_equal(dataset.displacement.sel(component="z", z=1.0), solution.displacement[2, -1])
        assert dataset.force_window.sel(component="z").item() == solution.stats["force_window"][2]

    def test_positions(self, dataset, solution):
        np.testing.assert_allclose(dataset.x, np.linspace(0, 2, 7), rtol=tol.ROUNDOFF)
        moved = dataset.x + dataset.displacement.sel(component="x", z=1.0)
        np.testing.assert_allclose(dataset.x_current, moved.transpose("y", "x"), rtol=tol.ROUNDOFF)
        # Confined silicone leaves at its rim.
        assert dataset.x_current[3, 0] < 0
        assert dataset.y_current[-1, 3] > 2

    def test_orientation(self, dataset):
        """The bump is at large x and small y."""
        peak = dataset.pressure_image.where(dataset.pressure_image == dataset.pressure_image.max(), drop=True)
        assert peak.x_image.item() == pytest.approx(1.2, abs=0.2)
        assert peak.y_image.item() == pytest.approx(0.8, abs=0.2)

    def test_every_variable_has_unit_and_name(self, dataset):
        text = {"component", "lateral"}
        bare = [name for name, values in dataset.variables.items() if name not in text and "units" not in values.attrs]
        assert bare == []
        assert all(values.attrs["long_name"] for values in dataset.variables.values())
        assert dataset.pressure.units == "MPa"

    def test_status_flags(self, dataset):
        flags = dict(zip(dataset.contact_status.flag_meanings.split(), dataset.contact_status.flag_values, strict=True))
        assert flags == {"not_converged": -1, "open": 0, "stick": 1, "slip": 2}
        assert set(np.unique(dataset.contact_status)) <= {0, 1, 2}


class TestImage:
    def test_pressure_lies_where_it_acts(self, dataset):
        """Oracle: piecewise linear interpolation between the nodes where they are now."""
        nodes = np.stack([dataset.x_current.values.ravel(), dataset.y_current.values.ravel()], axis=1)
        x, y = np.meshgrid(dataset.x_image, dataset.y_image)
        expected = griddata(nodes, dataset.pressure.values.ravel(), (x, y))
        inner = np.s_[2:-2, 2:-2]
        error = (dataset.pressure_image - expected)[inner]
        # Triangles against bilinear faces: a few per cent of what a face spans.
        assert np.abs(error).max() < 0.05 * float(dataset.pressure.max())
        # Reading the reference grid instead would be off by more.
        naive = dataset.pressure.interp(x=dataset.x_image, y=dataset.y_image).values - expected
        assert np.sqrt(np.mean(naive[inner] ** 2)) > 2 * np.sqrt(float((error**2).mean()))

    def test_at_a_moved_node_it_is_the_nodes_pressure(self, solution):
        """A map whose pixels lie where two nodes have gone."""
        moved = np.asarray(solution.positions[:2, -1] + solution.displacement[:2, -1])
        (x0, y0), (x1, y1) = moved[:, 2, 2], moved[:, 4, 5]
        grid = op.ThicknessMap(np.full((2, 2), 0.4), extent=(x1 - x0, y1 - y0), origin=(x0, y0))
        image = op.to_xarray(on_grid(solution, grid)).pressure_image.values
        found = [image[0, 0], image[1, 1]]
        np.testing.assert_allclose(found, [solution.pressure[2, 2], solution.pressure[4, 5]], rtol=1e-5)

    def test_pixels_off_the_layer_are_nan(self, solution):
        wide = op.ThicknessMap(np.full((5, 5), 0.4), extent=(6.0, 6.0), origin=(-2.0, -2.0))
        image = op.to_xarray(on_grid(solution, wide)).pressure_image
        x, y = np.meshgrid(image.x_image, image.y_image)
        assert np.array_equal(np.isfinite(image), (np.abs(x - 1) < 1.01) & (np.abs(y - 1) < 1.01))

    def test_thickness_meets_the_imposed_map(self, dataset):
        misfit = dataset.thickness - dataset.imposed_thickness
        assert np.sqrt(float((misfit**2).mean())) < 0.005
        assert int(dataset.missing.sum()) == 1


class TestRecord:
    def test_versions_and_status(self, dataset):
        assert dataset.attrs["jax_version"] == jax.__version__
        assert dataset.attrs["numpy_version"] == np.__version__
        assert dataset.attrs["opfem_version"]
        assert dataset.attrs["status"] in ("successful", "slides_off")

    def test_inputs_in_words(self, dataset):
        assert json.loads(dataset.attrs["layer"])["material"] == {
            "class": "MooneyRivlin", "c10": 2.23e-3, "c01": 7.03e-4, "bulk": 0.11732, "calibrated": None,
        }  # fmt: skip
        assert json.loads(dataset.attrs["window"])["friction"] == 0.15
        assert json.loads(dataset.attrs["sample"])["law"]["class"] == "ExponentialOverclosure"
        assert json.loads(dataset.attrs["sides"]) == dict.fromkeys(("x0", "x1", "y0", "y1"), "free")
        assert dataset.attrs["elements"].tolist() == [6, 6, 2]
        assert dataset.attrs["element"] == "mean_dilatation"
        steps = json.loads(dataset.attrs["thickness_steps"])
        assert steps == [{"step": "filled", "pixels": 1}, {"step": "smoothed", "fwhm": 0.2}]

    def test_hash_follows_every_input(self, solution, dataset):
        def hash_with(where, value):
            return op.to_xarray(eqx.tree_at(where, solution, value)).attrs["inputs_sha256"]

        nudged = solution.load.thickness.values.at[3, 3].add(1e-15)
        step = Step("smoothed", fwhm=0.3)
        hashes = {
            dataset.attrs["inputs_sha256"],
            hash_with(lambda s: s.palpation.layer.thickness, jnp.asarray(0.6)),
            hash_with(lambda s: s.palpation.window.friction, jnp.asarray(0.2)),
            hash_with(lambda s: s.load.thickness.values, nudged),
            hash_with(lambda s: s.load.thickness.steps, (step,)),
            hash_with(lambda s: s.palpation, op.Palpation(
                solution.palpation.layer, (2.0, 2.0), (6, 6, 2), solution.palpation.window,
                solution.palpation.sample, sides="roller",
            )),
        }  # fmt: skip
        assert len(hashes) == 6
        assert op.to_xarray(solution).attrs["inputs_sha256"] == dataset.attrs["inputs_sha256"]
        # Of the results it does not.
        other = eqx.tree_at(lambda s: s.displacement, solution, 2 * solution.displacement)
        assert op.to_xarray(other).attrs["inputs_sha256"] == dataset.attrs["inputs_sha256"]


class TestFailure:
    def test_is_converted_with_its_status(self, failed_solution):
        dataset = op.to_xarray(failed_solution)
        assert dataset.attrs["status"] == status_name(failed_solution) != "successful"
        assert dataset.attrs["status_message"]
        assert np.isnan(dataset.pressure).all()
        assert np.isnan(dataset.pressure_image).all()
        assert (dataset.contact_status == -1).all()
        assert 0 < dataset.load_fraction < 1

    def test_every_status_has_its_name(self, solution):
        item = RESULTS.nonfinite
        assert status_name(eqx.tree_at(lambda s: s.result, solution, item)) == "nonfinite"

    def test_traced_and_batched_are_refused(self, solution):
        with pytest.raises(ValueError, match="outside jit"):
            eqx.filter_jit(lambda s: op.to_xarray(s).attrs["status"])(solution)
        batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), eqx.filter(solution, eqx.is_array))
        with pytest.raises(ValueError, match="takes one solution"):
            op.to_xarray(batch)


def test_other_loads_have_no_map(solution):
    """Without a map the image grid is that of the mesh."""
    changed = eqx.tree_at(lambda s: s.load, solution, op.Displacement(-0.05))
    dataset = op.to_xarray(changed)
    assert "imposed_thickness" not in dataset
    assert "thickness_steps" not in dataset.attrs
    assert json.loads(dataset.attrs["load"]) == {"class": "Displacement", "uz": -0.05, "lateral": "free"}
