"""`opfem fit MAP --out DIR`: the traction that explains a measured thickness map, with its uncertainty."""

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import jax.numpy as jnp
from rich.console import Console
from rich.table import Table

from ..inverse import FitSettings, LogNormal, Matern, TractionFit, fit_traction, uniaxial_estimate
from ..measurement import ThicknessMap
from ..model import Contact, MooneyRivlin, Palpation
from ..results import layer_rows, pressure_rows, summary, to_xarray
from ..solvers.progress import Progress
from .folder import EXAMPLE, prepare, settle, write_result
from .options import ContactOptions, FitOptions, LayerOptions, MapOptions, ResultOptions, RunOptions, StepOptions
from .output import show_warnings
from .record import assumed_options, with_record
from .statement import configure_jax, read_maps, settings_of, show_assumptions, state_experiment

_ELEMENTS_PER_LENGTH = 3.0


def fit(
    map: str,
    out: Path,
    reading: MapOptions,
    layer: LayerOptions,
    contact: ContactOptions,
    options: FitOptions,
    steps: StepOptions,
    run: RunOptions,
    files: ResultOptions = ResultOptions(),
) -> None:
    """Fit the traction on the sample to a measured thickness map and write it.

    Args:
        map: File of the loaded thickness, or `example`.
        out: Folder of the results.
        reading: How to read the maps.
        layer: The layer and its mesh.
        contact: Contact with window and sample.
        options: The fit.
        steps: How the load is applied.
        run: The run itself.
        files: Files for other programs, to write too.
    """
    with Progress(True, at_once=True) as progress:
        progress.stage("reading")
        configure_jax(run.no_cache)
        settle(out, run.force)
        measured, unloaded = read_maps(map, reading)
        if measured.std is None:
            raise ValueError(
                "--std [mm] is needed: the standard deviation of the thickness noise, a positive number. Estimate it "
                "from two maps of one load, as the standard deviation of their difference over √2, or on a flat target."
            )
        palpation, filled = state_experiment(measured, unloaded, reading, layer, contact)
        prior = state_prior(palpation, filled, options)
        settings = {**settings_of(map, reading, layer, contact, filled), **_options_used(options, prior)}
        prepare(out)
        show_assumptions(palpation, measured, layer)
        Console(highlight=False).print(
            f"  prior: pressure {1e3 * settings['prior_mean']:.3g} ± {1e3 * settings['prior_std']:.3g} kPa, "
            f"correlated over {settings['prior_length']:.3g} mm; noise of the map as given"
        )
        solver = FitSettings().solver
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", category=UserWarning, module=r"opfem\.")  # shown with the results
            fitted = fit_traction(
                palpation,
                measured,
                prior,
                parameters=_parameters(palpation, options),
                nonnegative=options.nonnegative,
                model_std=options.model_std,
                hyperparameters=options.hyperparameters,
                solver=solver if steps.increments is None else dataclasses.replace(solver, increments=steps.increments),
                draws=options.draws,
            )
        progress.stage("summary")
        numbers = fit_summary(fitted, measured)
        progress.stage("pictures")
        # Loaded here, so that a refused run does not wait for matplotlib.
        from ..plot import draw_fit

        said = [*numbers["warnings"], *filter(None, [numbers["advice"]])]
        dataset = with_record(to_xarray(fitted), assumed_options(), warnings=said)
        figures = draw_fit(dataset, measured)
        progress.stage("writing")
        example = {EXAMPLE: measured} if map == "example" else {}
        numbers["settings"] = settings
        written = write_result(dataset, figures, numbers, out, example, measured=measured, options=files)
    _show(numbers, written, out)


def state_prior(palpation: Palpation, filled: ThicknessMap, options: FitOptions) -> Matern:
    """State what is known of the pressure; what was not given comes from the uniaxial estimate.

    Args:
        palpation: The experiment.
        filled: Loaded thickness without missing pixels.
        options: What was given.
    """
    pressure = uniaxial_estimate(palpation, filled)
    size = float(jnp.max(jnp.stack(palpation.mesh().spacing)))
    return Matern(
        length=_ELEMENTS_PER_LENGTH * size if options.prior_length is None else options.prior_length,
        std=jnp.std(pressure) if options.prior_std is None else options.prior_std,
        mean=jnp.mean(pressure) if options.prior_mean is None else options.prior_mean,
    )


def fit_summary(fitted: TractionFit, measured: ThicknessMap) -> dict[str, Any]:
    """Summarise a fit in types that JSON knows, every key with its unit.

    Args:
        fitted: A fit of one map, with the prior of `state_prior`.
        measured: The map.
    """
    stats, prior = fitted.stats, fitted.prior
    assert isinstance(prior, Matern)
    return {
        **summary(fitted.solution, measured),
        "pressure_std_mean_kPa": 1e3 * float(fitted.pressure_std.mean()),
        "pressure_std_max_kPa": 1e3 * float(fitted.pressure_std.max()),
        "pressure_std_error_percent": 100.0 * float(stats["std_error"]),
        "reduced_chi2": float(fitted.reduced_chi2),
        "advice": fitted.advice(),
        "effective_dof": float(fitted.effective_dof),
        "observed_dof": float(fitted.observed),
        "misfit_rms_um": 1e3 * float(stats["misfit_rms"]),
        "mesh_error_um": 1e3 * float(stats["mesh_error"]),
        "mesh_std_mean_kPa": 1e3 * float(fitted.mesh_std.mean()),
        "model_std_um": 1e3 * float(stats["model_std"]),
        "representation_rms_um": 1e3 * float(stats["representation_rms"]),
        "resolution_um": [1e3 * float(width) for width in fitted.resolution_width],
        "prior_length_mm": float(prior.length),
        "prior_std_kPa": 1e3 * float(prior.std),
        "fitted_numbers": {name: float(value) for name, value in fitted.numbers.items()},
        "fitted_intervals_95_percent": {name: list(ends) for name, ends in fitted.number_intervals().items()},
        "not_identified_within_25_percent": fitted.not_identified(0.25),
        "not_observed": {name: list(pair) for name, pair in fitted.unobserved().items()},
        "forward_solves_count": int(stats["forward_solves"]),
        "inner_iterations_count": int(stats["inner_iterations"]),
    }


def _parameters(palpation: Palpation, options: FitOptions) -> dict[str, LogNormal]:
    window, sample, material = palpation.window, palpation.sample, palpation.layer.material
    # As `state_experiment` states them.
    assert isinstance(window, Contact)
    assert isinstance(sample, Contact)
    assert isinstance(material, MooneyRivlin)
    known = {
        "window.friction": (window.friction, options.friction_spread),
        "sample.friction": (sample.friction, options.friction_spread),
        "layer.material.c10": (material.c10, options.modulus_spread),
    }
    return {name: LogNormal(median, spread) for name, (median, spread) in known.items() if spread is not None}


def _options_used(options: FitOptions, prior: Matern) -> dict[str, Any]:
    used = {name: float(getattr(prior, name)) for name in ("length", "std", "mean")}
    return {**dataclasses.asdict(options), **{f"prior_{name}": value for name, value in used.items()}}


def _show(numbers: dict[str, Any], files: list[str], out: Path) -> None:
    rows = [
        ("force on the layer, normal", f"{-numbers['force_sample_N'][2]:.4g}", "N"),
        *pressure_rows(numbers),
        ("its standard deviation, mean", f"{numbers['pressure_std_mean_kPa']:.2g}", "kPa"),
        ("of it the mesh's, mean", f"{numbers['mesh_std_mean_kPa']:.2g}", "kPa"),
        ("resolution", f"{sorted(numbers['resolution_um'])[len(numbers['resolution_um']) // 2]:.0f}", "µm"),
        *layer_rows(numbers),
        ("measured − computed thickness, rms", f"{numbers['residual_rms_um']:.2g}", "µm"),
        ("error of the mesh in thickness, rms", f"{numbers['mesh_error_um']:.2g}", "µm"),
        ("χ² per degree of freedom", f"{numbers['reduced_chi2']:.2f}", ""),
        (
            "forward solves, inner iterations",
            f"{numbers['forward_solves_count']}, {numbers['inner_iterations_count']}",
            "",
        ),
        *(
            (name, f"{value:.4g} ({low:.4g} to {high:.4g})", "")
            for (name, value), (low, high) in zip(
                numbers["fitted_numbers"].items(), numbers["fitted_intervals_95_percent"].values(), strict=True
            )
        ),
    ]
    table = Table("at the sample", "", "")
    table.columns[1].justify = "right"
    for row in rows:
        table.add_row(*row)
    console = Console(highlight=False)
    console.print(table)
    show_warnings(numbers)
    if numbers["advice"]:
        console.print(numbers["advice"], style="yellow")
    for name, part in numbers["not_identified_within_25_percent"].items():
        console.print(f"The data tell {name} to {100 * part:.0f} % only.", style="yellow")
    for name, (after, before) in numbers["not_observed"].items():
        console.print(f"The map does not determine: {name} ({after:.3g} after, {before:.3g} before).", style="yellow")
    console.print(f"Wrote {', '.join(files)} to {out}", markup=False, soft_wrap=True)
