"""Material laws from stress–strain curves: a fit, its uncertainty and what the curves cannot identify."""

from .law_fit import calibrate as calibrate
from .result import Calibration as Calibration
