"""Compiled programs on disk, and what may go wrong with them."""

import os
import shutil
import subprocess
import sys
import time
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

import opfem as op
from opfem import compilation

ROOT = Path(__file__).resolve().parents[1]
OPTIONS = (
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_enable_xla_caches",
)
ANSWER = 1.0969782335466


@pytest.fixture
def settings_restored(monkeypatch):
    before = {name: getattr(jax.config, name) for name in OPTIONS}
    monkeypatch.delenv("OPFEM_NO_CACHE", raising=False)
    monkeypatch.setattr(compilation, "_SAID", [])
    with warnings.catch_warnings():
        warnings.simplefilter("default")  # elsewhere warnings are errors; here the package shows them
        yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def program() -> float:
    jax.clear_caches()
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)  # this one compiles in no time
    return float(jax.jit(lambda v: jnp.cos(v) * 1.25)(0.5))


def entries(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*-cache")}


@pytest.mark.usefixtures("settings_restored")
def test_a_program_compiled_after_others_is_kept_and_found_again(tmp_path, capfd):
    jax.block_until_ready(jax.jit(jnp.sin)(1.0))
    folder = op.cache_compilation(tmp_path / "new")
    assert folder is not None
    assert folder.parent == tmp_path / "new"
    assert program() == pytest.approx(ANSWER)
    kept = entries(folder)
    assert kept
    assert program() == pytest.approx(ANSWER)
    assert kept == entries(folder)
    copied = op.cache_compilation(shutil.copytree(tmp_path / "new", tmp_path / "elsewhere"))
    assert copied is not None
    assert program() == pytest.approx(ANSWER)
    assert {path.name for path in entries(copied)} == {path.name for path in kept}
    assert capfd.readouterr().err == ""


@pytest.mark.usefixtures("settings_restored")
@pytest.mark.parametrize(
    "damaged",
    [lambda whole: whole[: len(whole) // 2], lambda whole: b"", lambda whole: os.urandom(len(whole))],
    ids=["truncated", "empty", "random"],
)
def test_a_damaged_entry_is_compiled_and_kept_anew(tmp_path, capfd, damaged):
    folder = op.cache_compilation(tmp_path)
    assert folder is not None
    program()
    whole = {path: path.read_bytes() for path in entries(folder)}
    for path, content in whole.items():
        path.write_bytes(damaged(content))
    assert program() == pytest.approx(ANSWER)
    assert capfd.readouterr().err == f"opfem: a program kept in {folder} is damaged; it is compiled and kept anew\n"
    assert entries(folder).keys() == whole.keys()
    assert all(compilation._is_whole(path) for path in whole)


@pytest.mark.usefixtures("settings_restored")
def test_the_users_cache_is_the_default_and_the_environment_overrides_it(tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    assert op.cache_compilation().parent == tmp_path
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setattr("pooch.os_cache", lambda project: tmp_path / project)
    assert op.cache_compilation().parent == tmp_path / "opfem" / "compiled"
    monkeypatch.setenv("OPFEM_NO_CACHE", "1")
    assert op.cache_compilation() is None
    monkeypatch.delenv("OPFEM_NO_CACHE")
    monkeypatch.setattr("pooch.os_cache", lambda project: Path("~/.cache") / project)
    assert op.cache_compilation() is None
    assert "no home folder" in capfd.readouterr().err

    def homeless(project):
        raise RuntimeError("could not determine the home directory")  # as platformdirs does

    monkeypatch.setattr("pooch.os_cache", homeless)
    assert op.cache_compilation() is None


@pytest.mark.usefixtures("settings_restored")
def test_a_folder_that_cannot_be_made_costs_one_line(tmp_path, capfd):
    (tmp_path / "file").write_text("")
    for _ in range(2):
        assert op.cache_compilation(tmp_path / "file") is None
    said = capfd.readouterr().err
    assert said.startswith("opfem: compiled programs are not kept: ")
    assert said.count("\n") == 1


@pytest.mark.usefixtures("settings_restored")
def test_entries_unused_for_longest_are_removed(tmp_path):
    other = tmp_path / "jaxlib-0.1-of-another-processor"
    other.mkdir()
    now = time.time()
    for age, name in enumerate(("a", "b", "c", "d")):
        (other / f"jit_{name}-cache").write_bytes(bytes(1000))
        os.utime(other / f"jit_{name}-cache", (now - 100 * age, now - 100 * age))
    (tmp_path / "jit_of_somebody_else-cache").write_bytes(bytes(5000))
    op.cache_compilation(tmp_path, gigabytes=2.5e-6)
    assert {path.name for path in entries(tmp_path)} == {"jit_a-cache", "jit_b-cache", "jit_of_somebody_else-cache"}


@pytest.mark.usefixtures("settings_restored")
def test_another_process_is_configured_alike_but_keeps_programs_of_its_own_machine(tmp_path, monkeypatch):
    op.cache_compilation(tmp_path)
    settings = compilation.configuration()
    monkeypatch.setattr(compilation, "_processor", lambda: "another")
    compilation.configure(settings)
    assert Path(jax.config.jax_compilation_cache_dir).parent == tmp_path
    assert jax.config.jax_compilation_cache_dir.endswith("another")


SOLVE = """
import resource, sys
import jax, jax.numpy as jnp
import opfem as op
folder = op.cache_compilation(sys.argv[1])
if len(sys.argv) > 2:  # a disk that is full, to all that Python can tell
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
for k in range(3):
    print(float(jax.jit(lambda v: jnp.linalg.norm(jnp.cos(v) * k))(jnp.arange(4.0))))
"""


def start(*arguments: object) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", SOLVE, *map(str, arguments)],
        cwd=ROOT,
        env={name: value for name, value in os.environ.items() if name != "OPFEM_NO_CACHE"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_processes_share_a_folder_and_a_full_disk_costs_one_line(tmp_path):
    """Two that begin at once with an empty folder, beside one on a disk that takes 100 bytes of a file."""
    pytest.importorskip("resource")
    processes = [start(tmp_path / "a"), start(tmp_path / "a"), start(tmp_path / "b", 100)]
    (one, said), (two, said_too), (three, complained) = (each.communicate(timeout=300) for each in processes)
    assert one == two == three != ""
    assert said.count("\n") <= 1
    assert said_too.count("\n") <= 1
    assert complained.startswith("opfem: compiled programs are no longer kept in ")
    assert complained.count("\n") == 1
    assert entries(tmp_path / "a")
    assert all(compilation._is_whole(path) for path in entries(tmp_path / "a"))
    assert not entries(tmp_path / "b")


ALARM = """
import sys
import jax, numpy as np
from opfem.compilation import silence_alarm
for k in range(2):
    constant = np.random.rand(40, 1000) + k  # folded while it compiles, for some seconds
    jax.jit(lambda: jax.lax.reduce_window(constant, 0.0, jax.lax.add, (9, 9), (1, 1), "SAME")).lower().compile()
    print("silent from here on", file=sys.stderr, flush=True)
    silence_alarm()
"""


@pytest.mark.slow
def test_the_alarm_of_xla_is_silenced():
    answer = subprocess.run([sys.executable, "-c", ALARM], cwd=ROOT, capture_output=True, text=True, check=True)
    before, after, _ = answer.stderr.split("silent from here on\n")
    assert "Constant folding an instruction is taking" in before
    assert after == ""
