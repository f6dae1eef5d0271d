"""A picture of what a deck states: its bodies from the side, and what each step presses in."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from ..measurement import ThicknessMap
from .maps import draw_image

_SIDE_HEIGHT, _MAP_HEIGHT, _WIDTH = 2.6, 3.0, 8.0  # inch
_MOST_MAPS = 4
_UM = 1e3


def draw_deck(
    sections: Mapping[str, Float[np.ndarray, "elements 4 2"]], maps: Mapping[str, ThicknessMap], title: str
) -> Figure:
    """Draw a deck without any display.

    Args:
        sections: Corners x, z [mm] of the elements that a cut along x goes through, by body.
        maps: Surfaces that are pressed in, by step; the first few are drawn.
        title: Above it.
    """
    shown = dict(list(maps.items())[:_MOST_MAPS])
    height = _SIDE_HEIGHT + (_MAP_HEIGHT if shown else 0.0)
    figure = Figure(figsize=(_WIDTH, height), layout="constrained")
    ratios = [_SIDE_HEIGHT, _MAP_HEIGHT] if shown else [_SIDE_HEIGHT]
    grid = figure.add_gridspec(len(ratios), max(len(shown), 1), height_ratios=ratios)
    side = figure.add_subplot(grid[0, :])
    for number, (name, corners) in enumerate(sections.items()):
        side.add_collection(PolyCollection(list(corners), facecolor=f"C{number}", edgecolor="k", lw=0.2, label=name))
    side.autoscale_view()
    side.set(xlabel="x [mm]", ylabel="z [mm]", title=title)
    side.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize="small", frameon=False)
    for column, (name, thickness) in enumerate(shown.items()):
        ax = figure.add_subplot(grid[1, column])
        values = np.where(thickness.mask, np.nan, thickness.values)
        draw_image(_UM * values, np.asarray(thickness.x), np.asarray(thickness.y), ax, "[µm]", "viridis", None)
        ax.set_title(f"Surface of {name}", fontsize="medium")
    return figure
