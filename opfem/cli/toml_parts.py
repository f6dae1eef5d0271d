"""Parts that files of several commands state in sections of TOML: materials, contacts, maps.

What the library says of its arguments is said of the file's sections and keys.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

from ..io import read_thickness
from ..measurement import ThicknessMap
from ..model import (
    AbstractMaterial,
    Bonded,
    Contact,
    ExponentialOverclosure,
    HardOverclosure,
    Hencky,
    LinearOverclosure,
    MooneyRivlin,
    NeoHooke,
    Roller,
    Side,
    Yeoh,
)
from ..sweeps.design import known_name
from .toml_file import converted

_Part = TypeVar("_Part")

_LAWS = {
    ("c10", "bulk"): NeoHooke,
    ("c10", "c01", "bulk"): MooneyRivlin,
    ("c10", "c20", "c30", "bulk"): Yeoh,
    ("shear", "bulk"): Hencky,
}
MATERIAL = dict.fromkeys(("c10", "c01", "c20", "c30", "shear", "bulk"), float)
CONTACT = {
    "kind": Literal["contact", "bonded", "roller"],
    "law": Literal["hard", "exponential", "linear"],
    **dict.fromkeys(("friction", "p0", "c0", "stiffness", "stick_slope"), float),
    "exact": bool,
}
_PUBLISHED = {"p0": 2.0, "c0": 0.01}
"""Contact of layer and sample in the published decks [MPa, mm]."""


# Names of the library, and what a file calls them.
_OWNERS = {
    "Layer": "layer", "Sample": "sample", "Experiment": "experiment", "Palpation": "experiment",
    "Compression": "compression", "measured_thickness": "measurement", "Newton": "solver",
}  # fmt: skip
_FACES = re.compile(r"(?:Experiment\.(window|interface|plate)|Palpation\.(window|sample))\b=?")
_OWNED = re.compile(rf"\b({'|'.join(_OWNERS)})\.(\w+)")
_ARGUMENT = re.compile(r"\b([a-z_]+)=(?=[\w\"'(\[])")


def sections(
    path: Path,
    stated: Mapping[str, Any],
    keys: Mapping[str, Mapping[str, Any]],
    needed: Mapping[str, tuple[str, ...]],
    tables: tuple[str, ...],
) -> dict[str, Any]:
    """Check the names of a file's sections and keys, and convert their values.

    Args:
        path: The file, for messages.
        stated: Its content.
        keys: Type of every key, by section.
        needed: Sections that must be there, with the keys that they must have.
        tables: Sections that may be stated several times; each becomes a list.
    """
    for section in stated:
        known_name(f"{path}: section", section, tuple(keys))
    for section, names in needed.items():
        missing = [name for name in names if name not in stated.get(section, {})]
        if section not in stated or missing:
            stating = f"[[{section}]]" if section in tables else f"[{section}]"
            raise ValueError(f"{path} needs {stating}" + (f" with {missing[0]} = ..." if missing else "") + ".")
    parts: dict[str, Any] = {}
    for section, found in stated.items():
        if section in tables:
            listed = found if isinstance(found, list) else [found]
            parts[section] = [
                _entries(path, f"[[{section}]] {number}", section, one, keys[section])
                for number, one in enumerate(listed, start=1)
            ]
        else:
            parts[section] = _entries(path, f"[{section}]", section, found, keys[section])
    return parts


def _entries(path: Path, what: str, section: str, stated: Any, keys: Mapping[str, Any]) -> dict[str, Any]:
    if not isinstance(stated, dict):
        raise ValueError(f"{path}: {section} must be a section, {what}, got {stated!r}.")
    for name in stated:
        known_name(f"{path}: {what}", name, tuple(keys))
    return {name: converted(f"{path}: {what} {name}", keys[name], value) for name, value in stated.items()}


def thickness_map(folder: Path, name: str, extent: tuple[float, float]) -> ThicknessMap:
    """Read a map; one that does not state its grid, as opfem's own do, spans the layer."""
    path = folder / name
    thickness = read_thickness(path) if path.suffix.lower() == ".npz" else read_thickness(path, extent=extent)
    return thickness.filled() if bool(thickness.mask.any()) and not thickness.is_filled else thickness


def material(what: str, given: Mapping[str, Any]) -> AbstractMaterial:
    """Build a material; its numbers [MPa] say which law it is."""
    numbers = {name: value for name, value in given.items() if name in MATERIAL}
    for names, law in _LAWS.items():
        if set(numbers) == set(names):
            return law(**numbers)
    known = "; ".join(f"{', '.join(names)} ({law.__name__})" for names, law in _LAWS.items())
    raise ValueError(f"{what} needs the numbers of one law [MPa], {known}; got {', '.join(numbers) or 'none'}.")


def face(section: str, given: Mapping[str, Any], exact: bool = True) -> Side:
    """Build a face of the layer: a contact with its law and friction, bonded, or a roller.

    Args:
        section: Its section.
        given: What that states.
        exact: Whether hard contact is exact where the section does not say.
    """
    kind = given.get("kind", "contact")
    if kind != "contact":
        others = [name for name in given if name != "kind"]
        if others:
            raise ValueError(f"[{section}] {others[0]} is for kind contact, got kind {kind!r}. Leave one out.")
        return Bonded() if kind == "bonded" else Roller()
    if "friction" not in given:
        raise ValueError(f"[{section}] needs friction [-]; it is never taken as zero. State friction = 0.0 for none.")
    kinds = {"hard": ("exact",), "exponential": ("p0", "c0"), "linear": ("stiffness",)}
    law = given.get("law", "exponential" if section in ("interface", "sample") else "hard")
    foreign = [name for name in given if name not in ("kind", "law", "friction", "stick_slope", *kinds[law])]
    if foreign:
        raise ValueError(f"[{section}] {foreign[0]} does not belong to law {law!r}, which takes {kinds[law]}.")
    if law == "linear" and "stiffness" not in given:
        raise ValueError(f"[{section}] law 'linear' needs stiffness [MPa/mm].")
    makers: dict[str, Callable[[], Any]] = {
        "hard": lambda: HardOverclosure(exact=given.get("exact", exact)),
        "exponential": lambda: ExponentialOverclosure(*({**_PUBLISHED, **given}[name] for name in ("p0", "c0"))),
        "linear": lambda: LinearOverclosure(given["stiffness"]),
    }
    return built(
        f"[{section}]", lambda: Contact(makers[law](), given["friction"], stick_slope=given.get("stick_slope"))
    )


def built(section: str, build: Callable[[], _Part]) -> _Part:
    """Build a part; what the library says of its arguments is said of the file's keys."""
    try:
        return build()
    except ValueError as cause:
        raise ValueError(in_keys(section, str(cause))) from None


def in_keys(section: str, message: str) -> str:
    """Say in sections and keys what a message says in arguments: `Layer.thickness` is `[layer] thickness`."""
    message = message.replace("Bonded()", 'kind "bonded"').replace("Roller()", 'kind "roller"')
    message = _FACES.sub(lambda found: f"[{found[1] or found[2]}] ", message).replace("]  ", "] ")
    message = _OWNED.sub(lambda found: f"[{_OWNERS[found[1]]}] {found[2]}", message)
    message = _ARGUMENT.sub(r"\1 = ", re.sub(r"\b(?:[A-Z]\w+)\.([a-z]\w*)", rf"{section} \1", message))
    return message if message.startswith("[") else f"{section} {message}"
