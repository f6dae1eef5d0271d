"""Pictures: maps, and the layer in three dimensions. `import opfem` does not load it: it loads matplotlib."""

from .calibration import draw_calibration, plot_calibration
from .deck import draw_deck
from .experiment import draw_simulation, plot_comparison, plot_section
from .maps import (
    plot_compression,
    plot_pressure,
    plot_residual,
    plot_status,
    plot_thickness,
    plot_uncertainty,
)
from .oct import draw_interface, plot_interface
from .parameters import draw_parameters, plot_parameters
from .phase import draw_displacement, plot_displacement
from .reports import draw_fit, draw_pictures, plot_fit, plot_report
from .scene import plot_layer
from .sweep import draw_sweep

__all__ = [
    "draw_calibration",
    "draw_deck",
    "draw_displacement",
    "draw_fit",
    "draw_interface",
    "draw_parameters",
    "draw_pictures",
    "draw_simulation",
    "draw_sweep",
    "plot_calibration",
    "plot_comparison",
    "plot_compression",
    "plot_displacement",
    "plot_fit",
    "plot_interface",
    "plot_layer",
    "plot_parameters",
    "plot_pressure",
    "plot_report",
    "plot_residual",
    "plot_section",
    "plot_status",
    "plot_thickness",
    "plot_uncertainty",
]
