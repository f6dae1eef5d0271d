"""`opfem palpate MAP --out DIR` and `opfem demo`: the measured surface is pressed into the layer."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from ..datasets import COIN_LAYER, coin_file
from ..io import Checkpoint
from ..measurement import ThicknessMap
from ..model import Imprint
from ..results import summary, summary_rows, to_xarray
from ..solvers import ConvergenceError, Explicit, Newton, Solution, solve
from ..solvers.progress import Progress
from .deck_options import WriteOptions
from .export import export, linear_settings, with_linear_contact
from .folder import EXAMPLE, FINISHED, prepare, record_failure, settle, write_result
from .options import ImprintOptions, LayerOptions, MapOptions, ResultOptions, RunOptions, SolverOptions
from .output import show_warnings
from .record import assumed_options, with_record
from .statement import configure_jax, read_maps, settings_of, show_assumptions, state_experiment


def palpate(
    map: str,
    out: Path,
    reading: MapOptions,
    layer: LayerOptions,
    contact: ImprintOptions,
    solver: SolverOptions,
    deck: WriteOptions,
    run: RunOptions,
    files: ResultOptions = ResultOptions(),
) -> None:
    """Solve for the stress map of a measured thickness map and write it.

    Args:
        map: File of the loaded thickness, or `example`.
        out: Folder of the results.
        reading: How to read the maps.
        layer: The layer and its mesh.
        contact: Contact with window and sample.
        solver: The solver.
        deck: A deck of the problem, to write too.
        run: The run itself.
        files: Files for other programs, to write too.
    """
    with Progress(True, at_once=True) as progress:
        progress.stage("reading")
        configure_jax(run.no_cache)
        settle(out, run.force)
        measured, unloaded = read_maps(map, reading)
        palpation, thickness = state_experiment(measured, unloaded, reading, layer, contact)
        palpation = with_linear_contact(palpation, deck)
        load = Imprint(thickness, correct_approach=contact.correct_approach)
        settings = settings_of(map, reading, layer, contact, thickness) | linear_settings(deck)
        chosen = _solver(solver)
        prepare(out)
        show_assumptions(palpation, thickness, layer)
        export(palpation, load, chosen, deck)
        try:
            solution = solve(palpation, load, chosen)
        except ConvergenceError as failure:
            record_failure({**summary(failure.solution), "settings": settings}, out)
            kept = f" {out} keeps its finished result." if (out / FINISHED).exists() else ""
            raise ConvergenceError(f"{failure}{kept}", failure.solution) from None
        progress.stage("summary")
        numbers = {**summary(solution, measured), "settings": settings}
        written = write_results(solution, measured, numbers, out, files, is_example=map == "example")
    _show_results(numbers, written, out)


def demo(out: Path, coin: bool, solver: SolverOptions, run: RunOptions, files: ResultOptions = ResultOptions()) -> None:
    """Compute the stress map of a built-in measurement, or of the published coin.

    Args:
        out: Folder of the results.
        coin: Which measurement.
        solver: The solver.
        run: The run itself.
        files: Files for other programs, to write too.
    """
    map = str(coin_file()) if coin else "example"
    reading = MapOptions(l0=str(COIN_LAYER), extent=(5.0, 5.0)) if coin else MapOptions()
    palpate(map, out, reading, LayerOptions(), ImprintOptions(), solver, WriteOptions(), run, files)


def write_results(
    solution: Solution,
    measured: ThicknessMap,
    numbers: dict[str, Any],
    out: Path,
    files: ResultOptions,
    *,
    is_example: bool,
) -> list[str]:
    """Write every file of a result; return their names.

    Args:
        solution: What was solved.
        measured: Loaded thickness as measured, for the report.
        numbers: For summary.json.
        out: Folder of the results.
        files: Files for other programs, to write too.
        is_example: Whether the built-in map was measured, which is written, too.
    """
    with Progress(True, at_once=True) as progress:
        progress.stage("pictures")
        # Loaded here, so that a refused run does not wait for matplotlib.
        from ..plot import draw_pictures

        dataset = with_record(to_xarray(solution), assumed_options(), warnings=numbers["warnings"])
        figures = draw_pictures(dataset, measured)
        progress.stage("writing")
        maps = {EXAMPLE: measured} if is_example else {}
        return write_result(dataset, figures, numbers, out, maps, measured=measured, options=files)


def _solver(options: SolverOptions) -> Newton | Explicit:
    duration, mass_scaling = options.duration, options.mass_scaling
    if options.solver == "newton":
        explicit = {
            "--duration": duration,
            "--mass-scaling": mass_scaling,
            "--checkpoint": options.checkpoint,
            "--precision float32": options.precision == "float32" or None,
        }
        given = [name for name, value in explicit.items() if value is not None]
        if given:
            raise ValueError(f"{', '.join(given)} needs --solver explicit, got --solver newton.")
        return Newton() if options.increments is None else Newton(increments=options.increments)
    if options.increments is not None:
        raise ValueError("--increments needs --solver newton; explicit takes as many as are stable.")
    published = Explicit()
    return Explicit(
        duration=published.duration if duration is None else duration,
        mass_scaling=published.mass_scaling if mass_scaling is None else mass_scaling,
        precision="float32" if options.precision == "float32" else None,
        checkpoint=None if options.checkpoint is None else Checkpoint(options.checkpoint),
    )


def _show_results(numbers: dict[str, Any], files: list[str], out: Path) -> None:
    table = Table("at the sample", "", "")
    table.columns[1].justify = "right"
    for row in summary_rows(numbers):
        table.add_row(*row)
    console = Console(highlight=False)
    console.print(table)
    show_warnings(numbers)
    console.print(f"Wrote {', '.join(files)} to {out}", markup=False, soft_wrap=True)
