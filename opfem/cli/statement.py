"""From options to an experiment: what the commands that read a map share."""

import dataclasses
import math
import warnings
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from .._types import ScalarLike
from ..compilation import cache_compilation, silence_alarm
from ..io import read_thickness
from ..measurement import EXAMPLE_LAYER, MeasurementError, MeasurementWarning, ThicknessMap, example_map
from ..model import (
    Contact,
    ExponentialOverclosure,
    HardOverclosure,
    Layer,
    LinearOverclosure,
    MooneyRivlin,
    Palpation,
    Side,
)
from .messages import in_options
from .options import (
    PUBLISHED_BULK,
    PUBLISHED_C01,
    PUBLISHED_C10,
    ContactOptions,
    InterfaceOptions,
    LayerOptions,
    MapOptions,
)

_SHARED = ("extent", "unit", "scale", "max_missing")  # by the loaded and the unloaded map


def configure_jax(no_cache: bool) -> None:
    """Compute in float64, and keep compiled programs for the commands to come."""
    jax.config.update("jax_enable_x64", True)
    if no_cache:
        silence_alarm()
    else:
        cache_compilation()


def read_maps(path: str, options: MapOptions) -> tuple[ThicknessMap, float | ThicknessMap]:
    """Read the loaded map, as measured, and the unloaded thickness [mm].

    Args:
        path: File of the loaded map, or `example`.
        options: How to read.

    Raises:
        ValueError: When options are missing or contradict each other.
        MeasurementError: For anything wrong with a file.
    """
    how: dict[str, Any] = {name: getattr(options, name) for name in _SHARED}
    how |= {"spacing": _spacing(options.spacing), "missing": _missing(options.missing)}
    if options.max_bytes is not None:
        how["max_bytes"] = options.max_bytes
    if path == "example":
        names = ("extent", "spacing", "std", "variable", "scale", "missing", "mask")
        given = [f"--{name}" for name in names if getattr(options, name) is not None]
        if given or options.unit != "mm":
            raise ValueError(f"The example knows its own grid; leave out {', '.join(given) or '--unit'}.")
        loaded = example_map()
    else:
        loaded = _read(path, std=options.std, variable=options.variable, mask=options.mask, **how)
    if options.l0 is None:
        if path != "example":
            raise ValueError("--l0 is needed: the unloaded thickness, a number in mm or the path of a map.")
        return loaded, EXAMPLE_LAYER
    try:
        number = float(options.l0)
    except ValueError:
        unloaded = _of_l0(lambda: _read(str(options.l0), variable=options.l0_variable, **how))
    else:
        if options.l0_variable is not None:
            raise ValueError(f"--l0-variable needs the path of a map in --l0, got the number {options.l0}.")
        return loaded, number
    if unloaded.shape != loaded.shape:
        raise ValueError(
            f"--l0 [pixels] must be on the grid of MAP, {loaded.shape} rows and columns, got {unloaded.shape}. "
            "Resample one of them; in Python, ThicknessMap takes another extent for each."
        )
    return loaded, unloaded


def _of_l0(read: Callable[[], ThicknessMap]) -> ThicknessMap:
    """Say of which of the two maps an error is."""
    try:
        return read()
    except MeasurementError as cause:
        raise MeasurementError(f"--l0 {cause}".replace("holds no variable", "holds no --l0-variable")) from cause


def _read(path: str, **how: Any) -> ThicknessMap:
    """Read a map, or measure it in an OCT volume, and say what is odd."""
    from .oct import find_thickness, is_volume, read_volume

    if is_volume(path):
        given = [
            name for name in ("extent", "spacing", "std", "variable", "scale", "missing") if how.get(name) is not None
        ]
        if given:
            options = ", ".join(f"--{name}" for name in given)
            raise ValueError(
                f"{path} is an OCT volume and knows its grid and noise; leave out {options}, or use opfem oct."
            )
        return find_thickness(read_volume(path), path, options=InterfaceOptions(mask=how.get("mask")))[1]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", MeasurementWarning)
        read = read_thickness(path, **how)
    console = Console(stderr=True, highlight=False)
    for warning in said:
        console.print(f"opfem: {in_options(str(warning.message))}", style="yellow", markup=False, soft_wrap=True)
    return read


def _spacing(stated: tuple[float, ...] | None) -> float | tuple[float, ...] | None:
    if stated is not None and len(stated) > 2:
        raise ValueError(f"--spacing [mm] must be two numbers, DX DY, or one for both, got {stated}.")
    return stated[0] if stated is not None and len(stated) == 1 else stated


def _missing(stated: str | None) -> Any:
    if stated is None or stated == "none":
        return stated
    try:
        return tuple(float(part) for part in stated.split(","))
    except ValueError:
        raise ValueError(
            f"--missing must be numbers of the file with commas between them, or none, got {stated!r}."
        ) from None


def state_experiment(
    measured: ThicknessMap,
    unloaded: float | ThicknessMap,
    reading: MapOptions,
    layer: LayerOptions,
    contact: ContactOptions,
) -> tuple[Palpation, ThicknessMap]:
    """State the experiment, and the loaded thickness without missing pixels; the maps are filled and smoothed here.

    Args:
        measured: Loaded thickness as measured.
        unloaded: Unloaded thickness [mm].
        reading: Smoothing.
        layer: Material, mesh and sides.
        contact: Contact with window and sample.

    Raises:
        ValueError: When options are missing or out of range.
    """
    extent = _layer_extent(measured, layer)
    fwhm = reading.smooth
    if fwhm is None:
        # Palpation refuses elements below 1, after this.
        fwhm = 0.5 * min(length / max(count, 1) for length, count in zip(extent, layer.elements[:2], strict=True))
    if isinstance(unloaded, ThicknessMap):
        unloaded = _ready(unloaded, fwhm)
    return state_palpation(unloaded, extent, layer, contact), _ready(measured, fwhm)


def state_palpation(
    unloaded: ScalarLike | ThicknessMap, extent: tuple[float, float], layer: LayerOptions, contact: ContactOptions
) -> Palpation:
    """State the experiment, which checks its numbers.

    Args:
        unloaded: Unloaded thickness [mm].
        extent: Of the layer [mm].
        layer: Material, mesh and sides.
        contact: Contact with window and sample.
    """
    return Palpation(
        Layer(unloaded, _material(layer)),
        extent=extent,
        elements=layer.elements,
        window=Contact(HardOverclosure(), contact.window_friction),
        sample=Contact(ExponentialOverclosure(contact.p0, contact.c0), contact.sample_friction),
        sides=layer.sides,
        element=layer.element,
    )


def show_assumptions(palpation: Palpation, thickness: ThicknessMap, layer: LayerOptions) -> None:
    """Print what a run takes for granted.

    Args:
        palpation: The experiment.
        thickness: The loaded map as it is used.
        layer: Options of the layer.
    """
    material = _material(layer)
    missing = int(np.sum(thickness.mask))
    unloaded = palpation.layer.thickness
    published = [name for name in ("c10", "c01", "bulk") if getattr(layer, name) is None]
    rows = {
        "layer": f"{palpation.extent[0]:g} × {palpation.extent[1]:g} mm, "
        + ("measured L0" if isinstance(unloaded, ThicknessMap) else f"L0 = {float(unloaded):g} mm"),
        "map": f"{thickness.shape[1]} × {thickness.shape[0]} pixels of {_pixel(thickness)}, {missing} missing"
        + ((" and filled" if thickness.is_filled else " and left out") if missing else ""),
        "smoothing": " and ".join(f"{1e3 * width:g} µm FWHM" for width in _smoothing(thickness)) or "none",
        "material": f"Mooney–Rivlin C10 = {1e3 * material.c10:g} kPa, C01 = {1e3 * material.c01:g} kPa, "
        + (
            "incompressible"
            if math.isinf(material.bulk)
            else f"bulk = {1e3 * material.bulk:g} kPa (K/µ = {material.bulk / material.shear:.3g})"
        ),
        "window": _contact(palpation.window),
        "sample": _contact(palpation.sample),
        "mesh": " × ".join(str(n) for n in palpation.elements) + f" {palpation.element} elements, sides {layer.sides}",
    }
    table = Table(box=None, show_header=False, padding=(0, 1))
    for name, value in rows.items():
        table.add_row(name, value)
    console = Console(highlight=False)
    console.print("Solving for the stress on the sample, with", table, sep="\n")
    if published:
        console.print(f"  Assumed: {', '.join(published)} of the published deck's layer. Is it yours?")


def _contact(side: Side) -> str:
    """Say in words what touches a face, and how."""
    if not isinstance(side, Contact):
        return type(side).__name__.lower()
    match side.law:
        case ExponentialOverclosure(pressure=p0, clearance=c0):
            law = f"exponential contact p0 = {float(p0):g} MPa, c0 = {1e3 * float(c0):g} µm"
        case LinearOverclosure(stiffness=stiffness):
            law = f"linear contact of {float(stiffness):g} MPa/mm"
        case _:
            law = "hard contact"
    return f"{law}, friction {float(side.friction):g}"


def _ready(thickness: ThicknessMap, fwhm: float) -> ThicknessMap:
    if np.any(thickness.mask) and not thickness.is_filled:
        thickness = thickness.filled()
    return thickness.smoothed(fwhm) if fwhm != 0 else thickness


def _layer_extent(measured: ThicknessMap, options: LayerOptions) -> tuple[float, float]:
    ends = (measured.origin + measured.extent).tolist()
    if options.layer_extent is not None:
        if any(length > 1.001 * end for length, end in zip(options.layer_extent, ends, strict=True)):
            raise ValueError(
                f"--layer-extent [mm] must lie on the map, which ends at x, y = {ends}, got {options.layer_extent}. "
                "Where nothing was measured there is no stress to compute: make the layer smaller."
            )
        return options.layer_extent
    if np.any(measured.origin):
        start = measured.origin.tolist()
        raise ValueError(f"The map starts at x, y = {start} mm, the layer at 0, 0. Pass --layer-extent LX LY.")
    return float(measured.extent[0]), float(measured.extent[1])


def _material(options: LayerOptions) -> MooneyRivlin:
    if options.bulk is None and (options.c10 is not None or options.c01 is not None):
        raise ValueError(
            "--bulk [MPa] is needed with --c10 or --c01: opfem never guesses it. 20 times the shear "
            "modulus 2 (C10 + C01) is what Abaqus/Explicit takes."
        )
    return MooneyRivlin(
        c10=PUBLISHED_C10 if options.c10 is None else options.c10,
        c01=PUBLISHED_C01 if options.c01 is None else options.c01,
        bulk=PUBLISHED_BULK if options.bulk is None else options.bulk,
    )


def settings_of(
    path: str, reading: MapOptions, layer: LayerOptions, contact: ContactOptions, thickness: ThicknessMap
) -> dict[str, Any]:
    """Collect what was asked for and what was assumed, for summary.json."""
    given = {name: value for part in (reading, layer, contact) for name, value in dataclasses.asdict(part).items()}
    material = _material(layer)
    used: dict[str, Any] = {name: float(getattr(material, name)) for name in ("c10", "c01", "bulk")}
    if math.isinf(used["bulk"]):
        used["bulk"] = "inf"  # JSON has no infinite number; --bulk reads this
    used["smooth"] = reading.smooth if reading.smooth is not None else _smoothing(thickness)[-1]
    assumed = [name for name in used if given[name] is None]
    stated = {name: value for name, value in given.items() if value is not None}
    return {"map": path, **stated, **used, "assumed": assumed}


def _pixel(thickness: ThicknessMap) -> str:
    """Size of a pixel, and where it is from."""
    size = " × ".join(f"{1e3 * float(step):.4g}" for step in thickness.spacing) + " µm"
    from_file = any(bool(step.numbers.get("spacing_from_file", False)) for step in thickness.steps)
    return f"{size} (as the file says)" if from_file else size


def _smoothing(thickness: ThicknessMap) -> list[float]:
    return [float(step.numbers["fwhm"]) for step in thickness.steps if step.name == "smoothed"]
