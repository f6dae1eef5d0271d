"""Measured maps and curves, before any mechanics."""

from .errors import MeasurementError, MeasurementWarning
from .example import EXAMPLE_LAYER, example_map
from .stress_strain import StressStrain
from .thickness import Step, ThicknessMap

__all__ = [
    "EXAMPLE_LAYER",
    "MeasurementError",
    "MeasurementWarning",
    "Step",
    "StressStrain",
    "ThicknessMap",
    "example_map",
]
