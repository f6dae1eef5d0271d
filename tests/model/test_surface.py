"""Height fields: what each interpolation keeps exactly, how smooth it is, and how fast it converges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from opfem.model import height_field
from tests.tolerances import FINITE_DIFFERENCE, RATE, ROUNDOFF

ALL = pytest.mark.parametrize("interpolation", ["cubic", "catmull-rom", "bilinear"])
SMOOTH = pytest.mark.parametrize("interpolation", ["cubic", "catmull-rom"])
ORIGIN, SPACING = (-0.3, 0.2), (0.1, 0.25)
# Nodes from an edge where its influence on a cubic spline, (2 - √3) per node, is below rounding.
FAR = 24


@pytest.fixture
def values():
    return np.random.default_rng(0).uniform(0.4, 0.5, (6, 8))


def make(values, interpolation, origin=ORIGIN, spacing=SPACING):
    return height_field(jnp.array(values), jnp.array(origin), jnp.array(spacing), interpolation)


def nodes(shape, origin=ORIGIN, spacing=SPACING):
    return np.meshgrid(origin[0] + spacing[0] * np.arange(shape[1]), origin[1] + spacing[1] * np.arange(shape[0]))


def inner_points(shape, margin, count=60):
    """Random points at least `margin` cells from the edge of the grid."""
    rng = np.random.default_rng(1)
    cells = [margin + rng.uniform(size=count) * (n - 1 - 2 * margin) for n in (shape[1], shape[0])]
    return tuple(jnp.array(o + d * c) for o, d, c in zip(ORIGIN, SPACING, cells, strict=True))


@pytest.mark.parametrize(("interpolation", "margin"), [("cubic", FAR), ("catmull-rom", 1), ("bilinear", 0)])
def test_a_plane_is_reproduced(interpolation, margin):
    shape = (2 * margin + 4, 2 * margin + 5)
    x, y = nodes(shape)
    surface = make(0.5 + 0.3 * x - 0.2 * y, interpolation)
    px, py = inner_points(shape, margin)
    height, slope_x, slope_y = surface(px, py)
    np.testing.assert_allclose(height, 0.5 + 0.3 * px - 0.2 * py, ROUNDOFF, ROUNDOFF)
    np.testing.assert_allclose(slope_x, 0.3, 10 * ROUNDOFF)
    np.testing.assert_allclose(slope_y, -0.2, 10 * ROUNDOFF)


def test_a_plane_tilts_towards_flat_only_at_the_edge():
    x, y = nodes((2 * FAR, 2 * FAR))
    _, slope_x, _ = make(0.3 * x, "cubic")(jnp.array(x[FAR]), jnp.array(y[FAR]))
    error = np.abs(slope_x / 0.3 - 1)
    np.testing.assert_allclose(error[2:8] / error[1:7], 2 - np.sqrt(3), rtol=1e-3)


@ALL
def test_a_constant_is_reproduced_everywhere(interpolation):
    surface = make(np.full((5, 4), 0.45), interpolation)
    rng = np.random.default_rng(2)
    height, slope_x, slope_y = surface(jnp.array(rng.uniform(-1, 1, 50)), jnp.array(rng.uniform(-1, 3, 50)))
    np.testing.assert_allclose(height, 0.45, ROUNDOFF)
    np.testing.assert_allclose([slope_x, slope_y], 0.0, atol=10 * ROUNDOFF)


@ALL
def test_surface_passes_through_its_nodes(interpolation, values):
    x, y = nodes(values.shape)
    np.testing.assert_allclose(make(values, interpolation)(jnp.array(x), jnp.array(y))[0], values, ROUNDOFF)


@ALL
def test_slopes_equal_central_differences(interpolation, values):
    surface = make(values, interpolation)
    x, y = inner_points(values.shape, 0)
    step = 1e-6
    _, slope_x, slope_y = surface(x, y)
    in_x = (surface(x + step, y)[0] - surface(x - step, y)[0]) / (2 * step)
    in_y = (surface(x, y + step)[0] - surface(x, y - step)[0]) / (2 * step)
    np.testing.assert_allclose(slope_x, in_x, FINITE_DIFFERENCE, FINITE_DIFFERENCE)
    np.testing.assert_allclose(slope_y, in_y, FINITE_DIFFERENCE, FINITE_DIFFERENCE)


@ALL
def test_slopes_are_the_derivative_of_the_height(interpolation, values):
    surface = make(values, interpolation)
    x, y = inner_points(values.shape, 0)
    one, zero = jnp.ones_like(x), jnp.zeros_like(x)
    for k, change in enumerate(((one, zero), (zero, one))):
        derivative = jax.jvp(lambda a, b: surface(a, b)[0], (x, y), change)[1]
        np.testing.assert_allclose(derivative, surface(x, y)[1 + k], ROUNDOFF, 10 * ROUNDOFF)


def jumps(surface, values, order):
    """Largest jump of the height (order 0) or a slope (1) or its rate (2) across inner grid lines."""
    x, y = nodes(values.shape)
    lines = jnp.array(x[1:-1, 1:-1]), jnp.array(y[1:-1, 1:-1] + 0.4 * SPACING[1])
    step = 1e-8
    before, after = ((lines[0] + sign * step, lines[1]) for sign in (-1, 1))
    if order < 2:
        return np.abs(np.asarray(surface(*after)[order]) - np.asarray(surface(*before)[order])).max()
    rates = [jax.jvp(lambda a: surface(a, p[1])[1], (p[0],), (jnp.ones_like(p[0]),))[1] for p in (before, after)]
    return np.abs(np.asarray(rates[1]) - np.asarray(rates[0])).max()


@pytest.mark.parametrize(("interpolation", "smoothness"), [("cubic", 2), ("catmull-rom", 1), ("bilinear", 0)])
def test_derivatives_join_across_cell_borders(interpolation, smoothness, values):
    surface = make(values, interpolation)
    for order in range(smoothness + 1):
        assert jumps(surface, values, order) < 1e-7 * 10.0 ** (2 * order)
    if smoothness < 2:
        assert jumps(surface, values, smoothness + 1) > 1e-2


@ALL
def test_outside_the_surface_keeps_its_edge_value(interpolation, values):
    surface = make(values, interpolation)
    x, y = nodes(values.shape)
    beyond = jnp.array([0.01, 0.7])
    for row in (0, 3):
        height, slope_x, _ = surface(x[row, -1] + beyond, jnp.full(2, y[row, -1]))
        np.testing.assert_allclose(height, values[row, -1], ROUNDOFF)
        np.testing.assert_array_equal(slope_x, 0.0)
        height, slope_x, _ = surface(x[row, 0] - beyond, jnp.full(2, y[row, 0]))
        np.testing.assert_allclose(height, values[row, 0], ROUNDOFF)
        np.testing.assert_array_equal(slope_x, 0.0)
    for column in (0, 3):
        height, _, slope_y = surface(jnp.full(2, x[-1, column]), y[-1, column] + beyond)
        np.testing.assert_allclose(height, values[-1, column], ROUNDOFF)
        np.testing.assert_array_equal(slope_y, 0.0)
        height, _, slope_y = surface(jnp.full(2, x[0, column]), y[0, column] - beyond)
        np.testing.assert_allclose(height, values[0, column], ROUNDOFF)
        np.testing.assert_array_equal(slope_y, 0.0)


@ALL
def test_slope_along_the_edge_goes_on_outside(interpolation, values):
    """Only the direction that leaves the grid is flat outside."""
    surface = make(values, interpolation)
    y = jnp.array(0.2 + 0.25 * np.array([0.3, 1.6, 3.4]))
    edge, outside = (surface(jnp.full(3, x), y) for x in (0.4, 0.9))
    np.testing.assert_allclose(outside[0], edge[0], ROUNDOFF)
    np.testing.assert_allclose(outside[2], edge[2], ROUNDOFF, ROUNDOFF)
    assert np.all(np.abs(outside[2]) > 1e-3)


@pytest.mark.parametrize(("interpolation", "order"), [("cubic", 4), ("catmull-rom", 3), ("bilinear", 2)])
def test_order_of_convergence_on_a_sine(interpolation, order):
    """Away from the edge, on points that sit at the same places of finer and finer cells."""

    def bump(x, y):
        return np.sin(2 * x + 0.3) * np.cos(3 * y)

    counts = np.array([64, 128])
    errors = []
    for n in counts:
        x, y = nodes((n + 1, n + 1), (0.0, 0.0), (2 / n, 2 / n))
        surface = make(bump(x, y), interpolation, (0.0, 0.0), (2 / n, 2 / n))
        fraction = np.linspace(0.1, 0.9, 5)
        middle = (np.arange(3 * n // 8, 5 * n // 8)[:, None] + fraction).ravel() * 2 / n
        px, py = np.meshgrid(middle, middle)
        errors.append(np.abs(surface(jnp.array(px), jnp.array(py))[0] - bump(px, py)).max())
    rate = np.log2(errors[0] / errors[1])
    assert abs(rate - order) < RATE


def test_surface_is_linear_in_its_values(values):
    x, y = inner_points(values.shape, 0, 5)

    def height(v):
        return height_field(v, jnp.array(ORIGIN), jnp.array(SPACING), "cubic")(x, y)[0]

    change = np.random.default_rng(3).standard_normal(values.shape)
    tangent = jax.jvp(height, (jnp.array(values),), (jnp.array(change),))[1]
    np.testing.assert_allclose(tangent, height(jnp.array(change)), ROUNDOFF, ROUNDOFF)


@SMOOTH
def test_jit_equals_eager(interpolation, values):
    surface = make(values, interpolation)
    x, y = inner_points(values.shape, 0, 5)
    for got, expected in zip(jax.jit(lambda s, a, b: s(a, b))(surface, x, y), surface(x, y), strict=True):
        np.testing.assert_allclose(got, expected, ROUNDOFF, ROUNDOFF)
