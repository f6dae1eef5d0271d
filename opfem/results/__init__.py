"""What a solution says: labelled data with units, and a short summary for people."""

from ..calibration import Calibration
from ..inverse import TractionFit
from ..solvers import ExperimentSolution, Solution
from .compare import Comparison, FieldMetrics, compare
from .dataset import to_xarray
from .interior import LayerFields, layer_fields, sample_fields
from .measured import measured_thickness
from .oct_scene import OctScene, oct_scene
from .summary import summary, summary_rows

__all__ = [
    "Calibration",
    "Comparison",
    "ExperimentSolution",
    "FieldMetrics",
    "LayerFields",
    "OctScene",
    "Solution",
    "TractionFit",
    "compare",
    "layer_fields",
    "measured_thickness",
    "oct_scene",
    "sample_fields",
    "summary",
    "summary_rows",
    "to_xarray",
]
