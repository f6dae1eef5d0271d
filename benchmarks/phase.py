"""Axial displacement from phase against simulated volumes: bias, scatter, lost turns, z-scores and strain.

Run `python benchmarks/phase.py [--seeds 4] [--snr 25]`. Prints one JSON line per case; `single_lines` is the strain of
the same volumes without lateral averages. Cases with `bulk_phase` turn the phase of each A-line at random and take out
that of the window. The last line is the time for 512 × 512 × 200 samples.
"""

import argparse
import json
import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import opfem as op

SHAPE, STEP, DEPTH, DEPTH_SPACING = (40, 60), 0.01, 0.5, 2.5e-3  # A-lines, mm, mm, mm
INNER = np.s_[8:-8, 8:-8, 20:]
MEDIA = (op.Medium(0.0, 0.5), op.Medium(0.0, 0.5))
BELOW = 60  # samples, 0.15 mm: the strain of what lies above is that of a window's reflection as well
WRAP = 301.8  # nm


def profile(strain: float, wave: float):
    """Displacement [mm] by depth [mm]: uniform strain, and an S of some amplitude [nm]."""
    return lambda z: strain * z + 1e-6 * wave * jnp.sin(2 * jnp.pi * z / DEPTH)


def volumes(displacement, seed: int, snr: float, shape=SHAPE):
    return op.simulate_oct(
        op.UWA_845NM,
        lambda x, y: np.full_like(x, DEPTH),
        key=jax.random.key(seed),
        spacing=(STEP, STEP),
        shape=shape,
        depth_spacing=DEPTH_SPACING,
        depth=DEPTH,
        increment=lambda x, y, z: (0 * z, 0 * z, displacement(z)),
        media=MEDIA,
        snr=snr,
    )


def with_window(before: op.OctVolume, after: op.OctVolume, seed: int):
    """Add the reflection of a window at 20 µm, and a random phase of each A-line of the second volume."""
    depth = np.arange(before.shape[2]) * DEPTH_SPACING
    window = 1e3 * np.exp(-2 * np.log(2) * ((depth - 0.02) / 7.8e-3) ** 2).astype(np.complex64)
    turns = np.exp(2j * np.pi * np.random.default_rng(seed).random((*before.shape[:2], 1))).astype(np.complex64)
    before, after = (
        eqx.tree_at(lambda v: v.values, volume, (volume.values + window) * turn)
        for volume, turn in ((before, 1.0), (after, turns))
    )
    return before, after, op.find_interface(before, op.UWA_845NM, edge="peak", search=(0.0, 0.06))


def case(strain: float, wave: float, bulk_phase: bool, seeds: int, snr: float) -> dict:
    errors, scores, slopes, single = [], [], [], []
    for seed in range(seeds):
        before, after = volumes(profile(strain, wave), seed, snr)
        reference = {}
        if bulk_phase:
            before, after, reference["reference"] = with_window(before, after, seed)
        found = op.axial_displacement(before, after, op.UWA_845NM, **reference)
        kept = ~found.mask[INNER]
        error = (found.values - np.asarray(profile(strain, wave)(found.depth)))[INNER][kept]
        errors.append(1e6 * error)
        scores.append(error / found.std[INNER][kept])
        for average, into in ((None, slopes), ((0.0, 0.0), single)):
            volume = found
            if average is not None:
                volume = op.axial_displacement(before, after, op.UWA_845NM, average=average, **reference)
            slope = volume.strain()
            into.append(slope.values[..., BELOW:][~slope.mask[..., BELOW:]].mean())
    error, score = np.concatenate(errors), np.concatenate(scores)
    return {
        "strain": strain,
        "wave_nm": wave,
        "bulk_phase": bulk_phase,
        "bias_nm": round(float(error.mean()), 3),
        "rms_nm": round(float(np.sqrt(np.mean(error**2))), 3),
        "lost_turns": float(np.mean(np.abs(error) > 0.5 * WRAP)),
        "z_rms": round(float(np.sqrt(np.mean(score**2))), 3),
        "strain_over_truth": None if wave else round(float(np.mean(slopes)) / strain, 4),
        "single_lines": None if wave else round(float(np.mean(single)) / strain, 4),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--snr", type=float, default=25.0)
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    uniform = [(strain, 0.0, False) for strain in (-1e-4, 1e-4, -1e-3, -3e-3, 3e-3, -5e-3, -6.6e-3, 6.6e-3, -1e-2)]
    for stated in [*uniform, (-3e-3, 50.0, False), (-1e-3, 0.0, True), (-3e-3, 0.0, True)]:
        print(json.dumps(case(*stated, asked.seeds, asked.snr)), flush=True)
    rng = np.random.default_rng(0)
    field = (rng.standard_normal((512, 512, 200, 2), np.float32) @ np.array([1, 1j], np.complex64)).astype(np.complex64)
    volume = op.OctVolume(field, (STEP, STEP), 3.5e-3, "complex", phase_sign=1)
    begin = time.process_time(), time.perf_counter()
    op.axial_displacement(volume, volume, op.UWA_845NM)
    seconds = [
        round(now - then, 1) for now, then in zip((time.process_time(), time.perf_counter()), begin, strict=True)
    ]
    print(json.dumps({"samples": [512, 512, 200], "cpu_s": seconds[0], "wall_s": seconds[1]}))


if __name__ == "__main__":
    main()
