"""The interface in OCT volumes of known truth: accuracy beside three simple detectors, the simulator itself, speed.

Run `python -m benchmarks.oct table [--seeds 3]` for bias, rms, outliers and z-scores by contrast, noise and slope, and
for a detector that takes the largest gradient of each A-line, the same without outliers (Hampel) and median filtered,
and the coarse path of semi-global matching without a fit; `simulator` for what the simulated speckle should be;
`loop` for a known pressure, its volume in a file, and the pressure of the map found in it;
`speed NY NX NZ [--file PATH]` for time and memory of a fresh process, on a volume made before and removed after.
Prints one JSON line per case.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
from scipy.ndimage import gaussian_filter1d, median_filter
from scipy.stats import kstest

import opfem as op
from opfem.measurement.oct import searching

DX, SIDE, UM = 12.5e-3, 128, 1e-3
CASES = ((15, 25), (10, 20), (10, 10), (6, 20), (3, 20))  # contrast and SNR [dB]
SLOPES = (0.16, 0.47)
TARGETS = {15: (0.4, 1.0, 5e-4), 10: (0.4, 1.2, 5e-4), 6: (0.4, 1.9, 1e-3), 3: (0.5, 3.2, 5e-3)}  # µm, µm, share


def waves(slope: float):
    k = 2 * np.pi / 0.8
    return lambda x, y: 0.28 + slope / k * np.sin(k * x + 0.3) * np.cos(0.5 * k * y)


def figures(depth: np.ndarray, truth: np.ndarray, kept: np.ndarray, std: np.ndarray | None = None) -> dict:
    error = (depth - truth)[kept] / UM
    row = {
        "bias_um": error.mean(),
        "rms_um": np.sqrt(np.mean(error**2)),
        "outliers": np.mean(np.abs(error) > 15.0),
    }
    if std is not None:
        z = error * UM / std[kept]
        row |= {"z_rms": np.sqrt(np.mean(z**2)), "within_2_std": np.mean(np.abs(z) < 2.0), "masked": 1 - kept.mean()}
    return {name: round(float(value), 4) for name, value in row.items()}


def simple_detectors(volume: op.OctVolume, sign: int = 1) -> dict[str, np.ndarray]:
    """Depths [mm] by the largest gradient of each A-line, and without outliers."""
    dz = float(volume.optical_spacing) / 1.4
    decibels = 10 * np.log10(np.maximum(volume.intensity(), 1e-30))
    gradient = sign * gaussian_filter1d(decibels, 3.0, axis=2, order=1)
    first = round(0.03 / dz)
    depth = (first + np.argmax(gradient[..., first:-8], axis=2)) * dz
    middle = median_filter(depth, 9)
    scatter = 1.4826 * median_filter(np.abs(depth - middle), 9)
    cleaned = np.where(np.abs(depth - middle) > 3.0 * scatter, middle, depth)
    return {"gradient": depth, "gradient, Hampel, median": median_filter(cleaned, 9)}


def coarse_alone(volume: op.OctVolume, edge: str) -> np.ndarray:
    """Depth [mm] of the path of semi-global matching."""
    kept = []
    refine = searching.refine

    def spy(volume, geometry, surface, *rest):
        kept.append(surface * geometry.dz)
        return refine(volume, geometry, surface, *rest)

    searching.refine = spy
    try:
        op.find_interface(volume, op.UWA_845NM, edge=edge)
    finally:
        searching.refine = refine
    return kept[0]


def table(seeds: int, first: int, last: int) -> None:
    x, y = np.meshgrid(DX * np.arange(SIDE), DX * np.arange(SIDE))
    cases = [(c, snr, slope, None) for c, snr in CASES for slope in SLOPES] + [(15, 25, 0.03, 25.0)]
    for contrast, snr, slope, specular in cases[first:last]:
        surface = waves(slope)
        truth = surface(x, y)
        found, simple = [], {}
        for seed in range(seeds):
            volume = op.simulate_oct(
                op.UWA_845NM, surface, key=jax.random.key([11, 23, 37, 51, 73][seed % 5] + 100 * (seed // 5)),
                spacing=(DX, DX), shape=(SIDE, SIDE), depth=0.5, snr=snr, specular=specular,
                media=(op.Medium(-contrast, 0.5), op.SAMPLE),
            )  # fmt: skip
            edge = "auto"
            interface = op.find_interface(volume, op.UWA_845NM, edge=edge)
            found.append([np.asarray(f) for f in (interface.depth, interface.std, ~interface.mask)])
            for name, depth in {**simple_detectors(volume), "coarse path": coarse_alone(volume, edge)}.items():
                simple.setdefault(name, []).append(depth)
        depth, std, kept = (np.stack(field) for field in zip(*found, strict=True))
        truths = np.broadcast_to(truth, depth.shape)
        case = {"contrast_dB": contrast, "snr_dB": snr, "slope": slope, "specular_dB": specular, "volumes": seeds}
        row = figures(depth, truths, kept, std)
        bias, rms, outliers = (0.1, 0.4, 0.0) if specular else TARGETS[contrast]
        row["met"] = abs(row["bias_um"]) <= bias and row["rms_um"] <= rms and row["outliers"] <= outliers
        row["std_met"] = 0.8 <= row["z_rms"] <= 1.25 and 0.90 <= row["within_2_std"] <= 0.97
        print(json.dumps({**case, "detector": "find_interface", **row}), flush=True)
        for name, depths in simple.items():
            plain = figures(np.stack(depths), truths, np.ones(depth.shape, bool))
            print(json.dumps({**case, "detector": name, **plain}), flush=True)


def width_at_half(lags: np.ndarray, correlation: np.ndarray) -> float:
    """FWHM of a correlation that is Gaussian, by its logarithm's slope in lag²."""
    used = correlation > 0.1
    return float(2 * np.sqrt(np.log(2) / -np.polyfit(lags[used] ** 2, np.log(correlation[used]), 1)[0]))


def correlation(field: np.ndarray, axis: int, lags: int) -> np.ndarray:
    """Intensity's autocovariance along an axis, by lag."""
    power = np.abs(field) ** 2
    power = np.moveaxis(power / power.mean() - 1.0, axis, 0)
    return np.array([np.mean(power[: len(power) - k] * power[k:]) for k in range(lags)]) / np.mean(power**2)


def simulator() -> None:
    """Compare the simulated speckle with theory: a medium without fading, far from surface and noise."""
    even = (op.Medium(0.0, 0.0), op.Medium(0.0, 0.0))
    common = {"key": jax.random.key(7), "depth": 0.5, "depth_spacing": 2.5e-3, "snr": 80.0, "media": even}

    def show(name, value, target):
        print(json.dumps({"quantity": name, "value": round(float(value), 5), "target": target}), flush=True)

    def deep(x, y):
        return np.full_like(x, 10.0)

    volume = op.simulate_oct(op.UWA_845NM, deep, spacing=(DX, DX), shape=(192, 192), scale="complex", **common)
    # Fading of the instrument is taken out by the mean of each depth.
    field = np.asarray(volume.values)[..., 10:-10]
    field = field / np.sqrt(np.mean(np.abs(field) ** 2, axis=(0, 1)))
    power = np.abs(field) ** 2
    show("speckle contrast", power.std() / power.mean(), "1.00 ± 0.02")
    show("p of exponential power (KS)", kstest(power[::3, ::3, ::12].ravel(), "expon").pvalue, "> 0.01")
    show("axial FWHM, µm", width_at_half(2.5 * np.arange(5), correlation(field, 2, 5)) / np.sqrt(2), "7.8 ± 3 %")
    fine = op.simulate_oct(op.UWA_845NM, deep, spacing=(3e-3, 3e-3), shape=(256, 256), scale="complex", **common)
    show(
        "lateral FWHM, µm",
        width_at_half(3.0 * np.arange(5), correlation(np.asarray(fine.values), 1, 5)) / np.sqrt(2),
        "11 ± 3 %",
    )
    for shift in (0.3, 1.0, 2.0, 3.0):
        before, after = op.simulate_oct(
            op.UWA_845NM, deep, spacing=(DX, DX), shape=(128, 128),
            increment=lambda x, y, z, s=shift: (0.0, 0.0, s * UM), **common,
        )  # fmt: skip
        a, b = (np.asarray(v.values)[..., 10:-10] for v in (before, after))
        gamma = np.vdot(a, b) / np.sqrt(np.vdot(a, a).real * np.vdot(b, b).real)
        theory = np.exp(-np.log(2) * (shift / 7.8) ** 2)
        show(f"coherence after {shift} µm less theory", abs(gamma) - theory, "0 ± 0.002")
        wrapped = np.angle(gamma * np.exp(-1j * 4 * np.pi * 1.4 * shift / 0.845))
        show(f"phase after {shift} µm, nm off", 845 / (4 * np.pi * 1.4) * wrapped, "0 ± 0.05")
    surface = waves(0.16)
    stepped = op.simulate_oct(
        op.UWA_845NM, surface, key=jax.random.key(3), spacing=(DX, DX), shape=(192, 192), depth=0.5, scale="linear",
        media=(op.Medium(-40.0, 0.0), op.Medium(0.0, 0.0)), snr=60.0,
    )  # fmt: skip
    x, y = np.meshgrid(DX * np.arange(192), DX * np.arange(192))
    away = 2.5e-3 * np.arange(stepped.shape[2]) - surface(x, y)[..., None]
    bins = np.arange(-0.05, 0.0501, 1e-3)
    # The instrument's roll-off is known, and taken out.
    level = stepped.values * 10 ** (0.6 * (1.4 * 2.5e-3 * np.arange(stepped.shape[2]) / 1.5) ** 2)
    total, _ = np.histogram(away, bins, weights=level)
    profile = total / np.histogram(away, bins)[0]
    # The integral of a blurred step is that of a sharp one: where it lies follows from the sum.
    level = profile[-20:].mean()
    show("surface less its place, µm", 50.0 - profile.sum() / level, "0 ± 0.2")
    dark = op.simulate_oct(
        op.UWA_845NM, surface, key=jax.random.key(3), spacing=(DX, DX), shape=(64, 64), depth=0.5, scale="linear",
        media=(op.Medium(-90.0, 0.0), op.Medium(0.0, 0.0)), snr=20.0,
    )  # fmt: skip
    roll_off = 10 ** (-0.6 * (1.4 * 0.28 / 1.5) ** 2)
    show("noise floor, dB off", 10 * np.log10(dark.values[..., :60].mean() / roll_off) + 20.0, "0 ± 0.2")
    again = op.simulate_oct(op.UWA_845NM, deep, spacing=(DX, DX), shape=(192, 192), scale="complex", **common)
    show("same key, same bits", np.array_equal(again.values, volume.values), 1)


def speckled_file(shape: tuple[int, int, int], path: Path) -> None:
    """Write a raw float32 volume in dB, of speckle that is correlated along depth; it repeats every 32 rows."""
    ny, nx, nz = shape
    rng = np.random.default_rng(0)
    x = DX * np.arange(nx)
    fields = [rng.standard_normal((2, nx, nz), np.float32) for _ in range(32)]
    with open(path, "wb") as file:
        for row in range(ny):
            depth = waves(0.16)(x, DX * row)
            away = 2.5e-3 * np.arange(nz, dtype=np.float32) - depth[:, None].astype(np.float32)
            mean = np.where(away > 0, np.exp(-6.0 * np.maximum(away, 0)), 0.03).astype(np.float32)
            # White scatterers of variance 1 have 1 / 6.6 of it left behind this filter.
            seen = gaussian_filter1d(np.sqrt(6.6 * mean) * fields[row % 32], 1.87, axis=2)
            real, imaginary = seen + np.float32(0.05) * fields[(row + 16) % 32][:, ::-1]
            file.write((10 * np.log10(real**2 + imaginary**2)).astype("<f4").tobytes())


CHILD = """
import json, sys, time
begin = time.perf_counter()
import numpy as np, opfem as op
path, ny, nx, nz, end = sys.argv[1], *map(int, sys.argv[2:5]), float(sys.argv[5])
volume = op.read_oct(path, shape=(ny, nx, nz), order="zxy", spacing=0.0125, depth_spacing=3.5e-3, scale="db")
found = op.find_interface(volume, op.UWA_845NM, edge=sys.argv[6], search=(0.03, end))
x, y = (0.0125 * np.arange(n) for n in (nx, ny))
k = 2 * np.pi / 0.8
truth = 0.28 + 0.16 / k * np.sin(k * x + 0.3) * np.cos(0.5 * k * y)[:, None]
error = 1e3 * (np.asarray(found.depth) - truth)[~np.asarray(found.mask)]
print(json.dumps({"seconds": time.perf_counter() - begin, "cpu_seconds": time.process_time(),
    "bias_um": error.mean(), "rms_um": np.sqrt(np.mean(error**2)), "masked": float(found.mask.mean())}))
"""


def speed(shape: tuple[int, int, int], path: Path, edge: str) -> None:
    try:
        speckled_file(shape, path)
        end = min(0.75, 2.5e-3 * (shape[2] - 1))
        begin = time.perf_counter()
        command = [sys.executable, "-c", CHILD, str(path), *map(str, shape), str(end), edge]
        done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "OPFEM_NO_CACHE": "1"})
        row = json.loads(done.stdout) if done.returncode == 0 else {"failed": done.stderr[-500:]}
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
        wall = time.perf_counter() - begin
        load = os.getloadavg()[0]
        print(json.dumps({"shape": shape, "edge": edge, **row, "wall_seconds": wall, "peak_GB": peak, "load": load}))
    finally:
        path.unlink(missing_ok=True)


def coin(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Compute the pressure of a disc with a ridge [MPa]."""
    disc = 1 / (1 + np.exp((np.hypot(x - 1.0, y - 1.0) - 0.55) / 0.08))
    return 2e-3 + 2.5e-3 * disc + 2e-3 * disc * np.exp(-(((x - 1.0) / 0.2) ** 2))


def loop() -> None:
    """Go from a known pressure, of a layer on a finer mesh, to a volume in a file, and back by `Imprint` and by fit."""
    side, lines, elements = 2.0, 128, 16
    fine, palpation = (
        op.Palpation(
            op.Layer(0.5, op.MooneyRivlin(2.23e-3, 7.03e-4, 0.11732)), (side, side), (count, count, count // 4),
            window=op.Contact(op.HardOverclosure(), 0.15),
            sample=op.Contact(op.ExponentialOverclosure(2.0, 0.01), 0.05),
        )
        for count in (2 * elements, elements)
    )  # fmt: skip
    nodes = np.meshgrid(*2 * [np.linspace(0.0, side, 2 * elements + 1)])
    truth = coin(*nodes)
    scene = op.oct_scene(op.solve(fine, op.Traction(truth)))
    truth = truth[::2, ::2]
    step = side / (lines - 1)
    x, y = np.meshgrid(*2 * [step * np.arange(lines)])
    exact = op.ThicknessMap(np.asarray(scene.surface.sample(x, y)), extent=(side, side))
    path = Path("oct_loop.oct")
    try:
        volume = op.simulate_oct(
            op.UWA_845NM, scene.surface, key=jax.random.key(2), spacing=(step, step), shape=(lines, lines), depth=0.6,
            media=(op.Medium(-15.0, 0.5), op.SAMPLE),
        )  # fmt: skip
        op.write_oct(volume, path)
        found = op.thickness_from_oct(op.read_oct(path), op.UWA_845NM)
    finally:
        path.unlink(missing_ok=True)
    error = np.asarray(found.values) - np.asarray(exact.values)
    pressures = [op.solve(palpation, op.Imprint(each.smoothed(side / 32))).pressure for each in (found, exact)]
    row = {
        "map_rms_um": np.sqrt(np.mean(error**2)) / UM,
        "imprint_difference": float(np.linalg.norm(pressures[0] - pressures[1]) / np.linalg.norm(pressures[1])),
    }
    # As `opfem fit` takes it where it is not given.
    around = op.uniaxial_estimate(palpation, found)
    prior = op.Matern(length=3 * side / elements, std=around.std(), mean=around.mean())
    for name, std in (("_without_mesh_error", 0.0), ("", None)):
        # The truth pushes along z.
        fit = op.fit_traction(palpation, found, prior, lateral="friction", model_std=std, draws=32)
        score = (np.asarray(fit.normal) - truth) / np.asarray(fit.normal_std)
        row |= {
            f"inside_95{name}": float(np.mean(np.abs(score) < 1.96)),
            f"chi2{name}": float(fit.reduced_chi2),
            f"left{name}": float((fit.observed - fit.effective_dof) / fit.observed),
            f"fit_difference{name}": float(np.linalg.norm(fit.normal - truth) / np.linalg.norm(truth)),
        }
    print(json.dumps({**row, "mesh_error_um": float(fit.stats["mesh_error"]) / UM}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    kinds = parser.add_subparsers(dest="what", required=True)
    accuracy = kinds.add_parser("table")
    accuracy.add_argument("--seeds", type=int, default=3)
    accuracy.add_argument("--cases", type=int, nargs=2, default=(0, 99), metavar=("FIRST", "LAST"))
    kinds.add_parser("simulator")
    kinds.add_parser("loop")
    fast = kinds.add_parser("speed")
    fast.add_argument("shape", type=int, nargs=3)
    fast.add_argument("--file", type=Path, default=Path("oct_speed.raw"))
    fast.add_argument("--edge", default="auto")
    chosen = parser.parse_args()
    if chosen.what == "table":
        table(chosen.seeds, *chosen.cases)
    elif chosen.what == "simulator":
        simulator()
    elif chosen.what == "loop":
        jax.config.update("jax_enable_x64", True)
        op.cache_compilation()
        loop()
    else:
        speed(tuple(chosen.shape), chosen.file, chosen.edge)


if __name__ == "__main__":
    main()
