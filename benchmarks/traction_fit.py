"""The traction fit against truth: accuracy, calibration, cost, edges, parameters.

Run `python -m benchmarks.traction_fit CASE`, CASE one of

- `truth`: data from quadratic tetrahedra on a mesh 1.8 times finer, not nested, friction on both sides, 2 µm noise;
  the fit beside the imprint route, the linear and the uniaxial estimate;
- `cost [--elements 20 40 80] [--missing 0.3] [--block 0.3] [--once] [--increments 8]`: Jacobian products, with and
  without preconditioner, and the whole fit in forward solves; 0 leaves a mask out; each fit twice, the second time
  nothing is compiled, or once;
- `coin MAP [--elements 40] [--model-std 4] [--out FILE.png]`: the published coin beside its imprint, also with a
  traction along z; and a map simulated from a draw of its posterior, beside that; or `--measured-only`;
- `coverage [--fits 400] [--first 0] [--believed 1]`: truths drawn from the prior on 12 × 12 × 2, one functional each;
  `--believed 2.5` takes a wrong bulk modulus, so that it must fail;
- `edge [--out FILE.png]`: a step of pressure, its edge-spread width against mesh, noise and prior;
- `parameters [--fits 100]`: window friction and C10 from three maps and readings of the force.

Each prints JSON lines. `--without RESCUE` switches one part of the algorithm off, for any case:

- `foundation`: a dead load instead of the elastic foundation;
- `jumps`: no step may increase the misfit;
- `secants`: no quasi-Newton pairs, neither of steps nor of CG iterations.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax import monitoring
from scipy.interpolate import RectBivariateSpline

import opfem as op
from opfem.inverse.measured_surface import interface_heights
from opfem.optimise.conjugate_gradients import Secants, least_squares, plus
from opfem.optimise.line_search import ParabolicBacktracking

C10, C01, BULK = 2.23e-3, 7.03e-4, 0.11732  # MPa
NOISE = 2e-3  # mm
THICKNESS = 0.5  # mm
ELEMENT = 0.125  # mm
# Events of jax.monitoring: lowering and compiling.
COMPILING = ("/jax/core/compile/jaxpr_to_mlir", "/jax/core/compile/backend_compile")
# Settings of a fit without one of its rescues; secants have none, see `main`.
RESCUES = {
    "foundation": {"foundation_stiffness": 0.0},
    "jumps": {"line_search": ParabolicBacktracking(short=0.0)},
    "secants": {},
}
# Those of this run, `--without`.
changed: dict = {}


def fit_map(*arguments, **options) -> op.TractionFit:
    """Fit, without the rescue that `--without` names."""
    return op.fit_traction(*arguments, **options, **changed)


def experiment(
    elements: tuple[int, int, int],
    side: float,
    window: float = 0.15,
    sample: float = 0.05,
    element: str = "mean_dilatation",
    c10: float = C10,
) -> op.Palpation:
    """State the published layer on a square field."""
    return op.Palpation(
        op.Layer(THICKNESS, op.MooneyRivlin(c10=c10, c01=C01, bulk=BULK)),
        extent=(side, side),
        elements=elements,
        window=op.Contact(op.HardOverclosure(), window),
        sample=op.Contact(op.ExponentialOverclosure(pressure=2.0, clearance=0.01), sample),
        element=element,
    )


def surface(palpation: op.Palpation, solution: op.Solution, pixels: int) -> np.ndarray:
    """Look at a solved interface on a grid of pixels [mm]."""
    mesh = palpation.mesh()
    heights = interface_heights(mesh, solution.displacement[:, -1])
    x, y = (np.asarray(part) for part in mesh.plane())
    place = np.linspace(0.0, float(mesh.extent[0]), pixels)
    return RectBivariateSpline(y[:, 0], x[0], np.asarray(heights))(place, place)


def as_map(heights: np.ndarray, side: float, seed: int, mask: np.ndarray | None = None) -> op.ThicknessMap:
    """Add noise."""
    noise = NOISE * np.random.default_rng(seed).standard_normal(heights.shape)
    return op.ThicknessMap(heights + noise, extent=(side, side), std=NOISE, mask=mask)


def error(p: jnp.ndarray, truth: jnp.ndarray) -> dict[str, float]:
    """Compare with a truth: over its own variation, and over its size."""
    off = float(jnp.linalg.norm(p - truth))
    return {
        "over_variation": round(off / float(jnp.linalg.norm(truth - truth.mean())), 4),
        "relative_L2": round(off / float(jnp.linalg.norm(truth)), 4),
    }


def lobes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The pressure of `truth` [MPa]: two lobes and a valley on 3 kPa."""
    return 1e-3 * (
        3.0
        + 4.0 * np.exp(-((x - 0.9) ** 2 + (y - 1.0) ** 2) / 0.18)
        + 2.5 * np.exp(-((x - 1.8) ** 2 / 0.1 + (y - 1.6) ** 2 / 0.3))
        - 1.5 * np.exp(-((x - 1.7) ** 2 + (y - 0.7) ** 2) / 0.12)
    )


def truth_case() -> None:
    """No inverse crime (docs/validation.md test 41)."""
    side, fine, coarse = 2.5, experiment((36, 36, 6), 2.5, element="tet10"), experiment((20, 20, 4), 2.5)
    known = op.solve(fine, op.Traction(lobes(*map(np.asarray, fine.mesh().plane()))))
    measured = as_map(surface(fine, known, 151), side, seed=1)
    truth = jnp.asarray(lobes(*map(np.asarray, coarse.mesh().plane())))
    prior = op.Matern(length=0.5, std=1.5e-3, mean=3e-3)
    begin = time.perf_counter()
    # This truth pushes along z.
    first = fit_map(coarse, measured, prior, lateral="friction", model_std=0.0, draws=2)
    seconds = time.perf_counter() - begin
    fit = fit_map(coarse, measured, prior, lateral="friction", draws=32)
    imprint = op.solve(coarse, op.Imprint(measured.smoothed(fwhm=ELEMENT)))
    linear, uniaxial = op.linear_estimate(coarse, measured, prior), op.uniaxial_estimate(coarse, measured)
    off = jnp.abs(fit.normal - truth)
    inside, without = off < 1.96 * fit.normal_std, off < 1.96 * first.normal_std
    print(
        json.dumps(
            {
                "strain": round(1.0 - float(measured.values.min()) / THICKNESS, 3),
                "fit": error(fit.normal, truth),
                "mesh_error_um": round(1e3 * float(fit.stats["mesh_error"]), 2),
                "mesh_std_kPa": round(1e3 * float(fit.mesh_std.mean()), 3),
                "imprint": error(-imprint.traction[2], truth),
                "linear": error(linear.normal, truth),
                "uniaxial": error(uniaxial, truth),
                "inside_95": round(float(inside.mean()), 3),
                "inside_95_without_mesh_error": round(float(without.mean()), 3),
                "reduced_chi2": round(float(fit.reduced_chi2), 3),
                "normal_std_kPa": round(1e3 * float(fit.normal_std.mean()), 3),
                "resolution_mm": np.round(np.median(fit.resolution_width), 3),
                "seconds": round(seconds, 1),
                **counts(fit),
            }
        ),
        flush=True,
    )


def counts(fit: op.TractionFit) -> dict[str, float]:
    """Count what a fit took."""
    return {
        name: int(fit.stats[name])
        for name in ("forward_solves", "gauss_newton_steps", "inner_iterations", "posterior_iterations", "draws")
    }


def prior_field(experiment: op.Palpation, prior: op.Matern, seed: int) -> jnp.ndarray:
    """Draw a traction from the prior [MPa]."""
    mesh = experiment.mesh()
    return prior.mean + prior.expand(jax.random.normal(jax.random.key(seed), mesh.thickness.shape), mesh.spacing)


def cost_case(elements: list[int], missing: float, block: float, times: int, increments: int) -> None:
    """Count products with the Jacobian, on maps of the fit's own model."""
    compiling: list[float] = []
    monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **_: compiling.append(seconds) if event.startswith(COMPILING) else None
    )
    for n in elements:
        palpation = experiment((n, n, max(2, n // 10)), n * ELEMENT)
        prior = op.Matern(length=0.6, std=1.5e-3, mean=3e-3)
        truth = prior_field(palpation, prior, seed=5)
        settings = op.Newton(increments=increments, max_path=increments + 8)  # of solve and fit
        solution = op.solve(palpation, op.Traction(truth), settings)
        heights = surface(palpation, solution, 4 * n + 1)
        rng = np.random.default_rng(2)
        edge = int(np.sqrt(block) * heights.shape[0])
        hole = np.zeros(heights.shape, bool)
        hole[10 : 10 + edge, 10 : 10 + edge] = True
        masks = {"none": None}
        if missing:
            masks["scattered"] = rng.random(heights.shape) < missing
        if block:
            masks["block"] = hole
        for name, mask in masks.items():
            measured = as_map(heights, n * ELEMENT, seed=3, mask=mask)
            seconds, compile_seconds = [], []
            for _ in range(times):
                compiling.clear()
                begin = time.perf_counter()
                fit = fit_map(palpation, measured, prior, lateral="friction", solver=settings, draws=2)
                seconds.append(round(time.perf_counter() - begin, 1))
                compile_seconds.append(round(sum(compiling), 1))
            begin = time.perf_counter()
            jax.block_until_ready(op.solve(palpation, op.Traction(1.001 * truth), settings).pressure)
            forward = time.perf_counter() - begin
            begin = time.perf_counter()
            iterations = int(fit.posterior.draw(jax.random.key(1))[2]) + 1
            products = (time.perf_counter() - begin) / iterations
            # The imprint at which the elastic foundation is at rest counts as one.
            whole = 1 + int(fit.stats["forward_solves"]) + int(fit.stats["inner_iterations"]) * products / forward
            row = {
                "elements": palpation.elements,
                "increments": increments,
                "missing": name,
                "fit": error(fit.normal, truth),
                "reduced_chi2": round(float(fit.reduced_chi2), 3),
                "seconds": seconds,
                "of_it_compiling": compile_seconds,
                "forward_seconds": round(forward, 2),
                "products_seconds": round(products, 2),  # with the Jacobian and with its transpose
                "fit_over_forward": round(whole, 1),
                "inner_per_step": round(int(fit.stats["inner_iterations"]) / int(fit.stats["gauss_newton_steps"]), 1),
                "unpreconditioned_last_system": unpreconditioned(fit) if n <= 20 else None,
                **counts(fit),
            }
            print(json.dumps(row), flush=True)


def unpreconditioned(fit: op.TractionFit) -> int:
    """Solve the first system of a posterior draw without preconditioner: iterations to 1e-2."""
    posterior = fit.posterior

    @eqx.filter_jit
    def solve(posterior, noise):
        J = posterior.jacobian
        return least_squares(J.mv, J.T.mv, lambda r: r, noise, 1e-2, 1000).iterations

    structure = posterior.residual_structure()
    key = jax.random.key(0)
    return int(solve(posterior, jax.tree.map(lambda s: jax.random.normal(key, s.shape, s.dtype), structure)))


def coin_case(path: Path, n: int, model_std: float | None, out: Path | None, measured_only: bool) -> None:
    """The published coin as measured, and a map of a draw from its posterior, with errors as large as the fit expects.

    The optimum itself would not do as a truth: it is smoother than what its prior expects, so that χ² comes out low.
    """
    loaded = op.read_thickness(path, extent=(5.0, 5.0), std=NOISE)
    palpation = experiment((n, n, n // 10), 5.0)
    # A coin's edges are steps: a prior without a slope.
    prior = op.Matern(length=0.5, std=4e-3, mean=op.uniaxial_estimate(palpation, loaded).mean(), smoothness=0.5)
    imprint = op.solve(palpation, op.Imprint(loaded.smoothed(fwhm=0.06)))
    fit = coin_fit("measured", palpation, loaded, prior, model_std, imprint)
    if measured_only:
        return
    # The imprint's slopes push sideways, which the sample's friction alone does not.
    along_z = coin_fit("along z", palpation, loaded, prior, model_std, imprint, lateral="friction")
    if out is not None:
        plot_beside_imprint([along_z, fit], imprint, out)
    if bool(fit.result != op.FitStatus.successful):
        return
    white = plus(fit.posterior.white, fit.posterior.draw(jax.random.key(6))[0])
    load = jax.tree.map(lambda v: v[0], fit.objective.tractions(white))
    truth = op.solve(palpation, load, op.Newton(increments=2))
    # White noise of as much power as one error per element.
    missed = (model_std or 0.0) * 160 / n * np.random.default_rng(5).standard_normal((161, 161))
    simulated = as_map(surface(palpation, truth, 161) + missed, 5.0, seed=4)
    coin_fit("simulated", palpation, simulated, prior, model_std, truth)


def coin_fit(
    name: str,
    palpation: op.Palpation,
    measured: op.ThicknessMap,
    prior: op.Matern,
    model_std: float | None,
    beside: op.Solution,
    lateral: str = "imprint",
) -> op.TractionFit:
    """Fit one map of the coin, and compare it with a solution beside it: the imprint or the truth."""
    begin = time.perf_counter()
    fit = fit_map(palpation, measured, prior, lateral=lateral, model_std=model_std, draws=8, throw=False)
    off = fit.pressure - beside.pressure
    row = {
        "map": name,
        "elements": palpation.elements,
        "message": op.FitStatus[fit.result],
        "force_N": -float(fit.solution.stats["force_sample"][2]),
        "force_beside_N": -float(beside.stats["force_sample"][2]),
        "reduced_chi2": float(fit.reduced_chi2),
        "effective_dof": float(fit.effective_dof),
        "model_std_um": 1e3 * float(fit.stats["model_std"]),
        "mesh_error_um": 1e3 * float(fit.stats["mesh_error"]),
        "mesh_std_kPa": 1e3 * float(fit.mesh_std.mean()),
        "misfit_rms_um": 1e3 * float(fit.stats["misfit_rms"]),
        "representation_rms_um": 1e3 * float(fit.stats["representation_rms"]),
        "pressure_std_kPa": 1e3 * float(fit.pressure_std.mean()),
        "difference_rms_kPa": 1e3 * float(jnp.sqrt(jnp.mean(off**2))),
        "within_two_std": float(jnp.mean(jnp.abs(off) < 2.0 * fit.pressure_std)),
        "seconds": round(time.perf_counter() - begin, 1),
        **counts(fit),
    }
    print(json.dumps(row), flush=True)
    return fit


def plot_beside_imprint(fits: list[op.TractionFit], imprint: op.Solution, out: Path) -> None:
    """Draw the pressure of fits and imprint, and where they differ: one row each."""
    side, highest = float(imprint.palpation.extent[0]), 1e3 * float(imprint.pressure.max())
    figure, axes = plt.subplots(len(fits), 3, figsize=(11.0, 3.4 * len(fits)), layout="compressed", sharex=True)
    for row, fit, lateral in zip(axes, fits, ("friction", "that of the imprint"), strict=True):
        parts = (
            (1e3 * fit.pressure, f"Fit, lateral traction: {lateral} [kPa]", "viridis", (0.0, highest)),
            (1e3 * imprint.pressure, "Imprint [kPa]", "viridis", (0.0, highest)),
            ((fit.pressure - imprint.pressure) / fit.pressure_std, "Difference over its std [-]", "RdBu_r", (-6, 6)),
        )
        for ax, (values, title, cmap, (low, high)) in zip(row, parts, strict=True):
            values = np.asarray(values)
            image = ax.imshow(values, cmap, origin="lower", extent=(0, side, 0, side), vmin=low, vmax=high)
            ax.set_title(title, fontsize="medium")
            figure.colorbar(image, ax=ax)
        row[0].set_ylabel("y [mm]")
    for ax in axes[-1]:
        ax.set_xlabel("x [mm]")
    figure.savefig(out, dpi=150)


def coverage_case(fits: int, first: int, believed: float) -> None:
    """Truths drawn from the prior (docs/validation.md test 42): is a functional in its own interval, and at what rank?

    Args:
        fits: How many truths.
        first: Number of the first one.
        believed: Bulk modulus that the fit takes, over the true one: 1 is right.
    """
    side, prior, settings = 1.5, op.Matern(length=0.6, std=1e-3, mean=4e-3), op.Newton(increments=2, max_path=12)
    palpation = experiment((12, 12, 2), side)
    assumed = eqx.tree_at(lambda p: p.layer.material.bulk, palpation, believed * palpation.layer.material.bulk)
    shape = palpation.mesh().thickness.shape
    rows = []
    for index in range(first, first + fits):
        truth = prior_field(palpation, prior, seed=1000 + index)
        solution = op.solve(palpation, op.Traction(truth), settings, throw=False, progress=False)
        measured = as_map(surface(palpation, solution, 49), side, seed=index)
        options = {"solver": settings, "draws": 1, "throw": False, "progress": False}
        fit = fit_map(assumed, measured, prior, lateral="friction", model_std=0.0, **options)
        row = {"index": index, "message": op.FitStatus[fit.result]}
        if bool(fit.result == op.FitStatus.successful):
            # As smooth as the traction, so that it is neither all noise nor all prior.
            weights = prior.expand(jax.random.normal(jax.random.key(5000 + index), shape), palpation.mesh().spacing)
            std = float(jnp.sqrt(jnp.sum(weights * fit.covariance(weights))))
            row["z"] = float(jnp.sum(weights * (truth - fit.normal))) / std
            row |= {"chi2": round(float(fit.reduced_chi2), 3), **counts(fit)}
        rows.append(row)
        print(json.dumps(row), flush=True)
    z = np.array([row["z"] for row in rows if "z" in row])
    ranks = np.histogram(jax.scipy.stats.norm.cdf(z), bins=20, range=(0.0, 1.0))[0]
    print(
        json.dumps(
            {
                "fits": len(z),
                "not_fitted": len(rows) - len(z),
                "inside_95": float(np.mean(np.abs(z) < 1.96)),
                "inside_90": float(np.mean(np.abs(z) < 1.645)),
                "reduced_chi2": float(np.median([row["chi2"] for row in rows if "z" in row])),
                "rank_chi2": float(np.sum((ranks - len(z) / 20) ** 2 / (len(z) / 20))),
                "forward_solves": float(np.median([row["forward_solves"] for row in rows if "z" in row])),
                "inner_iterations": float(np.median([row["inner_iterations"] for row in rows if "z" in row])),
            }
        ),
        flush=True,
    )


def edge_case(out: Path | None) -> None:
    """A step of pressure: how wide does the fit make it, by mesh, noise and prior?"""
    rows = []
    for elements, side in (((80, 4, 8), 2.0), ((80, 4, 8), 5.0), ((40, 4, 4), 5.0)):
        for noise in (NOISE, 0.25 * NOISE):
            for length in (0.25, 0.125):
                rows.append(edge_width(elements, side, noise, length))
                print(json.dumps(rows[-1]), flush=True)
    if out is not None:
        plot_edges(rows, out)


def edge_width(elements: tuple[int, int, int], side: float, noise: float, length: float) -> dict:
    """Fit a step of 2 to 4 kPa half-way along x, in plane strain; its width is from 10 to 90 % of its height."""
    nx, ny, nz = elements
    strip = side * ny / nx

    def plane_strain(elements: tuple[int, int, int]) -> op.Palpation:
        square = experiment(elements, side)
        return op.Palpation(
            square.layer, (side, strip), elements, square.window, square.sample, {"y0": "roller", "y1": "roller"}
        )

    palpation, fine = plane_strain(elements), plane_strain((2 * nx, ny, nz))
    x, _ = fine.mesh().plane()
    solution = op.solve(fine, op.Traction(jnp.where(x < 0.5 * side, 2e-3, 4e-3)), progress=False)
    heights = interface_heights(fine.mesh(), solution.displacement[:, -1])
    values = heights + noise * np.random.default_rng(0).standard_normal(heights.shape)
    measured = op.ThicknessMap(values, extent=(side, strip), std=noise)
    prior = op.Matern(length=length, std=2e-3, mean=3e-3)
    fit = fit_map(palpation, measured, prior, lateral="friction", draws=4, throw=False, progress=False)
    line = 1e3 * np.asarray(jnp.mean(fit.normal, axis=0))
    place = np.linspace(0.0, side, nx + 1)
    low, high = np.mean(line[place < 0.3 * side]), np.mean(line[place > 0.7 * side])
    share = (line - low) / (high - low)
    # Where the profile last leaves the lower end and first reaches the upper one, between nodes.
    middle = int(np.searchsorted(place, 0.5 * side))
    left = middle - int(np.argmax(share[middle::-1] < 0.1))
    right = middle + int(np.argmax(share[middle:] > 0.9))
    ends = [np.interp(0.1, share[left : left + 2], place[left : left + 2])]
    ends.append(np.interp(0.9, share[right - 1 : right + 1], place[right - 1 : right + 1]))
    return {
        "element_um": 1e3 * side / nx,
        "noise_um": 1e3 * noise,
        "pixels_per_element": 2,
        "prior_length_mm": length,
        "edge_10_90_um": round(1e3 * (ends[1] - ends[0]), 1),
        "resolution_um": round(1e3 * float(np.median(fit.resolution_width)), 1),
        "message": op.FitStatus[fit.result],
        "reduced_chi2": round(float(fit.reduced_chi2), 3),
    }


def plot_edges(rows: list[dict], out: Path) -> None:
    """Draw the widths of a step's edge."""
    figure, ax = plt.subplots(figsize=(6.4, 4.0), layout="compressed")
    for (noise, length), style in zip(
        sorted({(row["noise_um"], row["prior_length_mm"]) for row in rows}),
        ("C0o-", "C0s--", "C1o-", "C1s--"),
        strict=True,
    ):
        mine = sorted(
            (row["element_um"], row["edge_10_90_um"])
            for row in rows
            if (row["noise_um"], row["prior_length_mm"]) == (noise, length)
        )
        ax.plot(*zip(*mine, strict=True), style, label=f"noise {noise:.1f} µm, prior length {1e3 * length:.0f} µm")
    ax.axhspan(15.0, 25.0, color="0.85", label="published claim")
    ax.set(xlabel="Element [µm]", ylabel="Width of a step's edge, 10 to 90 % [µm]", ylim=(0.0, None))
    ax.legend(fontsize="small")
    figure.savefig(out, dpi=150)


def parameters_case(fits: int) -> None:
    """Window friction and C10 from three maps and force readings of 1 % (same model)."""
    side, settings = 1.5, op.Newton(increments=2, max_path=12)
    palpation = experiment((8, 8, 2), side)
    prior = op.Matern(length=0.6, std=1e-3, mean=3e-3)
    pattern = prior_field(palpation, prior, seed=7)
    area = side**2
    loads = [part * pattern for part in (0.5, 1.0, 1.5)]
    solutions = [op.solve(palpation, op.Traction(load), settings) for load in loads]
    surfaces = [surface(palpation, solution, 33) for solution in solutions]
    forces = [-float(solution.stats["force_sample"][2]) for solution in solutions]
    known = {"window.friction": 0.15, "layer.material.c10": C10}
    parameters = {name: op.LogNormal(0.8 * value, 0.5) for name, value in known.items()}
    wide = op.Matern(length=0.6, std=2e-3, mean=3e-3)
    inside = dict.fromkeys(known, 0)
    for index in range(fits):
        rng = np.random.default_rng(index)
        maps = [as_map(heights, side, seed=100 * index + i) for i, heights in enumerate(surfaces)]
        readings = [op.ForceReading(f * (1.0 + 0.01 * rng.standard_normal()), 0.01 * f) for f in forces]
        fit = fit_map(
            palpation, maps, wide, parameters=parameters, forces=readings, lateral="friction", model_std=0.0,
            solver=settings, draws=1, progress=False,
        )  # fmt: skip
        intervals = fit.number_intervals()
        for name, (low, high) in intervals.items():
            inside[name] += low <= known[name] <= high
        row = {"index": index, "values": {k: float(v) for k, v in fit.numbers.items()}, "intervals": intervals}
        row["not_identified"] = fit.not_identified()
        print(json.dumps(row | {"inside": inside, "area_mm2": area, **counts(fit)}), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("case", choices=("truth", "cost", "coin", "coverage", "edge", "parameters"))
    parser.add_argument("map", type=Path, nargs="?", help="the coin's map")
    parser.add_argument("--elements", type=int, nargs="+", default=[20, 40])
    parser.add_argument("--missing", type=float, default=0.3)
    parser.add_argument("--block", type=float, default=0.3)
    parser.add_argument("--once", action="store_true")
    parser.add_argument("--increments", type=int, default=8, help="load increments of `cost`")
    parser.add_argument("--fits", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument(
        "--believed", type=float, default=1.0, help="bulk modulus of `coverage`'s fits over the true one"
    )
    parser.add_argument(
        "--model-std",
        type=float,
        help="error of the coin's computed height [µm]; default: by op.mesh_error",
    )
    parser.add_argument("--out", type=Path, help="picture of `edge` or `coin` (.png)")
    parser.add_argument("--measured-only", action="store_true", help="of `coin`: neither along z nor simulated")
    parser.add_argument("--without", choices=RESCUES, help="part of the algorithm to switch off")
    chosen = parser.parse_args(sys.argv[1:])
    jax.config.update("jax_enable_x64", True)
    if chosen.without is not None:
        changed.update(RESCUES[chosen.without])
    if chosen.without == "secants":
        Secants.appended = lambda self, step, change: self  # records nothing
    if chosen.case == "truth":
        truth_case()
    elif chosen.case == "cost":
        cost_case(chosen.elements, chosen.missing, chosen.block, 1 if chosen.once else 2, chosen.increments)
    elif chosen.case == "coin":
        for n in chosen.elements:
            model_std = None if chosen.model_std is None else 1e-3 * chosen.model_std
            coin_case(chosen.map, n, model_std, chosen.out, chosen.measured_only)
    elif chosen.case == "coverage":
        coverage_case(chosen.fits, chosen.first, chosen.believed)
    elif chosen.case == "edge":
        edge_case(chosen.out)
    else:
        parameters_case(chosen.fits)


if __name__ == "__main__":
    main()
