"""Axial displacement from phase against simulated volumes whose displacement is known."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure

import opfem as op

NM = 1e6
INNER = np.s_[10:-10, 10:-10, 20:]  # A-lines whose lateral average is whole
MEDIA = (op.Medium(0.0, 0.5), op.Medium(0.0, 0.5))


def volumes(displacement, shape=(30, 36), seed=0, snr=25.0, depth=0.4):
    return op.simulate_oct(
        op.UWA_845NM, lambda x, y: np.full_like(x, depth), key=jax.random.key(seed), spacing=(0.01, 0.01), shape=shape,
        depth=depth, increment=lambda x, y, z: (0 * z, 0 * z, displacement(z)), media=MEDIA, snr=snr,
    )  # fmt: skip


def changed(volume, values, **change):
    given = {"phase_sign": volume.phase_sign, "wavelength": volume.wavelength, **change}
    return op.OctVolume(values, volume.spacing, volume.optical_spacing, "complex", **given)


def errors(found, displacement, where=INNER):
    kept = ~found.mask[where]
    error = (found.values - np.asarray(displacement(found.depth)))[where][kept]
    return NM * error, error / found.std[where][kept]


@pytest.mark.parametrize(
    ("strain", "bias", "rms"),
    [(-1e-4, 0.5, 3.0), (-3e-3, 0.5, 3.0), (3e-3, 0.5, 3.0), (-6.6e-3, 1.0, 5.0), (-1e-2, 1.0, 8.0)],
)
def test_uniform_strain(strain, bias, rms):
    before, after = volumes(lambda z: strain * z)
    found = op.axial_displacement(before, after, op.UWA_845NM)
    error, z = errors(found, lambda depth: strain * depth)
    assert abs(error.mean()) < bias
    assert np.sqrt(np.mean(error**2)) < rms
    assert np.abs(error).max() < 100  # a lost turn is 302 nm
    assert 0.8 < np.sqrt(np.mean(z**2)) < 1.3
    assert found.mask[..., 10:].mean() < 0.01
    slopes = found.strain()
    assert slopes.values[~slopes.mask].mean() == pytest.approx(strain, rel=0.01)


def test_single_lines_have_no_lag_bias():
    """Products of neighbouring samples would give 0.54 of the strain."""
    before, after = volumes(lambda z: -1e-3 * z)
    slopes = op.axial_displacement(before, after, op.UWA_845NM, average=(0.0, 0.0)).strain()
    assert slopes.values[~slopes.mask].mean() == pytest.approx(-1e-3, rel=0.01)


def test_profile_that_is_not_linear():
    def profile(z):
        return -3e-3 * z + 50e-6 * jnp.sin(2 * jnp.pi * z / 0.4)

    error, _ = errors(op.axial_displacement(*volumes(profile), op.UWA_845NM), profile)
    assert np.sqrt(np.mean(error**2)) < 3.0


def test_positions_are_those_before():
    """Without carrying the second volume back, displacement is that of the midpoint: ½ u ∂u/∂z more."""
    before, after = volumes(lambda z: -3e-3 * z)
    plain = op.axial_displacement(before, after, op.UWA_845NM, motion_compensation=False)
    error, _ = errors(plain, lambda z: -3e-3 * z, np.s_[10:-10, 10:-10, 120:])
    middle = 0.5 * 3e-3**2 * NM * plain.depth[120:].mean()
    assert abs(error.mean()) == pytest.approx(middle, abs=0.5)


def test_sign_convention():
    before, after = volumes(lambda z: -1e-3 * z)
    other = [changed(volume, volume.values.conj(), phase_sign=-1) for volume in (before, after)]
    np.testing.assert_allclose(
        op.axial_displacement(*other, op.UWA_845NM).values,
        op.axial_displacement(before, after, op.UWA_845NM).values,
        atol=1e-8,
    )
    stated = op.axial_displacement(
        *[changed(v, v.values, phase_sign=None) for v in (before, after)], op.UWA_845NM, phase_sign=1
    )
    assert stated.values[15, 15, -1] < 0
    with pytest.raises(op.MeasurementError, match="phase_sign must be 1 or -1"):
        op.axial_displacement(*[changed(v, v.values, phase_sign=None) for v in (before, after)], op.UWA_845NM)


def test_phase_of_the_window_is_taken_out_line_by_line():
    """A window's reflection at 20 µm, and a random phase of every A-line of the second volume."""
    before, after = volumes(lambda z: -1e-3 * z)
    rng = np.random.default_rng(0)
    point = 1e3 * np.exp(-2 * np.log(2) * ((np.arange(before.shape[2]) * 2.5e-3 - 0.02) / 7.8e-3) ** 2).astype(
        np.complex64
    )
    turns = np.exp(2j * np.pi * rng.random((*before.shape[:2], 1))).astype(np.complex64)
    window = op.find_interface(changed(before, before.values + point), op.UWA_845NM, edge="peak", search=(0.0, 0.06))
    found = op.axial_displacement(
        changed(before, before.values + point),
        changed(after, (after.values + point) * turns),
        op.UWA_845NM,
        reference=window,
    )
    error, _ = errors(found, lambda z: -1e-3 * z, np.s_[10:-10, 10:-10, 40:])
    assert abs(error.mean()) < 0.5
    assert np.sqrt(np.mean(error**2)) < 3.0


def test_bulk_phase_of_each_scan():
    before, after = volumes(lambda z: -1e-3 * z)
    turns = np.exp(1j * np.linspace(-3, 3, before.shape[0]))[:, None, None].astype(np.complex64)
    found = op.axial_displacement(before, changed(after, after.values * turns), op.UWA_845NM, reference="bulk")
    error, _ = errors(found, lambda z: -1e-3 * z)
    assert abs(error.mean()) < 1.0
    assert np.sqrt(np.mean(error**2)) < 3.0


def test_scans_are_registered():
    before, after = volumes(lambda z: -1e-3 * z, shape=(24, 60))
    moved = changed(after, np.roll(np.asarray(after.values), 2, axis=1))
    found = op.axial_displacement(before, moved, op.UWA_845NM)
    error, _ = errors(found, lambda z: -1e-3 * z)
    assert np.sqrt(np.mean(error**2)) < 1.5
    assert float(found.steps[-1].numbers["shift"]) == pytest.approx(2.0, abs=0.05)


def test_increments_add_up_where_points_have_moved():
    depth = np.arange(101) * 2.5e-3
    shape, first, second = (2, 2, 101), 0.02 * depth, 1e-3 * np.sin(20 * depth)

    def made(values):
        values = np.broadcast_to(values, shape)
        return dataclasses.replace(
            template,
            values=values,
            std=np.full(shape, 1e-6),
            coherence=np.full(shape, 0.99),
            mask=np.zeros(shape, bool),
            depth=depth,
        )

    template = op.axial_displacement(*volumes(lambda z: 0 * z, shape=(12, 12), depth=0.1), op.UWA_845NM)
    total = made(first).cumulative(made(second))
    inner = slice(0, 95)
    np.testing.assert_allclose(
        total.values[0, 0, inner], (first + 1e-3 * np.sin(20 * (depth + first)))[inner], atol=2e-6
    )
    np.testing.assert_allclose(total.std[0, 0, inner], np.sqrt(2) * 1e-6, rtol=1e-6)


def test_blocks_for_a_fit():
    before, after = volumes(lambda z: -1e-3 * z, shape=(40, 40))
    found = op.axial_displacement(before, after, op.UWA_845NM)
    layer = op.Layer(0.4, op.NeoHooke(3e-3, bulk=0.1))
    palpation = op.Palpation(layer, extent=(0.39, 0.39), elements=(2, 2, 1), window=op.Bonded(), sample=op.Bonded())
    blocks = found.increments(palpation, spacing=(0.1, 0.1, 0.05), margin=0.05)
    assert float(blocks.points[:, :2].min()) >= 0.05
    assert float(blocks.points[:, :2].max()) <= 0.34
    error = np.asarray(blocks.values + 1e-3 * blocks.points[:, 2])
    assert 0.25 < np.sqrt(np.mean((error / np.asarray(blocks.std)) ** 2)) < 1.3  # depths are anticorrelated
    with pytest.raises(ValueError, match="margin"):
        found.increments(palpation, margin=0.2)


def test_pictures():
    found = op.axial_displacement(*volumes(lambda z: -1e-3 * z, shape=(12, 14)), op.UWA_845NM)
    scan, line = op.plot_displacement(found, figure=Figure())
    assert scan.images[0].get_array().shape == (found.shape[2], 14)
    assert np.nanmin(line.lines[0].get_xdata()) == pytest.approx(-1e-3 * NM * 0.4, rel=0.05)


def test_what_is_refused():
    before, after = volumes(lambda z: 0 * z, shape=(12, 14))
    same = op.axial_displacement(before, before, op.UWA_845NM)
    assert np.abs(same.values).max() < 1e-9
    linear = op.OctVolume(before.intensity(), before.spacing, before.optical_spacing, "linear")
    with pytest.raises(op.MeasurementError, match=r"phase needs complex data.*export complex or raw spectra"):
        op.axial_displacement(before, linear, op.UWA_845NM)
    with pytest.raises(op.MeasurementError, match="crop to one grid"):
        op.axial_displacement(before, after.cropped(x=(0.0, 0.1)), op.UWA_845NM)
    other, _ = volumes(lambda z: 0 * z, shape=(12, 14), seed=9)
    with pytest.raises(op.MeasurementError, match=r"nothing in common.*smaller increments"):
        op.axial_displacement(before, other, op.UWA_845NM)
    with pytest.raises(ValueError, match="five samples"):
        same.strain(length=0.005)
