"""`opfem fit-parameters`: from a file of observed states to numbers; what is wrong with a file."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from PIL import Image

import opfem as op
from opfem.cli.fit_parameters import FILES
from opfem.cli.observed_states import read_observed_states
from tests.command_line import opfem

LAYER = """
[layer]
thickness = 0.5
c10 = 2.23e-3
c01 = 7.03e-4
bulk = 0.11732

[experiment]
extent = [2.0, 2.0]
elements = [6, 6, 2]

[window]
friction = 0.15

[sample]
friction = 0.05
"""
FORCE = """
[[state]]
thickness = 0.45
force = 0.02
force_std = 0.0002
"""
PRIORS = """
[parameters]
window.friction = { median = 0.15, spread = 0.5 }
"layer.material.c10" = { median = 2e-3, spread = 0.2 }
l0_offset = { mean = 0, std = 0.001 }
"""
OTHERS = """
[[state]]
thickness = "pressed.npy"
map = "measured.npz"

[[increment]]
displacement = "displacement.npz"
spacing = [0.2, 0.2, 0.1]
margin = 0.3

[[bulge]]
state = 2
side = "x1"
depth = [0.1, 0.2]
displacement = [0.05, 0.06]
std = 0.002

[fit]
model_std = 1e-5
scale_std = 0.02
"""


@pytest.fixture
def config(tmp_path):
    """Write a file, and the files that it names."""
    np.save(tmp_path / "pressed.npy", np.full((11, 11), 0.44))
    measured = op.ThicknessMap(np.full((11, 11), 0.44), extent=(2.0, 2.0), std=2e-3)
    op.write_thickness(measured, tmp_path / "measured.npz")
    shape, depth = (20, 20, 30), np.arange(30) * 0.014
    fields = (np.broadcast_to(-1e-3 * depth, shape), np.full(shape, 2e-6), np.full(shape, 0.98), np.zeros(shape, bool))
    both = jnp.array([0.1, 0.1])
    volume = op.DisplacementVolume(*fields, depth, both, 0.5 * both, jnp.array(0.01), both, jnp.array(2.0), ())
    op.write_displacement(volume, tmp_path / "displacement.npz")

    def write(*parts: str):
        (tmp_path / "states.toml").write_text("".join(parts), encoding="utf-8")
        return tmp_path / "states.toml"

    return write


def test_a_file_states_experiment_loads_and_observations(config):
    found = read_observed_states(config(LAYER, FORCE, OTHERS, PRIORS))
    assert found.palpation.elements == (6, 6, 2)
    assert isinstance(found.palpation.window.law, op.HardOverclosure)
    assert not found.palpation.window.law.exact
    assert isinstance(found.palpation.sample.law, op.ExponentialOverclosure)
    assert [float(load.thickness.values.mean()) for load in found.loads] == pytest.approx([0.45, 0.44])
    (one, force), (two, measured), increment, (of, bulge) = found.observations
    assert (one, two, of) == (0, 1, 1)
    assert float(force.force) == 0.02
    assert float(measured.std) == 2e-3
    assert (increment.before, increment.after) == (0, 1)
    assert float(increment.points[:, :2].min()) >= 0.3
    assert bulge.side == "x1"
    assert list(found.parameters) == ["window.friction", "layer.material.c10", "l0_offset"]
    assert isinstance(found.parameters["window.friction"], op.LogNormal)
    assert isinstance(found.parameters["l0_offset"], op.Normal)
    assert float(found.options["scale"].std) == 0.02
    assert found.options["model_std"] == 1e-5


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ((LAYER, FORCE), 'needs [parameters], such as "window.friction"'),
        ((LAYER, PRIORS), "needs [[state]]"),
        ((LAYER, "[[state]]\nthickness = 0.45\n", PRIORS), "states nothing that was observed"),
        ((LAYER, "[[state]]\nforce = 0.1\n", PRIORS), "[[state]] 1 needs thickness [mm]"),
        ((LAYER, "[[state]]\nthickness = 0.4\nforce = 0.1\n", PRIORS), "[[state]] 1 needs force_std [N]"),
        ((LAYER, FORCE, '[[increment]]\ndisplacement = "displacement.npz"\n', PRIORS), "after must be the number of a"),
        ((LAYER, FORCE, '[[increment]]\ndisplacement = "none.npz"\nafter = 1\n', PRIORS), "there is no such file"),
        ((LAYER, FORCE, "[[bulge]]\nstate = 3\n", PRIORS), "[[bulge]] 1 needs side"),
        ((LAYER, FORCE, "[parameters]\nwindow.friction = 0.1\n"), "must be a prior, { median = ..., spread = ... } or"),
        ((LAYER, FORCE, "[parameters]\nwindow.friction = { median = -1, spread = 0.1 }\n"), "must be positive"),
        ((LAYER, FORCE, "[parameters]\nwindow.fricton = { median = 1, spread = 0.1 }\n"), "got 'window.fricton'"),
        ((LAYER, FORCE, PRIORS, "[fit]\nsteps = 3\n"), "max_steps"),
        ((LAYER.replace("0.15", "-0.15"), FORCE, PRIORS), "[window] friction"),
    ],
)
def test_what_a_file_states_wrongly_is_named(config, tmp_path, capsys, parts, message):
    assert opfem("fit-parameters", config(*parts), "--out", tmp_path / "out") == 1
    said = capsys.readouterr().err
    assert message in said
    assert "Traceback" not in said
    assert not (tmp_path / "out" / "result.nc").exists()


def test_hard_contact_may_be_exact(config):
    stated = LAYER.replace("[window]", "[window]\nexact = true")
    assert read_observed_states(config(stated, FORCE, PRIORS)).palpation.window.law.exact


@pytest.mark.slow
def test_a_modulus_from_a_force(config, tmp_path, capsys):
    """The force is that of a modulus 20 % above the prior's median; friction is not known any better than before."""
    palpation = read_observed_states(config(LAYER, FORCE, PRIORS)).palpation
    flat = op.ThicknessMap(np.full((2, 2), 0.45), extent=(2.0, 2.0))
    force = -float(op.solve(palpation, op.Imprint(flat)).stats["force_sample"][2])
    prior = "[parameters]\nlayer.material.c10 = { median = 1.86e-3, spread = 0.3 }\n"
    state = FORCE.replace("0.02\n", f"{force}\n").replace("0.0002", f"{0.01 * force}")
    out = tmp_path / "out"
    assert opfem("fit-parameters", config(LAYER, state, prior), "--svg", "--out", out) == 0
    numbers = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert numbers["numbers"]["layer.material.c10"] == pytest.approx(2.23e-3, rel=5e-3)
    assert 0.0 < numbers["prior_share"]["layer.material.c10"] < 0.1
    low, high = numbers["interval_95"]["layer.material.c10"]
    assert low < 2.23e-3 < high
    assert sorted(path.name for path in out.iterdir()) == sorted([*FILES, "parameters.svg"])
    with xr.open_dataset(out / "result.nc") as data:
        assert float(data.value.sel(parameter="layer.material.c10")) == numbers["numbers"]["layer.material.c10"]
        assert data.sizes["datum_force"] == 1
    with Image.open(out / "parameters.png") as image:
        assert min(image.size) > 500
    assert "layer.material.c10" in capsys.readouterr().out
    assert opfem("fit-parameters", config(LAYER, state, prior), "--out", out) == 1
    assert "--force" in capsys.readouterr().err
