"""What a result is cautioned of: each warning has something that raises it, and the case next to it that does not."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.results.cautions import volume_ratio
from tests import tolerances as tol


def warned(solution, measured=None):
    return op.summary(solution, measured)["warnings"]


def noisy(loaded, std, mask=None):
    """The same map, measured with this noise."""
    return op.ThicknessMap(loaded.values, extent=loaded.extent, std=std, mask=mask)


def test_nothing_is_said_of_a_good_result(solution, loaded):
    assert warned(solution) == []
    assert warned(solution, loaded) == []


def test_a_mesh_that_does_not_follow_the_map(solution, loaded):
    rms = 1e-3 * op.summary(solution, noisy(loaded, None))["residual_rms_um"]
    (said,) = warned(solution, noisy(loaded, 0.49 * rms))
    assert said.startswith(
        f"The mesh does not follow the map: measured and computed thickness differ by {1e3 * rms:.2g}"
    )
    assert "Take more elements, or smooth the map less." in said
    assert warned(solution, noisy(loaded, 0.51 * rms)) == []
    assert warned(solution, noisy(loaded, None)) == []


def test_noise_that_differs_from_pixel_to_pixel_counts_where_there_is_a_residual(solution, loaded):
    rms = 1e-3 * op.summary(solution, noisy(loaded, None))["residual_rms_um"]
    mask = np.zeros(loaded.shape, bool)
    mask[0, 0] = True
    std = np.where(mask, 1.0, 0.51 * rms)
    assert warned(solution, noisy(loaded, std, mask)) == []
    assert len(warned(solution, noisy(loaded, 0.9 * std, mask))) == 1


@pytest.mark.parametrize(("ratio", "words"), [(0.94, "lost 6.0%"), (0.96, None), (1.04, None), (1.06, "gained 6.0%")])
def test_a_layer_that_changes_its_volume(solution, ratio, words):
    """The same layer, stretched along z until it has this part of its unloaded volume."""
    factor = ratio / volume_ratio(op.to_xarray(solution))
    current = solution.positions + solution.displacement
    stretched = current * jnp.array([1.0, 1.0, factor])[:, None, None, None] - solution.positions
    said = [part for part in warned(eqx.tree_at(lambda s: s.displacement, solution, stretched)) if "volume" in part]
    assert len(said) == (words is not None)
    for part in said:
        assert f"The layer has {words} of its volume" in part
        assert "bulk modulus is only 20 shear moduli" in part
        assert "Raise bulk=" in part


def test_volume_is_that_of_a_sheared_block(solution):
    """A block sheared along x and y and pressed to 90 % in z."""
    X = solution.positions
    F = jnp.array([[1.0, 0.2, 0.3], [0.0, 1.0, -0.1], [0.0, 0.0, 0.9]])
    sheared = eqx.tree_at(lambda s: s.displacement, solution, jnp.einsum("ij,jabc->iabc", F, X) - X)
    assert volume_ratio(op.to_xarray(sheared)) == pytest.approx(0.9, rel=tol.ROUNDOFF)
    numbers = op.summary(solution)
    assert numbers["min_volume_ratio"] < numbers["mean_volume_ratio"] < 1.0


def test_pressure_where_the_map_holds_no_data(solution, loaded):
    x, y = np.meshgrid(loaded.x, loaded.y)
    peak = np.hypot(x - 1.2, y - 0.8)
    (said,) = warned(solution, noisy(loaded, None, peak < 0.6))
    assert "of the force and the highest pressure lie where the map holds no data" in said
    # A hole as large as that beside the bump holds an ordinary share of the force.
    corner = np.hypot(x - 2.0, y - 2.0)
    assert warned(solution, noisy(loaded, None, corner < 0.6)) == []


def test_force_where_the_map_holds_no_data(solution, loaded):
    x, _ = np.meshgrid(loaded.x, loaded.y)
    (said,) = warned(solution, noisy(loaded, None, x < 0.8))
    assert "% of the force lies where the map holds no data" in said


def test_pixels_that_their_neighbours_tell_are_not_missed(solution, loaded):
    """Two pixels of five drop out all over the map: elements of three pixels hold data everywhere."""
    numbers = np.arange(loaded.values.size).reshape(loaded.shape)
    scattered = np.isin(numbers % 5, (0, 2))
    assert scattered.mean() == pytest.approx(0.4, abs=0.01)
    assert warned(solution, noisy(loaded, None, scattered)) == []
