"""How the command line reads maps: each option reaches the reader, and what the reader finds odd is said."""

import numpy as np
import PIL.Image
import pytest
import tifffile

from opfem.cli import main, statement
from opfem.cli.options import MapOptions
from opfem.cli.statement import read_maps

COUNTS = np.random.default_rng(0).integers(400, 470, (6, 11)).astype("u2")


@pytest.fixture
def told(monkeypatch):
    """The reader notes what it is asked, and refuses."""
    asked = []

    def note(path, **how):
        asked.append(how)
        raise ValueError("far enough")

    monkeypatch.setattr(statement, "read_thickness", note)
    return asked


@pytest.fixture
def path(tmp_path):
    np.save(tmp_path / "map.npy", COUNTS)
    return tmp_path / "map.npy"


@pytest.mark.parametrize(
    ("options", "argument", "value"),
    [
        (("--spacing", "0.01"), "spacing", 0.01),
        (("--spacing", "0.01", "0.02"), "spacing", (0.01, 0.02)),
        (("--missing", "0"), "missing", (0.0,)),
        (("--missing", "-1"), "missing", (-1.0,)),
        (("--missing", "0,65535,-9.9e3"), "missing", (0.0, 65535.0, -9900.0)),
        (("--missing", "none"), "missing", "none"),
        (("--mask", "bad.png"), "mask", "bad.png"),
        (("--scale", "2.93"), "scale", 2.93),
        (("--max-missing", "0.7"), "max_missing", 0.7),
        (("--max-bytes", "1000"), "max_bytes", 1000),
        (("--variable", "scan.thickness"), "variable", "scan.thickness"),
    ],
)
def test_options_reach_the_reader(tmp_path, path, told, options, argument, value):
    (tmp_path / "bad.png").touch()
    options = [str(tmp_path / option) if option == "bad.png" else option for option in options]
    value = str(tmp_path / value) if value == "bad.png" else value
    with pytest.raises(SystemExit):
        main(["palpate", str(path), *options, "--l0", "0.5", "--out", str(tmp_path / "o")])
    assert told[0][argument] == value


@pytest.mark.parametrize("command", ["palpate", "fit"])
def test_missing_that_is_no_number(tmp_path, path, told, command, capsys):
    with pytest.raises(SystemExit):
        main([command, str(path), "--missing", "zero", "--l0", "0.5", "--out", str(tmp_path / "o")])
    assert (
        "--missing must be numbers of the file with commas between them, or none, got 'zero'" in capsys.readouterr().err
    )
    assert told == []


@pytest.mark.parametrize(
    ("stated", "argument", "value"),
    [
        ("spacing = 0.5", "spacing", 0.5),
        ("spacing = [0.5, 0.25]", "spacing", (0.5, 0.25)),
        ("missing = 0", "missing", (0.0,)),
        ('missing = "0,-1"', "missing", (0.0, -1.0)),
        ("scale = 2.5", "scale", 2.5),
        ('mask = "bad.npy"', "mask", "bad.npy"),
    ],
)
def test_options_of_a_sweep_reach_the_reader(tmp_path, path, told, stated, argument, value):
    np.save(tmp_path / "bad.npy", COUNTS < 0)
    config = f'[inputs]\nmap = "map.npy"\nl0 = 0.5\n{stated}\n[axes]\np0 = [1.0]\n[outputs]\nkeep = ["pressure"]\n'
    (tmp_path / "sweep.toml").write_text(config)
    with pytest.raises(SystemExit):
        main(["sweep", str(tmp_path / "sweep.toml"), "--out", str(tmp_path / "o")])
    assert told[0][argument] == (str(tmp_path / value) if value == "bad.npy" else value)


def test_one_spacing_is_that_of_both_axes(path):
    read, _ = read_maps(str(path), MapOptions(l0="0.5", spacing=(0.5,), unit="um"))
    np.testing.assert_allclose(read.extent, (5.0, 2.5))
    read, _ = read_maps(str(path), MapOptions(l0="0.5", spacing=(0.5, 0.25), unit="um"))
    np.testing.assert_allclose(read.extent, (5.0, 1.25))


def test_mask_is_of_the_loaded_map_alone(tmp_path, path):
    mask = np.zeros(COUNTS.shape, "u1")
    mask[2, 3:6] = 255
    PIL.Image.fromarray(mask).save(tmp_path / "bad.png")
    np.save(tmp_path / "l0.npy", np.full(COUNTS.shape, 500))
    options = MapOptions(l0=str(tmp_path / "l0.npy"), spacing=(0.5,), unit="um", mask=str(tmp_path / "bad.png"))
    loaded, unloaded = read_maps(str(path), options)
    assert np.argwhere(loaded.mask).tolist() == [[2, 3], [2, 4], [2, 5]]
    assert not unloaded.mask.any()


def test_what_is_odd_is_said(tmp_path, capsys):
    counts = COUNTS.copy()
    counts[2, 2:6] = 500
    np.save(tmp_path / "map.npy", counts)
    read_maps(str(tmp_path / "map.npy"), MapOptions(l0="0.5", extent=(5.0, 4.0), unit="um"))
    said = capsys.readouterr().err.splitlines()
    assert "4 of 66 pixels hold exactly 500, apart from the others" in said[0] + said[1]
    assert "the 11 × 6 pixels 0.5 × 0.8 mm large, not square" in said[0] + said[1]


def test_pixel_size_of_the_file_is_used_and_said(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", COUNTS, imagej=True, resolution=(0.05, 0.05), metadata={"unit": "um"})
    read, _ = read_maps(str(tmp_path / "a.tif"), MapOptions(l0="0.5", unit="um"))
    np.testing.assert_allclose(read.spacing, (0.02, 0.02), rtol=1e-6)
    assert statement._pixel(read) == "20 × 20 µm (as the file says)"
    assert statement._pixel(read.smoothed(0.05)) == "20 × 20 µm (as the file says)"


@pytest.mark.parametrize("option", [{"missing": "0"}, {"mask": "a.png"}, {"scale": 2.0}])
def test_example_takes_none_of_it(option):
    with pytest.raises(ValueError, match=f"The example knows its own grid; leave out --{next(iter(option))}"):
        read_maps("example", MapOptions(**option))
