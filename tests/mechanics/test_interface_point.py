"""Points of the interface under places in space: exact where motion is separable, however much the edges bulge."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.mechanics.interface_point import NodalField, locate
from opfem.results.fields import under_pixels
from opfem.solvers.recover import deformed_thickness
from tests.tolerances import FINITE_DIFFERENCE, ROUNDOFF

NX, NY, LX, LY = 10, 8, 2.0, 1.6
FAR, SIZE = jnp.array([LX, LY]), jnp.array([LX / NX, LY / NY])
X, Y = np.meshgrid(np.linspace(0, LX, NX + 1), np.linspace(0, LY, NY + 1))
HEIGHT = 0.45 + 0.05 * np.cos(2 * X) * np.sin(3 * Y)
# Stretch of the fibres from one side to the other: gentle, a side that bulges, one that is squeezed too, and a shift of
# three elements.
STRETCHES = {
    "gentle": np.linspace(0.9, 1.1, NX),
    "bulging": np.r_[np.full(NX - 3, 1.0), 1.8, 2.6, 3.5],
    "both sides": np.r_[3.5, 2.2, np.full(NX - 4, 0.8), 2.2, 3.0],
    "squeezed beside stretched": np.r_[3.0, 0.15, 3.0, 0.15, np.full(NX - 8, 1.0), 0.15, 3.0, 0.15, 3.0],
}


def moved(stretches, shift=0.0):
    """Where the nodes along x have gone, and along y by the same law."""
    x = np.r_[0.0, np.cumsum(stretches)] * LX / NX
    y = np.r_[0.0, np.cumsum(stretches[:NY])] * LY / NY
    return x - 0.2 * (x[-1] - LX) + shift, y - 0.5 * (y[-1] - LY) - shift


def displacement(x, y):
    return np.stack([x[None] - X, y[:, None] - Y, HEIGHT - 0.5])


def on_places(x, y, values, px, py):
    """Bilinear in the reference, so along each axis a broken line over where the nodes are now."""
    rows = np.stack([np.interp(px, x, row) for row in values])
    return np.stack([np.interp(py, y, column) for column in rows.T], axis=1)


@pytest.mark.parametrize("shift", [0.0, 0.6])
@pytest.mark.parametrize("stretches", STRETCHES.values(), ids=STRETCHES)
def test_heights_and_images_on_edges_that_bulge(stretches, shift):
    x, y = moved(stretches, shift)
    u = displacement(x, y)
    grid = op.ThicknessMap(np.full((41, 53), 0.4), extent=(LX + 1.0, LY + 1.0), origin=(-0.5, -0.5))
    px, py = np.asarray(grid.x), np.asarray(grid.y)
    inside = ((py >= y[0]) & (py <= y[-1]))[:, None] & ((px >= x[0]) & (px <= x[-1]))
    expected = on_places(x, y, HEIGHT, px, py)
    positions = np.stack([X, Y, np.full_like(X, 0.5)])

    thickness = jax.jit(deformed_thickness)(jnp.asarray(positions), jnp.asarray(u), op.Imprint(grid))
    np.testing.assert_array_equal(thickness.mask, ~inside)
    np.testing.assert_allclose(np.asarray(thickness.values)[inside], expected[inside], 1e3 * ROUNDOFF)

    image = under_pixels(HEIGHT, positions[:2], u[:2], *np.meshgrid(px, py))
    np.testing.assert_array_equal(np.isfinite(image), inside)
    np.testing.assert_allclose(image[inside], expected[inside], 1e3 * ROUNDOFF)


def test_a_place_beyond_the_layer_is_found_along_the_other_axis_only():
    motion = NodalField(jnp.zeros((2, NY + 1, NX + 1)), SIZE)
    below = locate(motion, jnp.array([[LX + 0.1, 0.5, -0.2], [0.3, 0.3, LY + 1.0]]), FAR, SIZE)
    np.testing.assert_array_equal(below.found, [[False, True, False], [True, True, False]])
    np.testing.assert_allclose(below.at, [[LX, 0.5, 0.0], [0.3, 0.3, LY]], ROUNDOFF)


def test_a_fold_is_not_taken_for_a_point():
    """What is found lies at its place; where the interface turns over, a search that fails says so."""
    x, y = moved(np.r_[np.full(4, 1.0), -0.6, np.full(NX - 5, 1.0)])
    motion = NodalField(jnp.asarray(displacement(x, y)[:2]), SIZE)
    place = jnp.stack(jnp.meshgrid(jnp.linspace(0.0, 2.0, 201), jnp.linspace(0.3, 1.2, 7)))
    below = locate(motion, place, FAR, SIZE)
    arrived = below.at + motion(*below.at)[0]
    assert jnp.max(jnp.where(below.found, jnp.abs(arrived - place), 0.0)) < 1e-6 * SIZE.max()
    assert below.found.all(axis=0).mean() > 0.5


def test_derivatives_are_those_of_the_inverse():
    """By displacement and place: central differences, forward and reverse; jit and vmap as one by one."""
    x, y = moved(STRETCHES["bulging"])
    u = jnp.asarray(displacement(x, y)[:2])
    place = jnp.asarray(np.random.default_rng(0).uniform(0.2, 1.2, (2, 30)))
    change = jnp.asarray(np.random.default_rng(1).standard_normal(u.shape))

    def at(amount):
        return locate(NodalField(u + amount * change, SIZE), place + 0.3 * amount, FAR, SIZE).at

    step = 1e-6
    central = (at(step) - at(-step)) / (2 * step)
    forward = jax.jacfwd(at)(0.0)
    scale = float(jnp.abs(central).max())
    np.testing.assert_allclose(forward, central, FINITE_DIFFERENCE, FINITE_DIFFERENCE * scale)
    reverse = jax.grad(lambda amount: jnp.sum(at(amount) * place))(0.0)
    np.testing.assert_allclose(reverse, jnp.sum(forward * place), 1e3 * ROUNDOFF)
    lanes = jax.jit(jax.vmap(at))(jnp.array([0.0, 1e-3]))
    np.testing.assert_allclose(lanes, jnp.stack([at(0.0), at(1e-3)]), 1e3 * ROUNDOFF)


def test_single_precision_finds_to_its_rounding():
    x, y = moved(STRETCHES["bulging"])
    single = [jnp.asarray(v, jnp.float32) for v in (displacement(x, y)[:2], FAR, SIZE)]
    place = jnp.asarray(np.random.default_rng(0).uniform(0.2, 1.2, (2, 300)))
    got = locate(NodalField(single[0], single[2]), place.astype(jnp.float32), *single[1:])
    assert got.at.dtype == jnp.float32
    assert got.found.all()
    np.testing.assert_allclose(
        got.at, locate(NodalField(jnp.asarray(displacement(x, y)[:2]), SIZE), place, FAR, SIZE).at, atol=1e-5
    )
