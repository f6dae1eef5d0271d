"""Files in and out: the only part of the package that touches a disk."""

from ..measurement import MeasurementError
from .atomic import whole_file
from .checkpoint import Checkpoint as Checkpoint
from .netcdf import read_netcdf, write_netcdf
from .oct import read_oct, read_spectra, write_oct
from .thickness import read_thickness, write_thickness
from .vtk import layer_grid, write_pvd, write_vtu

__all__ = [
    "MeasurementError",
    "layer_grid",
    "read_netcdf",
    "read_oct",
    "read_spectra",
    "read_thickness",
    "whole_file",
    "write_netcdf",
    "write_oct",
    "write_pvd",
    "write_thickness",
    "write_vtu",
]
