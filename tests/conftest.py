"""Turns on what every test relies on: checked annotations, 64-bit numbers, and the shared reference data."""

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


@pytest.fixture(scope="module", autouse=True)
def _compiled_code_is_released():
    """XLA maps thousands of memory regions per compiled solve; Linux allows a process 65 530, then jaxlib crashes."""
    yield
    jax.clear_caches()


@pytest.fixture(autouse=True)
def _compiled_code_of_a_slow_test_is_released(request):
    """A module of derivatives alone compiles more than a process may map."""
    yield
    if request.node.get_closest_marker("slow"):
        jax.clear_caches()


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of reference data that is kept outside the repository, beside its root."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("needs the reference data in the folder `shared` beside the repository; it is not there")
    return folder


@pytest.fixture(scope="session")
def loaded():
    """A gentle bump pressed 13% into a 0.5 mm layer, off centre, with one missing pixel that is filled."""
    x, y = np.meshgrid(np.linspace(0.0, 2.0, 21), np.linspace(0.0, 2.0, 17))
    thickness = 0.5 * (1 - 0.07 - 0.06 * np.exp(-((x - 1.2) ** 2 + (y - 0.8) ** 2) / 0.3))
    mask = np.zeros(x.shape, bool)
    mask[3, 4] = True
    return op.ThicknessMap(thickness, extent=(2.0, 2.0), std=0.002, mask=mask).filled().smoothed(fwhm=0.2)


@pytest.fixture(scope="session")
def solution(loaded):
    """The bump pressed into a 2 × 2 mm layer on 6 × 6 × 2 elements, with friction on both sides."""
    palpation = op.Palpation(
        op.Layer(0.5, op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=0.11732)),
        extent=(2.0, 2.0),
        elements=(6, 6, 2),
        window=op.Contact(op.HardOverclosure(), friction=0.15),
        sample=op.Contact(op.ExponentialOverclosure(pressure=2.0, clearance=0.01), friction=0.05),
    )
    return op.solve(palpation, op.Imprint(loaded))


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
