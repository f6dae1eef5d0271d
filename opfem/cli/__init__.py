"""The command line: `opfem palpate MAP --out DIR` turns a thickness map into files and pictures of stress.

It reads, solves and writes with the same public functions as a notebook, and says what it assumed.
"""

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from ..datasets import COIN_LAYER, coin_file
from ..io import Checkpoint, write_thickness
from ..measurement import ThicknessMap
from ..results import summary, summary_rows, to_xarray
from ..solvers import ConvergenceError, Explicit, Newton, Solution, solve
from ..solvers.progress import Progress
from .fit import fit as fit
from .options import ContactOptions, LayerOptions, MapOptions, RunOptions
from .running import (
    FINISHED,
    app,
    configure_jax,
    main as main,
    prepare,
    refuse_finished,
    remove,
    reporting,
    write_files,
    write_summary,
)
from .statement import read_maps, settings_of, show_assumptions, state_experiment

app.command("opfem.cli.sweep:sweep", name="sweep")  # loaded when asked for, or for the help

FILES = ("result.vtu", "pressure.png", "report.png", "summary.json", FINISHED)


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
    with reporting(run.debug):
        with Progress(True, at_once=True) as progress:
            progress.stage("reading")
            configure_jax(run.no_cache)
            refuse_finished(out, run.force)
            measured, unloaded = read_maps(map, reading)
            palpation, load = state_experiment(measured, unloaded, reading, layer, contact)
            settings = settings_of(map, reading, layer, contact, load)
            prepare(out)
            if map == "example":
                write_thickness(measured, out / "example_map.npz")
            show_assumptions(palpation, load.thickness, layer, contact)
            try:
                solution = solve(palpation, load, _solver(run))
            except ConvergenceError as failure:
                remove(out, FILES)
                write_summary({**summary(failure.solution), "settings": settings}, out)
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
    with reporting(run.debug):
        path = coin_file()
    palpate(str(path), out=out, reading=MapOptions(l0=str(COIN_LAYER), extent=(5.0, 5.0)), run=run)


def write_results(solution: Solution, measured: ThicknessMap, settings: dict[str, Any], out: Path) -> None:
    """Write every file of a result.

    Args:
        solution: What was solved.
        measured: Loaded thickness as measured, for the report.
        settings: What the user asked for, for summary.json.
        out: Folder of the results.
    """
    with Progress(True, at_once=True) as progress:
        progress.stage("pictures")
        # Loaded here, so that the help and a refused run do not wait for matplotlib.
        from ..plot import draw_pictures

        dataset = to_xarray(solution)
        numbers = {**summary(solution), "settings": settings}
        figures = draw_pictures(dataset, measured)
        progress.stage("writing")
        write_files(dataset, figures, numbers, FILES, out)


def _solver(options: RunOptions) -> Newton | Explicit:
    duration, mass_scaling = options.duration, options.mass_scaling
    if options.solver == "newton":
        if not (duration is None and mass_scaling is None and options.checkpoint is None):
            raise ValueError("--duration, --mass-scaling and --checkpoint need --solver explicit.")
        return Newton() if options.increments is None else Newton(increments=options.increments)
    if options.increments is not None:
        raise ValueError("--increments is for --solver newton; explicit takes as many as are stable.")
    published = Explicit()
    return Explicit(
        duration=published.duration if duration is None else duration,
        mass_scaling=published.mass_scaling if mass_scaling is None else mass_scaling,
        precision="float32" if options.precision == "float32" else None,
        checkpoint=None if options.checkpoint is None else Checkpoint(options.checkpoint),
    )


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
