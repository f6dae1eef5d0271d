"""From measured thickness to traction: least squares through the solver, and faster estimates."""

from .linear_layer import (
    LinearEstimate as LinearEstimate,
    linear_estimate as linear_estimate,
    uniaxial_estimate as uniaxial_estimate,
)
from .model_error import mesh_error as mesh_error
from .observations import (
    AxialDisplacement as AxialDisplacement,
    ForceReading as ForceReading,
    SideBulge as SideBulge,
)
from .parameters import LogNormal as LogNormal, Normal as Normal
from .prior import Matern as Matern, Tikhonov as Tikhonov, TotalVariation as TotalVariation
from .refit import refitted as refitted
from .result import FitError as FitError, FitStatus as FitStatus, TractionFit as TractionFit
from .settings import FitSettings as FitSettings
from .traction_fit import fit_traction as fit_traction
