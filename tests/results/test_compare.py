"""Estimates beside the truth: errors and the field's measures against closed forms of made-up fields."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests.experiments import inclusion_experiment

CENTRE = (0.8, 1.1)
FAR = (0.85, 1.05)


def disc(x, y, width=0.08):
    """A pressure [MPa] of 3 kPa with a disc of 9 kPa, its edge at 0.45 mm smoothed as a logistic curve."""
    r = np.hypot(x - CENTRE[0], y - CENTRE[1])
    return 3e-3 + 6e-3 / (1.0 + np.exp((r - 0.45) / width))


def grid(n):
    return np.meshgrid(*2 * [np.linspace(0.0, 2.0, n)])


@pytest.fixture(scope="module")
def fine(truth):
    """A truth with made-up fields: the disc where its interface lies now, indented by a bump, and spread."""
    _, y, x = np.meshgrid([0.0, 0.5], *2 * [np.linspace(0.0, 2.0, 41)], indexing="ij")
    z = np.linspace(0.0, 0.5, 2)[:, None, None] + 0.0 * x
    bump = 0.05 + 0.04 * np.exp(-(((x - CENTRE[0]) / 0.3) ** 2) - ((y - CENTRE[1]) / 0.3) ** 2)
    u = 2.0 * z * np.stack([0.04 * (x - 1.0), 0.03 * (y - 1.0), -bump])
    pressure = jnp.asarray(disc(x[-1] + u[0, -1], y[-1] + u[1, -1]))
    thickness = op.ThicknessMap(0.5 - bump[-1], extent=(2.0, 2.0))
    return eqx.tree_at(
        lambda t: (t.layer.displacement, t.layer.positions, t.interface.pressure, t.thickness),
        truth,
        (jnp.asarray(u), jnp.asarray(np.stack([x, y, z])), pressure, thickness),
    )


def test_an_estimate_equal_to_the_truth_has_no_error(truth):
    same = op.compare(truth, truth)
    assert same.relative_error == 0.0
    assert np.nanmax(np.abs(same.error)) == 0.0
    assert same.estimate == same.truth
    assert same.truth.force == pytest.approx(-float(truth.stats["force_sample"][2]))
    assert np.isnan(same.covered)


def test_fields_are_read_where_the_interface_lies_now(fine):
    """The truth has moved by up to 40 µm sideways: read in space, it is the disc that an array holds."""
    compared = op.compare(disc(*grid(81)), fine, margin=0.1)
    assert compared.relative_error < 3e-3  # bilinear between nodes of a sixth of the edge's width
    x, y = np.meshgrid(compared.x, compared.y)
    np.testing.assert_allclose(compared.truth_pressure, disc(x, y), rtol=0.02)
    in_reference = op.compare(np.asarray(fine.pressure), fine, margin=0.1)
    assert in_reference.relative_error > 2e-2


def test_error_and_relative_error_of_a_scaled_pressure(fine):
    compared = op.compare(1.1 * disc(*grid(81)), fine, margin=0.1)
    assert compared.relative_error == pytest.approx(0.1, rel=0.02)
    known = np.isfinite(compared.error)
    assert known.all()
    np.testing.assert_allclose(compared.error, 0.1 * compared.truth_pressure, atol=4e-5)
    assert compared.estimate.force == pytest.approx(1.1 * np.mean(disc(*grid(2001))) * 4.0, rel=2e-3)


def test_measures_are_those_of_the_disc(fine):
    """Contrast 9/3; the slope of a logistic curve is half of its largest at 1.763 widths to each side."""
    compared = op.compare(disc(*grid(161)), fine, far=FAR)
    assert compared.truth.contrast == pytest.approx(3.0, rel=0.02)
    assert compared.estimate.contrast == pytest.approx(3.0, rel=0.02)
    assert compared.truth.resolution == pytest.approx(2 * 1.763 * 0.08, rel=0.06)
    sharper = op.compare(disc(*grid(161), width=0.04), fine, far=FAR)
    assert sharper.estimate.resolution < 0.65 * sharper.truth.resolution


def test_detectability_is_how_much_more_the_layer_shortens_over_the_inclusion(fine):
    compared = op.compare(fine, fine, far=FAR)
    assert compared.truth.detectability == pytest.approx(-0.04, rel=0.02)
    assert np.isnan(op.compare(disc(*grid(21)), fine).estimate.detectability)


def test_a_palpation_and_a_fit_of_it_are_estimates(solution, truth):
    compared = op.compare(solution, truth)
    assert 0.0 < compared.relative_error < 20.0
    assert compared.estimate.force == pytest.approx(-float(solution.stats["force_sample"][2]))
    assert compared.x.shape == (7,)


def test_an_array_lies_on_the_samples_of_a_map(fine):
    cut = op.ThicknessMap(np.full((41, 41), 0.4), extent=(1.0, 1.0), origin=(0.5, 0.5))
    x, y = np.meshgrid(np.linspace(0.5, 1.5, 41), np.linspace(0.5, 1.5, 41))
    compared = op.compare(disc(x, y), fine, grid=cut)
    assert np.isfinite(compared.estimate_pressure).sum() == 21 * 21
    assert compared.relative_error < 5e-3


def test_the_centre_is_found_without_an_inclusion(fine):
    plain = inclusion_experiment(sample=op.Sample(1.0, op.NeoHooke(3e-3, 0.12)))
    found = op.compare(fine, eqx.tree_at(lambda t: t.experiment, fine, plain), far=FAR)
    assert found.truth.contrast == pytest.approx(3.0, rel=0.03)


def test_maps_and_measures_are_labelled(fine):
    compared = op.compare(disc(*grid(81)), fine, margin=0.2)
    dataset = compared.to_xarray()
    assert dataset.error.dims == ("y", "x")
    assert dataset.error.attrs["units"] == "MPa"
    assert dataset.attrs["truth_contrast"] == compared.truth.contrast
    assert float(dataset.x[0]) == pytest.approx(0.2)
    np.testing.assert_array_equal(dataset.error, compared.error)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"estimate": np.ones((3, 3)), "truth": np.ones((3, 3))}, "two arrays know no places"),
        ({"estimate": np.ones(3)}, r"array \(ny, nx\) of samples in space, got ndarray of shape \(3,\)"),
        ({"estimate": "imprint"}, r"got ndarray of shape \(\) and <U7"),
        ({"margin": 1.2}, r"compare\.margin \[mm\] must leave part of the layer, got 1\.2"),
        ({"centre": (3.0, 1.0)}, r"compare\.centre \[mm\] must lie in x 0 to 2 and y 0 to 2, got \(3\.0, 1\.0\)"),
        ({"far": (5.0, 6.0)}, r"compare\.far \[mm\] must be two distances from 0 to 1\.1"),
        ({"estimate": np.full((3, 3), np.nan)}, "no place where both have a pressure"),
    ],
)
def test_what_cannot_be_compared_is_named(truth, arguments, message):
    with pytest.raises(ValueError, match=message):
        op.compare(**({"estimate": truth, "truth": truth} | arguments))


def test_failed_solutions_are_refused(truth, failed_solution):
    with pytest.raises(ValueError, match="solutions that converged"):
        op.compare(failed_solution, truth)
