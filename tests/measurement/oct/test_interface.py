"""The interface in simulated volumes, whose truth is known: bias, scatter, its std, and what is refused."""

import numpy as np
import pytest

import opfem as op
from tests.measurement.oct.scenes import DX, X, Y, errors, simulated, waves

UM = 1e-3


@pytest.mark.parametrize(
    ("contrast", "snr", "bias", "rms"),
    [
        (15, 25, 0.4, 1.0),
        pytest.param(10, 10, 0.4, 1.5, marks=pytest.mark.slow),
        pytest.param(6, 20, 0.4, 1.9, marks=pytest.mark.slow),
        (3, 20, 0.5, 3.2),
    ],
)
def test_accuracy_and_its_std(contrast, snr, bias, rms):
    surface = waves(0.16)
    found = op.find_interface(simulated(surface, contrast, snr, seed=contrast), op.UWA_845NM)
    error, std = errors(found, surface)
    assert abs(error.mean()) < bias * UM
    assert np.sqrt(np.mean(error**2)) < rms * UM
    assert np.mean(np.abs(error) > 15 * UM) <= 5e-3
    assert 0.8 < np.sqrt(np.mean((error / std) ** 2)) < 1.25
    assert np.asarray(found.mask).mean() < 0.02


@pytest.mark.parametrize("slope", [pytest.param(0.47, marks=pytest.mark.slow), 0.6])
def test_steep_surface(slope):
    surface = waves(slope)
    found = op.find_interface(simulated(surface), op.UWA_845NM, edge="brighter")
    error, _ = errors(found, surface)
    assert abs(error.mean()) < 0.4 * UM
    assert np.sqrt(np.mean(error**2)) < 1.0 * UM


def test_darker_sample():
    surface = waves(0.16)
    media = (op.SCATTERING_LAYER, op.Medium(-15.0, 1.0))
    found = op.find_interface(simulated(surface, media=media), op.UWA_845NM)
    error, _ = errors(found, surface)
    assert op.EDGES[int(np.median(found.edge))] == "darker"
    assert abs(error.mean()) < 0.4 * UM
    assert np.sqrt(np.mean(error**2)) < 1.5 * UM


def test_reflecting_interface():
    def surface(x, y):
        return 0.25 + 0.02 * x + 0.01 * y

    volume = simulated(surface, specular=25.0)
    for edge in ("peak", "auto"):
        found = op.find_interface(volume, op.UWA_845NM, edge=edge)
        error, std = errors(found, surface)
        assert abs(error.mean()) < 0.1 * UM, edge
        assert np.sqrt(np.mean(error**2)) < 0.4 * UM
        assert np.mean(np.abs(error) < 2 * std) > 0.85
    assert "peak" in op.EDGES[int(np.median(found.edge))]


def test_mixed_edges():
    """A sample that is brighter on one side and reflects on the other."""

    def surface(x, y):
        return 0.25 + 0.02 * x + 0.01 * y

    plain, shiny = (simulated(surface, specular=s, scale="linear") for s in (None, 25.0))
    values = np.where((X > 0.6)[..., None], shiny.values, plain.values)
    found = op.find_interface(op.OctVolume(values, plain.spacing, plain.optical_spacing, "linear"), op.UWA_845NM)
    edge = np.asarray(found.edge)
    assert np.mean(edge[X < 0.35] == 0) > 0.9
    assert np.mean(np.isin(edge[X > 0.85], (2, 3))) > 0.9
    error, _ = errors(found, surface)
    assert np.sqrt(np.mean(error**2)) < 1.0 * UM


def test_lines_at_constant_depth_over_a_flat_layer():
    def surface(x, y):
        return np.full_like(x, 0.25)

    clean = op.find_interface(simulated(surface), op.UWA_845NM)
    lines = [(0.1, 0.0), (0.16, 10.0), (0.262, 10.0), (0.35, 5.0)]
    found = op.find_interface(simulated(surface, lines=lines), op.UWA_845NM)
    moved = np.asarray(found.depth - clean.depth)[~np.asarray(found.mask | clean.mask)]
    assert abs(moved.mean()) < 0.5 * UM
    assert np.asarray(found.mask).mean() < 0.02
    assert "lines" in [step.name for step in found.steps]


def test_shadow_is_masked_and_not_bridged():
    surface = waves(0.16)
    volume = simulated(surface, scale="complex", snr=40.0)
    rng = np.random.default_rng(0)
    noise = 3e-2 * (rng.standard_normal(volume.shape) + 1j * rng.standard_normal(volume.shape))
    dark = (np.abs(X - 0.6) < 0.15) & (np.abs(Y - 0.6) < 0.25)
    values = np.where(dark[..., None], 0.0, volume.values) + noise
    shaded = op.OctVolume(values.astype(np.complex64), volume.spacing, volume.optical_spacing, "complex")
    found = op.find_interface(shaded, op.UWA_845NM)
    core = (np.abs(X - 0.6) < 0.1) & (np.abs(Y - 0.6) < 0.2)
    far = (np.abs(X - 0.6) > 0.25) | (np.abs(Y - 0.6) > 0.35)
    mask = np.asarray(found.mask)
    assert mask[core].mean() > 0.97
    assert mask[far].mean() < 0.02
    assert found.thickness().mask[core].mean() > 0.97


def test_masked_region_does_not_matter():
    surface = waves(0.16)
    volume = simulated(surface, scale="linear")
    mask = np.hypot(X - 0.7, Y - 0.5) < 0.2
    values = np.where(mask[..., None], 1e3, volume.values)
    found = op.find_interface(
        op.OctVolume(values, volume.spacing, volume.optical_spacing, "linear"), op.UWA_845NM, mask=mask
    )
    assert np.asarray(found.mask)[mask].all()
    error, _ = errors(found, surface)
    assert np.sqrt(np.mean(error**2)) < 1.5 * UM
    assert np.asarray(found.mask)[~mask].mean() < 0.02


def test_window_tilted_by_three_degrees():
    """Both interfaces of a dual-arm microscope; light bends towards the normal inside the layer."""
    outside = np.radians(3.0)
    inside = np.arcsin(np.sin(outside) / 1.4)
    path = 0.25 / np.cos(inside)  # of a layer of 0.25 mm

    def window(x, y):
        return 0.05 + np.tan(outside) / 1.4 * x  # stored depth is divided by the layer's index

    below = simulated(lambda x, y: window(x, y) + path, scale="complex")
    away = (np.asarray(below.depth(1.4)) - window(X, Y)[..., None]) / 7.8e-3
    reflected = 30.0 * np.exp(-2.0 * np.log(2.0) * away**2)
    volume = op.OctVolume(
        (below.values + reflected).astype(np.complex64), below.spacing, below.optical_spacing, "complex"
    )
    measured = op.thickness_from_oct(volume, op.UWA_845NM, window="find", tilt="plane")
    plain = op.thickness_from_oct(volume, op.UWA_845NM, window="find")
    kept = ~np.asarray(measured.mask)
    assert kept.mean() > 0.95
    error = np.asarray(measured.values)[kept] - 0.25
    assert abs(error.mean()) < 0.4 * UM
    assert abs(np.asarray(plain.values)[kept].mean() - path) < 0.4 * UM


def test_thickness_is_a_map_that_knows_its_noise():
    surface = waves(0.16)
    volume = simulated(surface)
    found = op.find_interface(volume, op.UWA_845NM)
    thickness = op.thickness_from_oct(volume, op.UWA_845NM)
    np.testing.assert_array_equal(thickness.values, found.depth)
    np.testing.assert_array_equal(thickness.std, found.std)
    np.testing.assert_allclose(thickness.spacing, (DX, DX))
    # Noise is correlated as `noise_length` says: variance left after smoothing.
    error = np.asarray(thickness.values) - surface(X, Y)
    smooth = op.ThicknessMap(0.5 + error, spacing=DX, std=float(error.std()), noise_length=thickness.noise_length)
    left = smooth.smoothed(0.12)
    inner = slice(12, -12)
    np.testing.assert_allclose(np.asarray(left.values)[inner, inner].std() / np.median(left.std), 1.0, atol=0.25)


def test_depth_counts_from_the_zero_delay():
    volume = simulated(waves(0.16))
    cropped = volume.cropped(depth=(0.14, 0.62))
    whole, part = (op.find_interface(v, op.UWA_845NM, search=(0.12, None)) for v in (volume, cropped))
    np.testing.assert_allclose(part.depth, whole.depth, atol=0.1 * UM)


def test_blocks_of_scans_change_nothing():
    """Nor a last block of three rows, whose own mean profile is mostly speckle."""
    volume = simulated(waves(0.3))
    one, other = (op.find_interface(volume, op.UWA_845NM, block_rows=rows) for rows in (96, 31))
    # Rates of decay are means over blocks, and those of a block in the first pass.
    np.testing.assert_allclose(one.depth, other.depth, atol=0.05 * UM)
    np.testing.assert_allclose(np.median(one.std, axis=1), np.median(other.std, axis=1), rtol=0.01)


def test_what_cannot_be_found_is_refused():
    rng = np.random.default_rng(1)
    noise = op.OctVolume(rng.exponential(size=(48, 48, 200)).astype(np.float32), DX, 3.5e-3, "linear")
    with pytest.raises(op.MeasurementError, match=r"contrast is below 1.5 dB over \d+% of the map"):
        op.find_interface(noise, op.UWA_845NM)
    volume = simulated(lambda x, y: np.full_like(x, 0.25))
    with pytest.raises(op.MeasurementError, match=r"end of the search, 0\.24"):
        op.find_interface(volume, op.UWA_845NM, search=(0.245, None))
    with pytest.raises(ValueError, match="at least 8 samples"):
        op.find_interface(volume, op.UWA_845NM, search=(0.44, None))
    with pytest.raises(ValueError, match=r"mask must be bool of shape \(96, 96\)"):
        op.find_interface(volume, op.UWA_845NM, mask=np.zeros((3, 3), bool))
