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
