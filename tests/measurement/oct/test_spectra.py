"""A mirror in raw spectra comes back at its depth, moves as it moved, and stays sharp under dispersion."""

import numpy as np
import pytest

import opfem as op
from tests.measurement.oct.scenes import errors, simulated, waves

PIXELS = 2048
K = (2 * np.pi / 930e-6, 2 * np.pi / 830e-6)  # rad/mm, at the ends of the spectrum


def mirror(depths, ascending=True, dispersion=0.0, offset=100.0):
    """Interferograms of a mirror at optical depths [mm], on a spectrometer whose pixels lie even in wavelength."""
    places = np.linspace(0.0, 1.0, PIXELS)
    wavelength = 2 * np.pi / K[1] + places * (2 * np.pi / K[0] - 2 * np.pi / K[1])  # short to long
    k = 2 * np.pi / wavelength
    if ascending:
        k = k[::-1]
    chirp = (k - k[0]) / (k[-1] - k[0]) * (PIXELS - 1)
    reference = 3e4 * np.exp(-0.5 * ((k - np.mean(K)) / 150.0) ** 2)
    span = 2 * chirp / (PIXELS - 1) - 1
    turn = dispersion * span**2
    counts = [reference * (1 + 0.2 * np.cos(2 * k * depth + turn)) + offset for depth in depths]
    return op.Spectra(
        np.array(counts, np.float32)[None], 0.01, np.pi / (K[1] - K[0]) * (PIXELS - 1) / PIXELS,
        reference=reference, offset=offset, chirp=chirp, is_ascending=ascending,
    )  # fmt: skip


def places(volume):
    """Depths [mm] of the brightest samples, by the parabola through the logarithm of the power."""
    power = np.log(volume.intensity()[0])
    top = np.argmax(power[:, 8:-8], axis=1) + 8
    low, mid, high = (power[np.arange(top.size), top + step] for step in (-1, 0, 1))
    return (top + 0.5 * (low - high) / (low - 2 * mid + high)) * float(volume.optical_spacing)


@pytest.mark.parametrize("ascending", [True, False])
def test_moving_mirror(ascending):
    depths = np.array([0.2, 0.3, 0.3001, 0.9, 1.6])
    volume = mirror(depths, ascending).to_volume()
    np.testing.assert_allclose(places(volume), depths, atol=0.5e-3)
    assert volume.phase_sign == (1 if ascending else -1)
    # 0.1 µm between the second and the third, at the centroid of the shaped spectrum.
    field = np.asarray(volume.values)[0]
    top = np.argmax(np.abs(field[1]))
    moved = volume.phase_sign * np.angle(field[2, top] * np.conj(field[1, top])) / (2 * np.mean(K))
    assert moved == pytest.approx(1e-4, rel=5e-3)


def test_dispersion_is_taken_out():
    sharp, blurred = mirror([0.5]).to_volume(), mirror([0.5], dispersion=30.0)
    assert blurred.to_volume().intensity().max() < 0.3 * sharp.intensity().max()
    mended = blurred.to_volume(dispersion=(30.0, 0.0))
    assert mended.intensity().max() == pytest.approx(sharp.intensity().max(), rel=1e-3)
    np.testing.assert_allclose(places(mended), 0.5, atol=0.5e-3)


def test_reference_is_the_mean_where_none_is_given():
    rng = np.random.default_rng(0)
    spectra = mirror(rng.uniform(0.3, 1.2, 200))
    plain = op.Spectra(
        spectra.values, 0.01, spectra.optical_spacing, offset=100.0, chirp=spectra.chirp, is_ascending=True
    )
    np.testing.assert_allclose(places(plain.to_volume())[:20], places(spectra.to_volume())[:20], atol=0.5e-3)


def test_bad_spectra_are_refused():
    good = mirror([0.3])
    with pytest.raises(ValueError, match="chirp must grow"):
        op.Spectra(good.values, 0.01, 2e-3, chirp=np.arange(PIXELS)[::-1])
    with pytest.raises(ValueError, match="one number a pixel, 2048, got shape"):
        op.Spectra(good.values, 0.01, 2e-3, reference=np.ones(5))


def test_interface_in_the_file_of_simulated_spectra(tmp_path):
    """A scene in raw spectra, with dispersion, written and read, has its interface where the volume has it."""
    surface = waves(0.16)
    direct = simulated(surface, seed=1, scale="complex")
    recorded = simulated(surface, seed=1, spectra=True, dispersion=(20.0, 5.0))
    for suffix in (".h5", ".oct"):
        op.write_oct(recorded, tmp_path / f"a{suffix}")
    stored, volume = (op.read_oct(tmp_path / f"a{suffix}") for suffix in (".h5", ".oct"))
    np.testing.assert_allclose(volume.values, stored.values, atol=1e-4 * np.abs(stored.values).max())
    assert volume.shape == direct.shape
    assert volume.phase_sign == -1
    one, other = (op.find_interface(v, op.UWA_845NM, edge="brighter") for v in (volume, direct))
    moved = np.asarray(one.depth - other.depth)
    assert abs(moved.mean()) < 0.5e-3  # a Hann window is not the Gaussian of the system
    assert moved.std() < 0.5 * np.median(other.std)  # the same speckle, other noise
    error, std = errors(one, surface)
    assert abs(error.mean()) < 0.4e-3
    assert 0.8 < np.sqrt(np.mean((error / std) ** 2)) < 1.25


def test_spectra_shaped_as_the_light_give_the_volume():
    """Without a window the axial resolution is the system's: the field is that of the volume, to its noise."""
    direct, recorded = (
        simulated(waves(0.16), seed=1, snr=50.0, **how) for how in ({"scale": "complex"}, {"spectra": True})
    )
    assert recorded.values.dtype == np.uint16
    field = np.conj(recorded.to_volume("none").values)[..., 12:110]  # resampling loses fringes beyond
    expected = np.asarray(direct.values)[..., 12:110]
    scale = np.vdot(expected, field) / np.vdot(expected, expected)
    left = np.abs(field / scale - expected) ** 2
    assert abs(np.angle(scale)) < 0.05  # the centroid of lit pixels lies 0.02 pixels beside the centre
    assert left.mean() < 2e-3 * np.mean(np.abs(expected) ** 2)


def test_noise_of_spectra():
    """Far from the sample a volume has the noise that was asked for."""
    common = {"media": (op.Medium(-90.0, 0.0), op.Medium(0.0, 0.0)), "snr": 20.0}
    surface = waves(0.0, depth=0.12)  # resampling loses little so near
    direct, recorded = (simulated(surface, **how, **common) for how in ({"scale": "linear"}, {"spectra": True}))
    power = recorded.to_volume("none").intensity()
    sample, dark = slice(56, 76), slice(16, 36)
    ratios = [p[..., sample].mean() / p[..., dark].mean() for p in (power, direct.values)]
    assert 10 * np.log10(ratios[0] / ratios[1]) == pytest.approx(0.0, abs=0.2)
