"""States of the layer and what was observed of them, as `opfem fit-parameters` reads them from a TOML file."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from ..inverse import ForceReading, LogNormal, Normal, SideBulge
from ..inverse.parameters import AbstractNumberPrior
from ..io import read_displacement, read_thickness
from ..measurement import ThicknessMap
from ..model import Imprint, Layer, Palpation
from .toml_file import as_json, read_toml
from .toml_parts import CONTACT, MATERIAL, built, face, material, sections, thickness_map

_Numbers = tuple[float, ...]
_TABLES = ("state", "increment", "bulge")
_KEYS: dict[str, dict[str, Any]] = {
    "layer": {"thickness": float | str, **MATERIAL},
    "experiment": {
        "extent": tuple[float, float],
        "elements": tuple[int, int, int],
        "sides": str | dict,
        "element": str,
        "hold": float,
        "side_contact": bool,
    },
    "window": CONTACT,
    "sample": CONTACT,
    "state": {"thickness": float | str, "force": float, "force_std": float, "map": str, "map_std": float},
    "increment": {
        "displacement": str,
        "before": int,
        "after": int,
        "spacing": tuple[float, float, float],
        "margin": float,
    },
    "bulge": {
        "state": int,
        "side": Literal["x0", "x1", "y0", "y1"],
        **dict.fromkeys(("depth", "displacement"), _Numbers),
        "std": float,
    },
    "fit": {"model_std": float, "scale_std": float, "max_steps": int},
}
_NEEDED = {
    "layer": ("thickness",),
    "experiment": ("extent", "elements"),
    "window": (),
    "sample": (),
    "parameters": (),
    "state": (),
}
# Keys of a prior, and what they make.
_PRIORS = {("median", "spread"): LogNormal, ("mean", "std"): Normal}
_PLATE_PIXELS = 2  # along each axis of the map of a flat plate


class ObservedStates(NamedTuple):
    """What a file states.

    Attributes:
        palpation: The experiment.
        loads: Its loads, which follow one another.
        observations: What was observed of the states.
        parameters: Priors of the fitted numbers, by path.
        options: Arguments of `fit_parameters`, as the file states them.
        stated: The file's content.
    """

    palpation: Palpation
    loads: list[Imprint]
    observations: list[Any]
    parameters: dict[str, AbstractNumberPrior]
    options: dict[str, Any]
    stated: dict[str, Any]


def read_observed_states(path: Path) -> ObservedStates:
    """Read a file; every name and number is checked before anything is computed.

    Args:
        path: A TOML file; files that it names are looked for beside it.

    Raises:
        ValueError: Where the file cannot be read, or states what cannot be.
        MeasurementError: For anything wrong with a map or a displacement.
    """
    stated = read_toml(path)
    parameters = _priors(path, stated.get("parameters", {}))
    keys = {**_KEYS, "parameters": dict.fromkeys(stated.get("parameters", {}), dict)}
    parts = sections(path, stated, keys, _NEEDED, _TABLES)
    extent = parts["experiment"]["extent"]

    def surface(given: float | str) -> float | ThicknessMap:
        return thickness_map(path.parent, given, extent) if isinstance(given, str) else given

    unloaded = surface(parts["layer"]["thickness"])
    layer = built("[layer]", lambda: Layer(unloaded, material("[layer]", parts["layer"])))
    # By a penalty: multipliers of exact contact move what slips, so that fits of frictions stall.
    faces = {name: face(name, parts[name], exact=False) for name in ("window", "sample")}
    palpation = built("[experiment]", lambda: Palpation(layer, **faces, **parts["experiment"]))
    loads, observations = [], []
    for number, state in enumerate(parts["state"], start=1):
        load, observed = _state(path.parent, f"[[state]] {number}", state, extent)
        loads.append(load)
        observations += [(number - 1, one) for one in observed]
    observations += [
        _increment(path.parent, f"[[increment]] {number}", one, palpation, len(loads))
        for number, one in enumerate(parts.get("increment", []), start=1)
    ]
    observations += [
        _bulge(f"[[bulge]] {number}", one, len(loads)) for number, one in enumerate(parts.get("bulge", []), start=1)
    ]
    if not observations:
        raise ValueError(
            f"{path} states nothing that was observed: a force or map of a [[state]], [[increment]]s or [[bulge]]s."
        )
    options = parts.get("fit", {})
    if "scale_std" in options:
        options["scale"] = built("[fit] scale_std", lambda: Normal(1.0, options.pop("scale_std")))
    return ObservedStates(palpation, loads, observations, parameters, options, as_json(stated))


def _priors(path: Path, stated: Any) -> dict[str, AbstractNumberPrior]:
    """Read priors by the path of their number; window.friction = {…} is a table in a table."""
    found: dict[str, AbstractNumberPrior] = {}

    def read(name: str, given: Any) -> None:
        what = f"{path}: [parameters] {name}"
        if not isinstance(given, dict):
            raise ValueError(f"{what} must be a prior, {_listed()}, got {given!r}.")
        numbers = {key: value for key, value in given.items() if not isinstance(value, dict)}
        if not numbers:
            for key, value in given.items():
                read(f"{name}.{key}" if name else key, value)
            return
        for keys, prior in _PRIORS.items():
            if set(given) == set(keys) and all(type(value) in (int, float) for value in given.values()):
                found[name] = built(f"[parameters] {name}:", lambda prior=prior: prior(**given))
                return
        raise ValueError(f"{what} must be a prior, {_listed()}, got {given!r}.")

    if stated != {}:
        read("", stated)
    if not found:
        raise ValueError(f'{path} needs [parameters], such as "window.friction" = {{ median = 0.15, spread = 0.5 }}.')
    return found


def _listed() -> str:
    return " or ".join("{ " + ", ".join(f"{key} = ..." for key in keys) + " }" for keys in _PRIORS)


def _state(folder: Path, what: str, given: Mapping[str, Any], extent: tuple[float, float]) -> tuple[Imprint, list[Any]]:
    """Build the load of a state, a flat plate or a map, and what was observed under it."""
    if "thickness" not in given:
        raise ValueError(f"{what} needs thickness [mm]: of the layer under a flat plate, or a map that is pressed in.")
    for key in ("force", "map"):
        if f"{key}_std" in given and key not in given:
            raise ValueError(f"{what} states {key}_std without {key}.")
    if "force" in given and "force_std" not in given:
        raise ValueError(f"{what} needs force_std [N], the standard deviation of the reading.")
    pressed = given["thickness"]
    if isinstance(pressed, str):
        surface = thickness_map(folder, pressed, extent)
    else:
        values = np.full((_PLATE_PIXELS, _PLATE_PIXELS), pressed)
        surface = built(f"{what} thickness:", lambda: ThicknessMap(values, extent=extent))
    observed: list[Any] = []
    if "force" in given:
        observed.append(built(what, lambda: ForceReading(given["force"], given["force_std"])))
    if "map" in given:
        path = folder / given["map"]
        grid = None if path.suffix.lower() == ".npz" else extent
        observed.append(read_thickness(path, std=given.get("map_std"), extent=grid))
    return Imprint(surface), observed


def _increment(folder: Path, what: str, given: Mapping[str, Any], palpation: Palpation, states: int) -> Any:
    """Read an increment of displacement between two states, counted from 1."""
    if "displacement" not in given:
        raise ValueError(f"{what} needs displacement, a file of opfem oct --phase.")
    before, after = (_number(what, given, key, default, states) for key, default in (("before", 1), ("after", 2)))
    volume = read_displacement(folder / given["displacement"])
    blocks = {key: given[key] for key in ("spacing", "margin") if key in given}
    return built(what, lambda: volume.increments(palpation, before=before, after=after, **blocks))


def _bulge(what: str, given: Mapping[str, Any], states: int) -> tuple[int, SideBulge]:
    for key in ("side", "depth", "displacement", "std"):
        if key not in given:
            raise ValueError(f"{what} needs {key}.")
    number = _number(what, given, "state", 1, states)
    depth, displacement = (np.asarray(given[key]) for key in ("depth", "displacement"))
    return number, built(what, lambda: SideBulge(given["side"], depth, displacement, given["std"]))


def _number(what: str, given: Mapping[str, Any], key: str, default: int, states: int) -> int:
    """Return the index of a state that the file counts from 1."""
    number = given.get(key, default)
    if not 1 <= number <= states:
        raise ValueError(f"{what} {key} must be the number of a [[state]], 1 to {states}, got {number}.")
    return number - 1
