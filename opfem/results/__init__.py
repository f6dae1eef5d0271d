"""What a solution says: labelled data with units, and a short summary for people."""

from ..calibration import Calibration
from ..identification import ParameterFit
from ..inverse import TractionFit
from ..solvers import ExperimentSolution, Solution
from .cautions import residual_rms
from .compare import Comparison, FieldMetrics, compare
from .dataset import to_xarray
from .interior import LayerFields, layer_fields, sample_fields
from .measured import measured_thickness
from .oct_scene import OctScene, oct_scene
from .pixels import on_pixels, touching_compression
from .summary import layer_rows, pressure_rows, summary, summary_rows

__all__ = [
    "Calibration",
    "Comparison",
    "ExperimentSolution",
    "FieldMetrics",
    "LayerFields",
    "OctScene",
    "ParameterFit",
    "Solution",
    "TractionFit",
    "compare",
    "layer_fields",
    "layer_rows",
    "measured_thickness",
    "oct_scene",
    "on_pixels",
    "pressure_rows",
    "residual_rms",
    "sample_fields",
    "summary",
    "summary_rows",
    "to_xarray",
    "touching_compression",
]
