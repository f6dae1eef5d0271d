"""Compiled programs on disk."""

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

import opfem as op

OPTIONS = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")


@pytest.fixture
def settings_restored():
    before = {name: getattr(jax.config, name) for name in OPTIONS}
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


@pytest.mark.usefixtures("settings_restored")
def test_a_program_compiled_after_others_is_kept_and_found_again(tmp_path):
    jax.block_until_ready(jax.jit(jnp.sin)(1.0))
    folder = op.cache_compilation(tmp_path / "new")
    assert folder.is_dir()
    assert folder.parent == tmp_path / "new"
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)  # this one compiles in no time

    def program():
        return float(jax.jit(lambda v: jnp.cos(v) * 1.25)(0.5))

    first = program()
    kept = {file: file.stat().st_mtime_ns for file in folder.iterdir() if file.name.endswith("-cache")}
    assert kept
    jax.clear_caches()
    assert program() == first
    assert kept == {file: file.stat().st_mtime_ns for file in folder.iterdir() if file.name.endswith("-cache")}


@pytest.mark.usefixtures("settings_restored")
def test_the_users_cache_is_the_default_and_the_environment_overrides_it(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path))
    assert op.cache_compilation().parent == tmp_path
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setattr("pooch.os_cache", lambda project: tmp_path / project)
    assert op.cache_compilation().parent == tmp_path / "opfem" / "compiled"
