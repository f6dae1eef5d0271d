"""`opfem simulate SCENE --out DIR`: a virtual experiment whose map can be measured and whose stress is known."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from ..measurement import ThicknessMap
from ..model import Experiment, MooneyRivlin, NeoHooke
from ..model.plausible import check_approach
from ..results import measured_thickness, summary, summary_rows, to_xarray
from ..solvers import ConvergenceError, ExperimentSolution, Newton, solve
from ..solvers.progress import Progress
from .deck_options import WriteOptions
from .export import export, with_linear_contact
from .folder import FINISHED, SIMULATED, UNLOADED, prepare, record_failure, settle, write_result
from .options import ResultOptions, RunOptions
from .output import show_warnings
from .record import assumed_keys, with_record
from .scene import Scene, read_scene
from .statement import configure_jax
from .toml_parts import in_keys


def simulate(
    config: Path, out: Path, deck: WriteOptions, run: RunOptions, files: ResultOptions = ResultOptions()
) -> None:
    """Solve the experiment of a scene, measure it, and write map, truth and pictures.

    Args:
        config: The scene.
        out: Folder of the results.
        deck: A deck of the problem, to write too.
        run: The run itself.
        files: Files for other programs, to write too.
    """
    with Progress(True, at_once=True) as progress:
        progress.stage("reading")
        configure_jax(run.no_cache)
        settle(out, run.force)
        scene = read_scene(config)
        scene = scene._replace(experiment=with_linear_contact(scene.experiment, deck))
        try:
            check_approach(scene.load.approach, scene.experiment.plate_height)
        except ValueError as cause:
            raise ValueError(in_keys("[compression]", str(cause))) from None
        prepare(out)
        _show_experiment(scene)
        solver = Newton() if scene.increments is None else Newton(increments=scene.increments)
        export(scene.experiment, scene.load, solver, deck)
        try:
            truth = solve(scene.experiment, scene.load, solver)
        except ConvergenceError as failure:
            record_failure({**summary(failure.solution), "scene": scene.stated}, out)
            kept = f" {out} keeps its finished result." if (out / FINISHED).exists() else ""
            raise ConvergenceError(f"{failure}{kept}", failure.solution) from None
        measured = measured_thickness(truth, *scene.measurement)
        progress.stage("pictures")
        # Loaded here, so that a refused run does not wait for matplotlib.
        from ..plot import draw_simulation

        numbers = {**summary(truth), "scene": scene.stated}
        dataset = with_record(to_xarray(truth), assumed_keys(scene.stated), warnings=numbers["warnings"])
        figures = draw_simulation(dataset, measured, scene.section)
        maps = {SIMULATED: measured}
        if isinstance(scene.experiment.layer.thickness, ThicknessMap):
            maps[UNLOADED] = _unloaded(truth, measured)
        progress.stage("writing")
        written = write_result(dataset, figures, numbers, out, maps, measured=measured, options=files)
    _show_results(truth, numbers, written, out)


def _unloaded(truth: ExperimentSolution, measured: ThicknessMap) -> ThicknessMap:
    """Sample the unloaded layer on the pixels of the map, without noise."""
    x, y = jnp.meshgrid(measured.x, measured.y)
    return ThicknessMap(truth.experiment.layer.thickness_at(x, y), extent=measured.extent)


def _show_experiment(scene: Scene) -> None:
    """Print what is pressed together."""
    experiment = scene.experiment
    (lx, ly), height = np.asarray(experiment.extent), float(experiment.plate_height)
    cells = " and ".join(" × ".join(map(str, counts)) for counts in experiment.elements)
    inclusions = ", ".join(type(where).__name__ for where, _ in experiment.sample.inclusions) or "none"
    rows = {
        "bodies": f"{lx:g} × {ly:g} mm, {height:g} mm from window to plate",
        "inclusions": inclusions,
        "mesh": f"{cells} {' and '.join(dict.fromkeys(experiment.element))} elements",
        "load": f"plate approaches by {float(scene.load.approach):g} mm, {float(scene.load.approach) / height:.1%}",
        "map": f"pixels of {1e3 * scene.measurement.pixel:g} µm, noise {1e3 * scene.measurement.std:g} µm",
    }
    table = Table(box=None, show_header=False, padding=(0, 1))
    for name, value in rows.items():
        table.add_row(name, value)
    Console(highlight=False).print("Solving the virtual experiment:", table, sep="\n")


def _show_results(truth: ExperimentSolution, numbers: dict[str, Any], files: list[str], out: Path) -> None:
    table = Table("at the interface", "", "")
    table.columns[1].justify = "right"
    for row in summary_rows(numbers):
        table.add_row(*row)
    console = Console(highlight=False)
    console.print(table)
    show_warnings(numbers)
    console.print(f"Wrote {', '.join(files)} to {out}", markup=False, soft_wrap=True)
    console.print(
        f"Now: opfem palpate {out / SIMULATED} {_options(truth.experiment, out)}", markup=False, soft_wrap=True
    )


def _options(experiment: Experiment, out: Path) -> str:
    """Write the options of `opfem palpate` for the same layer."""
    thickness, law = experiment.layer.thickness, experiment.layer.material
    unloaded = out / UNLOADED if isinstance(thickness, ThicknessMap) else f"{float(thickness):g}"
    options = f"--l0 {unloaded}"
    if isinstance(law, MooneyRivlin | NeoHooke):
        c01 = float(law.c01) if isinstance(law, MooneyRivlin) else 0.0
        options += f" --c10 {float(law.c10):g} --c01 {c01:g} --bulk {float(law.bulk):g}"
    return f"{options} --out stress_map"
