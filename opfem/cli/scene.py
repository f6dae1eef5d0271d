"""A scene: the virtual experiment that `opfem simulate` solves, stated in a TOML file.

Sections are the parts of an `Experiment`, keys their arguments; the numbers of a material say which law it is.
"""

import functools
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

from .._checks import check_non_negative, check_positive
from ..io import read_thickness
from ..measurement import ThicknessMap
from ..model import (
    AbstractInclusion,
    AbstractMaterial,
    Bonded,
    Box,
    Compression,
    Contact,
    Cylinder,
    Experiment,
    ExponentialOverclosure,
    HalfSpace,
    HardOverclosure,
    Hencky,
    Layer,
    LinearOverclosure,
    MooneyRivlin,
    NeoHooke,
    Roller,
    Sample,
    Side,
    Sphere,
    Yeoh,
)
from ..sweeps.design import known_name
from .toml_file import converted, read_toml

_Part = TypeVar("_Part")

_LAWS = {
    ("c10", "bulk"): NeoHooke,
    ("c10", "c01", "bulk"): MooneyRivlin,
    ("c10", "c20", "c30", "bulk"): Yeoh,
    ("shear", "bulk"): Hencky,
}
_SHAPES = {
    "cylinder": (Cylinder, ("centre", "radius", "depth")),
    "sphere": (Sphere, ("centre", "radius")),
    "box": (Box, ("low", "high")),
    "half_space": (HalfSpace, ("point", "normal")),
}
_Numbers = tuple[float, ...]
_MATERIAL = dict.fromkeys(("c10", "c01", "c20", "c30", "shear", "bulk"), float)
_CONTACT = {
    "kind": Literal["contact", "bonded", "roller"],
    "law": Literal["hard", "exponential", "linear"],
    **dict.fromkeys(("friction", "p0", "c0", "stiffness", "stick_slope"), float),
    "exact": bool,
}
_KEYS: dict[str, dict[str, Any]] = {
    "layer": {"thickness": float | str, **_MATERIAL},
    "sample": {"thickness": float | str, "levels": _Numbers, **_MATERIAL},
    "inclusion": {
        "shape": Literal["cylinder", "sphere", "box", "half_space"],
        **dict.fromkeys(("centre", "depth", "low", "high", "point", "normal"), _Numbers),
        "radius": float,
        **_MATERIAL,
    },
    "experiment": {
        "extent": tuple[float, float],
        "elements": list,
        "sides": str | dict,
        "element": str | tuple[str, str],
        "hold": float,
    },
    "window": _CONTACT,
    "interface": _CONTACT,
    "plate": _CONTACT,
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
_PUBLISHED = {"p0": 2.0, "c0": 0.01}
"""Contact of layer and sample in the published decks [MPa, mm]."""

# Names of the library, and what a scene calls them.
_OWNERS = {
    "Layer": "layer", "Sample": "sample", "Experiment": "experiment", "Compression": "compression",
    "measured_thickness": "measurement", "Newton": "solver",
}  # fmt: skip
_FACES = re.compile(r"Experiment\.(window|interface|plate)\b=?")
_OWNED = re.compile(rf"\b({'|'.join(_OWNERS)})\.(\w+)")
_ARGUMENT = re.compile(r"\b([a-z_]+)=(?=[\w\"'(\[])")


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
    parts = _checked(path, stated)
    extent = parts["experiment"]["extent"]

    def thickness(section: str) -> float | ThicknessMap:
        given = parts[section].pop("thickness")
        return _map(path.parent, given, extent) if isinstance(given, str) else given

    deep, shallow = thickness("sample"), thickness("layer")
    layer = _built("[layer]", lambda: Layer(shallow, _law("[layer]", parts["layer"])))
    sample = _built("[sample]", lambda: _sample(deep, parts))
    faces = {name: _side(name, parts[name]) for name in ("window", "interface", "plate")}
    measured = Measurement(**{"pixel": min(extent) / _PIXELS, "std": 0.0, "seed": 0, **parts.get("measurement", {})})
    check_positive("[measurement] pixel", "mm", measured.pixel)
    check_non_negative("[measurement] std", "mm", measured.std)
    check_non_negative("[measurement] seed", "-", measured.seed)
    return Scene(
        _built("[experiment]", lambda: Experiment(layer, sample, **faces, **parts["experiment"])),
        _built("[compression]", lambda: Compression(**parts["compression"])),
        measured,
        parts.get("solver", {}).get("increments"),
        parts.get("pictures", {}).get("y"),
        _as_json(stated),
    )


def _as_json(value: Any) -> Any:
    """Write infinite numbers as text; JSON has none."""
    if isinstance(value, dict):
        return {name: _as_json(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [_as_json(entry) for entry in value]
    return str(value) if isinstance(value, float) and math.isinf(value) else value


def _checked(path: Path, stated: Mapping[str, Any]) -> dict[str, Any]:
    """Check the names of sections and keys, and the types of values."""
    for section in stated:
        known_name(f"{path}: section", section, tuple(_KEYS))
    for section, keys in _NEEDED.items():
        missing = [key for key in keys if key not in stated.get(section, {})]
        if section not in stated or missing:
            raise ValueError(f"{path} needs [{section}]" + (f" with {missing[0]} = ..." if missing else "") + ".")
    parts: dict[str, Any] = {}
    for section, entries in stated.items():
        if section == "inclusion":
            tables = entries if isinstance(entries, list) else [entries]
            parts[section] = [_entries(path, f"[[inclusion]] {n}", section, e) for n, e in enumerate(tables, start=1)]
        else:
            parts[section] = _entries(path, f"[{section}]", section, entries)
    return parts


def _entries(path: Path, what: str, section: str, entries: Any) -> dict[str, Any]:
    if not isinstance(entries, dict):
        raise ValueError(f"{path}: {section} must be a section, {what}, got {entries!r}.")
    for name in entries:
        known_name(f"{path}: {what}", name, tuple(_KEYS[section]))
    return {name: converted(f"{path}: {what} {name}", _KEYS[section][name], value) for name, value in entries.items()}


def _map(folder: Path, name: str, extent: tuple[float, float]) -> ThicknessMap:
    """Read a map; one that does not state its grid, as opfem's own do, spans the layer."""
    path = folder / name
    thickness = read_thickness(path) if path.suffix.lower() == ".npz" else read_thickness(path, extent=extent)
    return thickness.filled() if bool(thickness.mask.any()) and not thickness.is_filled else thickness


def _law(what: str, given: Mapping[str, Any]) -> AbstractMaterial:
    numbers = {name: value for name, value in given.items() if name in _MATERIAL}
    for names, law in _LAWS.items():
        if set(numbers) == set(names):
            return law(**numbers)
    known = "; ".join(f"{', '.join(names)} ({law.__name__})" for names, law in _LAWS.items())
    raise ValueError(f"{what} needs the numbers of one law [MPa], {known}; got {', '.join(numbers) or 'none'}.")


def _sample(thickness: float | ThicknessMap, parts: Mapping[str, Any]) -> Sample:
    sample = Sample(thickness, _law("[sample]", parts["sample"]), parts["sample"].get("levels"))
    for number, entry in enumerate(parts.get("inclusion", []), start=1):
        what = f"[[inclusion]] {number}"
        sample = sample.with_inclusion(*_built(what, functools.partial(_inclusion, what, entry)))
    return sample


def _inclusion(what: str, entry: Mapping[str, Any]) -> tuple[AbstractInclusion, AbstractMaterial]:
    if "shape" not in entry:
        raise ValueError(f"{what} needs shape = {', '.join(_SHAPES)}.")
    shape, names = _SHAPES[entry["shape"]]
    stated = {name for name in entry if name not in _MATERIAL and name != "shape"}
    if stated != set(names):
        got = ", ".join(sorted(stated)) or "none"
        raise ValueError(f"{what}: a {entry['shape']} has {', '.join(names)}, got {got}.")
    return shape(**{name: entry[name] for name in names}), _law(what, entry)


def _side(section: str, given: Mapping[str, Any]) -> Side:
    kind = given.get("kind", "contact")
    if kind != "contact":
        others = [name for name in given if name != "kind"]
        if others:
            raise ValueError(f"[{section}] {others[0]} is for kind contact, got kind {kind!r}. Leave one out.")
        return Bonded() if kind == "bonded" else Roller()
    if "friction" not in given:
        raise ValueError(f"[{section}] needs friction [-]; it is never taken as zero. State friction = 0.0 for none.")
    kinds = {"hard": ("exact",), "exponential": ("p0", "c0"), "linear": ("stiffness",)}
    law = given.get("law", "exponential" if section == "interface" else "hard")
    foreign = [name for name in given if name not in ("kind", "law", "friction", "stick_slope", *kinds[law])]
    if foreign:
        raise ValueError(f"[{section}] {foreign[0]} does not belong to law {law!r}, which takes {kinds[law]}.")
    if law == "linear" and "stiffness" not in given:
        raise ValueError(f"[{section}] law 'linear' needs stiffness [MPa/mm].")
    makers: dict[str, Callable[[], Any]] = {
        "hard": lambda: HardOverclosure(exact=given.get("exact", True)),
        "exponential": lambda: ExponentialOverclosure(*({**_PUBLISHED, **given}[name] for name in ("p0", "c0"))),
        "linear": lambda: LinearOverclosure(given["stiffness"]),
    }
    return _built(
        f"[{section}]", lambda: Contact(makers[law](), given["friction"], stick_slope=given.get("stick_slope"))
    )


def _built(section: str, build: Callable[[], _Part]) -> _Part:
    """Build a part; what the library says of its arguments is said of the scene's keys."""
    try:
        return build()
    except ValueError as cause:
        raise ValueError(in_keys(section, str(cause))) from None


def in_keys(section: str, message: str) -> str:
    """Say in sections and keys what a message says in arguments: `Layer.thickness` is `[layer] thickness`."""
    message = message.replace("Bonded()", 'kind "bonded"').replace("Roller()", 'kind "roller"')
    message = _FACES.sub(lambda found: f"[{found[1]}] ", message).replace("]  ", "] ")
    message = _OWNED.sub(lambda found: f"[{_OWNERS[found[1]]}] {found[2]}", message)
    message = _ARGUMENT.sub(r"\1 = ", re.sub(r"\b(?:[A-Z]\w+)\.([a-z]\w*)", rf"{section} \1", message))
    return message if message.startswith("[") else f"{section} {message}"
