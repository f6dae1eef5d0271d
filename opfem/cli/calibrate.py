"""`opfem calibrate CURVE... --out DIR`: a material law from the stress–strain curves of a load frame."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from rich.console import Console
from rich.table import Table

from ..calibration import Calibration, calibrate
from ..io import netcdf_bytes, read_stress_strain, write_together
from ..solvers.progress import Progress
from .curve_options import CurveOptions, LawOptions
from .folder import prepare, refuse_finished, refuse_links
from .options import PictureOptions, RunOptions
from .output import pictures, with_drawings
from .statement import configure_jax

FILES = ("calibration.png", "summary.json", "result.nc")
"""What the command writes; the last marks a finished result."""


def run_calibration(
    curves: list[str],
    out: Path,
    reading: CurveOptions,
    options: LawOptions,
    run: RunOptions,
    files: PictureOptions = PictureOptions(),
) -> None:
    """Fit a law to curves and write it.

    Args:
        curves: Files of the curves.
        out: Folder of the results.
        reading: How to read the curves.
        options: What to fit.
        run: The run itself.
        files: Drawings to write, too.
    """
    with Progress(True, at_once=True) as progress:
        progress.stage("reading")
        configure_jax(run.no_cache)
        refuse_links(out, with_drawings(FILES))
        refuse_finished(out, FILES[-1], run.force)
        columns = tuple(int(name) if name.lstrip("-").isdigit() else name for name in reading.columns)
        arguments: dict[str, Any] = {**vars(reading), "columns": columns}
        data = [read_stress_strain(path, **arguments) for path in curves]
        prepare(out)
        progress.stage("fit")
        found = calibrate(
            data,
            options.law,
            bulk=options.bulk_ratio,
            offset=options.offset != "none",
            toe="strain" if options.offset == "strain" else "stress",
            terms=options.terms,
            weights=options.weights,
            range=options.stretches,
            platens=options.platens,
            diameter=options.diameter,
            height=reading.height,
        )
        progress.stage("pictures")
        from ..plot import draw_calibration

        numbers = {"curves": curves, **summary_of(found)}
        contents = {
            **pictures({FILES[0]: draw_calibration(found)}, files),
            "summary.json": (json.dumps(numbers, indent=2, ensure_ascii=False) + "\n").encode(),
            "result.nc": bytes(netcdf_bytes(_dataset(found))),
        }
        write_together(out, contents, with_drawings(FILES))
    _show(found, numbers, list(contents), out)


def summary_of(found: Calibration) -> dict[str, Any]:
    """List what a calibration found, in MPa and kPa as named."""
    bulk = float(found.material.bulk)
    return {
        "law": found.model.law.__name__,
        "numbers": {name: float(value) for name, value in found.numbers.items()},
        "std": {name: float(value) for name, value in found.std.items()},
        "bulk": bulk if np.isfinite(bulk) else None,
        "modulus_kPa": 1e3 * float(found.modulus),
        "modulus_std_kPa": 1e3 * float(found.modulus_std),
        "correlation": np.asarray(found.correlation).tolist(),
        "rms_kPa": 1e3 * float(found.rms),
        "aic": float(found.aic),
        "autocorrelation": float(found.autocorrelation),
        "stretches": list(found.range),
        "stable_stretches": {mode: list(ends) for mode, ends in found.stability.items()},
        "energy_loss": [None if curve.energy_loss is None else float(curve.energy_loss) for curve in found.data],
        "area_mm2": [None if curve.area is None else float(curve.area) for curve in found.data],
        "height_mm": [None if curve.height is None else float(curve.height) for curve in found.data],
        "advice": found.advice(),
    }


def _dataset(found: Calibration) -> xr.Dataset:
    """Label the points of all curves, and the law's stress at them."""
    curves = range(len(found.data))
    pairs = zip(found.curves.stretch, found.curves.modes, strict=True)
    parts = {
        "curve": [np.full(found.curves.stretch[i].size, i) for i in curves],
        "stretch": [np.asarray(found.curves.stretch[i]) for i in curves],
        "nominal": [np.asarray(found.curves.nominal[i]) for i in curves],
        "fitted": [np.asarray(stress) for stress in found.model.measured(found.unknown, found.curves)],
        "fitted_std": [np.asarray(found.stress_std(s, m)) for s, m in pairs],
    }
    units = {"curve": "1", "stretch": "1", "nominal": "MPa", "fitted": "MPa", "fitted_std": "MPa"}
    return xr.Dataset(
        {name: ("point", np.concatenate(values), {"units": units[name]}) for name, values in parts.items()}
    )


def _show(found: Calibration, numbers: dict[str, Any], files: list[str], out: Path) -> None:
    table = Table("number", "value", "std")
    for name in found.names:
        is_modulus = not name.startswith("alpha") and not (name.startswith("offset") and found.model.toe == "strain")
        factor, unit = (1e3, " kPa") if is_modulus else (1.0, "")
        value, std = factor * numbers["numbers"][name], factor * numbers["std"][name]
        table.add_row(name, f"{value:.4g}{unit}", f"{std:.2g}{unit}")
    table.add_row("E0", f"{numbers['modulus_kPa']:.4g} kPa", f"{numbers['modulus_std_kPa']:.2g} kPa")
    console = Console(highlight=False)
    console.print(table)
    for said in numbers["advice"]:
        console.print(said, markup=False, soft_wrap=True)
    console.print(f"Look at {out / FILES[0]} first. Wrote {', '.join(files)} to {out}", markup=False, soft_wrap=True)
