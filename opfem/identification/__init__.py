"""Identification of friction, moduli and offsets from observations of loaded states."""

from .parameter_fit import ParameterFit as ParameterFit, fit_parameters as fit_parameters
