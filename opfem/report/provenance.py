"""Where a report comes from, and what to cite: versions, the hash of the inputs, the command line, the papers."""

import json
from datetime import UTC, datetime

import xarray as xr

from .inputs import COMMAND

PAPERS = (
    "Kennedy et al., Optical palpation: optical coherence tomography-based tactile imaging using a compliant "
    "sensor, Optics Letters 39, 3014 (2014): the layer as a sensor of stress.",
    "P. Wijesinghe, D. D. Sampson and B. F. Kennedy, Computational optical palpation: a finite-element approach to "
    "micro-scale tactile imaging using a compliant sensor, J. R. Soc. Interface 14, 20160878 (2017), "
    "doi:10.1098/rsif.2016.0878: its mechanics by finite elements.",
    "Jones, Fang and Kennedy, J. Biophotonics (2024): measures of contrast and resolution, and friction.",
)


def provenance_rows(dataset: xr.Dataset) -> list[tuple[str, str]]:
    """Lay out what made a result: names and values.

    Args:
        dataset: What `to_xarray` returned.
    """
    attrs = dataset.attrs
    versions = ", ".join(
        f"{name.removesuffix('_version')} {attrs[name]}"
        for name in sorted(attrs, reverse=True)
        if name.endswith("_version")
    )
    steps = " → ".join(step["step"] for step in json.loads(attrs.get("thickness_steps", "[]")))
    rows = [
        ("Command line", attrs.get(COMMAND, "made in Python")),
        ("Versions", versions),
        ("Inputs, SHA-256", attrs.get("inputs_sha256", "not recorded")),
        ("Map", steps),
        ("Conventions", attrs.get("conventions", "")),
        ("Report written", datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")),
    ]
    return [(name, value) for name, value in rows if value]


def citation(dataset: xr.Dataset) -> str:
    """Say how to cite the program."""
    return f"opfem {dataset.attrs.get('opfem_version', '')}: optical palpation by differentiable finite elements."
