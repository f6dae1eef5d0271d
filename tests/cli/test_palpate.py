"""`opfem palpate` and `opfem fit`: what they write, what they refuse, and how they end when something goes wrong."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest
import pyvista
import scipy.io
import xarray as xr
from PIL import Image

import opfem as op
from opfem import cli
from tests.command_line import opfem

FILES = ("result.vtu", "pressure.png", "report.png", "report.html", "summary.json", "result.nc")
FIT_FILES = ("result.vtu", "pressure.png", "fit.png", "report.html", "summary.json", "result.nc")
SMALL = ("--extent", "2", "2", "--l0", "0.5", "--elements", "6", "6", "2", "--smooth", "0.2")


def contents(folder) -> dict[str, bytes]:
    """Read every file of a folder, hidden ones too."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def map_file(tmp_path):
    x, y = np.meshgrid(np.linspace(0.0, 2.0, 21), np.linspace(0.0, 2.0, 17))
    thickness = 0.5 * (1 - 0.07 - 0.06 * np.exp(-((x - 1.2) ** 2 + (y - 0.8) ** 2) / 0.3))
    thickness[3, 4] = np.nan
    np.save(tmp_path / "map.npy", thickness)
    return tmp_path / "map.npy"


@pytest.fixture
def solved(monkeypatch, solution):
    """The solve answers at once, with a solution of the same map."""
    calls = []

    def answer(palpation, load, solver):
        calls.append((palpation, load, solver))
        return solution

    monkeypatch.setattr("opfem.cli.palpate.solve", answer)
    return calls


def test_incompressible_layer(tmp_path, map_file, solved, capsys):
    layer = ("--c10", 2e-3, "--c01", 7e-4, "--bulk", "inf", "--element", "hybrid")
    assert opfem("palpate", map_file, *SMALL, *layer, "--out", tmp_path / "a") == 0
    ((palpation, _, _),) = solved
    assert palpation.element == "hybrid"
    assert np.isinf(palpation.layer.material.bulk)
    assert "incompressible" in capsys.readouterr().out
    # JSON knows no infinite number.
    written = json.loads((tmp_path / "a" / "summary.json").read_text(), parse_constant=pytest.fail)
    assert written["settings"]["bulk"] == "inf"


def test_palpate_from_map_to_files(tmp_path, map_file, capsys):
    out = tmp_path / "new" / "stress"
    assert opfem("palpate", map_file, *SMALL, "--out", out) == 0
    assert sorted(os.listdir(out)) == sorted(FILES)

    dataset = op.read_netcdf(out / "result.nc")
    assert dataset.attrs["status"] in ("successful", "slides_off")
    assert dataset.pressure.shape == (7, 7)
    assert int(dataset.missing.sum()) == 1
    steps = [step["step"] for step in json.loads(dataset.attrs["thickness_steps"])]
    assert steps == ["read", "filled", "smoothed"]

    numbers = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert numbers["pressure_max_kPa"] == pytest.approx(1e3 * float(dataset.pressure.max()))
    assert numbers["settings"]["assumed"] == ["c10", "c01", "bulk"]
    assert numbers["settings"]["smooth"] == 0.2
    assert pyvista.read(out / "result.vtu").n_cells == 72
    for picture in ("pressure.png", "report.png"):
        with Image.open(out / picture) as image:
            assert min(image.size) > 500

    said = capsys.readouterr().out
    assert "Assumed: c10, c01, bulk" in said
    assert "1 missing and filled" in said
    assert f"{numbers['pressure_mean_touching_kPa']:.3g}" in said
    assert "kPa" in said


@pytest.mark.slow
@pytest.mark.parametrize("spread", [(), ("--modulus-spread", 0.2)])
def test_fit_from_map_to_files(tmp_path, map_file, spread):
    out = tmp_path / "stress"
    assert opfem("fit", map_file, *SMALL, *spread, "--std", 2e-3, "--draws", 2, "--out", out) == 0
    assert sorted(os.listdir(out)) == sorted(FIT_FILES)

    dataset = op.read_netcdf(out / "result.nc")
    assert dataset.attrs["fit_status"] == "successful"
    assert dataset.pressure_std.shape == (7, 7)
    numbers = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert numbers["pressure_std_max_kPa"] == pytest.approx(1e3 * float(dataset.pressure_std.max()))
    assert list(numbers["fitted_numbers"]) == (["layer.material.c10"] if spread else [])
    for name, (low, high) in numbers["fitted_intervals_95_percent"].items():
        assert low < numbers["fitted_numbers"][name] < high
    assert pyvista.read(out / "result.vtu").n_cells == 72


def test_report_says_what_was_given_and_what_assumed(tmp_path, map_file, solved):
    given = ("--c10", "0.003", "--bulk", "0.2", "--window-friction=0.15", "--elements", "6", "6", "2")
    assert opfem("palpate", map_file, "--extent", 2, 2, "--l0", 0.5, *given, "--out", tmp_path / "a") == 0
    attrs = op.read_netcdf(tmp_path / "a" / "result.nc").attrs
    assert (
        attrs["command"] == f"opfem palpate {map_file} --extent 2 2 --l0 0.5 {' '.join(given)} --out {tmp_path / 'a'}"
    )
    assumed = set(json.loads(attrs["assumed"]))
    assert {"layer.material.c01", "sample.friction", "sample.law.pressure", "smooth", "element"} <= assumed
    assert not {"layer.material.c10", "layer.material.bulk", "window.friction", "elements"} & assumed
    page = (tmp_path / "a" / "report.html").read_text(encoding="utf-8")
    assert "Assumed, because nobody said otherwise. Layer: sides, C01; Window: contact law; Sample: contact law" in page
    assert attrs["command"] in page


def test_no_report(tmp_path, map_file, solved):
    assert opfem("palpate", map_file, *SMALL, "--no-report", "--out", tmp_path / "a") == 0
    assert sorted(os.listdir(tmp_path / "a")) == sorted(set(FILES) - {"report.html"})
    # One that is replaced goes with the rest of its result.
    assert opfem("palpate", map_file, *SMALL, "--force", "--out", tmp_path / "a") == 0
    assert (tmp_path / "a" / "report.html").is_file()
    assert opfem("palpate", map_file, *SMALL, "--no-report", "--force", "--out", tmp_path / "a") == 0
    assert not (tmp_path / "a" / "report.html").exists()


def test_defaults_are_the_published_case(tmp_path, map_file, solved):
    assert opfem("palpate", map_file, "--extent", 2, 2, "--l0", 0.5, "--out", tmp_path / "o") == 0
    palpation, load, solver = solved[0]
    expected = op.Palpation(
        op.Layer(0.5, op.MooneyRivlin(c10=0.00223, c01=0.000703, bulk=0.11732)),
        extent=(2.0, 2.0),
        elements=(40, 40, 4),
        window=op.Contact(op.HardOverclosure(), 0.15),
        sample=op.Contact(op.ExponentialOverclosure(2.0, 0.01), 0.05),
    )
    assert eqx.tree_equal(palpation, expected)
    assert eqx.tree_equal(solver, op.Newton())
    # Half an element.
    assert float(load.thickness.steps[-1].numbers["fwhm"]) == pytest.approx(0.025)
    assert not load.correct_approach


def test_files_for_other_programs_come_and_go_with_the_result(tmp_path, map_file, solved, loaded):
    out = tmp_path / "o"
    asked = ("--also", "csv", "mat", "tiff", "--pdf", "--svg")
    assert opfem("palpate", map_file, *SMALL, *asked, "--out", out) == 0
    drawings = {f"{name}.{kind}" for name in ("pressure", "report") for kind in ("pdf", "svg")}
    assert set(os.listdir(out)) == {*FILES, *drawings, "result.csv", "result.tif", "result.mat"}
    assert (out / "report.pdf").read_bytes().startswith(b"%PDF")
    assert b"<svg" in (out / "pressure.svg").read_bytes()[:1000]
    held = scipy.io.loadmat(out / "result.mat")
    # The map as measured, neither filled nor smoothed.
    np.testing.assert_allclose(held["measured_um"], 1e3 * np.load(map_file))
    assert opfem("palpate", map_file, *SMALL, "--out", out, "--force") == 0
    assert set(os.listdir(out)) == set(FILES)


def test_warnings_are_printed_in_options_and_kept(tmp_path, map_file, solved, capsys):
    """Noise of 10 nm, which no mesh follows."""
    assert opfem("palpate", map_file, *SMALL, "--std", 1e-5, "--out", tmp_path / "o") == 0
    said = "The mesh does not follow the map"
    assert said in capsys.readouterr().out
    numbers = json.loads((tmp_path / "o" / "summary.json").read_text(encoding="utf-8"))
    assert [warning.partition(":")[0] for warning in numbers["warnings"]] == [said]


def test_options_arrive(tmp_path, map_file, solved):
    given = """
        --c10 0.003 --c01 0.0005 --bulk 0.2 --window-friction 0.3 --sample-friction 0.1 --p0 1 --c0 0.02 --sides roller
        --element full --elements 8 6 2 --increments 5 --smooth 0 --correct-approach --layer-extent 1.5 1.8
    """
    assert opfem("palpate", map_file, "--extent", 2, 2, "--l0", 0.4, *given.split(), "--out", tmp_path / "o") == 0
    palpation, load, solver = solved[0]
    expected = op.Palpation(
        op.Layer(0.4, op.MooneyRivlin(c10=0.003, c01=0.0005, bulk=0.2)),
        extent=(1.5, 1.8),
        elements=(8, 6, 2),
        window=op.Contact(op.HardOverclosure(), 0.3),
        sample=op.Contact(op.ExponentialOverclosure(1.0, 0.02), 0.1),
        sides="roller",
        element="full",
    )
    assert eqx.tree_equal(palpation, expected)
    assert solver.increments == 5
    assert load.correct_approach
    assert [step.name for step in load.thickness.steps] == ["read", "filled"]


def test_compiled_programs_are_kept_unless_refused(tmp_path, map_file, solved, monkeypatch):
    asked = []
    monkeypatch.setattr("opfem.cli.statement.cache_compilation", lambda: asked.append(True))
    assert opfem("palpate", map_file, *SMALL, "--out", tmp_path / "a") == 0
    assert asked == [True]
    assert opfem("palpate", map_file, *SMALL, "--out", tmp_path / "b", "--no-cache") == 0
    assert asked == [True]


def test_explicit_solver_arrives(tmp_path, map_file, solved):
    options = ("--solver", "explicit", "--duration", 0.1, "--mass-scaling", 5, "--precision", "float32")
    assert opfem("palpate", map_file, *SMALL, *options, "--out", tmp_path / "a") == 0
    ((_, _, solver),) = solved
    assert isinstance(solver, op.Explicit)
    assert (solver.duration, solver.mass_scaling, solver.precision) == (0.1, 5.0, "float32")


@pytest.mark.parametrize("options", [("--duration", 0.1), ("--solver", "explicit", "--increments", 4)])
def test_options_of_the_other_solver_are_refused(tmp_path, map_file, solved, capsys, options):
    assert opfem("palpate", map_file, *SMALL, *options, "--out", tmp_path / "a") == 1
    assert "--solver" in capsys.readouterr().err


@pytest.mark.slow
def test_palpate_by_explicit_dynamics(tmp_path, map_file):
    options = ("--solver", "explicit", "--duration", 0.2)
    assert opfem("palpate", map_file, *SMALL, *options, "--out", tmp_path / "a") == 0
    written = json.loads((tmp_path / "a" / "summary.json").read_text())
    assert written["status"] == "successful"
    assert 0 < written["kinetic_energy_percent"] < 1
    with xr.open_dataset(tmp_path / "a" / "result.nc") as data:
        assert data.energy_strain.sizes == {"output": 21}


def test_unloaded_map(tmp_path, map_file, solved):
    np.save(tmp_path / "l0.npy", np.full((17, 21), 500.0))
    np.save(map_file, 1e3 * np.load(map_file))
    arguments = ("--extent", 2, 2, "--unit", "um", "--l0", tmp_path / "l0.npy", "--out", tmp_path / "o")
    assert opfem("palpate", map_file, *arguments) == 0
    thickness = solved[0][0].layer.thickness
    np.testing.assert_allclose(thickness.values, 0.5)
    assert [step.name for step in thickness.steps] == ["read", "smoothed"]


def test_example_is_written_and_is_its_own_input(tmp_path, solved, monkeypatch):
    monkeypatch.setattr("opfem.plot.draw_pictures", lambda *_: {})  # the solution is of another map
    assert opfem("palpate", "example", "--out", tmp_path / "o") == 0
    assert {"example_map.npz", "result.nc"} <= set(os.listdir(tmp_path / "o"))
    assert eqx.tree_equal(op.read_thickness(tmp_path / "o" / "example_map.npz"), op.measurement.example_map())


class TestRefusals:
    def test_unloaded_map_on_another_grid(self, tmp_path, map_file, solved, capsys):
        np.save(tmp_path / "l0.npy", np.full((17, 20), 0.5))
        message = self.refused(capsys, map_file, "--extent", 2, 2, "--l0", tmp_path / "l0.npy", "--out", tmp_path / "o")
        assert "--l0 [pixels] must be on the grid of MAP, (17, 21)" in message
        assert "got (17, 20). Resample" in message

    def test_map_smaller_than_the_layer(self, tmp_path, map_file, solved, capsys):
        message = self.refused(capsys, map_file, *SMALL, "--layer-extent", 2, 2.5, "--out", tmp_path / "o")
        assert "--layer-extent [mm] must lie on the map, which ends at x, y = [2.0, 2.0], got (2.0, 2.5)" in message

    def refused(self, capsys, *arguments, status=1) -> str:
        assert opfem("palpate", *arguments) == status
        said = capsys.readouterr()
        assert "Traceback" not in said.err + said.out
        return said.err

    def test_finished_result(self, tmp_path, map_file, solved, capsys):
        out = tmp_path / "o"
        assert opfem("palpate", map_file, *SMALL, "--out", out) == 0
        before = {path.name: path.stat().st_mtime_ns for path in out.iterdir()}
        capsys.readouterr()
        assert "--force" in self.refused(capsys, map_file, *SMALL, "--out", out)
        assert {path.name: path.stat().st_mtime_ns for path in out.iterdir()} == before
        assert opfem("palpate", map_file, *SMALL, "--out", out, "--force") == 0
        assert all(path.stat().st_mtime_ns > before[path.name] for path in out.iterdir())

    def test_folder_that_cannot_be_written(self, tmp_path, map_file, solved, capsys):
        (tmp_path / "file").write_text("")
        for out in (tmp_path / "file", tmp_path / "file" / "o"):
            assert "Cannot write results" in self.refused(capsys, map_file, *SMALL, "--out", out)
        assert solved == []

    def test_missing_file(self, tmp_path, solved, capsys):
        said = self.refused(capsys, tmp_path / "none.mat", *SMALL, "--out", tmp_path / "o")
        assert "none.mat: no such file" in said
        assert not (tmp_path / "o").exists()

    def test_wrong_unit(self, tmp_path, map_file, solved, capsys):
        said = self.refused(capsys, map_file, *SMALL, "--unit", "um", "--out", tmp_path / "o")
        assert "unit" in said
        assert "--unit" in self.refused(capsys, map_file, *SMALL, "--unit", "inch", "--out", tmp_path / "o", status=2)

    @pytest.mark.parametrize(
        ("arguments", "reason"),
        [
            (("--extent", 2, 2), "--l0 is needed"),
            (("--l0", 0.5), "needs either --extent Lx Ly or --spacing dx dy"),
            (("--extent", 2, 2, "--l0", 0.5, "--c10", 0.003), "--bulk"),
            (("--extent", 2, 2, "--l0", 0.5, "--elements", 3, 3, 3, "--element", "tet10"), "--elements must be even"),
        ],
    )
    def test_options(self, tmp_path, map_file, solved, capsys, arguments, reason):
        assert reason in self.refused(capsys, map_file, *arguments, "--out", tmp_path / "o")
        assert solved == []

    def test_example_with_a_grid(self, tmp_path, solved, capsys):
        assert "--extent" in self.refused(capsys, "example", "--extent", 2, 2, "--out", tmp_path / "o")

    def test_map_away_from_the_origin(self, tmp_path, loaded, solved, capsys):
        op.write_thickness(loaded.cropped(x=(0.5, 1.5)), tmp_path / "cropped.npz")
        arguments = (tmp_path / "cropped.npz", "--l0", 0.5, "--out", tmp_path / "o")
        assert "--layer-extent" in self.refused(capsys, *arguments)

    def test_traceback_on_demand(self, tmp_path, map_file, monkeypatch, capsys):
        def fail(*_):
            raise RuntimeError("inner")

        monkeypatch.setattr("opfem.cli.palpate.solve", fail)
        said = self.refused(capsys, map_file, *SMALL, "--out", tmp_path / "o")
        assert "Unexpected RuntimeError: inner" in said
        with pytest.raises(RuntimeError, match="inner"):
            cli.main([str(part) for part in ("palpate", map_file, *SMALL, "--out", tmp_path / "o", "--debug")])


class TestFailures:
    def test_no_convergence_is_recorded(self, tmp_path, map_file, failed_solution, monkeypatch, capsys):
        def fail(*_):
            raise op.ConvergenceError("The solve stopped at 40.0% of the load.", failed_solution)

        monkeypatch.setattr("opfem.cli.palpate.solve", fail)
        out = tmp_path / "o"
        assert opfem("palpate", map_file, *SMALL, "--out", out) == 1
        assert "stopped at 40.0% of the load" in capsys.readouterr().err
        assert os.listdir(out) == ["summary.json"]
        numbers = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        assert numbers["status"] == "increment_too_small"
        assert numbers["load_reached_percent"] == pytest.approx(40)
        assert numbers["pressure_max_kPa"] is None

    def test_no_convergence_keeps_the_earlier_result(self, tmp_path, map_file, failed_solution, monkeypatch, capsys):
        def fail(*_):
            raise op.ConvergenceError("The solve stopped at 40.0% of the load.", failed_solution)

        monkeypatch.setattr("opfem.cli.palpate.solve", fail)
        out = tmp_path / "o"
        out.mkdir()
        (out / "result.nc").write_text("of an earlier run")
        assert opfem("palpate", map_file, *SMALL, "--out", out, "--force") == 1
        assert f"{out} keeps its finished result" in capsys.readouterr().err
        assert os.listdir(out) == ["result.nc"]
        assert (out / "result.nc").read_text() == "of an earlier run"

    def test_interrupted_solve_keeps_the_earlier_result(self, tmp_path, map_file, monkeypatch, capsys):
        def interrupt(*_):
            raise KeyboardInterrupt

        out = tmp_path / "o"
        out.mkdir()
        (out / "result.nc").write_text("of an earlier run")
        monkeypatch.setattr("opfem.cli.palpate.solve", interrupt)
        assert opfem("palpate", map_file, *SMALL, "--out", out, "--force") == 130
        assert "Interrupted" in capsys.readouterr().err
        assert os.listdir(out) == ["result.nc"]

    def test_an_interrupt_that_python_drops_is_raised_again(self, tmp_path, map_file, monkeypatch, capsys):
        class Callback:
            def __del__(self):
                raise KeyboardInterrupt

        def solve(*_):
            Callback()
            for _ in range(3000):
                time.sleep(0.01)

        monkeypatch.setattr("opfem.cli.palpate.solve", solve)
        # A test run in the background ignores Ctrl-C.
        former = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            assert opfem("palpate", map_file, *SMALL, "--out", tmp_path / "o") == 130
        finally:
            signal.signal(signal.SIGINT, former)
        assert "Interrupted" in capsys.readouterr().err

    def test_interrupted_writing_keeps_the_earlier_result(self, tmp_path, map_file, solved, monkeypatch):
        monkeypatch.setattr("opfem.plot.draw_pictures", lambda *_: {})
        out = tmp_path / "o"
        assert opfem("palpate", map_file, *SMALL, "--out", out) == 0
        before = contents(out)
        write = Path.write_bytes

        def half(path, content):
            write(path, bytes(content)[: len(content) // 2])
            if path.name == "result.nc":
                raise KeyboardInterrupt

        monkeypatch.setattr(Path, "write_bytes", half)
        assert opfem("palpate", map_file, *SMALL, "--out", out, "--force") == 130
        assert contents(out) == before


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [2, 5])
def test_ctrl_c_in_a_fresh_process(tmp_path, seconds):
    """The interpreter ends in order although a computation is in flight."""
    out = tmp_path / "o"
    # A test run in the background hands on that Ctrl-C is ignored; a terminal does not.
    listen = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    code = f"{listen}; from opfem.cli import main; main()"
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", code, "palpate", "example", "--out", out, "--elements", "20", "20", "4"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    for line in process.stdout:
        if b"Assumed" in line:  # the last before the solve
            break
    time.sleep(seconds)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert b"Interrupted" in said
    assert os.listdir(out) == []


def test_help_in_a_fresh_process():
    code = "from opfem.cli import main; main(['palpate', '--help'])"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for option in ("--out", "--l0", "--extent", "--elements", "--bulk", "--window-friction", "--force"):
        assert option in answer.stdout
    code = "import opfem.cli, jax, sys; print(jax.config.jax_enable_x64, 'matplotlib' in sys.modules)"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "False False"


@pytest.mark.parametrize("coin", [False, True], ids=["example", "coin"])
def test_demo_solves_a_sample_of_its_own(tmp_path, monkeypatch, shared, solved, coin):
    monkeypatch.setenv("OPFEM_DATA", str(tmp_path / "data"))
    if coin:
        (tmp_path / "data").mkdir()
        name = "coin_5c_1-thickness.mat"
        (tmp_path / "data" / name).write_bytes((shared / "data" / name).read_bytes())
    monkeypatch.setattr("opfem.cli.palpate.write_results", lambda *_, **__: [])
    assert opfem("demo", *["--coin"] * coin, "--out", tmp_path / "demo") == 0
    ((palpation, load, _),) = solved
    assert load.thickness.shape == ((502, 502) if coin else (201, 201))
    np.testing.assert_allclose(palpation.extent, 5.0)
    assert float(palpation.layer.thickness) == 0.5


@pytest.mark.parametrize(
    ("l0", "message"), [(500, "got 500; is it in µm?"), (5e-4, "got 0.0005; is it in m?"), (25, "got 25; is it in µm?")]
)
@pytest.mark.parametrize("command", ["palpate", "fit"])
def test_l0_in_another_unit_is_refused_before_the_solve(tmp_path, map_file, solved, capsys, command, l0, message):
    options = ("--extent", 2, 2, "--elements", 6, 6, 2, "--std", 0.002, "--l0", l0, "--out", tmp_path / "out")
    assert opfem(command, map_file, *options) == 1
    assert message in capsys.readouterr().err
    assert solved == []
