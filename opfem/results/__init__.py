"""What a solution says: labelled data with units, and a short summary for people."""

from ..inverse import TractionFit
from ..solvers import Solution
from .dataset import to_xarray
from .interior import LayerFields, layer_fields
from .oct_scene import OctScene, oct_scene
from .summary import summary, summary_rows

__all__ = [
    "LayerFields",
    "OctScene",
    "Solution",
    "TractionFit",
    "layer_fields",
    "oct_scene",
    "summary",
    "summary_rows",
    "to_xarray",
]
