"""The published ridged sample: the stress of the forward deck against that recovered by its inverse deck.

Run `python -m benchmarks.ridged_decks FORWARD INVERSE --out FOLDER [--solver deck newton] [--margin 0.25]`. FORWARD is
fQOCE_sim_sin_t1.inp.gz of the published toolbox (a layer, a deformable sample with ridges and two plates), INVERSE
fQOCE_sol_sin_t2.inp.gz (the same layer, pressed by the surface that the former's interface took). Every step of both is
solved; for each the true pressure of the first is compared with the recovered one of the second. Prints one JSON line
per step and solver; writes the maps (comparison_*.nc) and their picture (comparison_*.png) to FOLDER.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

import opfem as op

SOLVERS = {"deck": None, "newton": op.Newton()}


def solve_steps(path: Path, solver: op.Newton | op.Explicit | None) -> list:
    """Solve the steps of a deck, each from the one before."""
    deck = op.read_inp(path)
    experiment, solutions = deck.experiment(), []
    for load in deck.loads():
        start = solutions[-1] if solutions else None
        solutions.append(op.solve(experiment, load, solver or deck.solver(), start=start))
    return solutions


def thickness_difference(truth, estimate) -> float:
    """Compute the rms difference of the deformed layer's thickness [µm], forward against inverse, inside the layer."""
    lx, ly = np.asarray(truth.experiment.extent)
    x, y = np.meshgrid(np.linspace(0.05, 0.95, 40) * lx, np.linspace(0.05, 0.95, 40) * ly)
    apart = truth.thickness.sample(x, y) - estimate.load.thickness.sample(x, y)
    return 1e3 * float(np.sqrt(np.nanmean(np.asarray(apart) ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("forward", type=Path)
    parser.add_argument("inverse", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--solver", nargs="+", choices=SOLVERS, default=["newton"], help="of the inverse deck")
    parser.add_argument("--margin", type=float, default=0.25, help="rim that is left out [mm]")
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    chosen.out.mkdir(parents=True, exist_ok=True)
    begin = time.process_time()
    truths = solve_steps(chosen.forward, None)
    forward_s = time.process_time() - begin
    for name in chosen.solver:
        begin = time.process_time()
        estimates = solve_steps(chosen.inverse, SOLVERS[name])
        inverse_s = time.process_time() - begin
        for number, (estimate, truth) in enumerate(zip(estimates, truths, strict=True), start=1):
            comparison = op.compare(estimate, truth, margin=chosen.margin)
            stem = f"comparison_{name}_{number}"
            comparison.to_xarray().to_netcdf(chosen.out / f"{stem}.nc")
            figure = Figure((11.0, 3.6), layout="constrained")
            op.plot_comparison(comparison, figure)
            figure.savefig(chosen.out / f"{stem}.png", dpi=150)
            result = {
                "step": number,
                "inverse_solver": name,
                "margin_mm": chosen.margin,
                "force_truth_N": comparison.truth.force,
                "force_recovered_N": comparison.estimate.force,
                "relative_l2": comparison.relative_error,
                "thickness_rms_um": thickness_difference(truth, estimate),
                "newton_steps": int(truth.stats["newton_steps"]),
                "krylov_steps": int(truth.stats["krylov_steps"]),
                "attempts": int(truth.stats["attempts"]),
                "forward_cpu_s": round(forward_s, 1),
                "inverse_cpu_s": round(inverse_s, 1),
            }
            print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
