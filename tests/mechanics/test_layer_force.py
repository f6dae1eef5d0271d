"""The sum-factorised internal force against the generic one, which has its own tests."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.mechanics import layer_force
from opfem.mechanics.inertia import lumped_mass
from opfem.mechanics.internal import layer_body
from opfem.mechanics.layer_force import LayerForce
from tests.tolerances import FINITE_DIFFERENCE, ROUNDOFF

MATERIALS = {
    "mooney_rivlin": op.MooneyRivlin(c10=2.2e-3, c01=7.03e-4, bulk=0.11612),
    "neo_hooke": op.NeoHooke(c10=2.9e-3, bulk=0.11612),
    "yeoh": op.Yeoh(c10=2.9e-3, c20=-4e-4, c30=1e-4, bulk=0.11612),
    "ogden": op.Ogden(mu=(5e-3,), alpha=(1.8,), bulk=0.11612),
}


def made(form="mean_dilatation", material="mooney_rivlin", uniform=True, elements=(5, 4, 3)):
    rng = np.random.default_rng(0)
    thickness = 0.5 if uniform else op.ThicknessMap(0.5 + 0.05 * rng.standard_normal((5, 6)), extent=(1.0, 0.8))
    layer = op.Layer(thickness, MATERIALS[material])
    palpation = op.Palpation(layer, (1.0, 0.8), elements, op.Bonded(), op.Bonded(), element=form)
    body = layer_body(palpation.mesh(), layer.material, form)
    X = palpation.mesh().positions()
    return LayerForce(body, uniform), jnp.asarray(0.01 * rng.standard_normal(X.shape)), X


def none(change):
    return jnp.zeros_like(change)


@pytest.mark.parametrize(
    ("material", "form", "uniform"),
    [
        *(
            (material, form, form == "full")
            for material in ("neo_hooke", "yeoh")
            for form in ("full", "mean_dilatation")
        ),
        *(("mooney_rivlin", form, uniform) for form in ("full", "mean_dilatation") for uniform in (True, False)),
        # What has no fast way takes the body's own.
        *(("mooney_rivlin", form, False) for form in ("reduced", "tet4")),
        ("ogden", "mean_dilatation", True),
    ],
)
def test_force_is_that_of_the_body(form, material, uniform):
    force, u, _ = made(form, material, uniform)
    expected, _ = force.body.internal_force(u)
    own, _ = jax.jit(lambda u: force(u, none))(u)
    np.testing.assert_allclose(own, expected, rtol=0, atol=10 * ROUNDOFF * np.abs(expected).max())


@pytest.mark.parametrize("uniform", [True, False])
def test_blocks_of_rows_change_nothing(uniform, monkeypatch):
    force, u, _ = made(uniform=uniform)
    weights = jnp.asarray(np.random.default_rng(1).standard_normal((3, 4, 5)))

    def evaluate(u):
        return force(u, lambda change, w: 1e-3 * w * change, weights)

    whole = evaluate(u)
    for rows in (1, 2):
        monkeypatch.setattr(layer_force, "_BLOCK", 15 * rows)
        for own, expected in zip(evaluate(u), whole, strict=True):
            np.testing.assert_allclose(own, expected, rtol=0, atol=ROUNDOFF * np.abs(expected).max())


@pytest.mark.parametrize("form", ["full", "mean_dilatation", "reduced", "tet4"])
def test_extra_stress_works_on_the_volume(form):
    """A mean stress q in every element: its force is the derivative of q times volume."""
    force, u, _ = made(form, uniform=False)
    q = jnp.asarray(np.random.default_rng(1).standard_normal((3, 4, 5)))

    def volume_energy(u):
        return jnp.sum(q * force(u, none)[1] * force.body.cells.volume[0])

    own = force(u, lambda _: q)[0] - force(u, none)[0]
    direction = jnp.asarray(np.random.default_rng(2).standard_normal(u.shape))
    h = 1e-6
    difference = (volume_energy(u + h * direction) - volume_energy(u - h * direction)) / (2 * h)
    np.testing.assert_allclose(jnp.vdot(own, direction), difference, rtol=FINITE_DIFFERENCE)


def test_float32_keeps_its_digits_at_small_strain():
    """A near-incompressible layer at strain 1e-4: relative error of some roundings over the strain, not over one."""
    force, u, _ = made()
    u = 1e-3 * u
    single = jax.tree.map(lambda v: v.astype(jnp.float32), force)
    error = np.asarray(single(u.astype(jnp.float32), none)[0], float) - np.asarray(force(u, none)[0])
    assert np.abs(error).max() < 1e-5 * np.abs(force(u, none)[0]).max()


@pytest.mark.parametrize("form", ["mean_dilatation", "tet4"])
def test_mass_is_that_of_the_layer(form):
    """All of it, and its first moments: those of a body cut into columns."""
    force, _, X = made(form, uniform=False)
    mass = lumped_mass(force.body.cells, jnp.asarray(2.0))
    cells = force.body.cells
    np.testing.assert_allclose(jnp.sum(mass), 2.0 * float(jnp.sum(cells.weight * jnp.ones_like(cells.slope_x))))
    assert float(mass.min()) > 0
    flat, _, X = made(form, uniform=True)
    even = lumped_mass(flat.body.cells, jnp.asarray(2.0))
    np.testing.assert_allclose([float(jnp.sum(even * x)) for x in X], 2.0 * 0.4 * np.array([0.5, 0.4, 0.25]))
