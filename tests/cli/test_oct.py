"""`opfem oct` from volumes to files, and `opfem palpate` of a volume in one go."""

import json
import os

import jax
import numpy as np
import pytest
from PIL import Image

import opfem as op
from opfem.cli.oct import FILES
from tests.command_line import opfem


@pytest.fixture(scope="module")
def volumes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("volumes")
    for seed, (name, surface) in enumerate(
        {"loaded": lambda x, y: 0.25 + 0.05 * x, "unloaded": lambda x, y: np.full_like(x, 0.3)}.items()
    ):
        volume = op.simulate_oct(
            op.UWA_845NM, surface, key=jax.random.key(seed), spacing=(0.0125, 0.0125), shape=(40, 48), depth=0.42,
            media=(op.Medium(-15.0, 0.5), op.SAMPLE),
        )  # fmt: skip
        op.write_oct(volume, folder / f"{name}.oct")
    return folder


def test_from_volumes_to_maps(volumes, tmp_path, capsys):
    mask = np.zeros((40, 48), np.uint8)
    mask[:6, :7] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    out = tmp_path / "out"
    given = ("--unloaded", volumes / "unloaded.oct", "--mask", tmp_path / "mask.png", "--edge", "brighter")
    assert opfem("oct", volumes / "loaded.oct", *given, "--out", out) == 0
    assert sorted(os.listdir(out)) == sorted(FILES)
    loaded, unloaded = (op.read_thickness(out / f"{name}.npz") for name in ("thickness", "unloaded"))
    np.testing.assert_allclose(loaded.spacing, 0.0125)
    assert np.asarray(loaded.mask)[:6, :7].all()
    kept = ~np.asarray(loaded.mask)
    error = np.asarray(loaded.values) - (0.25 + 0.05 * np.asarray(loaded.x))
    assert np.sqrt(np.mean(error[kept] ** 2)) < 1.5e-3
    assert abs(np.median(unloaded.values) - 0.3) < 1e-3
    numbers = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert numbers["strain_median"] == pytest.approx(np.median(np.asarray(loaded.values)[kept]) / 0.3 - 1, abs=5e-3)
    assert numbers["edge_shares"] == {"brighter": 1.0}
    for picture in ("bscans.png", "maps.png"):
        with Image.open(out / picture) as image:
            assert min(image.size) > 500
    assert "bscans.png first" in capsys.readouterr().out
    # A finished result is not replaced unasked.
    assert opfem("oct", volumes / "loaded.oct", "--out", out) == 1
    assert "Pass --force" in capsys.readouterr().err


def test_palpate_takes_a_volume(volumes, tmp_path, capsys):
    given = ("--l0", volumes / "unloaded.oct", "--elements", 6, 6, 2, "--out", tmp_path / "stress")
    assert opfem("palpate", volumes / "loaded.oct", *given) == 0
    dataset = op.read_netcdf(tmp_path / "stress" / "result.nc")
    assert "find_interface" in dataset.attrs["thickness_steps"]
    assert float(dataset.pressure.max()) > 0
    assert opfem("palpate", volumes / "loaded.oct", *given[:-2], "--spacing", 0.01, "--out", tmp_path / "b") == 1
    assert "knows its grid and noise; leave out --spacing" in capsys.readouterr().err


def test_what_is_wrong_is_said_in_one_line(volumes, tmp_path, capsys):
    (tmp_path / "a.raw").write_bytes(b"\1" * 4000)
    assert opfem("oct", tmp_path / "a.raw", "--out", tmp_path / "o") == 1
    said = capsys.readouterr().err
    assert "a.raw: needs" in said
    assert said.count("opfem: ") == 1
    assert opfem("oct", volumes / "loaded.oct", "--search", 0.05, 0.12, "--out", tmp_path / "o") == 1
    said = capsys.readouterr().err
    assert "No interface" in said
    assert "--edge" in said
    assert opfem("oct", volumes / "loaded.oct", "--l0", 0.5, "--unloaded", "x.oct", "--out", tmp_path / "o") == 1
    assert "leave one out" in capsys.readouterr().err


def test_displacement_from_phase(tmp_path, capsys):
    pair = op.simulate_oct(
        op.UWA_845NM, lambda x, y: np.full_like(x, 0.3), key=jax.random.key(0), spacing=(0.01, 0.01), shape=(12, 16),
        depth=0.3, increment=lambda x, y, z: (0 * z, 0 * z, -1e-3 * z), media=(op.Medium(0.0, 0.5), op.SAMPLE),
    )  # fmt: skip
    for name, volume in zip(("before", "after"), pair, strict=True):
        op.write_oct(volume, tmp_path / f"{name}.h5")
    out = tmp_path / "out"
    assert opfem("oct", "--phase", tmp_path / "before.h5", tmp_path / "after.h5", "--out", out) == 0
    numbers = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert numbers["strain_median"] == pytest.approx(-1e-3, rel=0.02)
    with np.load(out / "displacement.npz") as stored:
        assert stored["values"].shape == pair[0].shape
    assert (out / "displacement.png").is_file()
    assert opfem("oct", "--out", tmp_path / "none") == 1
    assert "either LOADED or --phase" in capsys.readouterr().err
