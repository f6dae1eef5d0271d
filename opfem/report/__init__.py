"""A result as a page for a browser. `import opfem` does not load it: it loads plotly."""

from .page import report_bytes, write_report

__all__ = ["report_bytes", "write_report"]
