"""The map that would be measured of a solved layer."""

import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests import tolerances as tol


def test_pixels_at_nodes_that_stay_have_the_nodes_thickness(truth):
    measured = op.measured_thickness(truth, spacing=2.0 / 6)
    assert measured.shape == (7, 7)
    assert measured.std is None
    np.testing.assert_allclose(measured.extent, [2.0, 2.0], rtol=tol.ROUNDOFF)
    np.testing.assert_allclose(measured.values, truth.thickness.values, rtol=1e-9)


def test_thickness_is_read_where_the_interface_lies_now(truth):
    """At the current place of every inner node lies that node, less what the window lets it lift."""
    measured = op.measured_thickness(truth, spacing=0.002)
    x, y, z = np.asarray(truth.positions + truth.displacement)[:, -1, 1:-1, 1:-1]
    own = z - np.asarray(truth.displacement[2, 0, 1:-1, 1:-1])
    np.testing.assert_allclose(
        measured.sample(jnp.asarray(x), jnp.asarray(y)), own, atol=5e-5
    )  # half a pixel across a kink of the surface by 0.1


def test_noise_has_its_std_and_seed(truth):
    clean, one, same, other = (
        np.asarray(op.measured_thickness(truth, (0.02, 0.04), std, seed).values)
        for std, seed in ((0.0, 0), (0.003, 1), (0.003, 1), (0.003, 2))
    )
    assert one.shape == (51, 101)
    assert (one - clean).std() == pytest.approx(0.003, rel=tol.SAMPLING)  # of 5151 pixels
    np.testing.assert_array_equal(one, same)
    assert abs(np.corrcoef((one - clean).ravel(), (other - clean).ravel())[0, 1]) < 0.05


def test_a_palpation_can_be_measured_too(solution):
    assert op.measured_thickness(solution, 0.1).shape == (21, 21)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"spacing": 0.0}, r"measured_thickness\.spacing \(dx, dy\) \[mm\] must be positive"),
        ({"spacing": 0.1, "std": -1e-3}, r"measured_thickness\.std \[mm\] must be zero or positive, got -0\.001"),
    ],
)
def test_numbers_are_checked(truth, arguments, message):
    with pytest.raises(ValueError, match=message):
        op.measured_thickness(truth, **arguments)


def test_failed_solutions_are_refused(failed_solution):
    with pytest.raises(ValueError, match="one solution that converged"):
        op.measured_thickness(failed_solution, 0.1)
