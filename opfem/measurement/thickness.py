"""A measured map of the layer's thickness, with its grid, noise and missing pixels, and how it was processed.

First link of the chain: readers make it, `Imprint` and `fit_traction` take it. All of it is a frozen
PyTree: every number is a leaf, so two maps of one shape share one compilation.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import wadler_lindig as wl
from jaxtyping import Array

from .._checks import as_leaf, check_non_negative, check_positive, concrete
from .._repr import quantity
from .._types import Map, Mask, Pair, Points, Scalar, ScalarLike
from .checks import check_grid, check_map_shape, check_mask, check_std, check_thickness
from .filtering import WHITE_NOISE_LENGTH, smooth, smoothed_variance
from .grid import AbstractGrid, bilinear, kept, pair
from .inpainting import harmonic_fill

# A sample counts as used by an interpolated point above this weight; below it is round-off of a grid line.
_USED = 1e-6


class Step(eqx.Module):
    """One processing step of a map: its name and its numbers.

    Attributes:
        name: Name of the step; static.
        numbers: Its numbers; leaves, so that maps with other numbers share one compilation.
    """

    name: str = eqx.field(static=True)
    numbers: dict[str, Array]

    def __init__(self, name: str, **numbers: Any):
        self.name = name
        self.numbers = {key: jnp.asarray(value) for key, value in numbers.items()}


class ThicknessMap(AbstractGrid):
    """Thickness of the layer at every pixel.

    Samples sit on points, not in cells; outside them the surface continues at its edge value.

    Attributes:
        values: Thickness [mm], `[y, x]`, positive. Where `mask` is True it is a placeholder, or the fill.
        extent: (Lx, Ly), distance from the first to the last sample [mm].
        origin: (x, y) of `values[0, 0]` [mm].
        std: Standard deviation of the noise [mm], one number or per pixel; None when not known.
        noise_length: FWHM [mm] of the Gaussian that would correlate white noise like this map's; 0 when white.
            Pixels d apart correlate by exp(-d²/(4 s²)), s = noise_length / 2.3548.
        mask: True for missing data. Filling does not change it.
        steps: Processing steps of the map, in order.
        is_filled: Whether masked pixels have a smooth fill; static.

    Example:
        >>> import jax.numpy as jnp
        >>> import opfem as op
        >>> loaded = op.ThicknessMap(jnp.full((11, 21), 0.45), extent=(5.0, 2.5), std=0.003)
        >>> loaded.shape, tuple(round(float(d), 3) for d in loaded.spacing)
        ((11, 21), (0.25, 0.25))
    """

    values: Map
    extent: Pair
    origin: Pair
    std: Scalar | Map | None
    noise_length: Scalar
    mask: Mask
    steps: tuple[Step, ...]
    is_filled: bool = eqx.field(static=True)

    def __init__(
        self,
        values: Any,
        extent: Any = None,
        spacing: Any = None,
        origin: Any = (0.0, 0.0),
        std: Any = None,
        mask: Any = None,
        *,
        noise_length: Any = 0.0,
        steps: tuple[Step, ...] = (),
        is_filled: bool = False,
    ):
        """Make a map from an array and its grid.

        Args:
            values: Thickness [mm], shape (ny, nx); of a NumPy masked array, masked pixels are no data.
            extent: (Lx, Ly) from the first to the last sample [mm]; this or `spacing`.
            spacing: (dx, dy) between samples [mm], or one number for both; this or `extent`.
            origin: (x, y) of `values[0, 0]` [mm].
            std: Standard deviation of the noise [mm], one number or shape (ny, nx).
            mask: Bool, shape (ny, nx); True where `values` is not data.
            noise_length: FWHM [mm] that the noise is correlated by; 0 is white.
            steps: Previous processing steps of the map.
            is_filled: Whether masked pixels of `values` have a smooth fill.

        Raises:
            ValueError: For a wrong shape; NaN, infinite, or unmasked non-positive thickness; a range that
                suggests another unit; both or neither of `extent` and `spacing`.
        """
        if isinstance(values, np.ma.MaskedArray):
            masked = np.ma.getmaskarray(values)
            mask = masked if mask is None else jnp.asarray(mask) | masked
            values = values.filled(1.0)  # values of masked pixels, NaN included, are ignored
        self.values = as_leaf(values, "ThicknessMap.values", "mm")
        check_map_shape(self.values)
        shape, dtype = self.values.shape, self.values.dtype
        if (extent is None) == (spacing is None):
            got = "neither" if extent is None else "both"
            raise ValueError(
                f"ThicknessMap needs either extent=(Lx, Ly) or spacing=(dx, dy) [mm], got {got}; "
                f"the map has (ny, nx) = {shape} samples."
            )
        if extent is None:
            steps_between = jnp.array([shape[1] - 1, shape[0] - 1], dtype)
            spacing = as_leaf(spacing, "ThicknessMap.spacing (dx, dy)", "mm")
            check_positive("ThicknessMap.spacing (dx, dy)", "mm", spacing)
            self.extent = pair("ThicknessMap.spacing (dx, dy)", spacing) * steps_between
        else:
            self.extent = pair("ThicknessMap.extent (Lx, Ly)", extent)
        self.origin = pair("ThicknessMap.origin (x, y)", origin)
        self.mask = jnp.zeros(shape, bool) if mask is None else jnp.asarray(mask)
        self.std = None if std is None else as_leaf(std, "ThicknessMap.std", "mm")
        self.noise_length = as_leaf(noise_length, "ThicknessMap.noise_length", "mm")
        self.steps = steps
        self.is_filled = is_filled
        check_grid(self.extent, self.origin)
        check_mask(self.mask, shape)
        check_thickness(self.values, self.mask)
        check_non_negative("ThicknessMap.noise_length", "mm", self.noise_length)
        if self.std is not None:
            check_std(self.std, self.mask, shape)

    def __pdoc__(self, **options: Any) -> Any:
        del options
        values, mask = concrete(self.values), concrete(self.mask)
        if values is None or mask is None or values.ndim != 2 or mask.all():
            return None  # traced or stacked: as equinox writes it
        low, high = values[~mask].min(), values[~mask].max()
        span = f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
        parts = [f"{values.shape[1]} × {values.shape[0]} pixels", f"{span} mm"]
        for name in ("extent", "origin", "std", "noise_length"):
            part = getattr(self, name)
            if part is not None and (concrete(part) is None or np.any(part)):
                parts.append(f"{name} {quantity(part, 'mm')}")
        parts += [f"{mask.sum()} missing{' and filled' if self.is_filled else ''}"] if mask.any() else []
        return wl.TextDoc(f"ThicknessMap({', '.join(parts)})")

    @property
    def shape(self) -> tuple[int, int]:
        """Number of samples (ny, nx)."""
        ny, nx = self.values.shape
        return ny, nx

    @property
    def spacing(self) -> tuple[Scalar, Scalar]:
        """Distance between samples (dx, dy) [mm]."""
        ny, nx = self.shape
        return self.extent[0] / (nx - 1), self.extent[1] / (ny - 1)

    def filled(self) -> "ThicknessMap":
        """Fill masked pixels smoothly, as a membrane stretched from the rim of each hole.

        The mask stays: a filled pixel is still no data. Its std is left as it was and has no meaning.

        Raises:
            ValueError: When the fill does not converge.
        """
        values = harmonic_fill(self.values, self.mask, self.spacing)
        known = concrete(values)
        if known is not None and not np.isfinite(known).all():
            raise ValueError(
                "ThicknessMap.filled did not converge; crop the map so that less of it is masked, "
                f"got {int(self.mask.sum())} masked of {self.mask.size} pixels."
            )
        step = Step("filled", pixels=self.mask.sum())
        return self._processed(step, values=values, is_filled=True)

    def smoothed(self, fwhm: ScalarLike) -> "ThicknessMap":
        """Smooth by a Gaussian, and reduce the std of the noise accordingly.

        Beyond its edges the map continues at the edge value. `noise_length` grows in quadrature. Noise of
        filled pixels counts like that of the others. Differentiable in `fwhm`.

        Args:
            fwhm: Full width at half maximum [mm]; zero changes nothing.

        Raises:
            ValueError: For masked pixels that are not filled, and a negative width or one above half the map.
                Under jit such masked pixels turn the whole map into NaN.
        """
        check_non_negative("smoothed.fwhm", "mm", fwhm)
        sides, width = concrete(self.extent), concrete(fwhm)
        if sides is not None and width is not None and np.any(width > 0.5 * sides.min()):
            raise ValueError(
                f"smoothed.fwhm [mm] must be at most half of the map's shorter side, {0.5 * sides.min():g}, "
                f"got {width:g}."
            )
        values = smooth(self._usable_values("smooth"), self.spacing, fwhm)
        std = self.std
        if std is not None:
            variance = jnp.broadcast_to(std, self.shape) ** 2
            std = jnp.sqrt(smoothed_variance(variance, self.spacing, fwhm, self.noise_length))
        noise_length = _root(self.noise_length**2 + jnp.asarray(fwhm, self.values.dtype) ** 2)
        return self._processed(Step("smoothed", fwhm=fwhm), values=values, std=std, noise_length=noise_length)

    def cropped(self, x: tuple[float, float] | None = None, y: tuple[float, float] | None = None) -> "ThicknessMap":
        """Keep the samples within the given ranges; they stay where they are.

        Args:
            x: (first, last) position along image columns [mm], both included; None keeps all.
            y: (first, last) position along image rows [mm], both included; None keeps all.

        Raises:
            ValueError: When fewer than 2 samples remain along an axis; under jit, where the new shape is unknown.
        """
        columns = kept("x", x, self.x)
        rows = kept("y", y, self.y)

        def cut(field: Array) -> Array:
            return field[rows, columns]

        extent = jnp.stack([self.x[columns][-1] - self.x[columns][0], self.y[rows][-1] - self.y[rows][0]])
        origin = jnp.stack([self.x[columns][0], self.y[rows][0]])
        std = self.std if self.std is None or self.std.ndim == 0 else cut(self.std)
        step = Step("cropped", origin=origin, extent=extent)
        return self._processed(
            step, values=cut(self.values), mask=cut(self.mask), std=std, extent=extent, origin=origin
        )

    def resampled(self, spacing: Any = None, shape: tuple[int, int] | None = None) -> "ThicknessMap":
        """Interpolate bilinearly onto another grid over the same extent.

        A new pixel is masked where a masked one contributes. The std is interpolated and not reduced, an
        upper bound. Onto a finer grid `noise_length` grows so that the noise per area stays: pixels made
        by interpolation bring no information. A coarser grid picks pixels without averaging: smooth first.

        Args:
            spacing: (dx, dy) [mm], or one number for both, rounded to divide the extent; this or `shape`.
            shape: Number of samples (ny, nx), at least 2 each; this or `spacing`.

        Raises:
            ValueError: For both or neither of `spacing` and `shape`, or a bad one; for `spacing` under jit.
        """
        ny, nx = self._new_shape(spacing, shape)
        x = self.origin[0] + self.extent[0] * jnp.linspace(0.0, 1.0, nx)
        y = self.origin[1] + self.extent[1] * jnp.linspace(0.0, 1.0, ny)
        xs, ys = jnp.meshgrid(x.astype(self.values.dtype), y.astype(self.values.dtype))

        def interpolate(field: Map) -> Array:
            return bilinear(field, self.origin, self.spacing, xs, ys)

        std = self.std if self.std is None or self.std.ndim == 0 else interpolate(self.std)
        old_area = self.spacing[0] * self.spacing[1]
        new_area = self.extent[0] * self.extent[1] / ((nx - 1) * (ny - 1))
        noise_length = _root(self.noise_length**2 + WHITE_NOISE_LENGTH**2 * jnp.maximum(old_area - new_area, 0.0))
        return self._processed(
            Step("resampled", spacing=jnp.stack([self.extent[0] / (nx - 1), self.extent[1] / (ny - 1)])),
            values=interpolate(self.values),
            mask=interpolate(self.mask.astype(self.values.dtype)) > _USED,
            std=std,
            noise_length=noise_length,
        )

    def sample(self, x: Points, y: Points) -> Points:
        """Interpolate the thickness bilinearly at any points; beyond the samples the edge value continues.

        Args:
            x: Positions along image columns [mm].
            y: Positions along image rows [mm]; shape of `x`.

        Returns:
            Thickness [mm]; NaN where a masked pixel that is not filled contributes.
        """
        thickness = bilinear(self.values, self.origin, self.spacing, x, y)
        if self.is_filled:
            return thickness
        missing = bilinear(self.mask.astype(self.values.dtype), self.origin, self.spacing, x, y)
        return jnp.where(missing > _USED, jnp.nan, thickness)

    def _usable_values(self, verb: str) -> Map:
        if self.is_filled:
            return self.values
        masked = concrete(self.mask)
        if masked is None:
            return jnp.where(self.mask.any(), jnp.nan, self.values)
        if masked.any():
            raise ValueError(
                f"Cannot {verb} a ThicknessMap with {int(masked.sum())} masked pixels that are not filled; "
                "call filled() first."
            )
        return self.values

    def _new_shape(self, spacing: Any, shape: tuple[int, int] | None) -> tuple[int, int]:
        if (spacing is None) == (shape is None):
            got = "neither" if shape is None else "both"
            raise ValueError(f"resampled needs either spacing=(dx, dy) [mm] or shape=(ny, nx), got {got}.")
        if shape is None:
            sides, step = concrete(self.extent), concrete(pair("resampled.spacing (dx, dy)", spacing))
            if sides is None or step is None:
                raise ValueError("resampled(spacing=) needs known numbers; under jit or vmap pass shape=(ny, nx).")
            check_positive("resampled.spacing (dx, dy)", "mm", step)
            intervals = np.round(sides / step).astype(int)
            shape = (int(intervals[1]) + 1, int(intervals[0]) + 1)
        if len(shape) != 2 or min(shape) < 2:
            raise ValueError(f"resampled.shape (ny, nx) must be at least 2 by 2 samples, got {shape}.")
        return shape

    def _processed(self, step: Step, **changed: Any) -> "ThicknessMap":
        fields: dict[str, Any] = {name: getattr(self, name) for name in self.__dataclass_fields__}
        fields |= changed
        fields["steps"] = (*self.steps, step)
        return ThicknessMap(**fields)


def _root(square: Scalar) -> Scalar:
    # The double where keeps the derivative finite at zero, where the root has none.
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
