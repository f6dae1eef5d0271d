"""From the OCT volume to the thickness map, and volumes with known truth."""

from .interface import Interface, find_interface, thickness_from_oct
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
    "Interface",
    "Medium",
    "OctSystem",
    "OctVolume",
    "Spectra",
    "find_interface",
    "simulate_oct",
    "thickness_from_oct",
]
