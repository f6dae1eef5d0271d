"""Where the sample begins in an OCT volume: the interface's depth with a standard deviation at every pixel.

Second link of the chain: takes an `OctVolume`, gives an `Interface`, whose `thickness` is the map that `Imprint` and
`fit_traction` take.
"""

import math
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ..._checks import check_positive
from ..._types import Map, Mask, Pair, Scalar
from ..errors import MeasurementError
from ..grid import AbstractGrid
from ..thickness import Step, ThicknessMap
from .searching import CONTRAST, Found, Search, search_volume
from .system import OctSystem
from .volume import OctVolume

Edge = Literal["auto", "brighter", "darker", "peak"]

_WINDOW_REACH = 0.03  # mm below the window's interface at which the search for the sample's starts


class Interface(AbstractGrid):
    """Depth of the interface between layer and sample at every pixel.

    Attributes:
        depth: Geometric depth from the zero delay [mm].
        std: Its standard deviation [mm].
        confidence: Posterior probability of this depth against the best other one.
        contrast_db: Power below over power above [dB]; of a peak, over its ground.
        edge: Index in `EDGES` of the kind of edge.
        mask: True where there is no interface to be sure of.
        spacing: (dx, dy) [mm].
        origin: (x, y) of the first pixel [mm].
        noise_length: FWHM [mm] of the Gaussian that correlates the noise.
        index: Group index that made depth geometric [-].
        steps: Processing steps of the volume and of this search.
    """

    depth: Map
    std: Map
    confidence: Map
    contrast_db: Map
    edge: Int[Array, "ny nx"]
    mask: Mask
    spacing: Pair
    origin: Pair
    noise_length: Scalar
    index: Scalar
    steps: tuple[Step, ...]

    @property
    def shape(self) -> tuple[int, int]:
        """Number of pixels (ny, nx)."""
        ny, nx = self.depth.shape
        return ny, nx

    def thickness(self, window: "Interface | float" = 0.0, tilt: Literal["none", "plane"] = "none") -> ThicknessMap:
        """Thickness of the layer between the window's interface and this one.

        Args:
            window: Interface between window and layer; or its depth [mm], 0 in a common-path microscope.
            tilt: "plane" measures along the normal of the plane through the window's interface; light that enters the
                layer at an angle is refracted towards it. Below 2° the difference is below 0.2 µm of 0.5 mm.

        Raises:
            ValueError: For a window of another shape, or a plane through a window that is a number.
        """
        variance, mask, factor = self.std**2, self.mask, 1.0
        edge_depth: Any = window
        if isinstance(window, Interface):
            if window.shape != self.shape:
                raise ValueError(f"Interface.thickness: window has (ny, nx) = {window.shape}, this {self.shape}.")
            edge_depth, variance, mask = window.depth, variance + window.std**2, mask | window.mask
            if tilt == "plane":
                factor = _cosine_inside(window)
        elif tilt == "plane":
            raise ValueError('Interface.thickness: tilt="plane" needs the window\'s interface; pass window=.')
        values = factor * (self.depth - edge_depth)
        usable = ~mask & (values > 0)
        if not usable.any():
            raise MeasurementError("No pixel has an interface below the window; inspect the B-scans.")
        placeholder = jnp.median(values[usable])
        step = Step("thickness", masked_pixels=(~usable).sum(), tilt_factor=factor)
        return ThicknessMap(
            jnp.where(usable, values, placeholder),
            spacing=self.spacing,
            origin=self.origin,
            std=jnp.where(usable, jnp.sqrt(variance), jnp.sqrt(jnp.median(variance))),
            mask=~usable,
            noise_length=self.noise_length,
            steps=(*self.steps, step),
        )


def find_interface(
    volume: OctVolume,
    system: OctSystem,
    *,
    edge: Edge = "auto",
    search: tuple[Any, float | int | None] = (0.03, None),
    max_slope: float | int = 0.6,
    average: float | int = 0.06,
    background: OctVolume | None = None,
    mask: Any = None,
    confidence: float | int = 0.5,
    block_rows: int = 64,
) -> Interface:
    """Find the interface between layer and sample.

    A smooth surface of large depth gradient is found by semi-global matching; then an edge is fitted to profiles that
    are averaged along it, by maximum likelihood. Gradients and thresholds alone lie 4 to 9 µm too near the window.

    Args:
        volume: The volume; one that lies in a file is read by blocks.
        system: The microscope, with the layer's index.
        edge: The sample is "brighter" or "darker" than the layer, or the interface a reflecting "peak"; "auto" chooses
            by likelihood, in every neighbourhood.
        search: (from, to) geometric depth [mm]; `from` may be a map, `to` None is the volume's end. The first 20 to
            30 µm contain residual reference light.
        max_slope: Largest slope of the interface [-].
        average: FWHM of the lateral average [mm]; half an element or less.
        background: Volume without a layer, whose mean depth profile is subtracted in place of artefact lines.
        mask: Bool (ny, nx); True where A-lines have no data.
        confidence: Pixels of less are masked.
        block_rows: B-scans that are worked on at once.

    Raises:
        MeasurementError: Where there is no interface to be found: too little contrast, an interface at the end of the
            search, or no pixel of enough confidence.
        ValueError: For options out of range.

    Example:
        >>> import jax
        >>> import opfem as op
        >>> volume = op.simulate_oct(
        ...     op.UWA_845NM, lambda x, y: 0.3 + 0.1 * x, key=jax.random.key(0), spacing=(0.01, 0.01), shape=(48, 48),
        ...     depth=0.5, media=(op.Medium(-15.0, 0.5), op.SAMPLE),
        ... )
        >>> found = op.find_interface(volume, op.UWA_845NM)
        >>> abs(float((found.depth - 0.3 - 0.1 * found.x).mean())) < 5e-4
        True
    """
    for name, value in (("max_slope", max_slope), ("average", average)):
        check_positive(f"find_interface.{name}", "mm" if name == "average" else "-", value)
    if mask is None:
        ignored = np.zeros(volume.shape[:2], bool)
    else:
        ignored = np.asarray(mask)
        if ignored.dtype != bool or ignored.shape != volume.shape[:2]:
            raise ValueError(
                f"find_interface.mask must be bool of shape {volume.shape[:2]} (ny, nx), got {ignored.dtype} of shape "
                f"{ignored.shape}."
            )
    options = Search(edge, search, max_slope, average, background, ignored, block_rows)
    found, steps = search_volume(volume, system, options)
    weak = np.abs(found.contrast) < CONTRAST
    doubtful = weak | found.moved | found.at_bound | found.shaded | (found.confidence < confidence) | ignored
    _refuse(found, doubtful, ignored, weak, confidence)
    return Interface(
        depth=jnp.asarray(found.depth, float),
        std=jnp.asarray(found.std, float),
        confidence=jnp.asarray(found.confidence, float),
        contrast_db=jnp.asarray(found.contrast, float),
        edge=jnp.asarray(found.edge, jnp.int32),
        mask=jnp.asarray(doubtful),
        spacing=volume.spacing,
        origin=volume.origin,
        noise_length=jnp.asarray(found.noise_length, float),
        index=jnp.asarray(system.index, float),  # float64 where JAX has it enabled
        steps=(*volume.steps, *steps),
    )


def thickness_from_oct(
    volume: OctVolume,
    system: OctSystem,
    window: Literal["first_pixel", "find"] = "first_pixel",
    tilt: Literal["none", "plane"] = "none",
    **find: Any,
) -> ThicknessMap:
    """Measure the layer's thickness in an OCT volume.

    Args:
        volume: The volume.
        system: The microscope, with the layer's index.
        window: Where the layer begins: at the zero delay (common path), or at a reflecting interface to be found first.
        tilt: See `Interface.thickness`.
        find: Options of `find_interface` for the sample's interface.
    """
    if window == "first_pixel":
        return find_interface(volume, system, **find).thickness()
    first = find_interface(volume, system, edge="peak", search=(0.0, None), mask=find.get("mask"))
    find = {"search": (np.asarray(first.depth) + _WINDOW_REACH, None), **find}
    return find_interface(volume, system, **find).thickness(first, tilt)


def _refuse(found: Found, doubtful, ignored, weak, confidence: float) -> None:
    """Raise where an interface cannot be what was found."""
    used = ~ignored
    if not used.any():
        raise MeasurementError("find_interface.mask leaves no A-line.")
    if weak[used].mean() > 0.5:
        raise MeasurementError(
            f"No interface: the contrast is below {CONTRAST:g} dB over {weak[used].mean():.0%} of the map (median "
            f"{np.median(np.abs(found.contrast[used])):.2g} dB, noise at {found.noise_db:.0f} dB). Inspect the "
            "B-scans; pass edge= one of brighter, darker, peak, or another search=."
        )
    if found.at_bound[used].mean() > 0.05:
        raise MeasurementError(
            f"The interface lies at the end of the search, {found.bounds[0]:.3g} to {found.bounds[1]:.3g} mm, in "
            f"{found.at_bound[used].mean():.0%} of the map; pass another search=(from, to) [mm]."
        )
    if doubtful[used].all():
        raise MeasurementError(
            f"No pixel has an interface of confidence {confidence:g} or more (median "
            f"{np.median(found.confidence[used]):.2g}); inspect the B-scans, or lower confidence=."
        )


def _cosine_inside(window: Interface) -> float:
    """Cosine of the angle inside the layer at which light meets the window's plane."""
    x, y = np.meshgrid(np.asarray(window.x), np.asarray(window.y))
    known = ~np.asarray(window.mask)
    columns = np.stack([np.ones(int(known.sum())), x[known], y[known]], axis=1)
    (_, *slopes), *_ = np.linalg.lstsq(columns, np.asarray(window.depth)[known], rcond=None)
    index = float(window.index)
    # Above the window's interface light is in air: the depth there was divided by an index that it has not.
    outside = math.atan(index * math.hypot(*slopes))
    return math.cos(math.asin(math.sin(outside) / index))
