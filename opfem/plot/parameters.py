"""Fitted numbers as a picture: posterior beside prior, and every pair of numbers.

Edge of the chain: drawn from a `ParameterFit`. Moduli are in kPa, lengths in µm.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from ..results import ParameterFit
from .layout import shown_figure

_INCHES = 2.3  # a panel
_LEAST_SIZE = 4.0  # inches
_REACH = 4.0  # posterior standard deviations drawn
_POINTS = 400
_TICKS = 3
_POSTERIOR, _PRIOR = "#0072b2", "#e69f00"
# Factor and unit of a number by the last part of its path; others are dimensionless.
_READ_IN = {
    **dict.fromkeys(("c10", "c01", "c20", "c30", "shear", "bulk", "pressure"), (1e3, "kPa")),
    **dict.fromkeys(("thickness", "clearance", "l0_offset"), (1e3, "µm")),
}


def plot_parameters(fit: ParameterFit, figure: Figure | None = None) -> np.ndarray:
    """Draw the posterior of fitted numbers: each beside its prior, and the 68 and 95 % regions of every pair.

    Args:
        fit: What was found.
        figure: Empty figure to draw on; None makes one.

    Returns:
        The axes, one row and column for each number.
    """
    count = len(fit.names)
    figure = shown_figure((_size(count), _size(count))) if figure is None else figure
    axes: Any = figure.subplots(count, count, squeeze=False, sharex="col")
    factors, labels = zip(*(_label(name) for name in fit.names), strict=True)
    centre = np.array([factor * float(fit.numbers[name]) for factor, name in zip(factors, fit.names, strict=True)])
    covariance = np.asarray(fit.covariance) * np.outer(factors, factors)
    for row in range(count):
        for column in range(count):
            ax = axes[row, column]
            if row == column:
                _draw_number(ax, fit, row, factors[row])
            elif column < row:
                _draw_pair(ax, centre[[column, row]], covariance[np.ix_([column, row], [column, row])])
            else:
                ax.set_visible(False)
            if row == count - 1:
                ax.set_xlabel(labels[column])
            if column == 0 and row > 0:
                ax.set_ylabel(labels[row])
            elif column < row:
                ax.tick_params(labelleft=False)
            ax.locator_params(axis="x", nbins=_TICKS)
            ax.ticklabel_format(useOffset=False)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="upper right", frameon=False)
    figure.suptitle(", ".join(_explained(fit)), x=0.02, ha="left", fontsize="medium")
    figure.align_labels()
    return axes


def draw_parameters(fit: ParameterFit) -> Figure:
    """Draw the picture that goes with the files of a fit, without any display."""
    size = _size(len(fit.names))
    figure = Figure(figsize=(size, size), layout="compressed")
    plot_parameters(fit, figure)
    return figure


def _size(count: int) -> float:
    return max(_INCHES * count, _LEAST_SIZE)


def _label(name: str) -> tuple[float, str]:
    """Return the factor that a number is shown with, and its label."""
    factor, unit = _READ_IN.get(name.split(".")[-1], (1.0, "-"))
    return factor, f"{name.removeprefix('layer.material.')} [{unit}]"


def _explained(fit: ParameterFit) -> list[str]:
    """State χ² of every source, a datum."""
    chi2 = {source: float(jnp.mean(values**2)) for source, values in fit.residuals.items()}
    return [f"χ² of {source} {value:.2g} a datum" for source, value in chi2.items()]


def _draw_number(ax: Any, fit: ParameterFit, place: int, factor: float) -> None:
    """Draw the densities of posterior and prior, over their largest values, and the 95 % interval."""
    name = fit.names[place]
    prior, mean, spread = fit.priors[name], float(fit.white[place]), float(fit.white_std[name])
    white = mean + spread * np.linspace(-_REACH, _REACH, _POINTS)
    number = factor * np.asarray(prior.number(jnp.asarray(white)))
    slope = np.abs(np.gradient(number, white))
    posterior = np.exp(-0.5 * ((white - mean) / spread) ** 2) / slope
    expected = np.exp(-0.5 * white**2) / slope
    low, high = (factor * end for end in fit.intervals()[name])
    inside = (number >= low) & (number <= high)
    ax.fill_between(number[inside], posterior[inside] / posterior.max(), color=_POSTERIOR, alpha=0.3, linewidth=0)
    ax.plot(number, posterior / posterior.max(), color=_POSTERIOR, label="posterior, 95 % filled")
    ax.plot(number, expected / expected.max(), "--", color=_PRIOR, label="prior")
    ax.set(yticks=[], ylim=(0.0, 1.1), title=_interval(low, high))


def _interval(low: float, high: float) -> str:
    """Format an interval to two significant digits of its width; to three of its ends where that is no number."""
    if not 0.0 < high - low < np.inf:
        return f"{low:.3g} to {high:.3g}"
    digits = max(1 - int(np.floor(np.log10(high - low))), 0)
    return f"{low:.{digits}f} to {high:.{digits}f}"


def _draw_pair(ax: Any, centre: np.ndarray, covariance: np.ndarray) -> None:
    """Draw the regions that hold 68 and 95 % of a normal distribution of two numbers."""
    angle = np.linspace(0.0, 2.0 * np.pi, _POINTS)
    values, vectors = np.linalg.eigh(covariance)
    unit = vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * np.stack([np.cos(angle), np.sin(angle)]))
    for share, alpha in ((0.95, 0.25), (0.68, 0.45)):
        ring = centre[:, None] + np.sqrt(-2.0 * np.log(1.0 - share)) * unit
        ax.fill(*ring, color=_POSTERIOR, alpha=alpha, linewidth=0)
    ax.plot(*centre, "+", color="black")
