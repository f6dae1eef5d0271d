"""`opfem sweep`: from a file to a table, going on, and what is wrong with a file."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem import cli
from opfem.cli.statement import read_maps, state_experiment
from opfem.cli.sweep import _AXES, _inputs, _points, _read
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


def opfem(*arguments) -> int:
    """Run the command line and return its exit status."""
    with pytest.raises(SystemExit) as end:
        cli.main([str(argument) for argument in arguments])
    return end.value.code


@pytest.fixture(autouse=True)
def _cache_of_the_user_is_left_alone(monkeypatch):
    monkeypatch.setenv("OPFEM_NO_CACHE", "1")


@pytest.fixture
def config(tmp_path):
    x, y = np.meshgrid(np.linspace(0.0, 2.0, 21), np.linspace(0.0, 2.0, 17))
    np.save(tmp_path / "map.npy", 0.5 * (1 - 0.07 - 0.06 * np.exp(-((x - 1.2) ** 2 + (y - 0.8) ** 2) / 0.3)))
    (tmp_path / "sweep.toml").write_text(CONFIG, encoding="utf-8")
    return tmp_path / "sweep.toml"


def test_from_file_to_table_and_on(config, tmp_path, capsys):
    out = tmp_path / "out"
    assert opfem("sweep", config, "--out", out) == 0
    assert "4 points, 0 failed" in capsys.readouterr().out
    data = op.read_netcdf(out / "result.nc")
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


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[outputs]", "[output]", "section must be one of inputs, axes, design, outputs, execution, got 'output'"),
        ("window_friction", "window_frction", "Did you mean 'window_friction'?"),
        ("elements", "elments", "Did you mean 'elements'?"),
        ('unit = "kPa"', 'unit = "mm"', "[axes] c10 unit must be one of MPa, kPa, Pa, got 'mm'"),
        ("[0.0, 0.2]", "[]", "Axis 'window_friction' of the sweep is empty"),
        ("[0.0, 0.2]", "[-0.1, 0.2]", "[axes] window_friction [1] must be zero or positive"),
        ("[0.0, 0.2]", '["low"]', "[axes] window_friction must hold numbers"),
        ("[0.0, 0.2]", "0.2", "[axes] window_friction must be a list of numbers"),
        ("[6, 6, 2]", "[6, 6]", "[inputs] elements must be tuple[int, int, int], got [6, 6]"),
        ("[6, 6, 2]", "[6, 6, 2.5]", "[inputs] elements must be int, got 2.5"),
        ("smooth = 0.2", 'smooth = "much"', "[inputs] smooth must be float, got 'much'"),
        ("smooth = 0.2", "c10 = 0.1", "[inputs] c10 is also one of the [axes]"),
        ("bulk = 0.11732", "", "--bulk [MPa] is needed"),
        ('map = "map.npy"', "", "needs [inputs] with map = ..."),
        ('keep = ["max_pressure", "pressure", "force_sample"]', 'keep = "all"', "keep must be a list of names"),
        ("[outputs]", "[outputs", "is not TOML"),
        ("[outputs]", "[design]\nkind = 'sobol'\n[outputs]", "points must be a whole number of at least 1"),
        ("[outputs]", "[execution]\nmode = 'pmap'\n[outputs]", "Batch.mode must be one of"),
    ],
)
def test_what_is_wrong_with_a_file(config, tmp_path, capsys, old, new, message):
    assert old in CONFIG
    config.write_text(CONFIG.replace(old, new), encoding="utf-8")
    assert opfem("sweep", config, "--out", tmp_path / "out") == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


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


def test_inputs_are_the_options_of_palpate(config, tmp_path):
    stated = _read(config)
    inputs = _inputs(stated["inputs"], _points(stated["axes"], {}), tmp_path)
    assert inputs.map == str(tmp_path / "map.npy")
    assert inputs.reading.extent == (2.0, 2.0)
    assert inputs.reading.l0 == "0.5"
    assert inputs.layer.elements == (6, 6, 2)
    assert (inputs.layer.c10, inputs.layer.bulk) == (2e-3, 0.11732)
