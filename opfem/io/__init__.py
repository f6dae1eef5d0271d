"""Files in and out: the only part of the package that touches a disk."""

from ..measurement import MeasurementError
from .atomic import finish, take_place, whole_file, write_together, write_whole
from .checkpoint import Checkpoint as Checkpoint
from .displacement import displacement_bytes, read_displacement, write_displacement
from .map_files import MAP_FILES, encoded, write_csv, write_mat, write_tiff
from .netcdf import netcdf_bytes, read_netcdf, write_netcdf
from .oct import read_oct, read_spectra, write_oct
from .stress_strain import read_stress_strain
from .thickness import read_thickness, write_thickness
from .vtk import bodies_grid, layer_grid, vtu_bytes, write_pvd, write_vtu

__all__ = [
    "MAP_FILES",
    "MeasurementError",
    "bodies_grid",
    "displacement_bytes",
    "encoded",
    "finish",
    "layer_grid",
    "netcdf_bytes",
    "read_displacement",
    "read_netcdf",
    "read_oct",
    "read_spectra",
    "read_stress_strain",
    "read_thickness",
    "take_place",
    "vtu_bytes",
    "whole_file",
    "write_csv",
    "write_displacement",
    "write_mat",
    "write_netcdf",
    "write_oct",
    "write_pvd",
    "write_thickness",
    "write_tiff",
    "write_together",
    "write_vtu",
    "write_whole",
]
