"""`sweep`: a function at many points, as one labelled table.

It sees the whole chain and sweeps any function of numbers, such as a solve.
"""

import dataclasses
import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import xarray as xr

from ..io import write_netcdf, write_whole
from ..solvers.progress import Progress
from .cluster import Cluster
from .columns import csv_bytes
from .design import Points, check_arguments, grid
from .execution import Batch, Columns, Devices, Program
from .keys import environment, hash_of
from .outputs import ERROR, Keep, OutputError, Outputs
from .plan import Plan
from .progress import SweepProgress
from .store import FINISHED, TABLE, Folder, Memory, Outcome
from .table import table

Execution = Batch | Devices | Cluster
# Compiling takes as long whatever the mesh.
_COMPILES = "the solver of the sweep, about half a minute the first time"


def sweep(
    fn: Callable[..., Any],
    axes: Mapping[str, Any] | Points,
    *,
    keep: Keep = None,
    units: Mapping[str, str] | None = None,
    execution: Execution = Batch(),
    out: str | os.PathLike | None = None,
    progress: bool = True,
) -> xr.Dataset:
    """Compute a function at many points; a failed point is marked and stops no other.

    `status` of each point: "successful"; what `RESULTS` and `FitStatus` name; "nonfinite" where an output
    has no finite number; "error" where the function raised, with its words in `message`. Failed points hold NaN.
    `wall_time` [s] of a point in a batch is its share of it. A `Solution` must come from `solve(..., throw=False)`.

    Args:
        fn: Function of numbers, called with one argument for each axis; it captures constants.
            Returns a number, an array, a `Solution`, a `TractionFit`, or a dict of these.
        axes: Values of each argument: a grid of all combinations; or points from `zip_` or `sample`.
        keep: Fields of a solution to store: "max_pressure", "pressure", "traction", "slip", "contact_status",
            "displacement", "stress_zz", "thickness", of a fit also "pressure_std", "residual", "chi2",
            "effective_dof", and the names in `stats`; None: pressure and all of `stats`. Or a function that reduces
            the result of `fn` to a dict of arrays.
        units: Units of axes, and of outputs without a known unit.
        execution: `Batch`, `Devices` or `Cluster`.
        out: Folder that keeps every finished point: a sweep that was interrupted goes on where it was when it is
            called again, and ends as if it had not been. The whole is `result.nc`, numbers are `table.csv`, too. None
            keeps nothing.
        progress: Show progress on a terminal, in a notebook or, where it takes long, on stderr.

    Returns:
        Outputs by axes, or by `point` where these form no grid.

    Raises:
        ValueError: For an axis that is empty or no argument of `fn`, units that contradict an output's own, an
            `out` with different inputs, or a function that captures objects that cannot be hashed.
        RuntimeError: If the function raised at every point.

    Example:
        >>> import jax.numpy as jnp
        >>> import opfem as op
        >>> def work(force, distance):
        ...     return {"work": force * distance}
        >>> data = op.sweep(work, {"force": [1.0, 2.0], "distance": [3.0, 4.0, 5.0]}, units={"work": "N mm"})
        >>> float(data.work.sel(force=2.0, distance=5.0))
        10.0
    """
    points = axes if isinstance(axes, Points) else grid(axes)
    check_arguments(fn, points)
    points = points.with_units(units or {})
    kept = keep if keep is None or callable(keep) else (keep,) if isinstance(keep, str) else tuple(keep)
    name = getattr(fn, "__name__", "value").replace("<lambda>", "value")
    outputs = Outputs(name, kept, dict(units or {}), tuple(points.columns))
    with Progress(progress, alone=True) as bar:
        bar.stage("sweep", compiles=_COMPILES)
        store = Memory() if out is None else _open(out, fn, kept, points)
        plan, program = store.plan, None
        if plan is None:
            plan, program = _prepare(fn, outputs, execution, points)
            store.begin(plan)
        elif (wanted := execution.plan(plan)) != plan:
            raise ValueError(
                f"{out} holds a sweep begun with {plan}, got {wanted}. Go on as it was begun, or choose another out=."
            )
        errors = _run(fn, outputs, plan, program, execution, points, store, bar)
    if len(errors) == len(points):
        raise RuntimeError(f"{name} raised at every point of the sweep; at the first: {errors[0].message}")
    attributes = {
        "title": f"Sweep of {name}",
        "execution": json.dumps(dataclasses.asdict(plan)),
        **environment(),
    }
    data = table(points, lambda i: errors[i] if i in errors else store.read(i), attributes)
    if out is not None:
        write_whole(Path(out) / TABLE, csv_bytes(data))
        write_netcdf(data, Path(out) / FINISHED)
    return data


def _open(out: str | os.PathLike, fn: Callable, keep: Keep, points: Points) -> Folder:
    """Find or make the folder of a sweep; everything that decides its numbers is hashed."""
    common = {"function": hash_of("fn", fn), "keep": hash_of("keep", keep), **environment()}
    axes = {f"axis {name}": hash_of(name, values) for name, values in points.columns.items()}
    keys = []
    for i in range(len(points)):
        values = {name: column[i] for name, column in points.columns.items()}
        keys.append(hash_of("point", {**common, "values": values}))
    return Folder(Path(out), {**common, **axes}, keys)


def _prepare(fn: Callable, outputs: Outputs, execution: Execution, points: Points) -> tuple[Plan, Program | None]:
    """Choose how batches are computed; by default, functions that cannot be traced are called."""
    plan = execution.plan(None)
    example = _columns(points, range(1))
    called = Plan("call", 1)
    words = any(column.dtype.kind == "U" for column in example.values())
    if plan.mode == "call" or (words and execution.mode == "auto"):
        return called, None
    try:
        if isinstance(execution, Cluster):  # its workers compile
            jax.eval_shape(lambda point: outputs.arrays(fn(**point))[0], {k: v[0] for k, v in example.items()})
            return plan, None
        return plan, Program(fn, outputs, plan, example)
    except OutputError:
        raise
    except Exception as cause:
        if execution.mode != "auto" or plan.devices > 1:
            raise
        if not isinstance(cause, jax.errors.JAXTypeError):
            # Numbers were wanted where there are tracers, or the function is wrong: then it raises again.
            fn(**{name: column[0].item() for name, column in example.items()})
        return called, None


def _run(
    fn: Callable,
    outputs: Outputs,
    plan: Plan,
    program: Program | None,
    execution: Execution,
    points: Points,
    store: Memory | Folder,
    shown: Progress,
) -> dict[int, Outcome]:
    """Compute missing points; return those where the function raised, which are not stored."""
    batches = [range(i, min(i + plan.points, len(points))) for i in range(0, len(points), plan.points)]
    missing = [i for i in range(len(points)) if not store.has(i)]
    errors: dict[int, Outcome] = {}
    if not missing:
        return errors

    def waiting() -> Iterator[tuple[range, Columns]]:
        for batch in batches:
            # Checked again just before the start: another process may have computed it.
            if not all(store.has(i) for i in batch):
                yield batch, _columns(points, batch)

    if isinstance(execution, Cluster):
        finished = execution.run(fn, outputs, plan, waiting())
    else:
        program = program or Program(fn, outputs, plan, _columns(points, range(1)))
        finished = execution.run(program, waiting())
    bar = SweepProgress(shown, len(points), len(points) - len(missing))
    for batch, outcomes in finished:
        for i, outcome in zip(batch, outcomes, strict=True):
            if outcome.status == ERROR:
                errors[i] = outcome
            elif not store.has(i):
                store.write(i, outcome)
            bar.finished({name: column[i] for name, column in points.columns.items()}, outcome)
    return errors


def _columns(points: Points, batch: range) -> Columns:
    return {name: column[batch.start : batch.stop] for name, column in points.columns.items()}
