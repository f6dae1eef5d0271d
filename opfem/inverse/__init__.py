"""From measured thickness to traction: least squares through the solver, and faster estimates."""

from .estimates import (
    LinearEstimate as LinearEstimate,
    linear_estimate as linear_estimate,
    uniaxial_estimate as uniaxial_estimate,
)
from .fit import fit_traction as fit_traction
from .prior import Matern as Matern, Tikhonov as Tikhonov
from .result import FitStatus as FitStatus, TractionFit as TractionFit
