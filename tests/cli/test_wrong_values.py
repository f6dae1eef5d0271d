"""Every option of every command with a wrong value: the message names option, unit, what is expected and what it got.

The table is held against the options that the commands have, so that none is left out. Nothing is solved.
"""

import re

import numpy as np
import pytest

from opfem import cli
from opfem.cli.commands import app
from opfem.cli.messages import alike, in_options
from tests.decks.texts import imprint_deck, text

MAP = ("--l0", "0.5", "--extent", "2", "2")
A_NUMBER = "must be a positive number"
COUNT = "must be a whole number of at least 1"
# Option, wrong value, unit, expected, got; what else must be given.
MAPS = [
    ("--l0", "-0.5", "mm", f"{A_NUMBER}, or the path of a map", "-0.5"),
    ("--l0", "nan", "mm", f"{A_NUMBER}, or the path of a map", "nan"),
    ("--l0", "0,5", "mm", f"{A_NUMBER}, or the path of a map", "'0,5': there is no such file"),
    ("--l0", "none.npy", "mm", f"{A_NUMBER}, or the path of a map", "'none.npy': there is no such file"),
    ("--extent", "2 -2", "mm", "must be two positive numbers", "2 -2"),
    ("--extent", "2 wide", "mm", "must be two positive numbers", "'2 wide'"),
    ("--extent", "2", "mm", "must be two positive numbers", "2"),
    ("--spacing", "0", "mm", "must be one positive number, or two", "0"),
    ("--spacing", "0.1 -0.1", "mm", "must be one positive number, or two", "0.1 -0.1"),
    ("--scale", "0", "µm", A_NUMBER, "0"),
    ("--missing", "0,hole", None, "must be numbers of the file with commas between them, or none", "'0,hole'"),
    ("--mask", "none.png", None, "must be the path of an image or array", "'none.png': there is no such file"),
    ("--max-missing", "1.5", "1", "must be a number from 0 to 1", "1.5"),
    ("--max-bytes", "0", "bytes", COUNT, "0"),
    ("--max-bytes", "1.5", "bytes", COUNT, "'1.5'"),
    ("--spacing", "inf", "mm", "must be one positive number, or two", "inf"),
    ("--unit", "inch", None, "must be one of mm, um, µm, m", "'inch'"),
    ("--std", "0", "mm", A_NUMBER, "0"),
    ("--variable", "none", None, "map.npy: holds no --variable", "'none'"),
    ("--l0-variable", "none", None, "--l0 map.npy: holds no --l0-variable", "'none'"),
    ("--smooth", "-1", "mm", "must be zero or a positive number", "-1"),
    ("--smooth", "much", "mm", "must be zero or a positive number", "'much'"),
]
LAYER = [
    ("--c10", "nan", "MPa", "must be a number", "nan"),
    ("--c01", "soft", "MPa", "must be a number", "'soft'"),
    ("--bulk", "0", "MPa", f"{A_NUMBER}, or inf", "0"),
    ("--bulk", "-inf", "MPa", f"{A_NUMBER}, or inf", "-inf"),
    ("--layer-extent", "0 2", "mm", "must be two positive numbers", "0 2"),
    ("--elements", "6 6 0", "1", "must be three whole numbers of at least 1", "6 6 0"),
    ("--elements", "6.4 6 2", "1", "must be three whole numbers of at least 1", "'6.4 6 2'"),
    ("--elements", "6 6", "1", "must be three whole numbers of at least 1", "6 6"),
    ("--sides", "glued", None, "must be one of free, roller", "'glued'"),
    ("--element", "hexahedron", None, "must be one of mean_dilatation, full, reduced, hybrid", "'hexahedron'"),
]
CONTACT = [
    ("--window-friction", "-0.1", "1", "must be zero or a positive number", "-0.1"),
    ("--sample-friction", "inf", "1", "must be zero or a positive number", "inf"),
    ("--p0", "0", "MPa", A_NUMBER, "0"),
    ("--c0", "-0.01", "mm", A_NUMBER, "-0.01"),
]
SOLVER = [
    ("--solver", "abaqus", None, "must be one of newton, explicit", "'abaqus'"),
    ("--increments", "0", "1", COUNT, "0"),
    ("--increments", "2.5", "1", COUNT, "'2.5'"),
    ("--duration", "0", "s", A_NUMBER, "0"),
    ("--mass-scaling", "-25", "1", A_NUMBER, "-25"),
    ("--precision", "half", None, "must be one of float32, float64", "'half'"),
    ("--checkpoint", "run.txt", None, "must be a .npz file in a folder that exists", "'run.txt'"),
    ("--checkpoint", "none/run.npz", None, "must be a .npz file in a folder that exists", "'none/run.npz'"),
]
FLAGS = [(f"--{name}=maybe", None, None, "must be given without a value", "'maybe'") for name in ("force", "debug")]
FLAGS += [("--no-cache=maybe", None, None, "must be given without a value", "'maybe'")]
FILES = [
    ("--also", "xls", None, "must be one of csv, tiff, mat", "'xls'"),
    *((f"--{name}=maybe", *FLAGS[0][1:]) for name in ("pdf", "svg", "report", "no-report")),
]
OUT = [("--out", "a_file", None, "Cannot write results to", "a_file")]
FIT = [
    ("--prior-length", "0", "mm", A_NUMBER, "0"),
    ("--prior-std", "-1", "MPa", A_NUMBER, "-1"),
    ("--prior-mean", "inf", "MPa", "must be a number", "inf"),
    ("--hyperparameters", "evidnce", None, "must be one of given, discrepancy, evidence", "'evidnce'"),
    ("--nonnegative=maybe", None, None, "must be given without a value", "'maybe'"),
    ("--model-std", "-1", "mm", "must be zero or a positive number", "-1"),
    ("--friction-spread", "0", "1", A_NUMBER, "0"),
    ("--modulus-spread", "wide", "1", A_NUMBER, "'wide'"),
    ("--draws", "0", "1", COUNT, "0"),
    ("--draws", "many", "1", COUNT, "'many'"),
]
APPROACH = [("--correct-approach=maybe", None, None, "must be given without a value", "'maybe'")]
WRITE = [
    ("--write-inp", "layer.txt", None, "must be a .inp file in a folder that exists", "'layer.txt'"),
    ("--code", "ansys", None, "must be one of abaqus, calculix", "'ansys'"),
    ("--contact-stiffness", "0", "MPa/mm", A_NUMBER, "0"),
    ("--stick-slope", "-1", "MPa/mm", A_NUMBER, "-1"),
]
DECK = [
    WRITE[1],
    ("--bulk", "0", "MPa", A_NUMBER, "0"),
    ("--layer", "skin", None, "the soft body is", "LAYER-1"),
    ("--interpolation", "linear", None, "must be one of cubic, catmull-rom, bilinear", "'linear'"),
    ("--solver", "abaqus", None, "must be one of deck, newton, explicit", "'abaqus'"),
    *SOLVER[1:3],
    ("--precision", "half", None, "must be one of float32, float64", "'half'"),
    ("--info=maybe", None, None, "must be given without a value", "'maybe'"),
]
TABLE = {
    "palpate": [*MAPS, *LAYER, *CONTACT, *APPROACH, *SOLVER, *WRITE, *FILES, *FLAGS, *OUT],
    "deck": [*DECK, *FILES, *FLAGS, *OUT],
    "fit": [*MAPS, *LAYER, *CONTACT, *FIT, *SOLVER[1:3], *FILES, *FLAGS, *OUT],
    "demo": [*SOLVER, *FILES, *FLAGS, *OUT, ("--coin=maybe", None, None, "must be given without a value", "'maybe'")],
    "sweep": [*FILES[1:3], *FLAGS, *OUT, ("--resume=maybe", None, None, "must be given without a value", "'maybe'")],
}
ROWS = [(command, *row) for command, rows in TABLE.items() for row in rows]
CONFIG = (
    '[inputs]\nmap = "map.npy"\nextent = [2.0, 2.0]\nl0 = 0.5\n[axes]\np0 = [1.0]\n[outputs]\nkeep = ["pressure"]\n'
)


# Refused once a file or folder was looked at, not by the option alone.
LATE = ("--out", "--variable", "--l0-variable", "--missing", "--layer")


def accepted(*_, **__):
    raise AssertionError("the wrong value was accepted")


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run a command on a good map, and return its status and what it said."""
    monkeypatch.chdir(tmp_path)
    for name in ("palpate.solve", "deck.solve", "fit.fit_traction", "sweep.compute"):
        monkeypatch.setattr(f"opfem.cli.{name}", accepted)
    np.save("map.npy", np.full((17, 21), 0.45))
    (tmp_path / "a_file").write_text("")
    (tmp_path / "sweep.toml").write_text(CONFIG)
    (tmp_path / "layer.inp").write_text(text(imprint_deck()))

    def run(command, *arguments):
        files = {"palpate": ["map.npy"], "fit": ["map.npy"], "sweep": ["sweep.toml"], "deck": ["layer.inp"], "demo": []}
        with pytest.raises(SystemExit) as end:
            cli.main([command, *files[command], *arguments])
        return end.value.code, capsys.readouterr().err

    return run


def value_of(value: str | None) -> list[str]:
    return [] if value is None else value.split()


@pytest.mark.parametrize(("command", "option", "value", "unit", "expected", "got"), ROWS)
def test_wrong_value(run, command, option, value, unit, expected, got):
    given = {"--l0": MAP[2:], "--l0-variable": ("--l0", "map.npy", *MAP[2:]), "--extent": MAP[:2]}.get(option, MAP)
    given = (*given, "--std", "0.002") if command == "fit" and option != "--std" else given
    out = () if option == "--out" else ("--out", "out")
    status, said = run(command, *(given if command in ("palpate", "fit") else ()), *out, option, *value_of(value))
    assert status == (1 if option in LATE else 2)
    message = said.splitlines()[-1]
    assert message.startswith("opfem: ")
    assert option.partition("=")[0] in message
    assert unit is None or f"[{unit}]" in message
    assert expected in message
    assert got in message.partition(expected)[2]
    assert not re.search(r"Traceback|\b[A-Z]\w+\.[a-z]\w*\b|\w=", said)  # no field or argument of Python


def arguments_of(command: str):
    return app[command].assemble_argument_collection(default_parameter=app.default_parameter)


def test_no_option_is_left_out():
    for command, rows in TABLE.items():
        options = {name for argument in arguments_of(command) for name in argument.names}
        assert {row[0].partition("=")[0] for row in rows} == {name for name in options if name.startswith("--")}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("palpate", *MAP, "--out", "o", "--frction", "3"), "Did you mean --window-friction or --sample-friction?"),
        (("palpate", *MAP, "--out", "o", "--elemnts", "3"), "Did you mean --elements?"),
        (("palpate", *MAP, "--out", "o", "--tolerance", "3"), "There is no option --tolerance. See opfem palpate"),
        (("fit", *MAP, "--out", "o", "--correct-approach"), "There is no option --correct-approach."),
        (("fit", *MAP, "--out", "o", "--element", "tet4"), "--element must be one of mean_dilatation, full, reduced"),
        (("fit", *MAP, "--out", "o"), "--std [mm] is needed"),
        (("palpate", *MAP), "--out is needed: Folder of the results."),
        (("palpate", *MAP, "--out"), "--out"),
        (("palpate", "again.npy", *MAP, "--out", "o"), "opfem palpate has no place for 'again.npy'"),
        (("palpate", *MAP, "--out", "o", "--p0", "1", "--p0", "2"), "--p0 must be given once, got it twice"),
        (("palpate", *MAP, "--out", "o", "--duration", "2"), "--duration needs --solver explicit, got --solver newton"),
        (("palpate", *MAP, "--out", "o", "--precision", "float32"), "--precision float32 needs --solver explicit"),
        (("palpate", *MAP, "--out", "o", "--unit", "um"), "Pass --unit mm."),
        (("palpate", *MAP, "--out", "o", "--spacing", "0.1"), "either --extent Lx Ly or --spacing dx dy"),
        (("palpate", *MAP, "--out", "o", "--smooth", "3"), "--smooth [mm] must be at most half"),
        (("palpate", *MAP, "--out", "o", "--bulk", "inf"), "pass --element hybrid"),
        (("palpate", *MAP, "--out", "o", "--element", "tet10", "--elements", "3", "3", "3"), "--elements must be even"),
        (("palpate", *MAP, "--out", "o", "--l0-variable", "L0"), "--l0-variable needs the path of a map in --l0, got"),
    ],
)
def test_what_is_missing_or_does_not_go_together(run, arguments, said):
    status, message = run(*arguments)
    assert status in (1, 2)
    assert said in message
    assert not re.search(r"Traceback|\b[A-Z]\w+\.[a-z]\w*\b|\w=", message)


def test_commands_are_suggested(capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["palpat", "map.npy"])
    assert end.value.code == 2
    assert "There is no command palpat. Did you mean palpate?" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["palpate", "fit", "sweep", "demo"])
def test_every_command_and_option_is_described(command):
    assert len(app[command].help.split()) > 4
    for argument in arguments_of(command):
        assert argument.parameter.help or argument.children, argument.name


@pytest.mark.parametrize(
    ("message", "said"),
    [
        ('Pass unit="um".', "Pass --unit um."),
        ("needs extent=(Lx, Ly) or spacing=(dx, dy)", "needs --extent Lx Ly or --spacing dx dy"),
        (
            "above max_missing=0.5; pass a larger max_missing= if",
            "above --max-missing 0.5; pass a larger --max-missing if",
        ),
        ('pass missing=9999, or missing="none"', "pass --missing 9999, or --missing none"),
        ("pass variable= to name one of: a, b", "pass --variable to name one of: a, b"),
        ("Layer.thickness [mm] must be positive, got -0.5.", "--l0 [mm] must be positive, got -0.5."),
        ("Contact.friction [1] is", "--window-friction or --sample-friction [1] is"),
        ("or Palpation(elements=...) with more", "or --elements with more"),
        ("Matern.length [mm] must be at least an element", "--prior-length [mm] must be at least an element"),
        ("Newton.increments must", "--increments must"),
        ("/data/extent=3/map.npy: no such file", "/data/extent=3/map.npy: no such file"),
        ("status (residual = 3)", "status (residual = 3)"),
    ],
)
def test_arguments_in_options(message, said):
    assert in_options(message) == said


def test_names_that_are_alike():
    names = ["window-friction", "sample-friction", "duration", "l0", "l0-variable", "std", "prior-std"]
    assert alike("frction", names) == ["window-friction", "sample-friction"]
    assert alike("durtion", names) == ["duration"]
    assert alike("zzz", names) == []
