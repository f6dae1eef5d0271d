"""Measured maps: what comes out of the microscope, before any mechanics."""

from .errors import MeasurementError
from .example import EXAMPLE_LAYER, example_map
from .thickness import Step, ThicknessMap

__all__ = ["EXAMPLE_LAYER", "MeasurementError", "Step", "ThicknessMap", "example_map"]
