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


@jax.jit
def _evaluate(surface, x, y):
    return surface(x, y)


def evaluate(surface, x, y):
    """Height and slopes, in batches of one size, so that every test runs the same compiled code."""
    x, y = np.broadcast_arrays(x, y)
    padding = -x.size % 64
    batches = [np.pad(np.ravel(v), (0, padding), mode="edge").reshape(-1, 64) for v in (x, y)]
    found = [_evaluate(surface, jnp.array(a), jnp.array(b)) for a, b in zip(*batches, strict=True)]
    return tuple(np.concatenate([f[k] for f in found])[: x.size].reshape(x.shape) for k in range(3))


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
    height, slope_x, slope_y = evaluate(surface, px, py)
    np.testing.assert_allclose(height, 0.5 + 0.3 * px - 0.2 * py, ROUNDOFF, ROUNDOFF)
    np.testing.assert_allclose(slope_x, 0.3, 10 * ROUNDOFF)
    np.testing.assert_allclose(slope_y, -0.2, 10 * ROUNDOFF)


def test_a_plane_tilts_towards_flat_only_at_the_edge():
    x, y = nodes((2 * FAR, 2 * FAR))
    _, slope_x, _ = evaluate(make(0.3 * x, "cubic"), x[FAR], y[FAR])
    error = np.abs(slope_x / 0.3 - 1)
    np.testing.assert_allclose(error[2:8] / error[1:7], 2 - np.sqrt(3), rtol=1e-3)


@ALL
def test_a_constant_is_reproduced_everywhere(interpolation):
    surface = make(np.full((6, 8), 0.45), interpolation)
    rng = np.random.default_rng(2)
    height, slope_x, slope_y = evaluate(surface, rng.uniform(-1, 1, 50), rng.uniform(-1, 3, 50))
    np.testing.assert_allclose(height, 0.45, ROUNDOFF)
    np.testing.assert_allclose([slope_x, slope_y], 0.0, atol=10 * ROUNDOFF)


@ALL
def test_surface_passes_through_its_nodes(interpolation, values):
    x, y = nodes(values.shape)
    np.testing.assert_allclose(evaluate(make(values, interpolation), x, y)[0], values, ROUNDOFF)


@ALL
def test_slopes_equal_central_differences(interpolation, values):
    surface = make(values, interpolation)
    x, y = inner_points(values.shape, 0)
    step = 1e-6
    _, slope_x, slope_y = evaluate(surface, x, y)
    in_x = (evaluate(surface, x + step, y)[0] - evaluate(surface, x - step, y)[0]) / (2 * step)
    in_y = (evaluate(surface, x, y + step)[0] - evaluate(surface, x, y - step)[0]) / (2 * step)
    np.testing.assert_allclose(slope_x, in_x, FINITE_DIFFERENCE, FINITE_DIFFERENCE)
    np.testing.assert_allclose(slope_y, in_y, FINITE_DIFFERENCE, FINITE_DIFFERENCE)


@ALL
def test_slopes_are_the_derivative_of_the_height(interpolation, values):
    surface = make(values, interpolation)
    x, y = inner_points(values.shape, 0)
    derivatives = jax.jit(jax.grad(lambda p: jnp.sum(surface(*p)[0])))((x, y))
    for derivative, slope in zip(derivatives, evaluate(surface, x, y)[1:], strict=True):
        np.testing.assert_allclose(derivative, slope, ROUNDOFF, 10 * ROUNDOFF)


def jumps(surface, values, order):
    """Largest jump of the height (order 0), its slope (1) or the slope's rate (2) across inner grid lines."""
    x, y = nodes(values.shape)
    x, y = x[1:-1, 1:-1], y[1:-1, 1:-1] + 0.4 * SPACING[1]
    step = 1e-7
    if order < 2:
        return np.abs(evaluate(surface, x + step, y)[order] - evaluate(surface, x - step, y)[order]).max()
    slope = [evaluate(surface, x + k * step, y)[1] for k in (-2, -1, 1, 2)]
    return np.abs((slope[3] - slope[2]) - (slope[1] - slope[0])).max() / step


@pytest.mark.parametrize(("interpolation", "smoothness"), [("cubic", 2), ("catmull-rom", 1), ("bilinear", 0)])
def test_derivatives_join_across_cell_borders(interpolation, smoothness, values):
    surface = make(values, interpolation)
    for order in range(smoothness + 1):
        assert jumps(surface, values, order) < 1e-4 * 10.0**order
    if smoothness < 2:
        assert jumps(surface, values, smoothness + 1) > 0.1


@ALL
def test_outside_the_surface_keeps_its_edge_value(interpolation, values):
    surface = make(values, interpolation)
    x, y = nodes(values.shape)
    beyond = np.array([0.01, 0.7])
    for row in (0, 3):
        for edge, sign in ((0, -1), (-1, 1)):
            height, slope_x, _ = evaluate(surface, x[row, edge] + sign * beyond, y[row, edge])
            np.testing.assert_allclose(height, values[row, edge], ROUNDOFF)
            np.testing.assert_array_equal(slope_x, 0.0)
    for column in (0, 3):
        for edge, sign in ((0, -1), (-1, 1)):
            height, _, slope_y = evaluate(surface, x[edge, column], y[edge, column] + sign * beyond)
            np.testing.assert_allclose(height, values[edge, column], ROUNDOFF)
            np.testing.assert_array_equal(slope_y, 0.0)


@ALL
def test_slope_along_the_edge_goes_on_outside(interpolation, values):
    """Only the direction that leaves the grid is flat outside."""
    surface = make(values, interpolation)
    y = 0.2 + 0.25 * np.array([0.3, 1.6, 3.4])
    edge, outside = (evaluate(surface, x, y) for x in (0.4, 0.9))
    np.testing.assert_allclose(outside[0], edge[0], ROUNDOFF)
    np.testing.assert_allclose(outside[2], edge[2], ROUNDOFF, ROUNDOFF)
    assert np.all(np.abs(outside[2]) > 1e-3)


@pytest.mark.parametrize(("interpolation", "order"), [("cubic", 4), ("catmull-rom", 3), ("bilinear", 2)])
def test_order_of_convergence_on_a_sine(interpolation, order):
    """Away from the edge, on points that sit at the same places of finer and finer cells."""

    def bump(x, y):
        return np.sin(2 * x + 0.3) * np.cos(3 * y)

    counts = (48, 96)
    errors = []
    for n in counts:
        x, y = nodes((n + 1, n + 1), (0.0, 0.0), (2 / n, 2 / n))
        surface = make(bump(x, y), interpolation, (0.0, 0.0), (2 / n, 2 / n))
        fraction = np.linspace(0.1, 0.9, 5)
        middle = ((n // 2 + n // 12 * np.arange(-2, 3))[:, None] + fraction).ravel() * 2 / n
        px, py = np.meshgrid(middle, middle)
        errors.append(np.abs(evaluate(surface, px, py)[0] - bump(px, py)).max())
    rate = np.log2(errors[0] / errors[1])
    assert abs(rate - order) < RATE


def test_surface_is_linear_in_its_values(values):
    """Also the derivative by the measured thickness."""
    x, y = inner_points(values.shape, 0, 64)

    @jax.jit
    def height(v):
        return height_field(v, jnp.array(ORIGIN), jnp.array(SPACING), "cubic")(x, y)[0]

    change = jnp.array(np.random.default_rng(3).standard_normal(values.shape))
    tangent = jax.jit(lambda v: jax.jvp(height, (v,), (change,))[1])(jnp.array(values))
    np.testing.assert_allclose(tangent, evaluate(make(change, "cubic"), x, y)[0], ROUNDOFF, 10 * ROUNDOFF)


@SMOOTH
def test_jit_equals_eager_and_vmap_a_loop(interpolation, values):
    surface = make(values, interpolation)
    x, y = inner_points(values.shape, 0, 64)
    eager = surface(x, y)
    by_point = jax.jit(jax.vmap(lambda a, b: surface(a, b)))(x, y)
    for got in (_evaluate(surface, x, y), by_point):
        for part, expected in zip(got, eager, strict=True):
            np.testing.assert_allclose(part, expected, ROUNDOFF, 10 * ROUNDOFF)
