"""Turns on what every test relies on: checked annotations, 64-bit numbers, and the shared reference data."""

from pathlib import Path

import jax
import jaxtyping
import pytest

jaxtyping.install_import_hook("opfem", "beartype.beartype")
jax.config.update("jax_enable_x64", True)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of reference data that is kept outside the repository, beside its root."""
    folder = Path(__file__).resolve().parents[2] / "shared"
    if not folder.is_dir():
        pytest.skip("needs the reference data in the folder `shared` beside the repository; it is not there")
    return folder


@pytest.fixture(scope="session")
def solve_small():
    """Solve a 2 × 2 mm layer on 6 × 6 × 2 elements under a loaded thickness map [mm]; every use shares one compilation."""
    import opfem as op

    def solve(loaded, **options):
        palpation = op.Palpation(
            op.Layer(0.5, op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=0.11732)),
            extent=(2.0, 2.0),
            elements=(6, 6, 2),
            window=op.Contact(op.HardOverclosure(), friction=0.15),
            sample=op.Contact(op.ExponentialOverclosure(pressure=2.0, clearance=0.01), friction=0.05),
        )
        return op.solve(palpation, op.Imprint(loaded), **options)

    return solve


@pytest.fixture(scope="session")
def loaded():
    """A gentle bump pressed 13% into a 0.5 mm layer, off centre, with one missing pixel that is filled."""
    import numpy as np

    import opfem as op

    x, y = np.meshgrid(np.linspace(0.0, 2.0, 21), np.linspace(0.0, 2.0, 17))
    thickness = 0.5 * (1 - 0.07 - 0.06 * np.exp(-((x - 1.2) ** 2 + (y - 0.8) ** 2) / 0.3))
    mask = np.zeros(x.shape, bool)
    mask[3, 4] = True
    return op.ThicknessMap(thickness, extent=(2.0, 2.0), std=0.002, mask=mask).filled().smoothed(fwhm=0.2)


@pytest.fixture(scope="session")
def solution(solve_small, loaded):
    """A frictional solution that converged."""
    return solve_small(loaded)


@pytest.fixture(scope="session")
def failed_solution(solve_small, loaded):
    """A solve that failed: the map leaves 2% of the layer."""
    import equinox as eqx

    return solve_small(eqx.tree_at(lambda m: m.values, loaded, 0.0 * loaded.values + 0.01), throw=False)
