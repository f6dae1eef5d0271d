"""The deformed layer for ParaView, as an unstructured grid of hexahedra.

Edge of the chain: built from the dataset of `to_xarray`, or from one that was read back.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np
import xarray as xr
from jaxtyping import Float

from .atomic import write_whole

if TYPE_CHECKING:
    import pyvista


def layer_grid(dataset: xr.Dataset) -> "pyvista.UnstructuredGrid":
    """Build the deformed layer as a pyvista grid of hexahedra.

    Points lie where the nodes are after loading [mm]. Array names end in their unit. What acts on a face
    is NaN (status: -1) at points off that face, `stress_zz_MPa` in cells below the top ones. Stress, strain
    and energy inside the layer come with a dataset of `to_xarray(solution, interior=True)`.

    Args:
        dataset: What `to_xarray` returned.

    Raises:
        ValueError: For a failed solution, which has no deformed layer.
    """
    # Loaded here, so that `import opfem` stays free of it.
    import pyvista

    displacement = dataset["displacement"].transpose("component", "z", "y", "x").values
    if not np.isfinite(displacement).all():
        raise ValueError(f"The deformed layer needs a converged solution, got status {dataset.attrs.get('status')!r}.")
    current = _reference(dataset) + displacement
    # VTK's structured axes are the transpose of ours, x fastest in both.
    grid = pyvista.StructuredGrid(*(np.ascontiguousarray(axis.T) for axis in current)).cast_to_unstructured_grid()
    for name, values in _point_arrays(dataset, displacement).items():
        grid.point_data[name] = values
    layers = displacement.shape[1] - 1
    grid.cell_data["stress_zz_MPa"] = _on_layer(dataset["stress_zz"].values, layers, top=True, elsewhere=np.nan)
    return grid


def write_vtu(dataset: xr.Dataset, path: str | os.PathLike) -> None:
    """Write the deformed layer, as `layer_grid` builds it, to a .vtu file, whole or not at all.

    Args:
        dataset: What `to_xarray` returned.
        path: File to make or replace; must end in .vtu.

    Raises:
        ValueError: For another suffix, or a failed solution, which has no deformed layer.
        FileNotFoundError: When the folder does not exist.
    """
    write_whole(_with_suffix(path, ".vtu"), vtu_bytes(dataset))


def vtu_bytes(dataset: xr.Dataset) -> bytes:
    """Encode the deformed layer as a .vtu file in memory; VTK itself crashes on a full disk.

    Args:
        dataset: What `to_xarray` returned.

    Raises:
        ValueError: For a failed solution, which has no deformed layer.
    """
    # Loaded here, so that `import opfem` stays free of it.
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    writer = vtkXMLUnstructuredGridWriter()
    writer.SetInputData(layer_grid(dataset))
    writer.SetWriteToOutputString(True)
    writer.SetDataModeToBinary()  # in base64
    writer.Write()
    return writer.GetOutputString().encode()


def write_pvd(datasets: Sequence[xr.Dataset], path: str | os.PathLike, times: Sequence[float] | None = None) -> None:
    """Write a series of states for ParaView: one .vtu file each beside a .pvd file that lists them.

    The .pvd file comes last, so that it never lists a file that is not there.

    Args:
        datasets: What `to_xarray` returned, for one state after the other.
        path: File to make or replace; must end in .pvd. The others are called `<stem>_000.vtu` and so on.
        times: What ParaView shows as time, rising; None counts 0, 1, 2, …

    Raises:
        ValueError: For another suffix, no state, or times that do not rise or do not match.
        FileNotFoundError: When the folder does not exist.
    """
    path = _with_suffix(path, ".pvd")
    times = list(range(len(datasets)) if times is None else times)
    if not datasets or len(times) != len(datasets) or np.any(np.diff(times) <= 0):
        raise ValueError(f"write_pvd needs one rising time for each of {len(datasets)} states, got times={times}.")
    root = ElementTree.Element("VTKFile", type="Collection", version="0.1")
    collection = ElementTree.SubElement(root, "Collection")
    for number, (dataset, time) in enumerate(zip(datasets, times, strict=True)):
        name = f"{path.stem}_{number:03d}.vtu"
        write_vtu(dataset, path.with_name(name))
        ElementTree.SubElement(collection, "DataSet", timestep=repr(float(time)), part="0", file=name)
    write_whole(path, ElementTree.tostring(root, encoding="utf-8", xml_declaration=True))


def _with_suffix(path: str | os.PathLike, suffix: str) -> Path:
    path = Path(path)
    if path.suffix.lower() != suffix:
        raise ValueError(f"The file's name must end in {suffix}, got {path}.")
    return path


def _reference(dataset: xr.Dataset) -> Float[np.ndarray, "3 nz ny nx"]:
    z = dataset["z"] * dataset["unloaded_thickness"]
    x, y, z = xr.broadcast(dataset["x"], dataset["y"], z)
    return np.stack([axis.transpose("z", "y", "x").values for axis in (x, y, z)])


def _point_arrays(dataset: xr.Dataset, displacement: np.ndarray) -> dict[str, np.ndarray]:
    arrays: dict[str, np.ndarray] = {"displacement_mm": displacement.reshape(3, -1).T}
    if "stress" in dataset:
        arrays["stress_MPa"] = dataset["stress"].values.reshape(9, -1).T
        arrays["green_strain"] = dataset["green_strain"].values.reshape(9, -1).T
        arrays["energy_density_MPa"] = dataset["energy_density"].values.ravel()
    nodes = displacement.shape[1]
    for prefix, top in (("", True), ("window_", False)):
        pressure, traction = dataset[f"{prefix}pressure"].values, dataset[f"{prefix}traction"].values
        arrays[f"{prefix}pressure_MPa"] = _on_layer(pressure, nodes, top, np.nan)
        arrays[f"{prefix}traction_MPa"] = np.stack([_on_layer(part, nodes, top, np.nan) for part in traction], axis=1)
        arrays[f"{prefix}contact_status"] = _on_layer(dataset[f"{prefix}contact_status"].values, nodes, top, -1)
    return arrays


def _on_layer(values: np.ndarray, layers: int, top: bool, elsewhere: float | int) -> np.ndarray:
    """Spread the values of the top or bottom layer over all layers, and flatten, x fastest."""
    spread = np.full((layers, *values.shape), elsewhere, values.dtype)
    spread[-1 if top else 0] = values
    return spread.ravel()
