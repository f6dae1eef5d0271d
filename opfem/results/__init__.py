"""What a solution says: labelled data with units, and a short summary for people."""

from ..inverse import TractionFit
from ..solvers import Solution
from .dataset import to_xarray
from .interior import LayerFields, layer_fields
from .summary import summary, summary_rows

__all__ = ["LayerFields", "Solution", "TractionFit", "layer_fields", "summary", "summary_rows", "to_xarray"]
