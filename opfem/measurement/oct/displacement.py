"""Axial displacement at every point of a volume, its strain, and increments added up.

`axial_displacement` makes it from the phase of two volumes; a friction fit takes its `increments`.
"""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from ..._types import Pair, Scalar
from ..grid import AbstractGrid
from ..thickness import Step
from .increments import AxialIncrement

_MOST_WEIGHT = 0.999  # coherence that counts most: above, its own estimate is the larger error
_LEAST_SHARE = 0.5  # of a window's or block's samples that must be known

Volume = Float[np.ndarray, "ny nx nz"]


class StrainVolume(eqx.Module):
    """Axial strain at every point of a volume.

    Attributes:
        values: du_z/dz `[y, x, z]` [-], negative in compression.
        std: Its standard deviation [-], without that of the common scale.
        mask: True where there is none.
    """

    values: Volume
    std: Volume
    mask: Bool[np.ndarray, "ny nx nz"]


class DisplacementVolume(AbstractGrid):
    """Axial displacement of the layer between two volumes, at positions of the first.

    Attributes:
        values: Displacement `[y, x, z]` [mm], negative towards the window.
        std: Its standard deviation [mm], without that of the scale.
        coherence: Of the two volumes, laterally averaged [-].
        mask: True where the displacement is not known; values are 0 there.
        depth: Geometric depths of the first volume [mm].
        spacing: Distance between A-lines (dx, dy) [mm].
        origin: (x, y) of the first A-line [mm].
        scale_std: Relative standard deviation of the scale λ/n, common to all values [-].
        noise_length: FWHM of the lateral average along x and y [mm].
        axial_noise: Samples along depth that share one sample's noise [-].
        steps: Processing steps, in order.
    """

    values: Volume
    std: Volume
    coherence: Volume
    mask: Bool[np.ndarray, "ny nx nz"]
    depth: Float[np.ndarray, " nz"]
    spacing: Pair
    origin: Pair
    scale_std: Scalar
    noise_length: Pair
    axial_noise: Scalar
    steps: tuple[Step, ...]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Number of samples (ny, nx, nz)."""
        ny, nx, nz = self.values.shape
        return ny, nx, nz

    def strain(self, length: float | int = 0.1) -> StrainVolume:
        """Compute the axial strain by weighted least squares over a window in depth.

        Lags between neighbours would be biased towards zero: pixels of one point spread function share their
        scatterers. Over 40 samples and more the slope of the unwrapped phase is not.

        Args:
            length: Of the window [mm].

        Raises:
            ValueError: For a window of fewer than 5 samples.

        Source:
            Kennedy et al., Optics Express 20 (2012) 23414 (weighted least squares).
        """
        dz = float(self.depth[1] - self.depth[0])
        half = round(0.5 * float(length) / dz)
        if half < 2:
            raise ValueError(f"strain: length [mm] must be at least {4 * dz:.3g}, five samples, got {length:g}.")
        c = np.clip(self.coherence, 0.0, _MOST_WEIGHT)
        w = np.where(self.mask, 0.0, c**2 / (1.0 - c**2))
        z = np.broadcast_to(self.depth, w.shape)

        def windowed(values):
            ends = [np.zeros((*w.shape[:2], count)) for count in (half + 1, half)]
            sums = np.cumsum(np.concatenate([ends[0], values, ends[1]], axis=2), axis=2)
            return sums[..., 2 * half + 1 :] - sums[..., : -2 * half - 1]

        total = np.maximum(windowed(w), 1e-30)
        middle = windowed(w * z) / total
        spread = np.maximum(windowed(w * z**2) - total * middle**2, 1e-30)
        slope = (windowed(w * z * self.values) - middle * windowed(w * self.values)) / spread
        v = w**2 * self.std**2
        moment = windowed(v * z**2) - 2.0 * middle * windowed(v * z) + middle**2 * windowed(v)
        std = np.sqrt(np.maximum(moment * float(self.axial_noise), 0.0)) / spread
        mask = self.mask | (windowed(~self.mask) < _LEAST_SHARE * (2 * half + 1))
        return StrainVolume(np.where(mask, 0.0, slope), np.where(mask, 0.0, std), mask)

    def cumulative(self, *increments: "DisplacementVolume") -> "DisplacementVolume":
        """Add the displacements of increments that follow one another, each taken where the point has moved to.

        u(X) = Σ u_i(X + Σ_{j<i} u_j), at positions before the first.

        Args:
            increments: What followed, in order, on the same grid.

        Raises:
            ValueError: For another grid.
        """
        total, variance, mask = self.values.astype(float), self.std.astype(float) ** 2, self.mask.copy()
        coherence = self.coherence
        dz = float(self.depth[1] - self.depth[0])
        for number, increment in enumerate(increments, start=2):
            if increment.shape != self.shape or not np.allclose(increment.depth, self.depth):
                raise ValueError(
                    f"cumulative: increment {number} lies on another grid, {increment.shape}, than {self.shape}."
                )
            place = np.clip(np.arange(self.depth.size) + total / dz, 0, self.depth.size - 1)
            before = np.minimum(place.astype(int), self.depth.size - 2)
            share = place - before

            def at(values, before=before, share=share):
                one, two = (np.take_along_axis(values, before + k, axis=2) for k in (0, 1))
                return (1.0 - share) * one + share * two

            total, variance = total + at(increment.values), variance + at(increment.std**2)
            mask |= at(increment.mask.astype(float)) > 0
            coherence = np.minimum(coherence, at(increment.coherence))
        return eqx.tree_at(
            lambda v: (v.values, v.std, v.coherence, v.mask, v.steps),
            self,
            (np.where(mask, 0.0, total), np.sqrt(variance), coherence, mask,
             (*self.steps, Step("cumulative", increments=len(increments) + 1))),
        )  # fmt: skip

    def increments(
        self,
        palpation: Any,
        spacing: tuple[float, float, float] = (0.1, 0.1, 0.05),
        margin: float | int = 0.5,
        before: int = 0,
        after: int = 1,
    ) -> AxialIncrement:
        """Average over blocks, for a fit: of each block one displacement, whose noise counts the correlation in.

        Args:
            palpation: The experiment, whose `extent` bounds the layer.
            spacing: Size of the blocks along x, y and z [mm].
            margin: Distance from the layer's edges that is left out [mm]: there the mesh is the larger error.
            before: Number of the first state of the fit.
            after: Number of the second.

        Raises:
            ValueError: If no block is known.
        """
        extent = np.asarray(palpation.extent)
        x, y, z = np.asarray(self.x), np.asarray(self.y), self.depth
        counts = []
        for axis, size, inside in (
            (y, spacing[1], (y >= margin) & (y <= extent[1] - margin)),
            (x, spacing[0], (x >= margin) & (x <= extent[0] - margin)),
            (z, spacing[2], z >= 0),
        ):
            counts.append(np.where(inside, np.floor((axis - axis[0]) / size), -1).astype(int))
        blocks = [n.max() + 1 for n in counts]
        if min(blocks) < 1:
            raise ValueError(f"increments: no A-line lies more than margin={margin:g} mm inside the layer's edges.")
        index = np.ravel_multi_index(np.meshgrid(*[np.maximum(n, 0) for n in counts], indexing="ij"), blocks)
        used = ~self.mask & (counts[0] >= 0)[:, None, None] & (counts[1] >= 0)[:, None] & (counts[2] >= 0)
        weight = np.where(used, 1.0 / np.maximum(self.std, 1e-9) ** 2, 0.0)

        def summed(values):
            return np.bincount(index.ravel(), np.broadcast_to(values, weight.shape).ravel(), minlength=np.prod(blocks))

        total, pixels = summed(weight), summed(used.astype(float))
        known = pixels > _LEAST_SHARE * pixels.max()
        if not known.any():
            raise ValueError("increments: no block holds a known displacement; lower min_coherence, or average more.")
        mean = [summed(weight * values)[known] / total[known] for values in
                (x[:, None], y[:, None, None], z, self.values)]  # fmt: skip
        # Samples that share noise: of the lateral average, its area over a pixel's; along depth as said.
        dx, dy = np.asarray(self.spacing)
        lateral = [np.sqrt(0.5 * np.pi / np.log(2.0)) * length / step for length, step in
                   zip(np.asarray(self.noise_length), (dx, dy), strict=True)]  # fmt: skip
        shared = np.prod([max(one, 1.0) for one in lateral]) * float(self.axial_noise)
        std = np.sqrt(np.minimum(shared / pixels[known], 1.0) * pixels[known] / total[known])
        points = np.stack(mean[:3], axis=1)
        return AxialIncrement(points, mean[3], std, self.scale_std, before=before, after=after)
