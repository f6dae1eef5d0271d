"""What tests of README and documentation share: code blocks of a page, and the files that a reader has."""

import re
from pathlib import Path

import jax
import numpy as np
import scipy.io

import opfem as op

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def own_files() -> None:
    """Write map.mat as MATLAB does, scan.oct, and the curve compression.csv to the current folder."""
    values = np.asarray(op.datasets.example().filled().values)
    scipy.io.savemat("map.mat", {"thickness": values})
    volume = op.simulate_oct(
        op.UWA_845NM, lambda x, y: 0.42 + 0.02 * x, key=jax.random.key(0), spacing=(0.0125, 0.0125), shape=(40, 40),
        media=(op.Medium(-15.0, 0.5), op.SAMPLE),
    )  # fmt: skip
    op.write_oct(volume, "scan.oct")
    stretch = np.linspace(1.0, 0.7, 40)
    stress = 2 * (stretch - stretch**-2) * (2.23 + 0.703 / stretch)
    np.savetxt("compression.csv", np.stack([100 * (1 - stretch), stress], axis=1), delimiter=",")
