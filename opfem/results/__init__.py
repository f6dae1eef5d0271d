"""What a solution says: labelled data with units, and a short summary for people."""

from ..solvers import Solution
from .dataset import to_xarray
from .summary import summary, summary_rows

__all__ = ["Solution", "summary", "summary_rows", "to_xarray"]
