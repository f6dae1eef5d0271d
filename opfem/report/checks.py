"""What a reader should know before the maps: a result in a few sentences, and what in it asks for care.

A check that fails is said in words and marked by more than its colour.
"""

import json
import math
from typing import NamedTuple

import numpy as np
import xarray as xr

from ..results import touching_compression
from .convergence import imbalance, small_percent
from .inputs import ASSUMED, Input, assumptions
from .maps import KPA
from .numbers import mean_pressure, touching_share

WARNINGS = "warnings"
"""Attribute of a dataset: a JSON list of sentences of what limits the result."""
_BALANCED = 1e-3  # of the force: a converged solve leaves 1e-6, explicit dynamics some 1e-4
_CHI2 = (0.5, 2.0)  # as a fit's own advice has it
_NUMERICAL = ("Mesh", "Map")  # parts whose assumptions are choices of the computation


class Check(NamedTuple):
    """One check of a result.

    Attributes:
        good: Whether all is well.
        words: What was found.
    """

    good: bool
    words: str


def in_short(dataset: xr.Dataset, pixels: xr.Dataset) -> str:
    """Say a result in two sentences.

    Args:
        dataset: What `to_xarray` returned for a solve that converged.
        pixels: What `on_pixels` returned for it.
    """
    share = touching_share(dataset)
    if not share:
        return "The layer touches the sample nowhere: there is no pressure."
    sure = (
        f" (one place is known to ± {KPA * float(dataset['pressure_std'].mean()):.2g} kPa, one standard deviation)"
        if "pressure_std" in dataset
        else ""
    )
    return (
        f"The sample presses on the layer with {-1e3 * float(dataset['force_sample'][2]):.3g} mN and touches "
        f"{100.0 * share:.0f} % of it. Where it touches, the pressure is {mean_pressure(dataset):.2g} kPa in the mean"
        f"{sure} and {KPA * float(dataset['pressure'].max()):.3g} kPa at most; the layer is compressed by up to "
        f"{touching_compression(pixels)[1]:.0f} %."
    )


def checks(dataset: xr.Dataset, pixels: xr.Dataset, inputs: list[Input]) -> list[Check]:
    """Look at what a result stands or falls by.

    Args:
        dataset: What `to_xarray` returned for a solve that converged.
        pixels: What `on_pixels` returned for it.
        inputs: What it rests on.
    """
    attrs = dataset.attrs
    warnings = json.loads(attrs.get(WARNINGS, "[]"))
    left = imbalance(dataset)
    balance = "Nothing presses." if math.isnan(left) else f"Forces balance: {small_percent(left)} % is left."
    return [
        Check(attrs["status"] == "successful", f"The solve converged. {attrs.get('status_message', '')}"),
        Check(not left > _BALANCED, balance),
        *(Check(False, warning) for warning in warnings),
        *(() if any("χ²" in warning for warning in warnings) else _fit(dataset)),
        *_missing(pixels),
        *_inputs(inputs, assumptions(dataset), ASSUMED in attrs),
    ]


def _fit(dataset: xr.Dataset) -> list[Check]:
    if "reduced_chi2" not in dataset:
        return []
    chi2 = float(dataset["reduced_chi2"])
    near = _CHI2[0] <= chi2 <= _CHI2[1]
    words = "near 1: noise, material and friction explain the map" if near else "far from 1: see the numbers below"
    ended = dataset.attrs["fit_status"] == "successful"
    return [Check(near and ended, f"χ² per degree of freedom is {chi2:.2f}, {words}.")]


def _missing(pixels: xr.Dataset) -> list[Check]:
    if "missing" not in pixels or not pixels["missing"].values.any():
        return []
    words = f"{100.0 * np.mean(pixels['missing'].values):.1f} % of the map was not measured"
    return [Check(True, f"{words}; what is computed there rests on its surroundings.")]


def _inputs(inputs: list[Input], sentences: list[str], recorded: bool) -> list[Check]:
    physical = [row for row in inputs if row.mark == "assumed" and row.part not in _NUMERICAL]
    by_part = {row.part: ", ".join(r.name.split(",")[0] for r in physical if r.part == row.part) for row in physical}
    if physical or sentences:
        words = "; ".join([*(f"{part}: {names}" for part, names in by_part.items()), *sentences])
        return [Check(False, f"Assumed, because nobody said otherwise. {words}. Are they yours?")]
    return [Check(True, "Every input was given.")] if recorded else []
