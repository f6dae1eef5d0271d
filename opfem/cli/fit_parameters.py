"""`opfem fit-parameters CONFIG --out DIR`: friction, moduli and offsets from what was observed of loaded states."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from rich.console import Console
from rich.table import Column, Table

from ..identification import ParameterFit, fit_parameters
from ..io import netcdf_bytes, write_together
from ..solvers.progress import Progress
from .folder import prepare, refuse_finished, refuse_links
from .observed_states import read_observed_states
from .options import PictureOptions, RunOptions
from .output import pictures, with_drawings
from .statement import configure_jax

FILES = ("parameters.png", "summary.json", "result.nc")
"""What the command writes; the last marks a finished result."""


def run_fit(config: Path, out: Path, run: RunOptions, files: PictureOptions = PictureOptions()) -> None:
    """Fit the numbers that a file names, and write them.

    Args:
        config: The file.
        out: Folder of the results.
        run: The run itself.
        files: Drawings to write, too.
    """
    with Progress(True, at_once=True) as progress:
        progress.stage("reading")
        configure_jax(run.no_cache)
        refuse_links(out, with_drawings(FILES))
        refuse_finished(out, FILES[-1], run.force)
        states = read_observed_states(config)
        prepare(out)
        problem = (states.palpation, states.loads)
        found = fit_parameters(problem, states.observations, states.parameters, **states.options)
        progress.stage("pictures")
        # Loaded here, so that a refused run does not wait for matplotlib.
        from ..plot import draw_parameters

        numbers = {"config": str(config), **summary_of(found), "stated": states.stated}
        contents = {
            **pictures({FILES[0]: draw_parameters(found)}, files),
            "summary.json": (json.dumps(numbers, indent=2, ensure_ascii=False) + "\n").encode(),
            "result.nc": bytes(netcdf_bytes(_dataset(found))),
        }
        write_together(out, contents, with_drawings(FILES))
    _show(found, numbers, list(contents), out)


def summary_of(found: ParameterFit) -> dict[str, Any]:
    """List what a fit found, in MPa and mm."""
    return {
        "numbers": {name: float(value) for name, value in found.numbers.items()},
        "std": {name: float(value) for name, value in found.std.items()},
        "interval_95": {name: list(ends) for name, ends in found.intervals().items()},
        "mesh_std": {name: float(value) for name, value in found.mesh_std.items()},
        "prior_share": {name: float(value) for name, value in found.prior_share.items()},
        "correlation": np.asarray(found.correlation).tolist(),
        "chi2": {name: float(value) for name, value in found.chi2.items()},
        "data": {name: int(values.size) for name, values in found.residuals.items()},
        "steps": found.steps,
        "advice": found.advice(),
    }


def _dataset(found: ParameterFit) -> xr.Dataset:
    """Label numbers, covariance and standardised residuals."""
    names = list(found.names)
    low, high = zip(*(found.intervals()[name] for name in names), strict=True)
    each = {
        "value": [float(found.numbers[name]) for name in names],
        "std": [float(found.std[name]) for name in names],
        "low": low,
        "high": high,
        "mesh_std": [float(found.mesh_std[name]) for name in names],
        "prior_share": [float(found.prior_share[name]) for name in names],
    }
    parts: dict[str, Any] = {name: ("parameter", list(values)) for name, values in each.items()}
    parts["covariance"] = (("parameter", "other"), np.asarray(found.covariance))
    for source, values in found.residuals.items():
        parts[f"residual_{source}"] = (f"datum_{source}", np.asarray(values), {"units": "1"})
    return xr.Dataset(parts, {"parameter": names, "other": names}, {"interval": "95 %", "units": "MPa, mm, 1"})


def _show(found: ParameterFit, numbers: dict[str, Any], files: list[str], out: Path) -> None:
    table = Table(Column("number", no_wrap=True), "value", "std", "of it mesh", "95 % interval", "of prior")
    for name in found.names:
        low, high = numbers["interval_95"][name]
        value, std, mesh, share = (numbers[key][name] for key in ("numbers", "std", "mesh_std", "prior_share"))
        table.add_row(name, f"{value:.4g}", f"{std:.2g}", f"{mesh:.2g}", f"{low:.4g} to {high:.4g}", f"{share:.1%}")
    console = Console(highlight=False)
    console.print(table)
    for source, chi2 in numbers["chi2"].items():
        console.print(f"χ² of {source}: {chi2:.4g} of {numbers['data'][source]} data", markup=False, soft_wrap=True)
    for said in numbers["advice"]:
        console.print(said, style="yellow", markup=False, soft_wrap=True)
    console.print(f"Look at {out / FILES[0]} first. Wrote {', '.join(files)} to {out}", markup=False, soft_wrap=True)
