"""CalculiX' results as data sets on opfem's grid: `read_frd` for fields, `read_dat` for forces and stresses.

Nodes are found by their reference positions, whatever their numbers. Contact pressure is computed from the
displacements, by the forces that the elements exert: CalculiX' own, at facets that do not meet, is unreliable.
"""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import xarray as xr
from scipy.spatial import KDTree

from ..mechanics.face import nodal_area_vector, tributary_area
from ..mechanics.internal import layer_body
from ..model import AbstractMaterial, Experiment, Palpation
from ..model.mesh import AbstractBlockMesh
from .cards import Place

# Digits of a position in a .frd file are 6: nodes are the same within this, over the body's size.
_SAME = 1e-4
_FIELD, _FIRST = 12, 13  # characters of a number, and where the first one begins, in a line of values
_COMPONENTS = 6  # of symmetric tensors: xx, yy, zz, xy, yz, zx
_TENSOR = np.array([(0, 3, 5), (3, 1, 4), (5, 4, 2)])
_HEAD = re.compile(r" (.+?) (?:\((.*)\) )?for set (\S+) and time +(\S+)")


def read_frd(path: str | os.PathLike, problem: Palpation | Experiment) -> xr.Dataset:
    """Read the fields that CalculiX found for a palpation or an experiment (.frd, ASCII), such as `write_inp` wrote.

    Args:
        path: The file.
        problem: What was solved; its nodes are found in the file.

    Returns:
        Displacement, and `stress` at the nodes where the file has it, over time; at the interface `traction` and
        `pressure` as `to_xarray` has them, from the displacements; `force_sample`. Of an experiment also the sample's
        displacement.

    Raises:
        DeckError: If the file is no .frd in ASCII, or lacks nodes of the problem.
    """
    path = Path(path)
    positions, results = _read_blocks(path)
    layer, law, element = _layer_of(problem)
    where = _find(layer, positions, path)
    displaced = [(time, values) for name, time, values in results if name == "DISP"]
    if not displaced:
        raise Place(path.name, 1).refuse("the file has no displacements (DISP); ask for U in *NODE FILE.")
    times = [time for time, _ in displaced]
    u = np.stack([np.moveaxis(values[where][..., :3], -1, 0) for _, values in displaced])
    mechanics = [_interface(layer, law, element, one) for one in u]
    data = _dataset(layer, times) | {
        "displacement": (("time", "component", "z", "y", "x"), u, {"units": "mm", "long_name": "displacement"}),
        "traction": (
            ("time", "component", "y", "x"), np.stack([one[0] for one in mechanics]),
            {"units": "MPa", "long_name": "force on the layer at the sample per reference area"},
        ),
        "pressure": (
            ("time", "y", "x"), np.stack([one[1] for one in mechanics]),
            {"units": "MPa", "long_name": "contact pressure at the sample on the current area, compression positive"},
        ),
        "force_sample": (
            ("time", "component"), np.stack([one[2] for one in mechanics]),
            {"units": "N", "long_name": "force of the sample on the layer"},
        ),
    }  # fmt: skip
    stresses = [values for name, _, values in results if name == "STRESS"]
    if len(stresses) == len(times):
        tensors = np.stack([np.moveaxis(values[where][..., _TENSOR], (-2, -1), (0, 1)) for values in stresses])
        about = {"units": "MPa", "long_name": "Cauchy stress extrapolated to the nodes by CalculiX"}
        data["stress"] = (("time", "component", "direction", "z", "y", "x"), tensors, about)
    if isinstance(problem, Experiment):
        own = _find(_sample_of(problem), positions, path)
        sample = np.stack([np.moveaxis(values[own][..., :3], -1, 0) for _, values in displaced])
        about = {"units": "mm", "long_name": "displacement of the sample"}
        data["sample_displacement"] = (("time", "component", "z_sample", "y_sample", "x_sample"), sample, about)
    return xr.Dataset(data, attrs={"title": f"CalculiX, {path.name}"})


def read_dat(path: str | os.PathLike, problem: Palpation | Experiment) -> xr.Dataset:
    """Read what CalculiX printed of a palpation or an experiment (.dat), such as `write_inp` asked for.

    Args:
        path: The file.
        problem: What was solved.

    Returns:
        Over time, `force_NAME` of every node set with a total force, and `stress_zz`, the mean over the points of each
        top element, where stresses of the top elements were printed.

    Raises:
        DeckError: If the file has neither, or tables that are none.
    """
    path = Path(path)
    layer, _, _ = _layer_of(problem)
    nx, ny, _ = layer.elements
    forces: dict[str, dict[float, np.ndarray]] = {}
    stresses: dict[float, np.ndarray] = {}
    for place, what, name, time, rows in _tables(path):
        if what == "total force" and rows.shape == (1, 3):
            forces.setdefault(name, {})[time] = rows[0]
        elif what == "stresses" and rows.shape[1:] == (2 + _COMPONENTS,):
            elements, which = np.unique(rows[:, 0], return_inverse=True)
            if elements.size == nx * ny:
                stresses[time] = (np.bincount(which, rows[:, 4]) / np.bincount(which)).reshape(ny, nx)
        elif not rows.size:
            raise place.refuse(f"the table of {what} is empty.")
    times = sorted({time for found in forces.values() for time in found} | set(stresses))
    if not times:
        raise Place(path.name, 1).refuse("the file has no total force and no stresses of the top elements.")
    data: dict[str, Any] = {"component": ("component", ["x", "y", "z"]), "time": ("time", times, {"units": "s"})}
    for name, found in forces.items():
        values = np.stack([found.get(time, np.full(3, np.nan)) for time in times])
        about = {"units": "N", "long_name": f"total force on the nodes of {name}"}
        data[f"force_{name.lower()}"] = (("time", "component"), values, about)
    if stresses:
        nothing = np.full((ny, nx), np.nan)
        values = np.stack([stresses.get(time, nothing) for time in times])
        about = {"units": "MPa", "long_name": "Cauchy stress zz, mean over the top element, tension positive"}
        data["stress_zz"] = (("time", "y_element", "x_element"), values, about)
    return xr.Dataset(data, attrs={"title": f"CalculiX, {path.name}"})


def _layer_of(problem: Palpation | Experiment) -> tuple[AbstractBlockMesh, AbstractMaterial, str]:
    if isinstance(problem, Palpation):
        return problem.mesh(), problem.layer.material, problem.element
    return problem.layer_mesh(), problem.layer.material, problem.element[0]


def _sample_of(experiment: Experiment) -> np.ndarray:
    """Compute where the deck of an experiment has the sample's nodes `(3, nz+1, ny+1, nx+1)` [mm]."""
    X = np.array(experiment.sample_mesh().positions())
    X[2] += float(getattr(getattr(experiment.interface, "law", None), "zero_pressure_clearance", 0.0))
    return X


def _dataset(layer: AbstractBlockMesh, times: list[float]) -> dict[str, Any]:
    X = np.asarray(layer.positions())
    return {
        "time": ("time", times, {"units": "s"}),
        "component": ("component", ["x", "y", "z"]),
        "x": ("x", X[0, 0, 0], {"units": "mm"}),
        "y": ("y", X[1, 0, :, 0], {"units": "mm"}),
        "z": ("z", np.linspace(0.0, 1.0, X.shape[1]), {"units": "1", "long_name": "height over unloaded thickness"}),
    }


def _interface(
    layer: AbstractBlockMesh, law: AbstractMaterial, element: str, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute traction and pressure [MPa] at the nodes of the interface, and their force [N], from displacements."""
    X, moved = layer.positions(), jnp.asarray(u)
    body = layer_body(layer, law, element)  # pyright: ignore[reportArgumentType]
    force = np.asarray(body.internal_force(moved)[0])[:, -1]
    area = np.asarray(nodal_area_vector(X[:, -1] + moved[:, -1]))
    length = np.linalg.norm(area, axis=0)
    pressure = -np.sum(force * area, axis=0) / length**2
    return force / np.asarray(tributary_area(X[:, -1])), pressure, force.sum(axis=(1, 2))


def _find(mesh: AbstractBlockMesh | np.ndarray, positions: np.ndarray, path: Path) -> np.ndarray:
    """Find the nodes of a mesh among positions `(n, 3)` [mm]; of several at one place the first."""
    X = mesh if isinstance(mesh, np.ndarray) else np.asarray(mesh.positions())
    wanted = X.reshape(3, -1).T
    size = float(np.ptp(wanted, axis=0).max())
    near = KDTree(positions).query_ball_point(wanted, _SAME * size)
    missing = [k for k, found in enumerate(near) if not found]
    if missing:
        at = ", ".join(f"{value:.4g}" for value in wanted[missing[0]])
        raise Place(path.name, 1).refuse(f"the file has no node at ({at}) mm; is it of this problem?")
    return np.array([min(found) for found in near]).reshape(X.shape[1:])


def _read_blocks(path: Path) -> tuple[np.ndarray, list[tuple[str, float, np.ndarray]]]:
    """Read positions `(n, 3)` and every block of results: name, time, values `(n, components)` of the same nodes."""
    index: dict[int, int] = {}
    positions: list[list[float]] = []
    results: list[tuple[str, float, np.ndarray]] = []
    block, name, time, components = "", "", 0.0, 0
    values = np.zeros((0, 0))
    row = -1
    for number, line in enumerate(path.read_text(encoding="latin-1").splitlines(), start=1):
        place = Place(path.name, number)
        key = line[:6]
        if key == "    2C":
            block = "nodes"
        elif key == "    3C":
            block = "elements"
        elif key == "  100C":
            block, name, components = "header", "", 0
            time = _number(line[12:24], place)
        elif line.startswith(" -4") and block == "header":
            name = line[5:11].strip()
        elif line.startswith(" -5") and block == "header":
            components += line[33:38].strip() != "1"  # 1: made of the others when it is drawn
        elif line.startswith(" -3"):
            if block == "values":
                results.append((name, time, values))
            block = ""
        elif line.startswith(" -1") and block == "nodes":
            index[int(_number(line[3:13], place))] = len(positions)
            positions.append([_number(line[_FIRST + _FIELD * k :][:_FIELD], place) for k in range(3)])
        elif line.startswith((" -1", " -2")) and block in ("header", "values"):
            if block == "header":
                block, values = "values", np.full((len(positions), components), np.nan)
            if line.startswith(" -1"):
                row, start = index.get(int(_number(line[3:13], place)), -1), 0
                if row < 0:
                    raise place.refuse(f"a result of node {line[3:13].strip()[:20]}, which is not there.")
            else:
                start = _COMPONENTS
            for k in range(min(components - start, _COMPONENTS)):
                values[row, start + k] = _number(line[_FIRST + _FIELD * k :][:_FIELD], place)
    if not positions:
        raise Place(path.name, 1).refuse("no nodes: is it a .frd file in ASCII, of *NODE FILE and not *NODE OUTPUT?")
    return np.array(positions), results


def _tables(path: Path) -> Iterator[tuple[Place, str, str, float, np.ndarray]]:
    """Yield the tables of a .dat file: place, what, of which set, time, numbers."""
    head: tuple[Place, str, str, float] | None = None
    rows: list[list[float]] = []
    for number, line in enumerate(path.read_text(encoding="latin-1").splitlines(), start=1):
        place = Place(path.name, number)
        found = _HEAD.match(line)
        if found is not None:
            if head is not None:
                yield *head, np.array(rows)
            head, rows = (place, found[1], found[3], _number(found[4], place)), []
        elif line.strip() and head is not None:
            rows.append([_number(word, place) for word in line.split()])
            if len(rows[-1]) != len(rows[0]):
                raise place.refuse(f"the table of {head[1]} has a line of {len(rows[-1])} numbers.")
    if head is not None:
        yield *head, np.array(rows)


def _number(word: str, place: Place) -> float:
    try:
        return float(word)
    except ValueError:
        raise place.refuse(f"expected a number, got {word.strip()[:20]!r}.") from None
