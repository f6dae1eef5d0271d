"""What a result rests on, in words: layer, material, contact, mesh and map, each marked as given or assumed.

Which inputs were assumed is recorded by the command line; where nothing is recorded, a report says so.
"""

import json
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import xarray as xr

ASSUMED = "assumed"
"""Attribute of a dataset: a JSON list of the inputs that nobody stated, by their place, such as `window.friction`."""
ASSUMPTIONS = "assumptions"
"""Attribute of a dataset: a JSON list of sentences, such as what was read into a deck."""
COMMAND = "command"
"""Attribute of a dataset: the command line that made it."""
NOT_RECORDED = "not recorded"

_Row = tuple[str, str, str, str]  # key, part, name, value

_MATERIALS = {"MooneyRivlin": "Mooney–Rivlin", "NeoHooke": "neo-Hooke", "Hencky": "Hencky, linear in log strain"}
_LAWS = {
    "HardOverclosure": "hard",
    "ExponentialOverclosure": "pressure rises exponentially as the gap closes",
    "LinearOverclosure": "pressure rises linearly with penetration",
    "TabularOverclosure": "pressure from a table",
}
# Words, unit and factor of the numbers that are named; others are written as the library calls them.
_NUMBERS: dict[str, tuple[str, str, float]] = {
    "c10": ("C10", "kPa", 1e3),
    "c01": ("C01", "kPa", 1e3),
    "c20": ("C20", "kPa", 1e3),
    "c30": ("C30", "kPa", 1e3),
    "bulk": ("bulk modulus", "kPa", 1e3),
    "shear": ("shear modulus", "kPa", 1e3),
    "pressure": ("pressure as the gap closes, p0", "MPa", 1.0),
    "clearance": ("gap at which pressure begins, c0", "µm", 1e3),
    "stiffness": ("stiffness", "MPa/mm", 1.0),
    "friction": ("friction coefficient", "", 1.0),
    "length": ("correlation length", "mm", 1.0),
    "std": ("standard deviation", "kPa", 1e3),
    "mean": ("mean", "kPa", 1e3),
    "approach": ("approach of plate and window", "mm", 1.0),
}
_FACES = {"window": "Window", "sample": "Sample", "interface": "Layer on sample", "plate": "Plate"}


class Input(NamedTuple):
    """One thing that a result rests on.

    Attributes:
        part: What it is of.
        name: What it is.
        value: With its unit.
        mark: "given", "assumed", or "not recorded".
    """

    part: str
    name: str
    value: str
    mark: str


def input_rows(dataset: xr.Dataset) -> list[Input]:
    """Lay out what a result rests on.

    Args:
        dataset: What `to_xarray` returned.
    """
    attrs = dataset.attrs
    recorded = json.loads(attrs[ASSUMED]) if ASSUMED in attrs else None
    rows = [*_layer(attrs), *_contacts(attrs), *_sample(attrs), *_map(attrs), *_mesh(attrs), *_prior(attrs)]

    def mark(key: str) -> str:
        return NOT_RECORDED if recorded is None else ("assumed" if key in recorded else "given")

    return [Input(part, name, value, mark(key)) for key, part, name, value in rows]


def assumptions(dataset: xr.Dataset) -> list[str]:
    """List the sentences in which a result states what was read into its input."""
    return json.loads(dataset.attrs.get(ASSUMPTIONS, "[]"))


def _layer(attrs: dict[str, Any]) -> Iterator[_Row]:
    layer, sides = json.loads(attrs["layer"]), json.loads(attrs["sides"])
    yield "layer.thickness", "Layer", "unloaded thickness, L0", _length(layer["thickness"])
    yield "extent", "Layer", "width and height", " × ".join(f"{side:g}" for side in attrs["extent"]) + " mm"
    yield "sides", "Layer", "sides", ", ".join(dict.fromkeys(str(side) for side in sides.values()))
    yield from _material("layer.material", "Layer", layer["material"])


def _material(key: str, part: str, law: dict[str, Any]) -> Iterator[_Row]:
    kind = str(law["class"])
    yield f"{key}.law", part, "material law", _MATERIALS.get(kind, kind)
    yield from _numbers(key, part, law)


def _contacts(attrs: dict[str, Any]) -> Iterator[_Row]:
    for face, part in _FACES.items():
        side: dict[str, Any] = json.loads(attrs.get(face, "{}"))
        if side.get("class") == "Contact":
            law: dict[str, Any] = side["law"]
            kind = str(law["class"])
            yield f"{face}.law", part, "contact law", _LAWS.get(kind, kind)
            yield from _numbers(
                f"{face}.law", part, {n: law[n] for n in ("pressure", "clearance", "stiffness") if n in law}
            )
            yield from _numbers(face, part, {"friction": side["friction"]})
        elif side.get("class") in ("Bonded", "Roller"):
            yield f"{face}.law", part, "contact", side["class"].lower()


def _sample(attrs: dict[str, Any]) -> Iterator[_Row]:
    sample: dict[str, Any] = json.loads(attrs["sample"])
    if "material" not in sample:
        return
    yield "sample.thickness", "Sample", "thickness", _length(sample["thickness"])
    yield from _material("sample.material", "Sample", sample["material"])
    inclusions: list[Any] = sample.get("inclusions") or []
    for number, (where, law) in enumerate(inclusions, start=1):
        part = f"Inclusion {number}, {where['class'].lower()}"
        for name, value in where.items():
            if name != "class":
                yield f"inclusion.{name}", part, name, f"{_text(value)} mm"
        yield from _material("inclusion.material", part, law)


def _map(attrs: dict[str, Any]) -> Iterator[_Row]:
    load = json.loads(attrs["load"])
    pressed = load.get("thickness")
    if isinstance(pressed, dict) and "shape" in pressed and "extent" in pressed:
        rows, columns = pressed["shape"]
        sides = " × ".join(f"{side:g}" for side in pressed["extent"])
        yield "map", "Map", "pixels", f"{columns} × {rows} over {sides} mm"
        yield "missing", "Map", "pixels without data", str(pressed["missing_pixels"])
    for step in json.loads(attrs.get("thickness_steps", "[]")):
        if step["step"] == "smoothed":
            yield "smooth", "Map", "smoothing, FWHM of the Gaussian", f"{1e3 * float(step['fwhm']):g} µm"
        elif step["step"] == "filled":
            yield "filled", "Map", "pixels filled in from around", str(step.get("pixels", ""))
    yield from _numbers("load", "Load", {name: load[name] for name in ("approach",) if name in load})


def _mesh(attrs: dict[str, Any]) -> Iterator[_Row]:
    yield "elements", "Mesh", "elements of the layer", " × ".join(str(n) for n in attrs["elements"])
    if "sample_elements" in attrs:
        yield "elements", "Mesh", "elements of the sample", " × ".join(str(n) for n in attrs["sample_elements"])
    yield "element", "Mesh", "kind of element", str(attrs["element"]).replace("_", " ")


def _prior(attrs: dict[str, Any]) -> Iterator[_Row]:
    prior = json.loads(attrs.get("prior", "{}"))
    if prior:
        yield "prior", "Pressure before the fit", "prior", prior["class"]
        yield from _numbers("prior", "Pressure before the fit", prior)


def _numbers(key: str, part: str, fields: dict[str, Any]) -> Iterator[_Row]:
    for name, value in fields.items():
        if name == "class" or value is None or name == "calibrated":
            continue
        words, unit, factor = _NUMBERS.get(name, (name.replace("_", " "), "", 1.0))
        number = factor * value if isinstance(value, int | float) and not isinstance(value, bool) else value
        yield f"{key}.{name}", part, words, f"{_text(number)} {unit}".rstrip()


def _length(thickness: Any) -> str:
    return f"{thickness:g} mm" if isinstance(thickness, int | float) else f"a map, {_text(thickness)} mm"


def _text(value: Any) -> str:
    if isinstance(value, dict) and "min" in value:
        return f"{value['min']:.4g} to {value['max']:.4g}"
    if isinstance(value, list):
        return ", ".join(_text(item) for item in value)
    return "infinite" if value == math.inf else f"{value:.6g}" if isinstance(value, int | float) else str(value)
