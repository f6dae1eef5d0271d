"""What a long call says: on a terminal, in a log, and inside another one."""

import threading
import time

import jax
import jax.numpy as jnp
import pytest

from opfem.solvers import progress
from opfem.solvers.progress import Progress


@pytest.fixture(autouse=True)
def _no_terminal(monkeypatch):
    for name in ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE", "JUPYTER_COLUMNS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(progress, "_TICK", 0.01)


def lines(capsys) -> list[str]:
    """What was said, without the seconds."""
    said = capsys.readouterr().err.splitlines()
    assert all(line.startswith("opfem ") and line[12:14] == "  " for line in said)
    return [line[14:] for line in said]


def until(condition) -> None:
    """Wait, a minute at most: the machine may be busy."""
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_log_gets_a_line_a_stage_and_calls_inside_add_theirs(capsys):
    with Progress(True, at_once=True) as outer:
        outer.stage("reading")
        with Progress(True) as inner:
            inner.stage("solver")
            inner.show("load 37 %, 4 Newton steps", 0.37)
            with Progress(False) as innermost:
                innermost.stage("a solve of which nobody wants to hear")
        outer.stage("writing")
    assert lines(capsys) == ["reading", "solver", "writing"]
    assert not [thread for thread in threading.enumerate() if thread.name == "opfem progress"]


def test_a_long_stage_is_not_silent(capsys, monkeypatch):
    monkeypatch.setattr(progress, "_EVERY", 0.05)
    said = []
    with Progress(True, at_once=True) as shown:
        shown.stage("solver")
        shown.show("load 37 %, 4 Newton steps", 0.37)
        until(lambda: said.extend(lines(capsys)) or len(said) > 2)
    assert said[0] == "solver"
    assert set(said[1:]) == {"load 37 %, 4 Newton steps"}


def test_a_line_is_said_once_in_the_log_of_a_long_call(capsys, monkeypatch):
    with Progress(True, at_once=True) as shown:
        shown.stage("sweep")
        shown.line("1 of 2 points")
        shown.line("2 of 2 points")
    assert lines(capsys) == ["sweep", "1 of 2 points", "2 of 2 points"]
    with Progress(True) as short:
        short.stage("sweep")
        short.line("1 of 2 points")
    assert lines(capsys) == []


def test_short_library_calls_are_quiet_and_long_ones_are_not(capsys, monkeypatch):
    for _ in range(3):
        with Progress(True) as shown:
            shown.stage("solver")
    assert lines(capsys) == []
    monkeypatch.setattr(progress, "_PATIENCE", 0.1)
    said = []
    with Progress(True) as shown:
        shown.stage("solver")
        until(lambda: said.extend(lines(capsys)) or said)
    assert said == ["solver"]


def test_a_compilation_is_seen_and_named(capsys, monkeypatch):
    monkeypatch.setattr(progress, "_NOTABLE", 0.0)
    monkeypatch.setattr(progress, "_EVERY", 0.05)

    def slow_to_compile(x):
        for k in range(60):
            x = jnp.linalg.solve(jnp.eye(3) + k * jnp.outer(x, x), jnp.sort(x))
        return x

    with Progress(True, at_once=True) as shown:
        shown.stage("solver", compiles="the solver, about 20 s the first time")
        jax.jit(slow_to_compile).lower(jnp.arange(3.0)).compile()
        shown.stage("fields")
        until(lambda: not progress._COMPILING)
    said = lines(capsys)
    assert "compiling the solver, about 20 s the first time" in said
    assert said[-1] == "fields"


def test_calls_inside_many_of_a_kind_are_mute(capsys):
    with Progress(True, at_once=True) as outer:
        outer.stage("reading")
        with Progress(True, alone=True) as sweep:
            sweep.stage("sweep")
            with Progress(True, at_once=True) as point:
                point.stage("solver")
        outer.stage("writing")
    assert lines(capsys) == ["reading", "sweep", "writing"]


def test_a_terminal_gets_one_line_that_is_gone_at_the_end(capsys, monkeypatch):
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("TTY_INTERACTIVE", "1")
    monkeypatch.setenv("TERM", "xterm")
    with Progress(True) as shown:
        shown.stage("solver")
        shown.show("load 37 %, 4 Newton steps", 0.37)
        shown._display._bar.refresh()
        with Progress(True) as inside:
            inside.stage("fields")
            shown._display._bar.refresh()
    said = capsys.readouterr().err
    assert "load 37 %, 4 Newton steps" in said
    assert "fields" in said
    assert said.endswith("\x1b[1A\x1b[2K")


def test_an_error_ends_it(capsys):
    with pytest.raises(KeyboardInterrupt), Progress(True, at_once=True):
        raise KeyboardInterrupt
    with Progress(True, at_once=True) as another:
        another.stage("reading")
    assert lines(capsys) == ["reading"]


def test_long_work_says_how_long_is_left(monkeypatch):
    clock = iter((0.0, 0.0, 0.0, 10.0, 60.0, 80.0))
    monkeypatch.setattr(progress._Display, "_time", lambda self: next(clock))
    monkeypatch.setattr(progress._Display, "_keep_up", lambda self: None)
    said = []
    monkeypatch.setattr(progress._Display, "put", lambda self, now: said.append(now.text) or setattr(self, "now", now))
    with Progress(True) as shown:
        shown.stage("solver")
        for fraction in (0.0, 0.125, 0.25, 0.75):
            shown.show("load", fraction, estimate=True)
    assert said == ["solver", "load", "load, about 70 s left", "load, about 3 min left", "load, about 27 s left"]
