"""`opfem calibrate` from files of a load frame to a law."""

import json

import numpy as np
import pytest
import xarray as xr
from PIL import Image

from opfem.cli.calibrate import FILES
from tests.command_line import opfem


@pytest.fixture
def curve(tmp_path):
    strain = np.linspace(0.0, 0.4, 41)
    stretch = 1.0 - strain
    stress = 2 * 3.0 * (stretch - stretch**-2) - 0.05  # kPa
    np.savetxt(tmp_path / "a.csv", np.stack([100 * strain, stress], axis=1), delimiter=",", header="strain,stress")
    return tmp_path / "a.csv"


def test_a_law_from_a_file(curve, tmp_path, capsys):
    out = tmp_path / "out"
    assert opfem("calibrate", curve, "--law", "neo_hooke", "--bulk-ratio", 1e6, "--out", out) == 0
    numbers = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert numbers["numbers"] == pytest.approx({"c10": 3e-3, "offset": -5e-5}, rel=1e-4)
    assert numbers["bulk"] == pytest.approx(6e-3 * 1e6, rel=1e-4)
    assert numbers["stretches"] == pytest.approx([0.6, 1.0])
    assert sorted(path.name for path in out.iterdir()) == sorted(FILES)
    with xr.open_dataset(out / "result.nc") as data:
        np.testing.assert_allclose(data.fitted, data.nominal, atol=1e-8)
    with Image.open(out / "calibration.png") as image:
        assert min(image.size) > 500
    assert "c10" in capsys.readouterr().out
    assert opfem("calibrate", curve, "--out", out) == 1
    assert "--force" in capsys.readouterr().err


def test_drawings_come_and_go_with_the_result(curve, tmp_path):
    out = tmp_path / "out"
    assert opfem("calibrate", curve, "--svg", "--out", out) == 0
    assert sorted(path.name for path in out.iterdir()) == sorted([*FILES, "calibration.svg"])
    assert opfem("calibrate", curve, "--pdf", "--out", out, "--force") == 0
    assert sorted(path.name for path in out.iterdir()) == sorted([*FILES, "calibration.pdf"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--law", "mooney"), "--law must be one of neo_hooke"),
        (("--strain", "1"), "Pass --strain %"),
        (("--sign", "tension", "--columns", "0", "7"), "no column 7"),
        (("--platens", "bonded"), "needs --diameter"),
        (("--bulk-ratio", "0.5"), "--bulk-ratio"),
    ],
)
def test_what_is_wrong_is_said_in_options(curve, tmp_path, capsys, options, message):
    assert opfem("calibrate", curve, *options, "--out", tmp_path / "out") in (1, 2)
    assert message in capsys.readouterr().err
