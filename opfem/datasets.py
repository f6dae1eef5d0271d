"""Sample measurements: one built in, one that is downloaded for the user, with its licence.

The published coin map belongs to the toolbox of its authors (GPL-3) and is not part of opfem.
"""

import os
from pathlib import Path

from .io import read_thickness
from .measurement import ThicknessMap, example_map

COIN_LAYER = 0.5
"""Unloaded thickness of the layer of `coin` [mm]."""

_COIN = "coin_5c_1-thickness.mat"
_SOURCE = "github.com/philipwijesinghe/computational-optical-palpation, thickness_files/, GPL-3"
_URL = (
    "https://raw.githubusercontent.com/philipwijesinghe/computational-optical-palpation/"
    f"0f1b1064dbb8181a34918c21995f7b1241b94c22/thickness_files/{_COIN}"
)
_SHA256 = "91e721bc920b5441eb92fd3feeca227b3441acce73568cff3616420595ea5c1c"


def coin_file(folder: str | os.PathLike | None = None) -> Path:
    """Find the published map of a 5-cent coin on this machine, or download it once (0.8 MB).

    Source: the toolbox of Wijesinghe et al., J. R. Soc. Interface 14 (2017) 20160878, under GPL-3; the
    file is checked against its SHA-256.

    Args:
        folder: Where to keep it; None takes the folder in the environment variable OPFEM_DATA, else the
            user's cache.

    Raises:
        OSError: When it cannot be downloaded, or what came is not the published file.
    """
    # Loaded here, so that `import opfem` stays free of it.
    import pooch

    folder = Path(folder or os.environ.get("OPFEM_DATA") or pooch.os_cache("opfem"))
    pooch.get_logger().setLevel("WARNING")
    try:
        return Path(pooch.retrieve(_URL, f"sha256:{_SHA256}", fname=_COIN, path=folder))
    except Exception as cause:  # pooch and requests raise many kinds
        raise OSError(
            f"Could not get {_COIN} ({_SOURCE}): {cause}. Download it by hand into {folder}, or set OPFEM_DATA to the "
            "folder that holds it."
        ) from cause


def coin() -> ThicknessMap:
    """Read the published map of a 5-cent coin under a 0.5 mm layer, loaded [mm]; see `coin_file`.

    5 × 5 mm, 502 × 502 pixels, as MATLAB shows it. The unloaded layer is `COIN_LAYER` thick.
    """
    return read_thickness(coin_file(), extent=(5.0, 5.0))


def example(seed: int = 0) -> ThicknessMap:
    """Make the built-in synthetic map: noise, a hole of missing pixels, a corner of lift-off.

    Args:
        seed: Seed of the noise.
    """
    return example_map(seed)
