"""Provenance of a run, stored in its result and shown in its report: the command line, and assumed inputs.

An input is named by its place, such as `window.friction`; what a command takes for granted is an assumption.
"""

import json
from collections.abc import Iterable, Mapping
from typing import Any

import xarray as xr

from .command_line import command_line, given_options

# Options, and the inputs that are assumed without them.
_OPTIONS = {
    "--sides": ("sides",),
    "--c10": ("layer.material.c10", "layer.material.law"),
    "--c01": ("layer.material.c01",),
    "--bulk": ("layer.material.bulk",),
    "--window-friction": ("window.friction",),
    "--sample-friction": ("sample.friction",),
    "--p0": ("sample.law.pressure",),
    "--c0": ("sample.law.clearance",),
    "--contact-stiffness": ("window.law", "sample.law"),
    "--smooth": ("smooth",),
    "--elements": ("elements",),
    "--element": ("element",),
    "--prior-length": ("prior", "prior.length", "prior.smoothness"),
    "--prior-std": ("prior.std",),
    "--prior-mean": ("prior.mean",),
}
# Sections and keys of a scene, likewise.
_KEYS = {
    ("experiment", "sides"): ("sides",),
    ("experiment", "element"): ("element",),
    ("interface", "law"): ("interface.law",),
    ("interface", "p0"): ("interface.law.pressure",),
    ("interface", "c0"): ("interface.law.clearance",),
    ("window", "law"): ("window.law",),
    ("plate", "law"): ("plate.law",),
}


def assumed_options() -> list[str]:
    """List the inputs whose option the command line does not hold."""
    given = given_options()
    return [name for option, names in _OPTIONS.items() if option not in given for name in names]


def assumed_keys(stated: Mapping[str, Any]) -> list[str]:
    """List the inputs whose key a scene does not hold.

    Args:
        stated: Content of the scene, by section.
    """
    return [name for (section, key), names in _KEYS.items() if key not in stated[section] for name in names]


def with_record(
    dataset: xr.Dataset, assumed: Iterable[str], assumptions: Iterable[str] = (), warnings: Iterable[str] = ()
) -> xr.Dataset:
    """Add to a result what made it; only types that netCDF stores.

    Args:
        dataset: What `to_xarray` returned.
        assumed: Inputs that nobody stated.
        assumptions: Sentences of what was read into a file.
        warnings: Sentences of what limits the result.
    """
    return dataset.assign_attrs(
        command=command_line(),
        assumed=json.dumps(list(assumed)),
        assumptions=json.dumps(list(assumptions)),
        warnings=json.dumps(list(warnings)),
    )
