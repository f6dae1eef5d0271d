"""Pictures of maps; `import opfem` does not load this part, because it loads matplotlib."""

from .maps import plot_pressure, plot_residual, plot_status, plot_thickness, report_figure

__all__ = ["plot_pressure", "plot_residual", "plot_status", "plot_thickness", "report_figure"]
