"""Pictures: maps, and the layer in three dimensions. `import opfem` does not load it: it loads matplotlib."""

from .maps import plot_pressure, plot_residual, plot_status, plot_thickness, report_figure
from .scene import plot_layer

__all__ = ["plot_layer", "plot_pressure", "plot_residual", "plot_status", "plot_thickness", "report_figure"]
