"""A scene: the virtual experiment that `opfem simulate` solves, stated in a TOML file.

Sections are the parts of an `Experiment`, keys their arguments; the numbers of a material say which law it is.
"""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

from .._checks import check_non_negative, check_positive
from ..measurement import ThicknessMap
from ..model import (
    AbstractInclusion,
    AbstractMaterial,
    Box,
    Compression,
    Cylinder,
    Experiment,
    HalfSpace,
    Layer,
    Sample,
    Sphere,
)
from .toml_file import as_json, read_toml
from .toml_parts import CONTACT, MATERIAL, built, face, material, sections, thickness_map

_SHAPES = {
    "cylinder": (Cylinder, ("centre", "radius", "depth")),
    "sphere": (Sphere, ("centre", "radius")),
    "box": (Box, ("low", "high")),
    "half_space": (HalfSpace, ("point", "normal")),
}
_Numbers = tuple[float, ...]
_KEYS: dict[str, dict[str, Any]] = {
    "layer": {"thickness": float | str, **MATERIAL},
    "sample": {"thickness": float | str, "levels": _Numbers, **MATERIAL},
    "inclusion": {
        "shape": Literal["cylinder", "sphere", "box", "half_space"],
        **dict.fromkeys(("centre", "depth", "low", "high", "point", "normal"), _Numbers),
        "radius": float,
        **MATERIAL,
    },
    "experiment": {
        "extent": tuple[float, float],
        "elements": list,
        "sides": str | dict,
        "element": str | tuple[str, str],
        "hold": float,
    },
    "window": CONTACT,
    "interface": CONTACT,
    "plate": CONTACT,
    "compression": {"approach": float},
    "measurement": {"pixel": float, "std": float, "seed": int},
    "pictures": {"y": float},
    "solver": {"increments": int},
}
_NEEDED = {
    "layer": ("thickness",),
    "sample": ("thickness",),
    "experiment": ("extent", "elements"),
    "window": (),
    "interface": (),
    "plate": (),
    "compression": ("approach",),
}
_PIXELS = 200  # along the shorter side, where none are stated


class Measurement(NamedTuple):
    """How the map is measured.

    Attributes:
        pixel: Distance between pixels [mm].
        std: Standard deviation of the noise [mm].
        seed: Of the noise.
    """

    pixel: float
    std: float
    seed: int


class Scene(NamedTuple):
    """What a file states.

    Attributes:
        experiment: The experiment.
        load: Its load.
        measurement: How the map is measured.
        increments: Load increments asked of the solver; None leaves it to it.
        section: y of the section that is drawn [mm]; None: the middle.
        stated: The file's content, in types that JSON knows.
    """

    experiment: Experiment
    load: Compression
    measurement: Measurement
    increments: int | None
    section: float | None
    stated: dict[str, Any]


def read_scene(path: Path) -> Scene:
    """Read a scene; every name and number is checked before anything is computed.

    Args:
        path: A TOML file; maps that it names are looked for beside it.

    Raises:
        ValueError: Where the file cannot be read, or states what cannot be.
        MeasurementError: For anything wrong with a map.
    """
    stated = read_toml(path)
    parts = sections(path, stated, _KEYS, _NEEDED, ("inclusion",))
    extent = parts["experiment"]["extent"]

    def thickness(section: str) -> float | ThicknessMap:
        given = parts[section].pop("thickness")
        return thickness_map(path.parent, given, extent) if isinstance(given, str) else given

    deep, shallow = thickness("sample"), thickness("layer")
    layer = built("[layer]", lambda: Layer(shallow, material("[layer]", parts["layer"])))
    sample = built("[sample]", lambda: _sample(deep, parts))
    faces = {name: face(name, parts[name]) for name in ("window", "interface", "plate")}
    measured = Measurement(**{"pixel": min(extent) / _PIXELS, "std": 0.0, "seed": 0, **parts.get("measurement", {})})
    check_positive("[measurement] pixel", "mm", measured.pixel)
    check_non_negative("[measurement] std", "mm", measured.std)
    check_non_negative("[measurement] seed", "-", measured.seed)
    return Scene(
        built("[experiment]", lambda: Experiment(layer, sample, **faces, **parts["experiment"])),
        built("[compression]", lambda: Compression(**parts["compression"])),
        measured,
        parts.get("solver", {}).get("increments"),
        parts.get("pictures", {}).get("y"),
        as_json(stated),
    )


def _sample(thickness: float | ThicknessMap, parts: Mapping[str, Any]) -> Sample:
    sample = Sample(thickness, material("[sample]", parts["sample"]), parts["sample"].get("levels"))
    for number, entry in enumerate(parts.get("inclusion", []), start=1):
        what = f"[[inclusion]] {number}"
        sample = sample.with_inclusion(*built(what, functools.partial(_inclusion, what, entry)))
    return sample


def _inclusion(what: str, entry: Mapping[str, Any]) -> tuple[AbstractInclusion, AbstractMaterial]:
    if "shape" not in entry:
        raise ValueError(f"{what} needs shape = {', '.join(_SHAPES)}.")
    shape, names = _SHAPES[entry["shape"]]
    stated = {name for name in entry if name not in MATERIAL and name != "shape"}
    if stated != set(names):
        got = ", ".join(sorted(stated)) or "none"
        raise ValueError(f"{what}: a {entry['shape']} has {', '.join(names)}, got {got}.")
    return shape(**{name: entry[name] for name in names}), material(what, entry)
