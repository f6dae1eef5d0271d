"""How a command runs: any terminal, Ctrl-C at any moment, and a help that is quick because little is loaded."""

import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
import warnings

import numpy as np
import pytest

import opfem as op
from opfem import cli
from opfem.cli import running
from tests.command_line import opfem

SMALL = ("--extent", "2", "2", "--l0", "0.5", "--elements", "6", "6", "2", "--smooth", "0.2")
# A test run in the background hands on that Ctrl-C is ignored; a terminal does not.
LISTEN = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); from opfem.cli import main; "


@pytest.fixture
def palpated(tmp_path, solution, monkeypatch):
    """Return what writes a result without solving, and without pictures."""
    monkeypatch.setattr("opfem.cli.palpate.solve", lambda *_: solution)
    monkeypatch.setattr("opfem.plot.draw_pictures", lambda *_: {})

    def palpate(name="map.npy"):
        np.save(tmp_path / name, np.full((17, 21), 0.45))
        return opfem("palpate", tmp_path / name, *SMALL, "--out", tmp_path / "o", "--force")

    return palpate


class TestOutput:
    @pytest.mark.parametrize(
        ("encoding", "said"),
        [
            ("ascii", "6 x 6 x 2 mean_dilatation"),
            ("latin-1", "6 × 6 × 2 mean_dilatation"),
            ("cp1252", "Mooney–Rivlin C10"),
            ("iso8859-2", "200 um FWHM"),
            ("koi8-r", "K/u = 20"),
            ("cp437", "200 µm FWHM"),
            ("shift_jis", "6 × 6 × 2 mean_dilatation"),
            ("utf-16", "6 × 6 × 2 mean_dilatation"),
            ("utf-8", "Mooney–Rivlin C10"),
        ],
    )
    def test_any_encoding(self, palpated, monkeypatch, encoding, said):
        out = io.BytesIO()
        monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(out, encoding=encoding))
        assert palpated() == 0
        text = out.getvalue().decode(encoding)
        assert said in text
        assert "result.nc to" in text

    @pytest.mark.parametrize("command", [(), ("palpate",), ("fit",), ("sweep",), ("demo",)])
    def test_help_in_ascii(self, monkeypatch, command):
        out = io.BytesIO()
        monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(out, encoding="ascii"))
        assert opfem(*command, "--help") == 0
        assert b"Usage: opfem" in out.getvalue()

    def test_no_output_at_all(self, palpated, monkeypatch):
        monkeypatch.setattr(sys, "stdout", None)
        assert palpated() == 0

    def test_a_file_name_that_is_no_text(self, palpated, tmp_path, capsys):
        name = os.fsdecode(b"m\xff\xe9.npy")
        assert palpated(name) == 0
        settings = json.loads((tmp_path / "o" / "summary.json").read_text(encoding="utf-8"))["settings"]
        assert settings["map"] == str(tmp_path / name)

    @pytest.mark.parametrize(("end", "said"), [("/dev/full", b"No space left"), ("closed", b"")])
    def test_output_that_ends(self, end, said):
        if end == "closed":
            reader, target = os.pipe()
            os.close(reader)
        else:
            target = os.open(end, os.O_WRONLY)
        answer = subprocess.run(
            [sys.executable, "-m", "opfem", "fit", "--help"], stdout=target, stderr=subprocess.PIPE, check=False
        )
        os.close(target)
        assert answer.returncode == 1
        assert said in answer.stderr
        assert b"Traceback" not in answer.stderr
        assert b"Exception" not in answer.stderr


def test_warnings_are_one_line_in_options(capsys):
    with running.reporting(debug=False), warnings.catch_warnings():
        warnings.simplefilter("always")
        for _ in range(2):
            warnings.warn('MAP looks like µm; pass unit="um".', UserWarning, stacklevel=1)
    assert capsys.readouterr().err == "opfem: MAP looks like µm; pass --unit um.\n"


class TestInterrupts:
    @pytest.mark.parametrize("module", ["cyclopts.core", "numpy", "jax._src.config", "equinox", "opfem.measurement"])
    def test_while_something_is_imported(self, tmp_path, module):
        process = subprocess.Popen(
            [
                sys.executable,
                "-X",
                "importtime",
                "-c",
                LISTEN + "main()",
                "palpate",
                "example",
                "--out",
                tmp_path / "o",
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        said = []
        for line in process.stderr:
            said.append(line)
            if line.rpartition("|")[2].strip() == module:
                break
        process.send_signal(signal.SIGINT)
        said.append(process.communicate(timeout=60)[1])
        assert process.returncode == 130
        assert "Interrupted" in said[-1]
        assert "Traceback" not in said[-1]

    @pytest.fixture
    def _as_in_a_process_of_its_own(self):
        former = signal.signal(signal.SIGINT, cli.leave)
        yield
        assert signal.getsignal(signal.SIGINT) is cli.leave
        signal.signal(signal.SIGINT, former)

    @pytest.mark.usefixtures("_as_in_a_process_of_its_own")
    def test_what_is_interrupted_may_raise_something_else(self, capsys):
        def convert():
            try:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(10.0)
            except KeyboardInterrupt as cause:
                raise ImportError("initialisation failed") from cause

        with pytest.raises(SystemExit) as end, running.reporting(debug=False):
            convert()
        assert end.value.code == 130
        assert capsys.readouterr().err == "opfem: Interrupted; no file was left half-written.\n"

    @pytest.mark.usefixtures("_as_in_a_process_of_its_own")
    def test_nothing_is_left_of_the_watch(self):
        def watches():
            return sum(thread.name == "opfem Ctrl-C" for thread in threading.enumerate())

        with running.reporting(debug=False):
            assert watches() == 1
        time.sleep(0.2)
        assert watches() == 0
        assert signal.set_wakeup_fd(-1) == -1

    @pytest.mark.slow
    def test_while_python_cannot_hear_it(self):
        """LAPACK runs for longer than the test; the process ends by its watch."""
        work = "import numpy as np; from opfem.cli.running import reporting; "
        handler = "from opfem.cli import leave; signal.signal(signal.SIGINT, leave); "
        long = "\nwith reporting(False):\n print('begun', flush=True); np.linalg.svd(np.random.rand(9000, 9000))"
        process = subprocess.Popen(
            [sys.executable, "-c", "import signal; " + handler + work + long],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stdout.readline() == "begun\n"
        time.sleep(3.0)
        process.send_signal(signal.SIGINT)
        _, said = process.communicate(timeout=20)
        assert process.returncode == 130
        assert said == "opfem: Interrupted; no file was left half-written.\n"


class TestWhatIsLoaded:
    @pytest.mark.parametrize("command", [(), ("palpate",), ("fit",), ("sweep",), ("demo",)])
    def test_help_loads_nothing_that_takes_time(self, command):
        code = f"import sys\nfrom opfem.cli import main\ntry: main([*{command!r}, '--help'])\nexcept SystemExit: pass\n"
        code += "print('loaded', *sorted({'jax', 'numpy', 'xarray', 'scipy', 'matplotlib'} & set(sys.modules)))"
        answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert answer.stdout.splitlines()[-1] == "loaded"
        assert "Usage: opfem" in answer.stdout

    def test_the_package_is_a_command(self):
        answer = subprocess.run(
            [sys.executable, "-m", "opfem", "--version"], capture_output=True, text=True, check=True
        )
        assert answer.stdout == f"opfem {op.__version__}\n"

    def test_completion_is_installed(self, tmp_path):
        home = {**os.environ, "HOME": str(tmp_path), "SHELL": "/bin/bash"}
        command = [sys.executable, "-m", "opfem", "--install-completion"]
        answer = subprocess.run([*command, "--shell", "bash"], env=home, capture_output=True, text=True, check=True)
        script = tmp_path / ".local" / "share" / "bash-completion" / "completions" / "opfem"
        assert "palpate" in script.read_text()
        assert str(script) in answer.stdout
