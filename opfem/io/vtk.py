"""The deformed layer, of an experiment the sample too, for ParaView: an unstructured grid of hexahedra.

Edge of the chain: built from the dataset of `to_xarray`, or from one that was read back.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
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
    `bodies_grid` builds both bodies of an experiment.

    Args:
        dataset: Result of `to_xarray`.

    Raises:
        ValueError: For a failed solution, which has no deformed layer.
    """
    displacement = dataset["displacement"].transpose("component", "z", "y", "x").values
    if not np.isfinite(displacement).all():
        raise ValueError(f"The deformed layer needs a converged solution, got status {dataset.attrs.get('status')!r}.")
    grid = _hexahedra(_reference(dataset) + displacement)
    for name, values in _point_arrays(dataset, displacement, "", {"": True, "window_": False}).items():
        grid.point_data[name] = values
    layers = displacement.shape[1] - 1
    grid.cell_data["stress_zz_MPa"] = _on_layer(dataset["stress_zz"].values, layers, top=True, elsewhere=np.nan)
    return grid


def bodies_grid(dataset: xr.Dataset) -> "pyvista.UnstructuredGrid":
    """Build layer and sample of an experiment as one pyvista grid; cells of the array `body` are 0, or 1 in the sample.

    Arrays as in `layer_grid`, the layer's points and cells first; where a body lacks one it is NaN (status: -1).
    `element_stress_MPa` and `shear_modulus_MPa` are those of the cells.

    Args:
        dataset: Result of `to_xarray` for an experiment.

    Raises:
        ValueError: For a failed solution, which has no deformed bodies.
    """
    # Loaded here, so that `import opfem` stays free of it.
    import pyvista

    layer = layer_grid(dataset)
    displacement = dataset["sample_displacement"].transpose("component", ...).values
    x, y, z = xr.broadcast(dataset["x_sample"], dataset["y_sample"], dataset["sample_height"])
    reference = np.stack([axis.transpose(*dataset["sample_height"].dims).values for axis in (x, y, z)])
    sample = _hexahedra(reference + displacement)
    points = _point_arrays(dataset, displacement, "sample_", {"plate_": True})
    cells = {"shear_modulus_MPa": dataset["sample_shear_modulus"].values.ravel()}
    for number, (grid, name) in enumerate(((layer, "layer"), (sample, "sample"))):
        grid.cell_data["element_stress_MPa"] = _rows(dataset[f"{name}_element_stress"].values, 2)
        grid.cell_data["body"] = np.full(grid.n_cells, number)
    _fill(layer.point_data, points, layer.n_points)
    _fill(layer.cell_data, cells, layer.n_cells)
    for own, others, known, count in (
        (sample.point_data, layer.point_data, points, sample.n_points),
        (sample.cell_data, layer.cell_data, cells, sample.n_cells),
    ):
        for array, values in known.items():
            own[array] = values
        _fill(own, {array: np.asarray(others[array]) for array in others}, count)
    return pyvista.merge([layer, sample], merge_points=False)


def write_vtu(dataset: xr.Dataset, path: str | os.PathLike) -> None:
    """Write the deformed layer, of an experiment both bodies, to a .vtu file, whole or not at all.

    Args:
        dataset: Result of `to_xarray`.
        path: File to make or replace; must end in .vtu.

    Raises:
        ValueError: For another suffix, or a failed solution, which has no deformed layer.
        FileNotFoundError: When the folder does not exist.
    """
    write_whole(_with_suffix(path, ".vtu"), vtu_bytes(dataset))


def vtu_bytes(dataset: xr.Dataset) -> bytes:
    """Encode the deformed layer as a .vtu file in memory; VTK itself crashes on a full disk.

    Args:
        dataset: Result of `to_xarray`.

    Raises:
        ValueError: For a failed solution, which has no deformed layer.
    """
    # Loaded here, so that `import opfem` stays free of it.
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    writer = vtkXMLUnstructuredGridWriter()
    writer.SetInputData(bodies_grid(dataset) if "sample_displacement" in dataset else layer_grid(dataset))
    writer.SetWriteToOutputString(True)
    writer.SetDataModeToBinary()  # in base64
    writer.Write()
    return writer.GetOutputString().encode()


def write_pvd(datasets: Sequence[xr.Dataset], path: str | os.PathLike, times: Sequence[float] | None = None) -> None:
    """Write a series of states for ParaView: one .vtu file each beside a .pvd file that lists them.

    The .pvd file comes last, so that it never lists a file that is not there.

    Args:
        datasets: Results of `to_xarray`, one per state.
        path: File to make or replace; must end in .pvd. The others are called `<stem>_000.vtu` and so on.
        times: Times for ParaView, rising; None: 0, 1, 2, …

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


def _hexahedra(points: Float[np.ndarray, "3 mz my mx"]) -> "pyvista.UnstructuredGrid":
    """Build the hexahedra between points; VTK's structured axes are the transpose of ours, x fastest in both."""
    import pyvista

    return pyvista.StructuredGrid(*(np.ascontiguousarray(axis.T) for axis in points)).cast_to_unstructured_grid()


def _point_arrays(
    dataset: xr.Dataset, displacement: Float[np.ndarray, "3 mz my mx"], body: str, faces: dict[str, bool]
) -> dict[str, np.ndarray]:
    """Collect the nodal fields of a body.

    Args:
        dataset: Result of `to_xarray`.
        displacement: Of the body's nodes [mm].
        body: Prefix of the body's names in the dataset.
        faces: Prefix of the names of each face that something touches, and whether it is the upper one.
    """
    arrays: dict[str, np.ndarray] = {"displacement_mm": _rows(displacement, 1)}
    if f"{body}stress" in dataset:
        arrays["stress_MPa"] = _rows(dataset[f"{body}stress"].values, 2)
        arrays["green_strain"] = _rows(dataset[f"{body}green_strain"].values, 2)
        arrays["energy_density_MPa"] = dataset[f"{body}energy_density"].values.ravel()
    nodes = displacement.shape[1]
    for prefix, top in faces.items():
        pressure, traction = dataset[f"{prefix}pressure"].values, dataset[f"{prefix}traction"].values
        arrays[f"{prefix}pressure_MPa"] = _on_layer(pressure, nodes, top, np.nan)
        arrays[f"{prefix}traction_MPa"] = np.stack([_on_layer(part, nodes, top, np.nan) for part in traction], axis=1)
        arrays[f"{prefix}contact_status"] = _on_layer(dataset[f"{prefix}contact_status"].values, nodes, top, -1)
    return arrays


def _rows(values: np.ndarray, component_axes: int) -> np.ndarray:
    """Put the components of each point in a row, points x fastest."""
    return values.reshape(int(np.prod(values.shape[:component_axes])), -1).T


def _fill(data: Any, arrays: dict[str, np.ndarray], count: int) -> None:
    """Add arrays that a body lacks: NaN everywhere, -1 for whole numbers."""
    for name, like in arrays.items():
        if name not in data:
            elsewhere = -1 if like.dtype.kind == "i" else np.nan
            data[name] = np.full((count, *like.shape[1:]), elsewhere, like.dtype)


def _on_layer(values: np.ndarray, layers: int, top: bool, elsewhere: float | int) -> np.ndarray:
    """Spread the values of the top or bottom layer over all layers, and flatten, x fastest."""
    spread = np.full((layers, *values.shape), elsewhere, values.dtype)
    spread[-1 if top else 0] = values
    return spread.ravel()
