"""Notebooks run from top to bottom, and what they draw and print is there."""

import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
# What each prints, as patterns.
PRINTED = {
    "stress_map": [r"force 0\.\d+ N", r"C10: [+-]\d\.\d\d % per %"],
    "verification": [
        r"uniform compression: largest difference \d\.\de-(0[7-9]|1\d)",
        r"without friction: difference \d\.\de-(0[7-9]|1\d)",
        r"transfer function: largest difference 0\.\d\d%",
        r"hybrid, 4 layers: [+-]\d\.\d%",
        r"hard contact: penetration \de-0[5-9] µm",
    ],
}
SLOW = {"verification": pytest.mark.slow}


@pytest.mark.parametrize("name", [pytest.param(name, marks=SLOW.get(name, ())) for name in PRINTED])
def test_notebook_runs(name, tmp_path):
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    assert all(not cell.get("outputs") for cell in notebook.cells), "commit notebooks without outputs"
    NotebookClient(notebook, timeout=500, resources={"metadata": {"path": tmp_path}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    printed = "".join(output.get("text", "") for output in outputs)
    assert len(pictures) >= 3
    for pattern in PRINTED[name]:
        assert re.search(pattern, printed), printed


def test_every_notebook_is_run():
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == set(PRINTED)
