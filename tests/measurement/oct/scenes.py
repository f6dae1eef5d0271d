"""Surfaces and volumes that the tests of OCT share."""

import jax
import numpy as np

import opfem as op

DX, SAMPLES = 12.5e-3, 96  # mm; A-lines along a side
X, Y = np.meshgrid(DX * np.arange(SAMPLES), DX * np.arange(SAMPLES))


def waves(slope, depth=0.25):
    """Waves of 0.8 mm with a largest slope, in x and y."""
    k = 2 * np.pi / 0.8
    return lambda x, y: depth + slope / k * np.sin(k * x + 0.3) * np.cos(0.5 * k * y)


def simulated(surface, contrast=15.0, snr=25.0, seed=0, **more):
    """A sample `contrast` dB brighter than the layer, `snr` dB above the noise."""
    media = more.pop("media", (op.Medium(-contrast, 0.5), op.SAMPLE))
    return op.simulate_oct(
        op.UWA_845NM, surface, key=jax.random.key(seed), spacing=(DX, DX), shape=(SAMPLES, SAMPLES), depth=0.45,
        media=media, snr=snr, **more,
    )  # fmt: skip


def errors(found, surface):
    """Error [mm] of the depths that are not masked, and their std."""
    kept = ~np.asarray(found.mask)
    error = np.asarray(found.depth) - np.broadcast_to(surface(X, Y), X.shape)
    return error[kept], np.asarray(found.std)[kept]
