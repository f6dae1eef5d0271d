"""From the OCT volume to the thickness map, and volumes with known truth."""

from .displacement import DisplacementVolume, StrainVolume
from .increments import AxialIncrement
from .interface import Interface, find_interface, thickness_from_oct
from .phase import axial_displacement
from .searching import EDGES
from .simulation import LAYER, SAMPLE, SCATTERING_LAYER, Medium, simulate_oct
from .spectra import Spectra
from .system import UWA_845NM, OctSystem
from .volume import OctVolume

__all__ = [
    "EDGES",
    "LAYER",
    "SAMPLE",
    "SCATTERING_LAYER",
    "UWA_845NM",
    "AxialIncrement",
    "DisplacementVolume",
    "Interface",
    "Medium",
    "OctSystem",
    "OctVolume",
    "Spectra",
    "StrainVolume",
    "axial_displacement",
    "find_interface",
    "simulate_oct",
    "thickness_from_oct",
]
