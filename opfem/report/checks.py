"""What a reader should know before the maps: a result in a few sentences, and what in it asks for care.

A check that fails is said in words and marked by more than its colour.
"""

import math
from typing import NamedTuple

import numpy as np
import xarray as xr

from .convergence import imbalance, small_percent
from .inputs import ASSUMED, Input
from .maps import KPA, UM, ReportMap, loaded_thickness
from .numbers import mean_pressure, residual_rms, touching_share

_BALANCED = 1e-3  # of the force: a converged solve leaves 1e-6, explicit dynamics some 1e-4
_CHI2 = (0.5, 2.0)  # as a fit's own advice has it
_NUMERICAL = ("Mesh", "Map")  # parts whose assumptions are choices of the computation
_NOISE = 3.0  # residual over the map's noise from which on the mesh does not follow the map


class Check(NamedTuple):
    """One thing that was looked at.

    Attributes:
        good: Whether all is well.
        words: What was found.
    """

    good: bool
    words: str


def in_short(dataset: xr.Dataset) -> str:
    """Say a result in two sentences.

    Args:
        dataset: What `to_xarray` returned for a solve that converged.
    """
    pressure = KPA * dataset["pressure"].values
    compression = 100.0 * (1.0 - loaded_thickness(dataset) / dataset["unloaded_thickness"].values)
    sure = (
        f" ± {KPA * float(dataset['pressure_std'].mean()):.2g} kPa (one standard deviation)"
        if "pressure_std" in dataset
        else ""
    )
    return (
        f"The sample presses on the layer with {-1e3 * float(dataset['force_sample'][2]):.3g} mN and touches "
        f"{100.0 * touching_share(dataset):.0f} % of it. Where it touches, the pressure is "
        f"{mean_pressure(dataset):.2g} kPa in the mean{sure} and {pressure.max():.3g} kPa at most; the layer is "
        f"compressed by up to {compression.max():.0f} %."
    )


def checks(dataset: xr.Dataset, maps: list[ReportMap], inputs: list[Input], noise: float | None) -> list[Check]:
    """Look at what a result stands or falls by.

    Args:
        dataset: What `to_xarray` returned for a solve that converged.
        maps: Of the report.
        inputs: What it rests on.
        noise: Standard deviation of the map's noise [µm], where it is known.
    """
    attrs = dataset.attrs
    left = imbalance(dataset)
    found = [
        Check(attrs["status"] == "successful", "The solve converged. " + str(attrs.get("status_message", ""))),
        Check(
            not left > _BALANCED,
            "Nothing presses." if math.isnan(left) else f"Forces balance: {small_percent(left)} % is left.",
        ),
        *_materials(inputs, ASSUMED in attrs),
        *_noise(dataset, maps, noise),
    ]
    if "reduced_chi2" in dataset:
        chi2 = float(dataset["reduced_chi2"])
        near = _CHI2[0] <= chi2 <= _CHI2[1]
        words = "near 1: noise, material and friction explain the map" if near else "far from 1: see the numbers below"
        found.append(
            Check(near and attrs["fit_status"] == "successful", f"χ² per degree of freedom is {chi2:.2f}, {words}.")
        )
    missing = next((drawn.unmeasured for drawn in maps if drawn.key == "pressure"), None)
    if missing is not None and missing.any():
        words = f"{100.0 * np.mean(missing):.1f} % of the map was not measured"
        found.append(Check(True, f"{words}; what is computed there rests on its surroundings."))
    return found


def _materials(inputs: list[Input], recorded: bool) -> list[Check]:
    physical = [row for row in inputs if row.mark == "assumed" and row.part not in _NUMERICAL]
    by_part = {row.part: ", ".join(r.name.split(",")[0] for r in physical if r.part == row.part) for row in physical}
    if physical:
        words = "; ".join(f"{part}: {names}" for part, names in by_part.items())
        return [Check(False, f"Assumed, because nobody said otherwise. {words}. Are they yours?")]
    return [Check(True, "Every input was given.")] if recorded else []


def _noise(dataset: xr.Dataset, maps: list[ReportMap], noise: float | None) -> list[Check]:
    rms = residual_rms(maps)
    if rms is None or noise is None:
        return []
    allowed = UM * float(dataset["model_std"]) if "model_std" in dataset else 0.0
    mesh = f", and {allowed:.2g} µm are allowed for the mesh" if allowed else ""
    words = f"The computed thickness misses the map by {rms:.2g} µm rms; the map's noise is {noise:.2g} µm{mesh}."
    if rms > _NOISE * math.hypot(noise, allowed):
        return [Check(False, words + " The mesh or the contact does not follow the map.")]
    return [Check(True, words)]
