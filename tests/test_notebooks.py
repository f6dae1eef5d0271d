"""Notebooks run from top to bottom, and what they draw and print is there."""

import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
# What each prints, as patterns.
PRINTED = {
    "decks": [
        r"2 steps; force 0\.\d+ N, then 0\.\d+ N",
        r"phase from -\d\d\.\d to -?\d+\.\d rad",
        r"CalculiX has no element|CalculiX cannot say",
        r"round trip: equal for calculix",
    ],
    "calibration": [
        r"mooney_rivlin  E0 = 18\.[12]\d kPa",
        r"without offset: E0 = 16\.\d\d kPa",
        r"E0 known to 1\.\d%, C01 to \d\d%",
        r"0\.35 mm: stretches leave the test by [1-9]",
    ],
    "explicit": [
        r"explicit: force 0\.\d+ N",
        r"pressure inside: difference 0\.\d\d%",
        r"kinetic 0\.\d\d%, missing 0\.\d+%",
    ],
    "friction": [
        r"9\d% of the samples known, std \d\.\d nm",
        r"window\.friction      0\.(19|20|21)\d*, 95 %",
        r"sample\.friction      0\.0[78]\d*, 95 %",
        r"sample\.friction is prior-dominated",
        r"error of the peak: [+-]0\.[0-2]\d\d kPa, without friction -1\.\d",
    ],
    "oct": [
        r"interface: bias [+-]0\.[0-3]\d µm, rms 0\.\d\d µm",
        r"its std: 9[0-8]% of pixels within two",
        r"pressure: difference [0-4]\.\d%",
    ],
    "stress_map": [r"force 0\.\d+ N", r"C10: [+-]\d\.\d\d % per %"],
    "traction_fit": [
        r"chi2 per degree of freedom (0\.[4-9]|1\.[012])",
        r"fit: error ([0-9]|1\d|2[0-4])\.\d% of the variation, \d\.\d% of the pressure",
        r"imprint: error",
        r"uniaxial: error",
        r"(8[5-9]|9\d)% of points inside",
    ],
    "sweep": [
        r"ended as: (slides_off )?successful",
        r"friction changes the largest pressure by [+-]\d+\.\d%",
        r"224 points, 0 failed",
        r"l0 +first order [+-]\d\.\d\d, total \d\.\d\d",
        r"largest influence: \w+",
    ],
    "virtual_experiment": [
        r"truth: 0\.02\d+ N, contrast 1\.9\d, edge 0\.3\d mm",
        r"held: error ([6-9]|1[0-2])\.\d%",
        r"slippery: error [1-4]\.\d%",
        r"fit: error [1-5]\.\d%",
        r"uniaxial: error (2\d|3[0-5])\.\d%",
        r"(8\d|9\d|100)% of places within two standard deviations",
    ],
    "verification": [
        r"uniform compression: largest difference \d\.\de-(0[7-9]|1\d)",
        r"without friction: difference \d\.\de-(0[7-9]|1\d)",
        r"transfer function: largest difference 0\.\d\d%",
        r"hybrid, 4 layers: [+-]\d\.\d%",
        r"hard contact: penetration \de-0[5-9] µm",
    ],
}


@pytest.mark.slow
@pytest.mark.timeout(1500)
@pytest.mark.parametrize("name", PRINTED)
def test_notebook_runs(name, tmp_path):
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    assert all(not cell.get("outputs") for cell in notebook.cells), "commit notebooks without outputs"
    NotebookClient(notebook, timeout=1200, resources={"metadata": {"path": tmp_path}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    pictures = [output for output in outputs if "image/png" in output.get("data", {})]
    printed = "".join(output.get("text", "") for output in outputs)
    assert len(pictures) >= 3
    for pattern in PRINTED[name]:
        assert re.search(pattern, printed), printed


def test_every_notebook_is_run():
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == set(PRINTED)
