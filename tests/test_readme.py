"""The README's commands and Python run as they stand, on a map of the reader's own in the folder they start from."""

import re
import shlex
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.io

import opfem as op
from opfem.cli import main
from opfem.cli.scene import read_scene

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


@pytest.fixture
def own_map(tmp_path, monkeypatch):
    """A complete map.mat, as MATLAB would write it, and a volume scan.oct, in the current folder."""
    monkeypatch.chdir(tmp_path)
    values = np.asarray(op.datasets.example().filled().values)
    scipy.io.savemat("map.mat", {"thickness": values})
    volume = op.simulate_oct(
        op.UWA_845NM, lambda x, y: 0.42 + 0.02 * x, key=jax.random.key(0), spacing=(0.0125, 0.0125), shape=(40, 40),
        media=(op.Medium(-15.0, 0.5), op.SAMPLE),
    )  # fmt: skip
    op.write_oct(volume, "scan.oct")


def test_python(own_map):
    found, code, _, _, _, _, swept = blocks("python")
    names = {"op": op}
    exec(compile(found, "README.md", "exec"), names)
    assert float(names["loaded"].std.max()) < 0.01
    exec(compile(code, "README.md", "exec"), names)
    assert 0 < float(names["data"].pressure.mean()) < 0.1
    exec(compile(swept, "README.md", "exec"), names)
    assert names["table"].max_pressure.dims == ("c10", "friction")
    assert names["table"].max_pressure.notnull().all()
    assert plt.gcf().axes
    plt.close("all")


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_fit(own_map):
    _, code, fitted, *_ = blocks("python")
    assert "(40, 40, 4)" in code  # which takes minutes on 2 cores
    names = {}
    exec(compile(code.replace("(40, 40, 4)", "(20, 20, 2)") + fitted, "README.md", "exec"), names)
    assert bool(names["fit"].result == op.FitStatus.successful)
    plt.close("all")


def test_calibration(own_map):
    calibrated = blocks("python")[4]
    stretch = np.linspace(1.0, 0.7, 40)
    stress = 2 * (stretch - stretch**-2) * (2.23 + 0.703 / stretch)
    np.savetxt("compression.csv", np.stack([100 * (1 - stretch), stress], axis=1), delimiter=",")
    names = {"op": op}
    exec(compile(calibrated, "README.md", "exec"), names)
    assert float(names["found"].modulus) == pytest.approx(9 * 20 * 2 * 2.933e-3 / 61, rel=0.02)
    plt.close("all")


@pytest.mark.slow
def test_displacement_and_frictions(own_map):
    measured = blocks("python")[5]
    hard = op.HardOverclosure()
    layer = op.Layer(0.5, op.MooneyRivlin(2.23e-3, 7.03e-4, bulk=0.11732))
    palpation, truth = (
        op.Palpation(layer, (2.0, 2.0), (8, 8, 2), window=op.Contact(hard, w), sample=op.Contact(hard, s))
        for w, s in ((0.15, 0.05), (0.2, 0.08))
    )
    loads = [op.Imprint(op.ThicknessMap(np.full((5, 5), h), extent=(2.0, 2.0))) for h in (0.45, 0.449)]
    first = op.solve(truth, loads[0])
    scene = op.oct_scene(op.solve(truth, loads[1], start=first), before=first)
    volumes = op.simulate_oct(
        op.UWA_845NM, scene.surface, key=jax.random.key(0), spacing=(0.02, 0.02), shape=(101, 101), depth=0.44,
        increment=scene.increment, media=(op.Medium(0.0, 0.5), op.SAMPLE),
    )  # fmt: skip
    names = {"op": op, "palpation": palpation, "force": -float(first.stats["force_sample"][2])}
    names |= dict(zip(("preload", "actuation", "before", "after"), (*loads, *volumes), strict=True))
    exec(compile(measured, "README.md", "exec"), names)
    assert abs(float(names["fit"].numbers["window.friction"]) - 0.2) < 0.04


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_virtual_experiment(own_map):
    _, code, _, virtual, *_ = blocks("python")
    names = {}
    exec(compile(code.replace("(40, 40, 4)", "(16, 16, 2)") + virtual, "README.md", "exec"), names)
    assert 0.25 < names["compared"].relative_error < 0.42  # "a third": what README says, not an error of the solver
    assert names["compared"].truth.contrast > 1.1
    plt.close("all")


def test_scene_states_the_same_experiment(own_map):
    scene, _ = blocks("toml")
    Path("scene.toml").write_text(scene, encoding="utf-8")
    _, code, _, virtual, *_ = blocks("python")
    names = {}
    exec(compile(code.split("data =")[0] + virtual.split("truth =")[0], "README.md", "exec"), names)
    assert repr(read_scene(Path("scene.toml")).experiment) == repr(names["experiment"])


def test_sweep_file(own_map, tmp_path):
    _, config = blocks("toml")
    Path("sweep.toml").write_text(config, encoding="utf-8")
    with pytest.raises(SystemExit) as end:
        main(["sweep", "sweep.toml", "--out", "swept"])
    assert end.value.code in (0, None)
    data = op.read_netcdf(tmp_path / "swept" / "result.nc")
    assert data.sizes["c10"] == data.sizes["window_friction"] == 2
    assert data.max_pressure.notnull().all()


def test_commands(own_map, tmp_path):
    run_here = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("opfem ")]
    assert run_here
    for line in run_here:
        with pytest.raises(SystemExit) as end:
            main(shlex.split(line)[1:])
        assert end.value.code in (0, None)
    assert (tmp_path / "stress_map" / "result.nc").exists()
