"""What all maps share: size of the page, colour bars, axes, hatches and their key.

Edge of the chain. Row 0 of a map is at the top, so y grows downwards and x to the right; both have the same scale.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Patch, Rectangle
from matplotlib.transforms import ScaledTranslation

Limits = tuple[float, float, float, float]
"""x from and to, y from and to [mm]."""

# Inches.
_PANEL_AREA, _LOWEST_PANEL = 10.0, 2.0  # of a map, and its least height, which a label takes
_BESIDE, _ABOVE = 1.2, 0.35  # room for a map's colour bar, and for its title
_LEFT, _BELOW = 0.4, 0.85  # room for the labels of the outer axes, and below them for the key
_BAR = (1.03, 0.0, 0.05, 1.0)  # place of the colour bar beside a map, in parts of the map's width and height
_KEY_BELOW = 0.45  # the key of a single map, below its axis
_PAGE = math.sqrt(2.0)  # width over height that a page of maps comes near
_EMPTY = 3.0  # what an empty place counts, in logarithms of that ratio over the part of the places
# Ground where there is nothing to draw; hatches apart in direction and weight, dark on light and light on dark.
_GROUND = "0.92"
_NO_DATA: dict[str, Any] = {"hatch": "////", "edgecolor": "0.35", "facecolor": (0.92, 0.92, 0.92, 0.55)}
_OPEN: dict[str, Any] = {"hatch": "..", "edgecolor": "0.6", "facecolor": (1.0, 1.0, 1.0, 0.0)}


def page(count: int, limits: Limits) -> tuple[tuple[int, int], tuple[float, float]]:
    """Choose rows and columns for maps of one size, and the size of the page [inch] that they fill.

    Args:
        count: Number of maps.
        limits: What each shows.
    """
    aspect = (limits[1] - limits[0]) / (limits[3] - limits[2])
    height = max(math.sqrt(_PANEL_AREA / aspect), _LOWEST_PANEL)
    cell = (aspect * height + _BESIDE, height + _ABOVE)
    choices = [(math.ceil(count / columns), columns) for columns in range(1, count + 1)]

    def page_of(rows: int, columns: int) -> tuple[float, float]:
        return columns * cell[0] + _LEFT, rows * cell[1] + _BELOW

    def oddness(choice: tuple[int, int]) -> float:
        width, length = page_of(*choice)
        return abs(math.log(width / length / _PAGE)) + _EMPTY * (choice[0] * choice[1] - count) / count

    best = min(choices, key=oddness)
    return best, page_of(*best)


def shown_figure(size: tuple[float, float]) -> Figure:
    """Make a figure that notebooks show by themselves."""
    # Loaded here, so that writing a file never starts a display.
    import matplotlib.pyplot as plt

    return plt.figure(figsize=size, layout="compressed")


def single(ax: Axes | None, limits: Limits) -> Axes:
    """Return the given axes, or those of a new figure for one map."""
    return shown_figure(page(1, limits)[1]).subplots() if ax is None else ax


def empty_page(count: int, limits: Limits) -> Figure:
    """Make a figure of the right size for maps, without any display."""
    return Figure(figsize=page(count, limits)[1], layout="compressed")


def draw_page(
    panels: Mapping[str, Callable[[Axes], Any]], limits: Limits, figure: Figure | SubFigure | None = None
) -> np.ndarray:
    """Draw a page of maps: all show the same part of the layer, and one key names their hatches.

    Args:
        panels: What draws each map, by its title.
        limits: What each shows.
        figure: Empty figure to draw on; None makes one.

    Returns:
        The axes of the maps.
    """
    (rows, columns), size = page(len(panels), limits)
    figure = shown_figure(size) if figure is None else figure
    axes = np.ravel(figure.subplots(rows, columns, sharex=True, sharey=True))
    for ax, (title, draw) in zip(axes, panels.items(), strict=False):
        draw(ax)
        ax.set_title(title, fontsize="medium")
        ax.set(xlim=limits[:2], ylim=limits[:1:-1])
    for place, ax in enumerate(axes[: len(panels)]):
        ax.label_outer()
        if place + columns >= len(panels):  # nothing is drawn below
            ax.tick_params(labelbottom=True)
            ax.set_xlabel("x [mm]")
    for ax in axes[len(panels) :]:
        ax.set_axis_off()
    _common_key(figure, axes)
    return axes[: len(panels)]


def together(*limits: Limits) -> Limits:
    """Find the limits that hold all of several."""
    low_x, high_x, low_y, high_y = np.array(limits).T
    return float(low_x.min()), float(high_x.max()), float(low_y.min()), float(high_y.max())


def limits_of(x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."]) -> Limits:
    """Find the limits of nodes."""
    return float(x.min()), float(x.max()), float(y.min()), float(y.max())


def pixel_limits(x: Float[np.ndarray, " mx"], y: Float[np.ndarray, " my"]) -> Limits:
    """Find the limits of an image with samples at x and y [mm]: half a pixel beyond the outermost."""
    half_x, half_y = 0.5 * (x[1] - x[0]), 0.5 * (y[1] - y[0])
    return float(x[0] - half_x), float(x[-1] + half_x), float(y[0] - half_y), float(y[-1] + half_y)


def orient(ax: Axes, limits: Limits) -> None:
    """Give both axes the same scale, row 0 at the top, as imagesc shows a matrix."""
    ax.set(xlabel="x [mm]", ylabel="y [mm]", xlim=limits[:2], ylim=limits[:1:-1], aspect="equal", facecolor=_GROUND)


def colour_bar(ax: Axes, colours: ScalarMappable, label: str, extend: str) -> Colorbar:
    """Put a colour bar beside a map, as high as the map is drawn."""
    return ax.figure.colorbar(colours, cax=ax.inset_axes(_BAR), label=label, extend=extend)


def image(
    values: Float[np.ndarray, "my mx"],
    x: Float[np.ndarray, " mx"],
    y: Float[np.ndarray, " my"],
    ax: Axes,
    label: str,
    cmap: str,
    colours: tuple[float, float] | None = None,
) -> Axes:
    """Draw an image with samples at x and y [mm]; NaN shows the grey ground."""
    limits = pixel_limits(x, y)
    vmin, vmax = colours or (None, None)
    extent = (*limits[:2], limits[3], limits[2])
    drawn = ax.imshow(values, extent=extent, cmap=cmap, vmin=vmin, vmax=vmax, interpolation="nearest")
    known = values[np.isfinite(values)]
    low, high = drawn.get_clim()
    above, below = bool((known > high).any()), bool((known < low).any())
    colour_bar(ax, drawn, label, "both" if above and below else "max" if above else "min" if below else "neither")
    orient(ax, limits)
    return ax


def even(values: Float[np.ndarray, "..."], least: float) -> tuple[float, float]:
    """Find colours of a diverging map: even about zero, to the 99.5th percentile of the size, at least `least`."""
    known = np.abs(values[np.isfinite(values)])
    limit = max(float(np.percentile(known, 99.5)), least) if known.size else least
    return -limit, limit


def hatch_missing(
    ax: Axes, missing: Bool[np.ndarray, "my mx"], x: Float[np.ndarray, " mx"], y: Float[np.ndarray, " my"]
) -> None:
    """Hatch pixels that hold no data, filled or not."""
    if not missing.any():
        return
    # To the outer edge of the outermost pixels.
    x, y = (np.concatenate([[2 * v[0] - v[1]], v, [2 * v[-1] - v[-2]]]) for v in (x, y))
    _hatch(ax, x, y, np.pad(missing, 1, mode="edge"), "no data", _NO_DATA)


def hatch_open(
    ax: Axes, touching: Bool[np.ndarray, "my mx"], x: Float[np.ndarray, "my mx"], y: Float[np.ndarray, "my mx"]
) -> None:
    """Hatch where nothing touches, and outline contact, on the current positions of nodes [mm]."""
    if touching.all():
        return
    _hatch(ax, x, y, ~touching, "open", _OPEN)
    if touching.any():
        for width, colour in ((2.4, "white"), (1.0, "black")):
            ax.contour(x, y, touching.astype(float), levels=[0.5], colors=colour, linewidths=width)


def _hatch(
    ax: Axes, x: np.ndarray, y: np.ndarray, where: Bool[np.ndarray, "my mx"], name: str, style: dict[str, Any]
) -> None:
    filled = ax.contourf(
        x, y, where.astype(float), levels=[0.5, 1.5], colors=[style["facecolor"]], hatches=[style["hatch"]]
    )
    filled.set_edgecolor(style["edgecolor"])
    filled.set_linewidth(0.0)
    # What the key shows, of no size on the map itself.
    ax.add_patch(Rectangle((0.0, 0.0), 0.0, 0.0, label=name, linewidth=0.0, **style))


def key(ax: Axes) -> Axes:
    """Name the hatches of a single map, below it."""
    handles = _handles(ax)
    if handles:
        below = ax.transAxes + ScaledTranslation(0.0, -_KEY_BELOW, ax.figure.dpi_scale_trans)
        ax.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=(0.0, 0.0),
            bbox_transform=below,
            ncols=len(handles),
            frameon=False,
            fontsize="small",
            borderpad=0.0,
        )
    return ax


def _common_key(figure: Figure | SubFigure, axes: np.ndarray) -> None:
    """Name the hatches of all maps of a page, below them."""
    found = {str(handle.get_label()): handle for ax in axes for handle in _handles(ax)}
    if found:
        figure.legend(handles=list(found.values()), loc="outside lower center", ncols=len(found), frameon=False)


def _handles(ax: Axes) -> list[Patch]:
    """Collect what a map's hatches look like, large enough for a key."""
    drawn, names = ax.get_legend_handles_labels()
    return [
        Patch(
            label=name,
            hatch=patch.get_hatch(),
            facecolor=patch.get_facecolor(),
            edgecolor=patch.get_edgecolor(),
            linewidth=0.8,
        )
        for patch, name in zip(drawn, names, strict=True)
        if isinstance(patch, Rectangle)
    ]
