"""Turns on what every test relies on: checked annotations, 64-bit numbers, kept programs, and the reference data."""

import os
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxtyping
import matplotlib
import numpy as np
import pytest

jaxtyping.install_import_hook("opfem", "beartype.beartype")
jax.config.update("jax_enable_x64", True)
matplotlib.use("agg")

# After the hook, which checks only what is imported later.
import opfem as op  # noqa: E402
from tests.experiments import EXTENT, L0, PIXELS, inclusion_experiment, published_palpation  # noqa: E402
from tests.sharding import (  # noqa: E402
    pytest_addoption as pytest_addoption,
    pytest_collection_modifyitems as pytest_collection_modifyitems,
)

ROOT = Path(__file__).resolve().parents[1]
# In the environment for the processes that tests start, too.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".jax_cache"))
op.cache_compilation()

# Linux lets a process map 65 530 regions of memory; beyond, jaxlib crashes. XLA maps some 2000 for a compiled solve,
# and one test compiles at most a dozen.
_MOST_REGIONS = 30_000
# A test that compiles a solve, or loads one, takes longer [s].
_COMPILES = 0.5


def _regions() -> int:
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return _MOST_REGIONS + 1  # not Linux: unknown


@pytest.fixture(autouse=True)
def _compiled_code_is_released():
    """Forget compiled programs when they are many; the next test that needs one loads it from disk."""
    begin = time.monotonic()
    yield
    if time.monotonic() - begin > _COMPILES and _regions() > _MOST_REGIONS:
        jax.clear_caches()


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of reference data that is kept outside the repository, beside its root."""
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip("needs the reference data in the folder `shared` beside the repository; it is not there")
    return folder


@pytest.fixture(scope="session")
def loaded():
    """A gentle bump pressed 13% into a 0.5 mm layer, off centre, with one missing pixel that is filled."""
    x, y = np.meshgrid(np.linspace(0.0, EXTENT[0], PIXELS[1]), np.linspace(0.0, EXTENT[1], PIXELS[0]))
    thickness = L0 * (1 - 0.07 - 0.06 * np.exp(-((x - 1.2) ** 2 + (y - 0.8) ** 2) / 0.3))
    mask = np.zeros(x.shape, bool)
    mask[3, 4] = True
    return op.ThicknessMap(thickness, extent=EXTENT, std=0.002, mask=mask).filled().smoothed(fwhm=0.2)


@pytest.fixture(scope="session")
def solution(loaded):
    """The bump pressed into a 2 × 2 mm layer on 6 × 6 × 2 elements, with friction on both sides."""
    return op.solve(published_palpation(), op.Imprint(loaded))


@pytest.fixture(scope="session")
def truth():
    """The small virtual experiment, pressed by 0.2 mm."""
    return op.solve(inclusion_experiment(), op.Compression(0.2), op.Newton(rtol=1e-8))


@pytest.fixture(scope="session")
def failed_solution(solution):
    """What `solve(throw=False)` returns when it stops at 40% of the load: NaN in every public field."""

    def unknown(leaf):
        return jnp.full_like(leaf, jnp.nan) if eqx.is_inexact_array(leaf) else leaf

    def public(s):
        return [s.displacement, s.sample, s.window, s.thickness.values, s.stress_zz, s.stats]

    failed = eqx.tree_at(public, solution, jax.tree.map(unknown, public(solution)))
    return eqx.tree_at(
        lambda s: (s.result, s.last_converged.load_fraction, s.stats["load_fraction"]),
        failed,
        (op.RESULTS.increment_too_small, jnp.asarray(0.4), jnp.asarray(0.4)),
    )
