"""`opfem deck` and `--write-inp`: from a deck to its solution step by step, and from a map to a deck."""

import json
import os

import numpy as np
import pytest
from PIL import Image

import opfem as op
from tests.command_line import opfem
from tests.decks.texts import imprint_deck, stacked_deck, text
from tests.experiments import bumpy_map, inclusion_experiment, published_palpation

FILES = ("result.vtu", "pressure.png", "report.png", "report.html", "summary.json", "result.nc")


@pytest.fixture
def deck(tmp_path):
    def write(lines):
        (tmp_path / "small.inp").write_text(text(lines))
        return tmp_path / "small.inp"

    return write


@pytest.fixture
def solved(monkeypatch, solution):
    """The solve of `palpate` answers at once."""
    calls = []

    def answer(*arguments):
        calls.append(arguments)
        return solution

    monkeypatch.setattr("opfem.cli.palpate.solve", answer)
    return calls


def test_info_says_what_a_deck_states(deck, tmp_path, capsys):
    assert opfem("deck", deck(imprint_deck(steps=2)), "--info", "--out", tmp_path / "info") == 0
    said = capsys.readouterr().out
    for words in (
        "LAYER-1", "24 C3D8, x 0 to 1, y 0 to 1.5, z 0 to 0.5 mm, RUBBER", "mooney-rivlin 0.00223, 0.000703, 0",
        "LAYER-1 on IMP-1: exponential 0.01, 2", "friction 0.05",
        "explicit, 1 s, mass scaling 25, moves by up to 0.05 mm",
        "a palpation of 4 × 3 × 2 mean_dilatation elements under an imprint of 0.45 to 0.45 mm, then an imprint of 0.4",
        "D = 0 is read as a bulk modulus of 0.11732 MPa (20 shear moduli, as Abaqus/Explicit takes it)",
        "small.inp:1: *HEADING: a title.",
    ):  # fmt: skip
        assert " ".join(words.split()) in " ".join(said.split())
    with Image.open(tmp_path / "info" / "deck.png") as image:
        assert min(image.size) > 300
    assert opfem("deck", deck(stacked_deck()), "--info") == 0
    assert (
        "an experiment of 4 × 4 × 2 and 4 × 4 × 3 hybrid elements under a compression of 0.1" in capsys.readouterr().out
    )


def test_info_of_what_opfem_does_not_solve(deck, capsys):
    """The deck is told all the same; the exit status says that it is no problem for opfem."""
    lines = [line.replace("*Element, type=C3D8", "*Element, type=C3D8I") for line in imprint_deck()]
    lines = [line.replace("C3D8IR", "C3D8R") for line in lines]
    assert opfem("deck", deck(lines), "--info") == 1
    said = capsys.readouterr()
    assert "24 C3D8I" in said.out
    assert "LAYER-1 has elements C3D8I; of abaqus's opfem solves C3D8, C3D8H, C3D8R." in said.err.replace("\n", " ")


def test_steps_are_solved_in_a_row(tmp_path, capsys):
    loads = [op.Imprint(bumpy_map()), op.Imprint(bumpy_map(0.081))]
    op.write_inp(tmp_path / "two.inp", published_palpation(), loads)
    out = tmp_path / "out"
    assert opfem("deck", tmp_path / "two.inp", "--out", out) == 0
    assert sorted(os.listdir(out)) == sorted([*FILES, "step_1"])
    assert sorted(os.listdir(out / "step_1")) == sorted(FILES)
    first, last = (op.read_netcdf(folder / "result.nc") for folder in (out / "step_1", out))
    moved = last.displacement.sel(component="z") - first.displacement.sel(component="z")
    np.testing.assert_allclose(last.axial_increment, moved.transpose("z", "y", "x"), atol=1e-15)
    assert -1.1e-3 < float(last.axial_increment.min()) < -0.9e-3
    assert "axial_increment" not in first
    numbers = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert [step["step"] for step in numbers["steps"]] == ["STEP-1"]
    assert numbers["step"] == "STEP-2"
    assert numbers["force_sample_N"][2] < numbers["steps"][0]["force_sample_N"][2] < 0
    assert any("facets" in said for said in numbers["deck"]["assumed"])
    assert json.loads(last.attrs["assumptions"]) == numbers["deck"]["assumed"]
    assert opfem("deck", tmp_path / "two.inp", "--out", out) == 1
    assert "--force to replace it" in capsys.readouterr().err


WRONG = {
    "no out": ((), "--out is needed: folder of the results; or --info"),
    "increments of explicit": (("--out", "o", "--increments", 4), "--increments needs implicit statics"),
    "precision of statics": (("--out", "o", "--solver", "newton", "--precision", "float32"), "needs --solver explicit"),
    "wrong code": (("--out", "o", "--code", "calculix"), "--code calculix was passed"),
    "no such layer": (("--out", "o", "--layer", "skin"), "the soft body is LAYER-1"),
}


@pytest.mark.parametrize("what", WRONG)
def test_options_that_contradict(deck, tmp_path, monkeypatch, capsys, what):
    monkeypatch.chdir(tmp_path)
    options, words = WRONG[what]
    assert opfem("deck", deck(imprint_deck()), *options) == 1
    said = capsys.readouterr().err.splitlines()
    assert words in said[-1]
    assert all(line.endswith(" s  reading") for line in said[:-1])


def test_palpate_writes_a_deck(tmp_path, solved, capsys):
    np.save(tmp_path / "map.npy", np.asarray(bumpy_map().values))
    given = ("palpate", tmp_path / "map.npy", "--extent", 2, 2, "--l0", 0.5, "--elements", 6, 6, 2, "--smooth", 0)
    assert opfem(*given, "--out", tmp_path / "a", "--write-inp", tmp_path / "a.inp") == 0
    assert repr(op.read_inp(tmp_path / "a.inp").experiment()) == repr(published_palpation())
    assert "Wrote" in capsys.readouterr().out
    assert opfem(*given, "--out", tmp_path / "b", "--write-inp", tmp_path / "b.inp", "--code", "calculix") == 1
    assert "take --element full" in capsys.readouterr().err
    linear = ("--element", "full", "--contact-stiffness", 10, "--stick-slope", 0.1)
    assert opfem(*given, *linear, "--out", tmp_path / "c", "--write-inp", tmp_path / "c.inp", "--code", "calculix") == 0
    written = op.read_inp(tmp_path / "c.inp")
    assert written.code == "calculix"
    assert repr(written.experiment()) == repr(solved[-1][0])
    assert "linear contact of 10 MPa/mm, friction 0.15" in capsys.readouterr().out
    settings = json.loads((tmp_path / "c" / "summary.json").read_text())["settings"]
    assert (settings["contact_stiffness"], settings["stick_slope"]) == (10.0, 0.1)
    assert opfem(*given, "--stick-slope", 0.1, "--out", tmp_path / "d") == 1
    assert "--stick-slope needs --contact-stiffness" in capsys.readouterr().err


def test_simulate_writes_a_deck(tmp_path, monkeypatch, truth):
    from tests.cli.test_simulate import SCENE

    monkeypatch.setattr("opfem.cli.simulate.solve", lambda *_: truth)
    (tmp_path / "scene.toml").write_text(SCENE)
    given = ("simulate", tmp_path / "scene.toml", "--out", tmp_path / "out", "--write-inp", tmp_path / "scene.inp")
    assert opfem(*given) == 0
    deck = op.read_inp(tmp_path / "scene.inp")
    law = deck.experiment().sample_material()
    np.testing.assert_allclose(law.c10, inclusion_experiment().sample_material().c10)
    assert float(deck.loads()[0].approach) == pytest.approx(0.2)
