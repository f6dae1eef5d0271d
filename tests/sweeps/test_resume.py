"""A sweep that was killed goes on where it was, and ends as if it had not been."""

import json
import random
import subprocess
import sys
import textwrap
import time

import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.sweeps.store import FINISHED, PLAN, POINTS

AXES = {"a": np.linspace(0.1, 2.0, 5), "b": np.linspace(0.0, 1.0, 4)}
FACTOR = 2.0
# A sweep of 60 points that takes some seconds, in a process of its own.
PROGRAM = """
    import sys, time
    import jax, jax.numpy as jnp, numpy as np
    import opfem as op
    jax.config.update("jax_enable_x64", True)

    def turns(a, b):
        angle = jax.lax.fori_loop(0, 20_000, lambda i, x: jnp.sin(x) + a, b)
        jax.debug.callback(lambda: time.sleep(0.05))
        return {"angle": angle, "powers": angle ** jnp.arange(4.0)}

    out, mode, size = sys.argv[1:]
    axes = {"a": np.linspace(0.1, 2.0, 10), "b": np.linspace(0.0, 1.0, 6)}
    op.sweep(turns, axes, out=out, execution=op.Batch(int(size), mode))
"""


def wave(a, b):
    return {"wave": FACTOR * jnp.sin(a + b), "field": a * jnp.arange(3.0)}


def sweep(out, fn=wave, axes=AXES, **settings):
    settings = {"execution": op.Batch(3, "map"), **settings}
    return op.sweep(fn, axes, out=out, **settings).drop_vars("wall_time")


def files(out):
    """List the points; a kill may leave a hidden file that was being written."""
    return sorted(file for file in (out / POINTS).glob("*.npz") if not file.name.startswith("."))


def start(out, mode="map", size=1):
    return subprocess.Popen([sys.executable, "-c", textwrap.dedent(PROGRAM), str(out), mode, str(size)])


def run(out, mode="map", size=1):
    assert start(out, mode, size).wait(120) == 0
    return op.read_netcdf(out / FINISHED).drop_vars("wall_time")


def test_a_finished_sweep_is_read_not_computed(tmp_path):
    first = sweep(tmp_path / "out")
    written = {file: file.stat().st_mtime_ns for file in files(tmp_path / "out")}
    assert len(written) == 20
    assert sweep(tmp_path / "out").identical(first)
    assert op.read_netcdf(tmp_path / "out" / FINISHED).drop_vars("wall_time").identical(first)
    assert {file: file.stat().st_mtime_ns for file in files(tmp_path / "out")} == written


@pytest.mark.parametrize("execution", [op.Batch(3, "map"), op.Batch(8, "vmap"), op.Batch(mode="call")])
def test_only_what_is_missing_is_computed(tmp_path, execution):
    whole = sweep(tmp_path / "out", execution=execution)
    kept = files(tmp_path / "out")
    removed = kept[::3]
    for file in removed:
        file.unlink()
    before = {file: file.read_bytes() for file in set(kept) - set(removed)}
    assert sweep(tmp_path / "out", execution=execution).identical(whole)
    assert files(tmp_path / "out") == kept
    assert {file: file.read_bytes() for file in before} == before


@pytest.mark.parametrize("damage", ["cut", "flip", "empty", "another"])
def test_a_damaged_file_is_never_read_as_whole(tmp_path, damage):
    whole = sweep(tmp_path / "out")
    first, second = files(tmp_path / "out")[:2]
    content = bytearray(first.read_bytes())
    if damage == "cut":
        first.write_bytes(content[: len(content) // 2])
    elif damage == "flip":
        content[content.index(b"\x93NUMPY") + 130] ^= 1
        first.write_bytes(content)
    elif damage == "empty":
        first.write_bytes(b"")
    else:
        first.write_bytes(second.read_bytes())
    assert sweep(tmp_path / "out").identical(whole)


def test_what_was_left_half_written_is_ignored(tmp_path):
    whole = sweep(tmp_path / "out")
    (tmp_path / "out" / POINTS / ".half.0123.npz").write_bytes(b"PK")
    assert sweep(tmp_path / "out").identical(whole)


def test_points_that_raised_are_tried_again(tmp_path):
    licence = tmp_path / "licence"

    def fickle(a):
        if a == 2.0 and not licence.exists():
            raise OSError("no licence")
        return float(a)

    once = sweep(tmp_path / "out", fickle, {"a": [1.0, 2.0]}, execution=op.Batch(mode="call"))
    assert once.status.values.tolist() == ["successful", "error"]
    assert once.message.values.tolist() == ["", "OSError: no licence"]
    licence.touch()
    again = sweep(tmp_path / "out", fickle, {"a": [1.0, 2.0]}, execution=op.Batch(mode="call"))
    assert again.status.values.tolist() == ["successful", "successful"]
    np.testing.assert_array_equal(again.fickle, [1.0, 2.0])


def test_failures_are_kept_with_their_reason(tmp_path):
    def root(a):
        return jnp.sqrt(a)

    once = sweep(tmp_path / "out", root, {"a": [1.0, -1.0]})
    again = sweep(tmp_path / "out", root, {"a": [1.0, -1.0]})
    assert again.identical(once)
    assert again.status.values.tolist() == ["successful", "nonfinite"]


def test_another_sweep_is_refused(tmp_path, monkeypatch):
    out = tmp_path / "out"
    sweep(out)
    with pytest.raises(ValueError, match=r"different inputs: axis a, axis b. Choose another out="):
        sweep(out, axes={**AXES, "a": [1.0]})
    with pytest.raises(ValueError, match="different inputs: keep"):
        sweep(out, keep=lambda answer: {"wave": answer["wave"]})
    with pytest.raises(ValueError, match=r"begun with Plan\(mode='map', size=3.*got Plan\(mode='map', size=4"):
        sweep(out, execution=op.Batch(4, "map"))
    assert sweep(out, execution=op.Batch()).identical(sweep(out))
    with monkeypatch.context() as patched:
        patched.setitem(globals(), "FACTOR", 3.0)
        with pytest.raises(ValueError, match="different inputs: function"):
            sweep(out)
    record = json.loads((out / PLAN).read_text())
    record["inputs"]["jaxlib_version"] = "0.0.1"
    (out / PLAN).write_text(json.dumps(record))
    with pytest.raises(ValueError, match="different inputs: jaxlib_version"):
        sweep(out)
    (out / PLAN).write_text("{")
    with pytest.raises(ValueError, match="is no record of a sweep"):
        sweep(out)


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(ValueError, match=r"is not empty, and holds no sweep.json"):
        sweep(tmp_path)


def test_what_cannot_be_hashed_is_refused_before_anything_is_made(tmp_path):
    generator = np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"generator is a Generator, whose content op.sweep cannot hash"):
        sweep(tmp_path / "out", lambda a, b: generator.random())
    assert not (tmp_path / "out").exists()


def kill_in_the_middle(out, chance, mode="map", size=1):
    """Run until some points are there, then kill at a random moment."""
    process = start(out, mode, size)
    before = len(files(out))
    while len(files(out)) == before and process.poll() is None:
        time.sleep(0.005)
    time.sleep(chance.uniform(0.0, 0.3))
    process.kill()  # SIGKILL; nothing, where it has just ended
    process.wait()
    return len(files(out))


def test_two_processes_may_work_on_one_sweep(tmp_path):
    both = [start(tmp_path / "out") for _ in range(2)]
    assert [process.wait(120) for process in both] == [0, 0]
    assert len(files(tmp_path / "out")) == 60
    assert run(tmp_path / "out").identical(run(tmp_path / "alone"))


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "size"), [("map", 1), ("map", 4), ("vmap", 8)])
def test_killed_five_times(tmp_path, mode, size):
    chance = random.Random(size)
    counts = [kill_in_the_middle(tmp_path / "killed", chance, mode, size) for _ in range(5)]
    assert counts[0] < 60  # the first at least was killed in the middle
    assert not (tmp_path / "killed" / FINISHED).exists() or counts[-1] == 60
    assert run(tmp_path / "killed", mode, size).identical(run(tmp_path / "whole", mode, size))


def test_killed_once(tmp_path):
    assert 0 < kill_in_the_middle(tmp_path / "killed", random.Random(0)) < 60
    assert run(tmp_path / "killed").identical(run(tmp_path / "whole"))
