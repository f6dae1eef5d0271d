"""A picture of what a deck states: its bodies from the side, and what each step presses in."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from ..measurement import ThicknessMap
from . import layout
from .calibration import COLOURS

_SIDE_HEIGHT, _SIDE_WIDTH = 2.6, 8.0  # inch
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
    grids = [(np.asarray(thickness.x), np.asarray(thickness.y)) for thickness in shown.values()]
    limits = layout.together(*(layout.pixel_limits(*grid) for grid in grids)) if grids else None
    width, height = (0.0, 0.0) if limits is None else layout.page(len(grids), limits)[1]
    figure = Figure(figsize=(max(width, _SIDE_WIDTH), _SIDE_HEIGHT + height), layout="constrained")
    if limits is None:
        _draw_side(sections, title, figure.subplots())
        return figure
    parts: Any = figure.subfigures(2, 1, height_ratios=[_SIDE_HEIGHT, height])
    above, below = parts
    _draw_side(sections, title, above.subplots())
    panels = {f"Surface of {name}": partial(_draw_surface, thickness) for name, thickness in shown.items()}
    layout.draw_page(panels, limits, below)
    return figure


def _draw_side(sections: Mapping[str, np.ndarray], title: str, side: Axes) -> None:
    for number, (name, corners) in enumerate(sections.items()):
        side.add_collection(
            PolyCollection(list(corners), facecolor=COLOURS[number % len(COLOURS)], edgecolor="k", lw=0.2, label=name)
        )
    side.autoscale_view()
    side.set(xlabel="x [mm]", ylabel="z [mm]", title=title)
    side.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize="small", frameon=False)


def _draw_surface(thickness: ThicknessMap, ax: Axes) -> None:
    values = np.where(thickness.mask, np.nan, thickness.values)
    layout.image(_UM * values, np.asarray(thickness.x), np.asarray(thickness.y), ax, "Height [µm]", "viridis")
