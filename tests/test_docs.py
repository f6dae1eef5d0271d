"""The documentation's commands and Python run, and its reference lists every public name.

Meshes are made small where a page's own one takes minutes; Python that needs a cluster or two phase volumes is compiled
only.
"""

import re
import shlex
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest

import opfem as op
from opfem.cli import main
from opfem.cli.observed_states import read_observed_states
from opfem.cli.scene import read_scene
from tests.documents import DOCS, blocks, own_files

PAGES = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md") if "_build" not in path.parts)
HOW_TO = DOCS / "how-to"
NOT_RUN = {"how-to/cluster.md", "how-to/friction.md"}
RUN = {
    "start.md", "how-to/own-map.md", "how-to/oct.md", "how-to/uncertainty.md", "how-to/calibrate.md",
    "how-to/experiment.md", "how-to/sweep.md", "how-to/paraview.md", "developing/material.md",
    "developing/contact-law.md",
}  # fmt: skip


def python(page: str, names: dict | None = None, elements: str = "(8, 8, 2)") -> dict:
    """Run a page's Python, one block after the other."""
    names = {"op": op, "jax": jax} if names is None else names
    code = blocks(DOCS / page, "python")
    assert code
    for block in code:
        exec(compile(block.replace("(40, 40, 4)", elements), page, "exec"), names)
    plt.close("all")
    return names


def command(line: str) -> None:
    with pytest.raises(SystemExit) as end:
        main(shlex.split(line)[1:])
    assert end.value.code in (0, None)


@pytest.fixture(autouse=True)
def _own_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def own_map():
    """The names of the page on one's own map, whose experiment others go on with."""
    own_files()
    return python("how-to/own-map.md")


def test_every_page_with_python_is_tested_here():
    assert {page for page in PAGES if blocks(DOCS / page, "(?:python|py)")} == RUN | NOT_RUN


@pytest.mark.parametrize("page", sorted(NOT_RUN))
def test_what_is_not_run_is_python_and_names_what_there_is(page):
    for block in blocks(DOCS / page, "(?:python|py)"):
        compile(block, page, "exec")
        assert [name for name in re.findall(r"\bop\.(\w+)", block) if not hasattr(op, name)] == []


@pytest.mark.slow  # the README's six lines are much the same
def test_start():
    names = python("start.md")
    assert 5e-3 < float(names["data"].pressure.max()) < 0.02


def test_own_map_oct_sweep_and_paraview(own_map, tmp_path):
    assert 0 < float(own_map["data"].pressure.mean()) < 0.1
    table = python("how-to/sweep.md", own_map)["table"]
    assert table.max_pressure.dims == ("c10", "friction")
    assert table.max_pressure.notnull().all()
    python("how-to/paraview.md", own_map)
    assert (tmp_path / "layer.vtu").exists()
    assert (tmp_path / "series_000.vtu").exists()
    found = python("how-to/oct.md", own_map)
    assert float(found["loaded"].std.max()) < 0.01


def test_calibrate():
    own_files()
    found = python("how-to/calibrate.md")["found"]
    assert float(found.modulus) == pytest.approx(9 * 20 * 2 * 2.933e-3 / 61, rel=0.02)


def test_material():
    names = python("developing/material.md")
    assert isinstance(names["layer"].material, names["Gent"])
    assert float(names["law"].shear) == pytest.approx(5.9e-3)


@pytest.mark.slow
def test_contact_law():
    names = python("developing/contact-law.md")
    step = 0.5
    difference = (names["mean_pressure"](30.0 + step) - names["mean_pressure"](30.0 - step)) / (2 * step)
    assert float(names["gradient"]) == pytest.approx(float(difference), rel=1e-2)  # solves to 1e-5 of the pressure
    law = names["PowerOverclosure"](30.0, 1.5)
    pressure = np.array([0.0, 1e-4, 1e-2])
    clearance = law.clearance_at(jax.numpy.asarray(pressure), jax.numpy.asarray(1.0))
    np.testing.assert_allclose(law.pressure_at(clearance, jax.numpy.asarray(1.0)), pressure, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_uncertainty(own_map):
    names = python("how-to/own-map.md", elements="(20, 20, 2)") | {"op": op}
    assert bool(python("how-to/uncertainty.md", names)["fit"].result == op.FitStatus.successful)


@pytest.mark.slow
@pytest.mark.timeout(1500)
def test_experiment(own_map):
    names = python("how-to/own-map.md", elements="(16, 16, 2)")
    compared = python("how-to/experiment.md", names)["compared"]
    assert 0.25 < compared.relative_error < 0.42  # "a third": what the page says, not an error of the solver
    assert compared.truth.contrast > 1.1


def test_scene_states_the_same_experiment(own_map):
    (scene,) = blocks(HOW_TO / "experiment.md", "toml")
    (code,) = blocks(HOW_TO / "experiment.md", "python")
    Path("scene.toml").write_text(scene, encoding="utf-8")
    exec(compile(code.split("truth =")[0], "experiment.md", "exec"), own_map)
    assert repr(read_scene(Path("scene.toml")).experiment) == repr(own_map["experiment"])


def test_sweep_file(tmp_path):
    own_files()
    (config,) = blocks(HOW_TO / "sweep.md", "toml")
    Path("sweep.toml").write_text(config, encoding="utf-8")
    command("opfem sweep sweep.toml --out swept")
    data = op.read_netcdf(tmp_path / "swept" / "result.nc")
    assert data.sizes["c10"] == data.sizes["window_friction"] == 2
    assert data.max_pressure.notnull().all()


def test_friction_file(tmp_path):
    (stated,) = blocks(HOW_TO / "friction.md", "toml")
    Path("friction.toml").write_text(stated, encoding="utf-8")
    Path("displacement").mkdir()
    n, z = 25, np.linspace(0.01, 0.38, 20)
    both, shape = jax.numpy.array([0.2, 0.2]), (n, n, z.size)
    fields = (np.zeros(shape), np.full(shape, 5e-6), np.full(shape, 0.98), np.zeros(shape, bool), z)
    volume = op.DisplacementVolume(*fields, both, 0.5 * both, jax.numpy.array(0.01), both, jax.numpy.array(1.0), ())
    op.write_displacement(volume, "displacement/displacement.npz")
    states = read_observed_states(Path("friction.toml"))
    assert len(states.loads) == len(states.observations) == 2
    assert set(states.parameters) == {"window.friction", "sample.friction", "layer.material.bulk"}


def phase_volumes() -> None:
    """Write before.oct and after.oct: a layer that shortens by 0.1 %."""
    pair = op.simulate_oct(
        op.UWA_845NM, lambda x, y: np.full_like(x, 0.3), key=jax.random.key(0), spacing=(0.01, 0.01), shape=(12, 16),
        depth=0.3, increment=lambda x, y, z: (0 * z, 0 * z, -1e-3 * z), media=(op.Medium(0.0, 0.5), op.SAMPLE),
    )  # fmt: skip
    for name, volume in zip(("before", "after"), pair, strict=True):
        op.write_oct(volume, f"{name}.oct")


# A fit of frictions takes minutes; its command is tested on its own, its file below.
LINES = [
    line
    for page in PAGES
    for block in blocks(DOCS / page, "sh")
    for line in block.splitlines()
    if line[:6] == "opfem " and line[:21] != "opfem fit-parameters "
]


@pytest.mark.parametrize(
    "line",
    [pytest.param(line, marks=[pytest.mark.slow] * line.startswith(("opfem fit", "opfem sim"))) for line in LINES],
)
def test_commands(line, tmp_path):
    own_files()
    (scene,) = blocks(HOW_TO / "experiment.md", "toml")
    Path("scene.toml").write_text(scene.replace("[16, 16, [2, 8]]", "[8, 8, [2, 4]]"), encoding="utf-8")
    if "--phase" in line:
        phase_volumes()
    small = " --elements 8 8 2" if line.startswith(("opfem palpate", "opfem fit ")) else ""
    command(line + small)
    folder = re.search(r"--out (\w+)", line)
    out = tmp_path / (folder[1] if folder else "opfem_demo")
    assert any((out / name).exists() for name in ("result.nc", "thickness.npz", "displacement.npz"))


def test_every_public_name_is_in_the_reference():
    pages = "\n".join(page.read_text(encoding="utf-8") for page in (DOCS / "reference").glob("*.md"))
    listed = set(re.findall(r"^\.\. (?:auto\w+|py:data):: (\w+)", pages, re.MULTILINE))
    assert {name for name in dir(op) if name not in listed} == {"__version__", "datasets"}
    assert {name for name in listed if not hasattr(op, name) and not hasattr(op.datasets, name)} == set()


@pytest.mark.parametrize("page", PAGES)
def test_files_that_a_page_names_exist(page):
    words = (DOCS / page).read_text(encoding="utf-8")
    named = re.findall(r"\b(?:opfem|tests|benchmarks|notebooks)/[\w/]+\.(?:py|ipynb|md)\b", words)
    assert [name for name in named if not (DOCS.parent / name).exists()] == []


def test_fields_of_the_reference_are_those_of_results(own_map):
    page = (DOCS / "reference" / "file-formats.md").read_text(encoding="utf-8").split("## Variables")[1]
    named = {
        name for row in page.splitlines() if row.startswith("| `") for name in re.findall(r"`(\w+)`", row.split("|")[1])
    }
    assert len(named) > 20
    assert named - set(own_map["data"].variables) == set()
