"""The command line: `opfem palpate MAP --out DIR` turns a thickness map into files and pictures of stress.

It reads, solves and writes with the same public functions as a notebook, and says what it assumed.
"""

import _thread
import dataclasses
import json
import math
import os
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
from cyclopts import App, Parameter
from rich.console import Console
from rich.table import Table

from ..compilation import cache_compilation
from ..datasets import COIN_LAYER, coin_file
from ..io import read_thickness, whole_file, write_netcdf, write_thickness, write_vtu
from ..measurement import EXAMPLE_LAYER, ThicknessMap, example_map
from ..model import Contact, ExponentialOverclosure, HardOverclosure, Imprint, Layer, MooneyRivlin, Palpation
from ..results import summary, summary_rows, to_xarray
from ..solvers import ConvergenceError, Newton, Solution, solve
from .options import (
    PUBLISHED_BULK,
    PUBLISHED_C01,
    PUBLISHED_C10,
    ContactOptions,
    LayerOptions,
    MapOptions,
    RunOptions,
)

FINISHED = "result.nc"  # Written last: a folder that holds it holds a whole result.
FILES = ("result.vtu", "pressure.png", "report.png", "summary.json", FINISHED)

INTERRUPTED = 130

app = App(
    name="opfem",
    help="Stress on tissue from the measured thickness of a soft layer.",
    default_parameter=Parameter(negative=()),
)


def main(tokens: Sequence[str] | None = None) -> None:
    """Run the command line and exit: 0 done, 1 failed, 2 misused, 130 interrupted.

    Args:
        tokens: Arguments; None takes those of the process.
    """
    try:
        app(tokens)
    except SystemExit as end:
        if end.code == INTERRUPTED and tokens is None:
            # With a computation in flight jaxlib crashes while the interpreter winds down.
            for stream in (sys.stdout, sys.stderr):
                stream.flush()
            os._exit(INTERRUPTED)
        raise


@app.command
def palpate(
    map: Annotated[str, Parameter(name="MAP")],
    /,
    *,
    out: Path,
    reading: MapOptions = MapOptions(),
    layer: LayerOptions = LayerOptions(),
    contact: ContactOptions = ContactOptions(),
    run: RunOptions = RunOptions(),
) -> None:
    """Compute the stress map of a measured thickness map.

    Writes result.nc, result.vtu, summary.json, pressure.png and report.png.

    Args:
        map: Loaded thickness (.mat, .npy, .npz, .tif, .csv), or the word `example` for a built-in one.
        out: Folder of the results.
        reading: How to read the maps.
        layer: The layer and its mesh.
        contact: Contact with window and sample.
        run: The run itself.
    """
    with _reporting(run.debug):
        jax.config.update("jax_enable_x64", True)
        if run.keep_compiled:
            cache_compilation()
        _refuse_finished(out, run.force)
        measured, unloaded = read_maps(map, reading)
        palpation, load = state_experiment(measured, unloaded, reading, layer, contact)
        settings = _settings(map, reading, layer, contact, load)
        _prepare(out)
        if map == "example":
            write_thickness(measured, out / "example_map.npz")
        _show_assumptions(palpation, load, layer, contact)
        solver = Newton() if run.increments is None else Newton(increments=run.increments)
        try:
            solution = solve(palpation, load, solver)
        except ConvergenceError as failure:
            _remove(out)
            _write_summary(failure.solution, settings, out)
            raise
        write_results(solution, measured, settings, out)
        _show_results(solution, out)


@app.command
def demo(
    *,
    out: Path = Path("opfem_demo"),
    coin: Annotated[bool, Parameter(help="Take the published map of a 5-cent coin (downloaded once, GPL-3).")] = False,
    run: RunOptions = RunOptions(),
) -> None:
    """Show what opfem does: the stress map of a built-in measurement, or of the published coin.

    Args:
        out: Folder of the results.
        coin: Which measurement.
        run: The run itself.
    """
    if not coin:
        return palpate("example", out=out, run=run)
    with _reporting(run.debug):
        path = coin_file()
    palpate(str(path), out=out, reading=MapOptions(l0=str(COIN_LAYER), extent=(5.0, 5.0)), run=run)


def read_maps(path: str, options: MapOptions) -> tuple[ThicknessMap, float | ThicknessMap]:
    """Read the loaded map, as measured, and the unloaded thickness [mm].

    Args:
        path: File of the loaded map, or `example`.
        options: How to read.

    Raises:
        ValueError: When options are missing or contradict each other.
        MeasurementError: For anything wrong with a file.
    """
    grid: dict[str, Any] = {"extent": options.extent, "spacing": options.spacing, "unit": options.unit}
    if path == "example":
        given = [f"--{name}" for name in ("extent", "spacing", "std", "variable") if getattr(options, name) is not None]
        if given or options.unit != "mm":
            raise ValueError(f"The example knows its own grid; leave out {', '.join(given) or '--unit'}.")
        loaded = example_map()
    else:
        loaded = read_thickness(path, std=options.std, variable=options.variable, **grid)
    if options.l0 is None:
        if path != "example":
            raise ValueError("--l0 is needed: the unloaded thickness, a number in mm or the path of a map.")
        return loaded, EXAMPLE_LAYER
    try:
        return loaded, float(options.l0)
    except ValueError:
        unloaded = read_thickness(options.l0, variable=options.l0_variable, **grid)
    if unloaded.shape != loaded.shape:
        raise ValueError(
            f"--l0 [pixels] must be on the grid of MAP, {loaded.shape} rows and columns, got {unloaded.shape}. "
            "Resample one of them; in Python, ThicknessMap takes another extent for each."
        )
    return loaded, unloaded


def state_experiment(
    measured: ThicknessMap,
    unloaded: float | ThicknessMap,
    reading: MapOptions,
    layer: LayerOptions,
    contact: ContactOptions,
) -> tuple[Palpation, Imprint]:
    """State the experiment and its load; the maps are filled and smoothed here.

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
    palpation = Palpation(
        Layer(unloaded, _material(layer)),
        extent=extent,
        elements=layer.elements,
        window=Contact(HardOverclosure(), contact.window_friction),
        sample=Contact(ExponentialOverclosure(contact.p0, contact.c0), contact.sample_friction),
        sides=layer.sides,
        element=layer.element,
    )
    return palpation, Imprint(_ready(measured, fwhm), correct_approach=contact.correct_approach)


def write_results(solution: Solution, measured: ThicknessMap, settings: dict[str, Any], out: Path) -> None:
    """Write every file of a result, each whole or not at all, `result.nc` last.

    Args:
        solution: What was solved.
        measured: Loaded thickness as measured, for the report.
        settings: What the user asked for, for summary.json.
        out: Folder of the results.
    """
    # Loaded here, so that the help and a refused run do not wait for matplotlib.
    from ..plot import draw_pictures

    dataset = to_xarray(solution)
    figures = draw_pictures(dataset, measured)
    _remove(out)
    for name, figure in figures.items():
        with whole_file(out / name) as temporary:
            figure.savefig(temporary, dpi=200)
    write_vtu(dataset, out / "result.vtu")
    _write_summary(solution, settings, out)
    write_netcdf(dataset, out / FINISHED)


@contextmanager
def _reporting(debug: bool) -> Iterator[None]:
    """End with a message and an exit status instead of a traceback."""
    try:
        with _redelivered_interrupts():
            yield
    except KeyboardInterrupt:
        _complain("Interrupted; no file was left half-written.")
        raise SystemExit(INTERRUPTED) from None
    except Exception as cause:
        if debug:
            raise
        expected = isinstance(cause, ValueError | OSError | ConvergenceError)
        unexpected = f"Unexpected {type(cause).__name__}: {cause} (--debug shows where; please report it.)"
        _complain(str(cause) if expected else unexpected)
        raise SystemExit(1) from None


@contextmanager
def _redelivered_interrupts() -> Iterator[None]:
    """Raise Ctrl-C again where Python drops it.

    An exception in a callback of the garbage collector is printed and forgotten, and jax has such a callback, which
    runs often while it traces.
    """
    report = sys.unraisablehook

    def redeliver(dropped: Any) -> None:
        if issubclass(dropped.exc_type, KeyboardInterrupt):
            threading.Timer(0.01, _thread.interrupt_main).start()
        else:
            report(dropped)

    sys.unraisablehook = redeliver
    try:
        yield
    finally:
        sys.unraisablehook = report


def _complain(message: str) -> None:
    Console(stderr=True, highlight=False).print(f"opfem: {message}", style="bold red", markup=False, soft_wrap=True)


def _refuse_finished(out: Path, force: bool) -> None:
    if (out / FINISHED).exists() and not force:
        raise FileExistsError(
            f"{out} holds a finished result ({FINISHED}). Pass --force to replace it, or another --out."
        )


def _prepare(out: Path) -> None:
    """Find out before the long solve whether the results can be written."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as cause:
        raise OSError(f"Cannot write results to {out}: {cause.strerror}. Choose another --out.") from cause


def _remove(out: Path) -> None:
    """Remove an earlier result, the mark of a finished one first."""
    for name in reversed(FILES):
        (out / name).unlink(missing_ok=True)


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


def _settings(
    path: str, reading: MapOptions, layer: LayerOptions, contact: ContactOptions, load: Imprint
) -> dict[str, Any]:
    """Collect what was asked for and what was assumed, for summary.json."""
    given = {name: value for part in (reading, layer, contact) for name, value in dataclasses.asdict(part).items()}
    material = _material(layer)
    used: dict[str, Any] = {name: float(getattr(material, name)) for name in ("c10", "c01", "bulk")}
    if math.isinf(used["bulk"]):
        used["bulk"] = "inf"  # JSON has no infinite number; --bulk reads this
    used["smooth"] = reading.smooth if reading.smooth is not None else _smoothing(load.thickness)[-1]
    assumed = [name for name in used if given[name] is None]
    stated = {name: value for name, value in given.items() if value is not None}
    return {"map": path, **stated, **used, "assumed": assumed}


def _smoothing(thickness: ThicknessMap) -> list[float]:
    return [float(step.numbers["fwhm"]) for step in thickness.steps if step.name == "smoothed"]


def _write_summary(solution: Solution, settings: dict[str, Any], out: Path) -> None:
    with whole_file(out / "summary.json") as temporary:
        text = json.dumps({**summary(solution), "settings": settings}, indent=2, ensure_ascii=False)
        temporary.write_text(text + "\n", encoding="utf-8")


def _show_assumptions(palpation: Palpation, load: Imprint, layer: LayerOptions, contact: ContactOptions) -> None:
    material, thickness = _material(layer), load.thickness
    missing = int(np.sum(thickness.mask))
    unloaded = palpation.layer.thickness
    published = [name for name in ("c10", "c01", "bulk") if getattr(layer, name) is None]
    rows = {
        "layer": f"{palpation.extent[0]:g} × {palpation.extent[1]:g} mm, "
        + ("measured L0" if isinstance(unloaded, ThicknessMap) else f"L0 = {float(unloaded):g} mm"),
        "map": f"{thickness.shape[1]} × {thickness.shape[0]} pixels, {missing} missing"
        + (" and filled" if missing else ""),
        "smoothing": " and ".join(f"{1e3 * width:g} µm FWHM" for width in _smoothing(thickness)) or "none",
        "material": f"Mooney–Rivlin C10 = {1e3 * material.c10:g} kPa, C01 = {1e3 * material.c01:g} kPa, "
        + (
            "incompressible"
            if math.isinf(material.bulk)
            else f"bulk = {1e3 * material.bulk:g} kPa (K/µ = {material.bulk / material.shear:.3g})"
        ),
        "window": f"hard contact, friction {contact.window_friction:g}",
        "sample": f"exponential contact p0 = {contact.p0:g} MPa, c0 = {1e3 * contact.c0:g} µm, "
        f"friction {contact.sample_friction:g}",
        "mesh": " × ".join(str(n) for n in palpation.elements) + f" {palpation.element} elements, sides {layer.sides}",
    }
    table = Table(box=None, show_header=False, padding=(0, 1))
    for name, value in rows.items():
        table.add_row(name, value)
    console = Console(highlight=False)
    console.print("Solving for the stress on the sample, with", table, sep="\n")
    if published:
        console.print(f"  Assumed: {', '.join(published)} of the published deck's layer. Is it yours?")


def _show_results(solution: Solution, out: Path) -> None:
    numbers = summary(solution)
    table = Table("at the sample", "", "")
    table.columns[1].justify = "right"
    for row in summary_rows(numbers):
        table.add_row(*row)
    console = Console(highlight=False)
    console.print(table)
    if numbers["status_message"]:
        console.print(f"{numbers['status']}: {numbers['status_message']}", style="yellow", markup=False)
    console.print(f"Wrote {', '.join(FILES)} to {out}", markup=False, soft_wrap=True)
