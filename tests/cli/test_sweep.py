"""`opfem sweep`: from a file to a table, going on, and what is wrong with a file."""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from PIL import Image

import opfem as op
from opfem.cli.statement import read_maps, state_experiment
from opfem.cli.sweep import _AXES, _inputs, _points, _read
from tests.command_line import opfem
from tests.tolerances import SOLVER

CONFIG = """
[inputs]
map = "map.npy"
extent = [2.0, 2.0]
l0 = 0.5
elements = [6, 6, 2]
smooth = 0.2
bulk = 0.11732

[axes]
c10 = { from = 2.0, to = 4.0, points = 2, unit = "kPa" }
window_friction = [0.0, 0.2]

[outputs]
keep = ["max_pressure", "pressure", "force_sample"]
"""


@pytest.fixture
def config(tmp_path):
    x, y = np.meshgrid(np.linspace(0.0, 2.0, 21), np.linspace(0.0, 2.0, 17))
    np.save(tmp_path / "map.npy", 0.5 * (1 - 0.07 - 0.06 * np.exp(-((x - 1.2) ** 2 + (y - 0.8) ** 2) / 0.3)))
    (tmp_path / "sweep.toml").write_text(CONFIG, encoding="utf-8")
    return tmp_path / "sweep.toml"


def test_from_file_to_table_and_on(config, tmp_path, capsys, monkeypatch):
    for command in ("sweep", "palpate"):
        monkeypatch.setattr(f"opfem.cli.{command}.Newton", functools.partial(op.Newton, rtol=SOLVER / 10))
    out = tmp_path / "out"
    assert opfem("sweep", config, "--out", out) == 0
    said = capsys.readouterr()
    assert "4 points, 0 failed. Wrote table.csv, sweep.png, result.nc" in said.out
    data = op.read_netcdf(out / "result.nc")
    # A stiffer layer with more friction feels the most.
    low, high = 1e3 * float(data.max_pressure.min()), 1e3 * float(data.max_pressure.max())
    assert (
        f"max_pressure: lowest {low:.4g} kPa at c10 2 kPa, window_friction 0; "
        f"highest {high:.4g} kPa at c10 4 kPa, window_friction 0.2"
    ) in said.out
    for point in ("c10 0.002, window_friction 0: ", "c10 0.004, window_friction 0.2: "):
        assert sum(point in line and " of 4 points: " in line for line in said.err.splitlines()) == 1
    with Image.open(out / "sweep.png") as image:
        assert min(image.size) > 500
    assert data.max_pressure.dims == ("c10", "window_friction")
    np.testing.assert_allclose(data.c10, [2e-3, 4e-3])
    assert data.c10.attrs["units"] == "MPa"

    same = ("--extent", 2, 2, "--l0", 0.5, "--elements", 6, 6, 2, "--smooth", 0.2, "--bulk", 0.11732)
    this = ("--c10", 4e-3, "--window-friction", 0.2, "--out", tmp_path / "one")
    assert opfem("palpate", tmp_path / "map.npy", *same, *this) == 0
    one = op.read_netcdf(tmp_path / "one" / "result.nc")
    point = data.sel(c10=4e-3, window_friction=0.2)
    np.testing.assert_allclose(point.pressure, one.pressure, rtol=0, atol=SOLVER * float(one.pressure.max()))

    assert opfem("sweep", config, "--out", out) == 1
    assert "holds a sweep. Pass --resume" in capsys.readouterr().err
    removed = next((out / "points").glob("*.npz"))
    removed.unlink()
    assert opfem("sweep", config, "--out", out, "--resume") == 0
    again = op.read_netcdf(out / "result.nc")
    assert again.drop_vars("wall_time").identical(data.drop_vars("wall_time"))

    config.write_text(CONFIG.replace("0.2]", "0.3]"), encoding="utf-8")
    assert opfem("sweep", config, "--out", out, "--resume") == 1
    assert "different inputs: axis window_friction" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[outputs]", "[output]", "section must be one of inputs, axes, design, outputs, execution, got 'output'"),
        ("window_friction", "window_frction", "Did you mean 'window_friction'?"),
        ("elements", "elments", "Did you mean 'elements'?"),
        ('unit = "kPa"', 'unit = "mm"', "[axes] c10 unit must be one of MPa, kPa, Pa, got 'mm'"),
        ("[0.0, 0.2]", "[]", "Axis 'window_friction' of the sweep is empty"),
        ("[0.0, 0.2]", "[-0.1, 0.2]", "[axes] window_friction [1] must be zero or positive"),
        ("[0.0, 0.2]", '["low"]', "[axes] window_friction [1] must be a number, got 'low'"),
        ("[0.0, 0.2]", "0.2", "[axes] window_friction must be a list of numbers"),
        ("[6, 6, 2]", "[6, 6]", "[inputs] elements must be a list of 3, each a whole number, got [6, 6]"),
        ("[6, 6, 2]", "[6, 6, 2.5]", "[inputs] elements must be a whole number, got 2.5"),
        ("smooth = 0.2", 'smooth = "much"', "[inputs] smooth must be a number, got 'much'"),
        ("smooth = 0.2", "c10 = 0.1", "[inputs] c10 is also one of the [axes]"),
        ("bulk = 0.11732", "", "--bulk [MPa] is needed"),
        ('map = "map.npy"', "", "needs [inputs] with map = ..."),
        ('keep = ["max_pressure", "pressure", "force_sample"]', 'keep = "all"', "keep must be a list of names"),
        ("[outputs]", "[outputs", "is not TOML"),
        ("points = 2,", 'points = 2, log = "false",', "[axes] c10 log must be true or false, got 'false'"),
        ("points = 2,", "points = 2, log = 0,", "[axes] c10 log must be true or false, got 0"),
        ("points = 2,", "points = 2.0,", "[axes] c10 points must be a whole number, got 2.0"),
        ("points = 2,", "points = true,", "[axes] c10 points must be a whole number, got True"),
        ("points = 2,", "points = -1,", "[axes] c10 points must be a whole number of at least 1, got -1"),
        ("from = 2.0", 'from = "2.0"', "[axes] c10 [MPa] must be a number, got '2.0'"),
        ('unit = "kPa"', "unit = 3", "[axes] c10 unit must be one of MPa, kPa, Pa, got 3"),
        ('unit = "kPa"', 'unit = ["kPa"]', "[axes] c10 unit must be one of MPa, kPa, Pa, got ['kPa']"),
        ("[0.0, 0.2]", "[0.0, true]", "[axes] window_friction [1] must be a number, got True"),
        ("[0.0, 0.2]", "[0.0, nan]", "[axes] window_friction [1] must be zero or positive, got [0.0, nan]"),
        ("to = 4.0", "to = 1e999", "[axes] c10 [MPa] must be finite, got [2.0, inf]"),
        (
            "to = 4.0, points = 2",
            "to = nan, points = 2, log = true",
            "[axes] c10 [MPa] must be finite, got [2.0, nan]",
        ),
        ("[0.0, 0.2]", "{ values = 0.2 }", "[axes] window_friction must hold a list of numbers, got 0.2"),
        ("smooth = 0.2", 'smooth = "0.2"', "[inputs] smooth must be a number, got '0.2'"),
        ("smooth = 0.2", "smooth = true", "[inputs] smooth must be a number, got True"),
        ("smooth = 0.2", "smooth = -0.2", "[inputs] smooth [mm] must be zero or a positive number, got -0.2"),
        ("smooth = 0.2", 'correct_approach = "false"', "[inputs] correct_approach must be true or false, got 'false'"),
        ("smooth = 0.2", "correct_approach = 1", "[inputs] correct_approach must be true or false, got 1"),
        ("smooth = 0.2", "variable = 3", "[inputs] variable must be text, got 3"),
        ("smooth = 0.2", "increments = 4.0", "[inputs] increments must be a whole number, got 4.0"),
        ("smooth = 0.2", 'unit = "inch"', "[inputs] unit must be one of mm, um, µm, m, got 'inch'"),
        ("l0 = 0.5", "l0 = true", "[inputs] l0 must be text, got True"),
        ("l0 = 0.5", "l0 = -0.5", "[inputs] l0 [mm] must be a positive number, or the path of a map, got -0.5"),
        ("l0 = 0.5", 'l0 = "0,5"', "the path of a map, got '0,5': there is no such file"),
        ('map = "map.npy"', "map = 3", "[inputs] map must be text, got 3"),
        ('map = "map.npy"', 'map = "none.npy"', "none.npy: no such file"),
        ('["max_pressure", "pressure", "force_sample"]', '["max_presure"]', "Did you mean 'max_pressure'?"),
        ('["max_pressure", "pressure", "force_sample"]', "[1]", "[outputs] keep must be a list of names, got [1]"),
        ('"force_sample"]', '"pressure"]', "[outputs] keep must name each output once"),
        ("[outputs]", '[design]\nkind = "grid"\npoints = 4\n[outputs]', "[design] points is for kind sobol"),
        ("[outputs]", '[design]\nkind = ["zip"]\n[outputs]', "[design] kind must be one of grid"),
        ("[outputs]", '[execution]\nsize = "3"\n[outputs]', "[execution] size must be a whole number, got '3'"),
        ("[outputs]", "[execution]\nsize = 0\n[outputs]", "[execution] size must be a whole number of at least 1"),
        ("[outputs]", "[execution]\nthreads = true\n[outputs]", "[execution] threads must be a whole number, got True"),
        ("[outputs]", "[design]\nkind = 'sobol'\n[outputs]", "points must be a whole number of at least 1"),
        ("[outputs]", "[execution]\nmode = 'pmap'\n[outputs]", "[execution] mode must be one of"),
    ],
)
def test_what_is_wrong_with_a_file(config, tmp_path, capsys, old, new, message):
    assert old in CONFIG
    config.write_text(CONFIG.replace(old, new), encoding="utf-8")
    assert opfem("sweep", config, "--out", tmp_path / "out") == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.fixture
def computed(monkeypatch):
    """The sweep computes nothing, and leaves a folder as a real one does."""

    def compute(function, points, *, keep, execution, out):
        (out / "points").mkdir(parents=True)
        for name in ("points/a.npz", "sweep.json", "result.nc"):
            (out / name).write_text(str(len(points)))
        return xr.Dataset({"status": ("point", ["successful"] * len(points))})

    monkeypatch.setattr("opfem.cli.sweep.compute", compute)


def contents(folder) -> dict[str, str]:
    """Read every file of a folder, hidden ones too."""
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


OLD = {"points/old.npz": "kept", "sweep.json": "{}", "result.nc": "kept"}


@pytest.fixture
def finished(tmp_path):
    out = tmp_path / "out"
    (out / "points").mkdir(parents=True)
    for name, text in OLD.items():
        (out / name).write_text(text)
    return out


class TestForce:
    @pytest.mark.parametrize(
        ("old", "new"),
        [
            ('map = "map.npy"', 'map = "no_such_map.npy"'),
            ("[outputs]", "[outputs"),
            ("window_friction", "window_frction"),
            ('"force_sample"]', '"force_smple"]'),
            ("[0.0, 0.2]", "[-0.1, 0.2]"),
            ("extent = [2.0, 2.0]", "extent = [2.0, -2.0]"),
            ("bulk = 0.11732", ""),
            ("elements = [6, 6, 2]", 'elements = [6, 6, 3]\nelement = "tet10"'),
            ("bulk = 0.11732", "bulk = inf"),
            ("[outputs]", '[design]\nkind = "zip"\npoints = 3\n[outputs]'),
            ("[outputs]", "[execution]\nsize = -1\n[outputs]"),
        ],
    )
    def test_everything_is_checked_before_the_old_sweep_is_touched(self, config, finished, computed, old, new):
        assert old in CONFIG
        config.write_text(CONFIG.replace(old, new), encoding="utf-8")
        assert opfem("sweep", config, "--out", finished, "--force") == 1
        assert contents(finished) == OLD

    def test_the_new_sweep_takes_the_place_of_the_old_one(self, config, finished, computed):
        (finished / "notes.txt").write_text("mine")
        assert opfem("sweep", config, "--out", finished, "--force") == 0
        new = {"points/a.npz": "4", "sweep.json": "4", "result.nc": "4"}
        assert contents(finished) == {**new, "notes.txt": "mine"}

    def test_the_old_sweep_stays_until_the_new_one_is_complete(self, config, finished, monkeypatch, capsys):
        def begin(function, points, *, keep, execution, out):
            (out / "points").mkdir(parents=True, exist_ok=True)
            for name in ("points/a.npz", "sweep.json"):
                (out / name).write_text("begun")
            raise KeyboardInterrupt

        monkeypatch.setattr("opfem.cli.sweep.compute", begin)
        assert opfem("sweep", config, "--out", finished, "--force") == 130
        assert {name: text for name, text in contents(finished).items() if text != "begun"} == OLD

        def go_on(function, points, *, keep, execution, out):
            assert (out / "points" / "a.npz").read_text() == "begun"
            (out / "result.nc").write_text("done")
            return xr.Dataset({"status": ("point", ["successful"] * len(points))})

        assert opfem("sweep", config, "--out", finished) == 1
        assert "Pass --resume" in capsys.readouterr().err
        monkeypatch.setattr("opfem.cli.sweep.compute", go_on)
        assert opfem("sweep", config, "--out", finished, "--resume") == 0
        assert contents(finished) == {"points/a.npz": "begun", "sweep.json": "begun", "result.nc": "done"}

    def test_links(self, config, finished, tmp_path, computed, capsys):
        (finished / "result.nc").rename(tmp_path / "elsewhere.nc")
        (finished / "result.nc").symlink_to(tmp_path / "elsewhere.nc")
        assert opfem("sweep", config, "--out", finished, "--force") == 1
        assert "holds result.nc as a link" in capsys.readouterr().err
        assert contents(finished) == OLD
        (tmp_path / "dangling").symlink_to(tmp_path / "none")
        assert opfem("sweep", config, "--out", tmp_path / "dangling") == 1
        assert "is a link to" in capsys.readouterr().err

    def test_results_of_another_command(self, config, finished, map_of, capsys):
        assert opfem("palpate", map_of, "--extent", 2, 2, "--l0", 0.5, "--out", finished, "--force") == 1
        assert "holds a sweep (sweep.json)" in capsys.readouterr().err
        assert contents(finished) == OLD
        (finished / "sweep.json").unlink()
        assert opfem("sweep", config, "--out", finished, "--force") == 1
        assert "holds the result of another command" in capsys.readouterr().err

    @pytest.fixture
    def map_of(self, config):
        return config.parent / "map.npy"


def test_of_many_points_the_ends_and_some_between_are_stated(config, tmp_path, computed, monkeypatch, capsys):
    seen = []

    def state(unloaded, extent, layer, contact):
        seen.append(layer.c10)
        if layer.c10 == 5e-3:
            raise ValueError("too stiff")

    values = np.linspace(2.0, 4.0, 10_000)
    values[7] = 5.0  # kPa
    config.write_text(CONFIG.replace("{ from = 2.0, to = 4.0, points = 2, ", f"{{ values = {values.tolist()}, "))
    monkeypatch.setattr("opfem.cli.sweep.state_palpation", state)
    assert opfem("sweep", config, "--out", tmp_path / "out") == 1
    assert "[axes] at c10 = 0.005: too stiff" in capsys.readouterr().err
    values[7] = 3.0
    seen.clear()
    config.write_text(CONFIG.replace("{ from = 2.0, to = 4.0, points = 2, ", f"{{ values = {values.tolist()}, "))
    assert opfem("sweep", config, "--out", tmp_path / "out") == 0
    assert {2e-3, 4e-3} <= set(seen)
    assert len(seen) < 300


def test_a_file_from_notepad(config, tmp_path, computed):
    config.write_bytes(b"\xef\xbb\xbf" + CONFIG.replace("\n", "\r\n").encode())
    assert opfem("sweep", config, "--out", tmp_path / "out") == 0


def test_nothing_to_go_on_with(config, tmp_path, capsys):
    assert opfem("sweep", config, "--out", tmp_path / "out", "--resume") == 1
    assert "holds no sweep to go on with" in capsys.readouterr().err
    assert opfem("sweep", tmp_path / "none.toml", "--out", tmp_path / "out") == 1
    assert "Cannot read" in capsys.readouterr().err


def test_designs():
    axes = {"c10": {"from": 1.0, "to": 100.0, "log": True, "unit": "kPa"}, "l0": {"from": 400, "to": 500, "unit": "um"}}
    for kind in ("sobol", "latin_hypercube"):
        points = _points(axes, {"kind": kind, "points": 16, "seed": 1})
        assert len(points) == 16
        assert points.units == {"c10": "MPa", "l0": "mm"}
        assert np.ptp(np.sort(np.log10(points.columns["c10"]))) < 2.0
        # Either design has one point in each sixteenth of each axis.
        places = (points.columns["l0"] - 0.4) / 0.1
        np.testing.assert_array_equal(np.sort(np.floor(16 * places)), np.arange(16))
        places = np.log10(points.columns["c10"] / 1e-3) / 2
        np.testing.assert_array_equal(np.sort(np.floor(16 * places)), np.arange(16))
        assert (_points(axes, {"kind": kind, "points": 16, "seed": 1}).columns["c10"] == points.columns["c10"]).all()
    zipped = _points({"c10": [1e-3, 2e-3], "bulk": [0.1, 0.2]}, {"kind": "zip"})
    assert zipped.dims == ("point",)
    log = _points({"c10": {"from": 1.0, "to": 100.0, "points": 3, "log": True, "unit": "kPa"}}, {})
    np.testing.assert_allclose(log.columns["c10"], [1e-3, 1e-2, 1e-1])


def test_every_axis_is_a_number_of_the_experiment(config):
    """At two values of each: stated as its option, and put in the place that the axis names."""
    units = {"MPa": 1e-3, "mm": 0.1, "1": 0.1}
    for name, axis in _AXES.items():
        stated = _read(config)
        stated["inputs"].pop(name, None)
        points = _points({name: [1.0 * units[axis.unit], 1.5 * units[axis.unit]]}, {})
        inputs = _inputs(stated["inputs"], points, config.parent)
        measured, unloaded = read_maps(inputs.map, inputs.reading)
        palpation, _ = state_experiment(measured, unloaded, inputs.reading, inputs.layer, inputs.contact)
        assert axis.where(palpation) == pytest.approx(units[axis.unit])
        moved = eqx.tree_at(axis.where, palpation, jnp.asarray(1.5 * units[axis.unit]))
        assert axis.where(moved) == pytest.approx(1.5 * units[axis.unit])


def test_inputs_are_the_options_of_palpate(config, tmp_path):
    stated = _read(config)
    inputs = _inputs(stated["inputs"], _points(stated["axes"], {}), tmp_path)
    assert inputs.map == str(tmp_path / "map.npy")
    assert inputs.reading.extent == (2.0, 2.0)
    assert inputs.reading.l0 == "0.5"
    assert inputs.layer.elements == (6, 6, 2)
    assert (inputs.layer.c10, inputs.layer.bulk) == (2e-3, 0.11732)
