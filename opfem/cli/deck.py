"""`opfem deck FILE`: what an Abaqus or CalculiX deck states, and its solution step by step."""

import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from rich.console import Console
from rich.table import Table

from ..decks import Deck, DeckError, read_inp
from ..decks.bodies import Body, find_bodies
from ..decks.deck import Face
from ..io import write_whole
from ..model import Compression, Displacement, Imprint, Palpation
from ..results import measured_thickness, summary, summary_rows, to_xarray
from ..solvers import ConvergenceError, ExperimentSolution, Explicit, Newton, Solution, solve
from ..solvers.progress import Progress
from .deck_options import DeckOptions
from .folder import DECK_PICTURE, prepare, record_failure, settle, write_result
from .options import ResultOptions, RunOptions
from .output import show_warnings
from .record import with_record
from .statement import configure_jax

INCREMENT = "axial_increment"
_MOST_IGNORED = 40  # lines of --info


def state_deck(file: Path, out: Path | None, options: DeckOptions, run: RunOptions) -> None:
    """Print what a deck states and what of it is ignored; draw it.

    Args:
        file: The deck.
        out: Folder of the picture; None draws none.
        options: How it is taken.
        run: The run itself.

    Raises:
        DeckError: At the end, if it is no problem for opfem.
    """
    configure_jax(run.no_cache)
    deck = read_inp(file, code=options.code)
    bodies = find_bodies(deck)
    console = Console(highlight=False)
    console.print(_table(deck, bodies))
    refused: DeckError | None = None
    loads: tuple[Any, ...] = ()
    try:
        experiment = deck.experiment(options.bulk, options.layer)
        loads = deck.loads(options.interpolation, options.layer)
        console.print(f"opfem takes it as {_words(experiment, loads, deck)}", markup=False, soft_wrap=True)
        for said in deck.assumed(options.bulk, options.layer):
            console.print(f"  {said}", markup=False, soft_wrap=True)
    except DeckError as cause:
        refused = cause
    if deck.ignored:
        console.print("Ignored:")
    for line in deck.ignored[:_MOST_IGNORED]:
        console.print(f"  {line}", markup=False, soft_wrap=True)
    if out is not None:
        prepare(out)
        write_whole(out / DECK_PICTURE, _picture(deck, bodies, loads))
        console.print(f"Wrote {DECK_PICTURE} to {out}", markup=False, soft_wrap=True)
    if refused is not None:
        raise refused


def _table(deck: Deck, bodies: list[Body]) -> Table:
    table = Table("", f"{deck.name}, for {deck.code}", box=None, pad_edge=False)
    for body in bodies:
        low, high = body.X.min(axis=0), body.X.max(axis=0)
        spans = ", ".join(f"{axis} {a:.4g} to {b:.4g}" for axis, a, b in zip("xyz", low, high, strict=True))
        table.add_row(
            body.name, f"{len(body.elements)} {'/'.join(body.kinds)}, {spans} mm, {', '.join(set(body.material))}"
        )
    for material in deck.materials.values():
        numbers = ", ".join(f"{value:g}" for value in material.numbers)
        table.add_row(material.name, f"{material.kind} {numbers}")
    for pair in deck.pairs:
        contact = deck.interactions[pair.interaction]
        numbers = ", ".join(f"{value:g}" for value in contact.numbers)
        table.add_row("contact", f"{_on(pair.slave)} on {_on(pair.master)}: {contact.law} {numbers}".rstrip())
        table.add_row("", f"friction {contact.friction:g}")
    for step in deck.steps:
        moved = [np.abs(condition.values).max() for condition in step.prescribed if condition.values.size]
        more = f", mass scaling {step.mass_scaling:g}" if step.kind == "explicit" else ""
        table.add_row(step.name, f"{step.kind}, {step.time:g} s{more}, moves by up to {max(moved, default=0.0):.4g} mm")
    return table


def _on(faces: tuple[Face, ...]) -> str:
    """Name the instances that a surface lies on."""
    return ", ".join(dict.fromkeys(name or "a surface" for members, _ in faces for name in members))


def _words(experiment: Any, loads: tuple[Any, ...], deck: Deck) -> str:
    """Say in a line what is solved."""
    if isinstance(experiment, Palpation):
        what = f"a palpation of {' × '.join(map(str, experiment.elements))} {experiment.element} elements"
    else:
        cells = " and ".join(" × ".join(map(str, counts)) for counts in experiment.elements)
        what = f"an experiment of {cells} {' and '.join(dict.fromkeys(experiment.element))} elements"
    return f"{what} under {', then '.join(_load(load) for load in loads)}, solved by {type(deck.solver()).__name__}."


def _load(load: Any) -> str:
    if isinstance(load, Compression):
        return f"a compression of {float(load.approach):.4g} mm"
    if isinstance(load, Imprint):
        values = np.asarray(load.thickness.values)
        return f"an imprint of {values.min():.4g} to {values.max():.4g} mm"
    if isinstance(load, Displacement):
        return f"a displacement of {float(np.min(load.uz)):.4g} to {float(np.max(load.uz)):.4g} mm"
    return "a traction"


def _picture(deck: Deck, bodies: list[Body], loads: tuple[Any, ...]) -> bytes:
    # Loaded here, so that a refused run does not wait for matplotlib.
    from ..plot import draw_deck

    maps = {
        step.name: load.thickness for step, load in zip(deck.steps, loads, strict=False) if isinstance(load, Imprint)
    }
    middle = np.mean([body.X[:, 1].mean() for body in bodies])
    sections = {body.name: section for body in bodies if (section := body.section(float(middle))).size}
    picture = io.BytesIO()
    draw_deck(sections, maps, f"{deck.name}, cut at y = {middle:.3g} mm").savefig(picture, dpi=150)
    return picture.getvalue()


def solve_deck(
    file: Path, out: Path, options: DeckOptions, run: RunOptions, files: ResultOptions = ResultOptions()
) -> None:
    """Solve all steps of a deck and write them, the last one last.

    Args:
        file: The deck.
        out: Folder of the results.
        options: How it is taken.
        run: The run itself.
        files: Files for other programs, to write too.
    """
    with Progress(True, at_once=True) as progress:
        progress.stage("reading")
        configure_jax(run.no_cache)
        settle(out, run.force)
        deck = read_inp(file, code=options.code)
        experiment = deck.experiment(options.bulk, options.layer)
        loads = deck.loads(options.interpolation, options.layer)
        solver = _solver(deck, options)
        prepare(out)
    assumed = deck.assumed(options.bulk, options.layer)
    console = Console(highlight=False)
    console.print(f"Solving {deck.name}: {_words(experiment, loads, deck)}", markup=False, soft_wrap=True)
    for said in assumed:
        console.print(f"  {said}", markup=False, soft_wrap=True)
    record: dict[str, Any] = {"file": deck.name, "code": deck.code, "assumed": assumed, "ignored": deck.ignored}
    steps: list[dict[str, Any]] = []
    before: Any = None
    for number, (step, load) in enumerate(zip(deck.steps, loads, strict=True), start=1):
        is_last = number == len(loads)
        folder = out if is_last else out / f"step_{number}"
        try:
            solution: Any = solve(experiment, load, solver, start=before)  # pyright: ignore[reportCallIssue, reportArgumentType]
        except ConvergenceError as failure:
            record_failure({**summary(failure.solution), "step": step.name, "deck": record, "steps": steps}, out)
            raise ConvergenceError(f"Step {step.name}: {failure}", failure.solution) from None
        numbers = summary(solution)
        said = {**numbers, "step": step.name, "deck": record, "steps": steps}
        written = _write(solution, before, said, folder, run, files)
        steps = [*steps, {"step": step.name, **numbers}]
        before = solution
        console.print(_results(step.name, numbers))
        show_warnings(numbers)
        console.print(f"Wrote {', '.join(written)} to {folder}", markup=False, soft_wrap=True)


def _solver(deck: Deck, options: DeckOptions) -> Newton | Explicit:
    own = deck.solver()
    if options.solver == "deck" and options.increments is None and options.precision == "float64":
        return own
    explicit = isinstance(own, Explicit) if options.solver == "deck" else options.solver == "explicit"
    if explicit:
        if options.increments is not None:
            raise ValueError("--increments needs implicit statics: --solver newton.")
        solver = own if isinstance(own, Explicit) else Explicit()
        return dataclasses.replace(solver, precision="float32") if options.precision == "float32" else solver
    if options.precision == "float32":
        raise ValueError("--precision float32 needs --solver explicit.")
    if options.increments is not None:
        return Newton(increments=options.increments)
    return own if isinstance(own, Newton) else Newton()


def _write(
    solution: Solution | ExperimentSolution,
    before: Solution | ExperimentSolution | None,
    numbers: dict[str, Any],
    folder: Path,
    run: RunOptions,
    files: ResultOptions,
) -> list[str]:
    """Write every file of a step; return their names."""
    settle(folder, run.force)
    prepare(folder)
    with Progress(True, at_once=True) as progress:
        progress.stage("pictures")
        from ..plot import draw_pictures, draw_simulation

        said = numbers["deck"]["assumed"]
        # The sentences name materials, not bodies: of two with one open, both are marked.
        bulk = [f"{body}.material.bulk" for body in ("layer", "sample") if any("D = 0" in part for part in said)]
        dataset = with_record(to_xarray(solution), bulk, said, numbers["warnings"])
        if before is not None:
            dataset[INCREMENT] = axial_increment(solution, before)
        if isinstance(solution, Solution):
            load = solution.load
            measured = load.thickness if isinstance(load, Imprint) else solution.thickness
            figures = draw_pictures(dataset, measured)
        else:
            spacing = np.asarray(solution.experiment.extent) / solution.experiment.layer_elements[:2]
            figures = draw_simulation(dataset, measured_thickness(solution, spacing))
        progress.stage("writing")
        return write_result(dataset, figures, numbers, folder, options=files)  # nothing of a deck is measured


def axial_increment(solution: Solution | ExperimentSolution, before: Solution | ExperimentSolution) -> xr.DataArray:
    """Label the change of the layer's displacement along z between two steps, as phase-sensitive OCT sees it."""
    change = np.asarray(solution.displacement[2] - before.displacement[2])
    attrs = {"units": "mm", "long_name": "axial displacement in the layer since the step before"}
    return xr.DataArray(change, dims=("z", "y", "x"), attrs=attrs)


def _results(step: str, numbers: dict[str, Any]) -> Table:
    table = Table(f"step {step}", "", "")
    table.columns[1].justify = "right"
    for row in summary_rows(numbers):
        table.add_row(*row)
    return table
