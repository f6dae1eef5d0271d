"""`opfem simulate`: from a scene to map, truth and pictures that other commands take; what is wrong with a scene."""

import json
import os

import jaxtyping
import numpy as np
import pytest

import opfem as op
from opfem.cli.scene import read_scene
from tests.command_line import opfem
from tests.experiments import inclusion_experiment

SCENE = """
[layer]
thickness = 0.5
c10 = 2.23e-3
c01 = 7.03e-4
bulk = 0.11732

[sample]
thickness = 1.0
c10 = 3e-3
bulk = 0.12

[[inclusion]]
shape = "cylinder"
centre = [0.8, 1.1]
radius = 0.45
depth = [0.2, 0.7]
c10 = 2e-2
bulk = 0.8

[experiment]
extent = [2.0, 2.0]
elements = [[6, 6, 2], [5, 5, 4]]

[window]
friction = 0.15

[interface]
friction = 0.05

[plate]
friction = 0.15

[compression]
approach = 0.2

[measurement]
pixel = 0.05
std = 0.002
seed = 3
"""
FILES = ("map.npz", "result.vtu", "section.png", "report.png", "report.html", "summary.json", "result.nc")


@pytest.fixture
def scene(tmp_path):
    def write(text: str = SCENE, **changes: str):
        for old, new in changes.items():
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "scene.toml").write_text(text, encoding="utf-8")
        return tmp_path / "scene.toml"

    return write


@pytest.fixture
def solved(monkeypatch, truth):
    """The solve answers at once."""
    calls = []

    def answer(experiment, load, solver):
        calls.append((experiment, load, solver))
        return truth

    monkeypatch.setattr("opfem.cli.simulate.solve", answer)
    return calls


def test_a_scene_states_an_experiment(scene):
    stated = read_scene(scene())
    assert repr(stated.experiment) == repr(inclusion_experiment())
    assert repr(stated.load) == "Compression(approach=0.2 mm)"
    assert stated.measurement == (0.05, 0.002, 3)


def test_from_scene_to_map_and_back(scene, tmp_path, solved, truth, capsys):
    out = tmp_path / "out"
    assert opfem("simulate", scene(), "--out", out) == 0
    assert sorted(os.listdir(out)) == sorted(FILES)
    assert repr(solved[0][0]) == repr(inclusion_experiment())
    printed = capsys.readouterr().out
    assert "--l0 0.5 --c10 0.00223 --c01 0.000703 --bulk 0.11732" in printed

    dataset = op.read_netcdf(out / "result.nc")
    np.testing.assert_array_equal(dataset.pressure, truth.pressure)
    measured = op.read_thickness(out / "map.npz")
    assert measured.shape == (41, 41)
    assert float(measured.std) == 0.002
    off = np.asarray(measured.values) - np.asarray(op.measured_thickness(truth, 0.05).values)
    assert 0.0018 < off[~np.asarray(measured.mask)].std() < 0.0022
    numbers = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert numbers["force_plate_N"] == truth.stats["force_plate"].tolist()
    assert numbers["scene"]["inclusion"][0]["radius"] == 0.45

    same = ("--l0", 0.5, "--elements", 6, 6, 2, "--smooth", 0.2, "--out", tmp_path / "imprint")
    assert opfem("palpate", out / "map.npz", *same) == 0
    imprint = op.read_netcdf(tmp_path / "imprint" / "result.nc")
    force, true = (float(data.force_sample.sel(component="z")) for data in (imprint, dataset))
    assert force == pytest.approx(true, rel=0.1)

    assert opfem("simulate", scene(), "--out", out) == 1
    assert "--force to replace it" in capsys.readouterr().err


def test_what_a_failed_solve_leaves(scene, tmp_path, monkeypatch, truth, capsys):
    def fail(*_):
        raise op.ConvergenceError("The solve stopped at 40% of the load.", truth)

    monkeypatch.setattr("opfem.cli.simulate.solve", fail)
    assert opfem("simulate", scene(), "--out", tmp_path / "out") == 1
    assert "stopped at 40%" in capsys.readouterr().err
    assert os.listdir(tmp_path / "out") == ["summary.json"]


def test_maps_of_layer_and_sample_lie_beside_the_scene(scene, tmp_path, solved):
    uneven = op.ThicknessMap(0.5 + 0.01 * np.random.default_rng(0).random((9, 9)), extent=(2.0, 2.0))
    op.write_thickness(uneven, tmp_path / "layer.npz")
    np.save(tmp_path / "sample.npy", np.full((5, 5), 1.1))
    path = scene(**{"thickness = 0.5": 'thickness = "layer.npz"', "thickness = 1.0": 'thickness = "sample.npy"'})
    assert opfem("simulate", path, "--out", tmp_path / "out") == 0
    ((experiment, _, _),) = solved
    np.testing.assert_array_equal(experiment.layer.thickness.values, uneven.values)
    assert float(experiment.sample.thickness.extent[0]) == 2.0
    unloaded = op.read_thickness(tmp_path / "out" / "l0.npz")
    assert unloaded.shape == op.read_thickness(tmp_path / "out" / "map.npz").shape


def test_faces_laws_and_shapes(scene):
    changes = {
        "[window]\nfriction = 0.15": '[window]\nkind = "bonded"',
        "[plate]\nfriction = 0.15": '[plate]\nlaw = "linear"\nstiffness = 7.0\nfriction = 0.0\nstick_slope = 0.1',
        "[interface]\nfriction = 0.05": '[interface]\nlaw = "hard"\nexact = true\nfriction = 0.1',
        'shape = "cylinder"\ncentre = [0.8, 1.1]\nradius = 0.45\ndepth = [0.2, 0.7]': 'shape = "half_space"\n'
        "point = [1.0, 0, 0]\nnormal = [1, 0, 0]",
        "extent = [2.0, 2.0]": 'extent = [2, 2]\nsides = { x0 = "roller" }\nelement = ["hybrid", "full"]\nhold = 1e-3',
        "seed = 3": "seed = 3\n[solver]\nincrements = 5\n[pictures]\ny = 0.7",
    }
    stated = read_scene(scene(**changes))
    made = stated.experiment
    assert isinstance(made.window, op.Bonded)
    assert repr(made.plate.law) == "LinearOverclosure(stiffness=7 MPa/mm)"
    assert made.plate.stick_slope == 0.1
    assert made.interface.law.exact
    assert isinstance(made.sample.inclusions[0][0], op.HalfSpace)
    assert made.sides[0] == "roller"
    assert made.element == ("hybrid", "full")
    assert (stated.increments, stated.section) == (5, 0.7)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[plate]", "[plait]", "got 'plait'. Did you mean 'plate'?"),
        ("[plate]\nfriction = 0.15", "", "needs [plate]."),
        ("approach = 0.2", "", "needs [compression] with approach = ..."),
        ("radius = 0.45", "raduis = 0.45", "[[inclusion]] 1 must be one of"),
        ("radius = 0.45", "", "[[inclusion]] 1: a cylinder has centre, radius, depth, got centre, depth."),
        ("radius = 0.45", "radius = -0.45", "[[inclusion]] 1 radius [mm] must be positive, got -0.45."),
        ('shape = "cylinder"', 'shape = "tube"', "shape must be one of cylinder, sphere, box, half_space, got 'tube'"),
        ('shape = "cylinder"', "", "[[inclusion]] 1 needs shape = cylinder, sphere, box, half_space."),
        ("centre = [0.8, 1.1]", "centre = [0.8, 5.0]", "inclusion 1 (Cylinder) holds no centre of an element"),
        ("c01 = 7.03e-4\n", "c02 = 7.03e-4\n", "[layer] must be one of"),
        ("c01 = 7.03e-4\n", "c20 = 7.03e-4\n", "[layer] needs the numbers of one law [MPa], c10, bulk (NeoHooke);"),
        ("c10 = 3e-3", "c10 = 3000.0", "[sample] NeoHooke shear modulus [MPa] must lie between"),
        ("thickness = 0.5", "thickness = 500.0", "[layer] thickness [mm] must lie between 0.02 and 20, got 500"),
        ("thickness = 0.5", "thickness = true", "[layer] thickness must be a number or text, got True"),
        ("thickness = 0.5", 'thickness = "none.npz"', "none.npz"),
        ("[plate]\nfriction = 0.15", "[plate]", "[plate] needs friction [-]; it is never taken as zero."),
        ("[plate]\nfriction = 0.15", "[plate]\nfriction = 0.1\np0 = 2.0", "[plate] p0 does not belong to law 'hard'"),
        ("[plate]\nfriction = 0.15", "[plate]\nfriction = -0.1", "[plate] friction [-] must be zero or positive"),
        (
            "[plate]\nfriction = 0.15",
            '[plate]\nkind = "roller"\nfriction = 0.1',
            "[plate] friction is for kind contact",
        ),
        ("[plate]\nfriction = 0.15", '[plate]\nlaw = "linear"\nfriction = 0.1', "needs stiffness [MPa/mm]"),
        ("[interface]\nfriction = 0.05", '[interface]\nkind = "roller"', "[interface] must be Contact(law, friction)"),
        ("[interface]\nfriction = 0.05", '[interface]\nkind = "bonded"', '[interface] kind "bonded" shares nodes'),
        ("[5, 5, 4]", "[12, 12, 4]", "[experiment] elements: the layer's face is too coarse for contact"),
        ("approach = 0.2", "approach = 1.7", "[compression] approach [mm] must be at most 90% of the 1.5 mm"),
        ("approach = 0.2", "approach = 0.0", "[compression] approach [mm] must be positive, got 0"),
        ("bulk = 0.12\n", "bulk = inf\n", 'pass element = "hybrid"'),
        ("seed = 3", "seed = 3.5", "[measurement] seed must be a whole number, got 3.5"),
        ("pixel = 0.05", "pixel = -0.05", "[measurement] pixel [mm] must be positive"),
        ("std = 0.002", "std = -0.002", "[measurement] std [mm] must be zero or positive"),
        ("[layer]", "[layer", "is not TOML"),
    ],
)
def test_what_is_wrong_with_a_scene_is_named(scene, tmp_path, solved, old, new, message, capsys):
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        assert opfem("simulate", scene(**{old: new}), "--out", tmp_path / "out") == 1
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
    said = " ".join(capsys.readouterr().err.split())
    assert message in said
    assert "--" not in said.replace("--debug", "")
    assert solved == []
    assert not (tmp_path / "out" / "result.nc").exists()


def test_a_scene_that_is_not_there(tmp_path, capsys):
    assert opfem("simulate", tmp_path / "none.toml", "--out", tmp_path / "out") == 1
    assert "Cannot read" in capsys.readouterr().err
