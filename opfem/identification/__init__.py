"""Identification of friction, moduli and offsets from observations of loaded states."""

from .parameter_fit import fit_parameters as fit_parameters
from .result import ParameterFit as ParameterFit
