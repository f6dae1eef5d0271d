"""Simulated speckle is what theory says it is, and the same for the same key."""

import jax
import numpy as np
import pytest

import opfem as op
from opfem.measurement.oct import simulation
from tests.measurement.oct.scenes import DX, waves
from tests.tolerances import SAMPLING

EVEN = (op.Medium(0.0, 0.0), op.Medium(0.0, 0.0))


def deep(x, y):
    return np.full_like(x, 10.0)


def speckle(shape=(64, 64), key=0, **more):
    common = {"spacing": (DX, DX), "depth": 0.4, "snr": 80.0, "media": EVEN, "scale": "complex"}
    return op.simulate_oct(op.UWA_845NM, deep, key=jax.random.key(key), shape=shape, **{**common, **more})


def test_speckle_is_fully_developed():
    field = np.asarray(speckle().values)[..., 10:-10]
    power = np.abs(field) ** 2
    power /= power.mean(axis=(0, 1))
    assert power.std() == pytest.approx(1.0, abs=SAMPLING)  # 64 × 64 × 140 samples, some 100 000 of them independent
    # The largest lag has the largest effect: two samples apart along depth.
    relative = power - 1.0
    measured = np.mean(relative[..., 2:] * relative[..., :-2]) / np.mean(relative**2)
    assert measured == pytest.approx(np.exp(-2 * np.log(2) * (5.0 / 7.8) ** 2), abs=SAMPLING)


def test_motion_turns_the_phase_and_decorrelates():
    shift = 2e-3
    before, after = speckle(increment=lambda x, y, z: (0.0, 0.0, shift))
    a, b = (np.asarray(volume.values)[..., 10:-10] for volume in (before, after))
    gamma = np.vdot(a, b) / np.sqrt(np.vdot(a, a).real * np.vdot(b, b).real)
    assert abs(gamma) == pytest.approx(np.exp(-np.log(2) * (2.0 / 7.8) ** 2), abs=2e-3)
    phase = np.angle(gamma * np.exp(-4j * np.pi * 1.4 * shift / 845e-6))
    assert abs(845.0 / (4 * np.pi * 1.4) * phase) < 0.05  # nm
    assert before.phase_sign == 1


def test_sideways_motion_moves_the_speckle():
    before, after = speckle((32, 32), spacing=(4e-3, 4e-3), increment=lambda x, y, z: (4e-3, 0.0, 0.0))
    a, b = (np.abs(np.asarray(volume.values)[:, 4:-4, 10:-10]) ** 2 for volume in (before, after))
    assert np.corrcoef(a[:, :-1].ravel(), b[:, 1:].ravel())[0, 1] > 0.99


def test_noise_floor_and_levels():
    surface = waves(0.16)
    media = (op.Medium(-90.0, 0.0), op.Medium(0.0, 0.0))
    volume = op.simulate_oct(
        op.UWA_845NM, surface, key=jax.random.key(1), spacing=(DX, DX), shape=(48, 48), depth=0.4, media=media,
        snr=20.0, scale="linear",
    )  # fmt: skip
    roll_off = 10 ** (-0.6 * (1.4 * 0.25 / 1.5) ** 2)
    assert 10 * np.log10(volume.values[..., :60].mean() / roll_off) == pytest.approx(-20.0, abs=0.2)


def test_same_key_same_bits_whatever_the_slabs(monkeypatch):
    whole = speckle((12, 16))
    monkeypatch.setattr(simulation, "_SUBVOXELS", 1)  # one row at a time
    np.testing.assert_array_equal(speckle((12, 16)).values, whole.values)
    assert not np.array_equal(speckle((12, 16), key=1).values, whole.values)


def test_spectra_of_two_states():
    """An increment makes spectra before and after, whose volumes turn the phase against its direction in them."""
    how = {"spectra": True, "scale": "db", "increment": lambda x, y, z: (0.0, 0.0, 0.05e-3)}
    before, after = speckle((8, 8), **how)
    again, _ = speckle((8, 8), **how)
    np.testing.assert_array_equal(before.values, again.values)
    a, b = (np.asarray(spectra.to_volume("none").values)[..., 10:60] for spectra in (before, after))
    turned = np.angle(np.vdot(a, b)) / (4 * np.pi * 1.4 / 845e-6)
    assert before.to_volume().phase_sign == -1
    assert turned == pytest.approx(-0.05e-3, abs=0.1e-6)


def test_scales_agree():
    field, power, decibels = (speckle((8, 8), scale=scale) for scale in ("complex", "linear", "db"))
    np.testing.assert_allclose(field.intensity(), power.values, rtol=1e-5)
    np.testing.assert_allclose(decibels.intensity(), power.values, rtol=1e-5)


def test_what_cannot_be_simulated_is_refused():
    with pytest.raises(ValueError, match="at most 3 pixels, got 8"):
        speckle((8, 8), increment=lambda x, y, z: (0.0, 0.0, 0.02))
    with pytest.raises(ValueError, match=r"depth_spacing \[mm\] must be at most half of axial_fwhm"):
        speckle((8, 8), depth_spacing=5e-3)
    with pytest.raises(ValueError, match="is that of spectra; pass spectra=True"):
        speckle((8, 8), dispersion=(3.0, 0.0))
    with pytest.raises(ValueError, match=r"shape \(ny, nx\) is needed"):
        op.simulate_oct(op.UWA_845NM, deep, key=jax.random.key(0), spacing=(DX, DX))
