"""A calibration as a picture: measured stress, the law with its band, and what is left between them.

Edge of the chain: drawn from a `Calibration`. Strain and stress are positive in the direction of the test.
"""

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..results import Calibration
from .layout import shown_figure

_KPA = 1e3
_SIZE = (6.4, 5.6)  # inches
_BAND = 2.0  # standard deviations drawn
_BEYOND = 0.25  # of the range of strain, drawn dashed beyond it
_POINTS = 200
COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")


def plot_calibration(calibration: Calibration, figure: Figure | None = None) -> np.ndarray:
    """Draw measured stress, the fitted law with a band of two standard deviations, and the residuals [kPa].

    Offsets are taken out of the points. The law is dashed beyond the strains of the test.

    Args:
        calibration: What was found.
        figure: Empty figure to draw on; None makes one.

    Returns:
        The two axes, stress above residuals.
    """
    figure = shown_figure(_SIZE) if figure is None else figure
    axes: Any = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    for number, curve in enumerate(calibration.curves.stretch):
        _draw_curve(calibration, number, np.asarray(curve), axes)
    E, std = _KPA * float(calibration.modulus), _KPA * float(calibration.modulus_std)
    band = _BAND * std
    # Two digits of the band, and the modulus to the same place.
    places = max(0, 1 - math.floor(math.log10(band))) if band > 0.0 else 3
    title = f"{calibration.model.law.__name__}: E0 = {E:.{places}f} ± {band:.{places}f} kPa"
    axes[0].set(ylabel="Nominal stress [kPa]", title=title)
    axes[0].legend()
    axes[1].axhline(0.0, color="0.5", linewidth=0.8)
    axes[1].set(xlabel="Strain [%]", ylabel="Law − data [kPa]")
    figure.align_ylabels()
    return axes


def draw_calibration(calibration: Calibration) -> Figure:
    """Draw the picture that goes with a calibration's files, without any display."""
    figure = Figure(figsize=_SIZE, layout="compressed")
    plot_calibration(calibration, figure)
    return figure


def _draw_curve(calibration: Calibration, number: int, stretch: np.ndarray, axes: Any) -> None:
    colour = COLOURS[number % len(COLOURS)]
    mode = calibration.curves.modes[number]
    offset = float(calibration.offset[number]) if calibration.offset.size else 0.0
    at = stretch / (1.0 + offset) if calibration.model.toe == "strain" else stretch
    stress = np.asarray(calibration.curves.nominal[number]) - (offset if calibration.model.toe == "stress" else 0.0)
    sign = 1.0 if at[np.argmax(np.abs(at - 1.0))] > 1.0 else -1.0
    ends = sorted((1.0, float(at[np.argmax(np.abs(at - 1.0))])))
    beyond = _BEYOND * (ends[1] - ends[0]) * sign
    inner = np.linspace(ends[0], ends[1], _POINTS)
    outer = np.linspace(ends[1] if sign > 0 else ends[0], (ends[1] if sign > 0 else ends[0]) + beyond, _POINTS)

    def drawn(ax: Axes, where: np.ndarray, what: Any, style: str, **options: Any) -> None:
        options.setdefault("color", colour)
        ax.plot(1e2 * sign * (where - 1.0), _KPA * sign * np.asarray(what), style, **options)

    drawn(axes[0], at, stress, ".", markersize=5, alpha=0.5, label=f"{mode}, measured")
    for where, style, name in ((inner, "-", "law"), (outer, "--", "law, beyond the test")):
        law, std = (np.asarray(f(where, mode)) for f in (calibration.stress, calibration.stress_std))
        drawn(axes[0], where, law, style, linewidth=1.2, color="black", label="_" if number else name)
        low, high = (_KPA * sign * (law + side * _BAND * std) for side in (-1.0, 1.0))
        axes[0].fill_between(1e2 * sign * (where - 1.0), low, high, color=colour, alpha=0.25, linewidth=0)
    drawn(axes[1], at, np.asarray(calibration.stress(at, mode)) - stress, ".", markersize=3)
