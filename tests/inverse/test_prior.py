"""Priors: what their fields look like, and that whitening undoes expanding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.inverse.prior import on_nodes

SHAPE, SPACING = (17, 21), (0.25, 0.25)
X, Y = np.meshgrid(0.25 * np.arange(21), 0.25 * np.arange(17))


def covariance(prior):
    """Compute the covariance of all nodes [MPa²]."""
    rows = jax.vmap(lambda white: prior.expand(white.reshape(SHAPE), SPACING).ravel())(jnp.eye(X.size))
    return np.asarray(rows.T @ rows)


@pytest.mark.parametrize(
    ("smoothness", "correlation"),
    [
        (1.5, lambda r: (1 + np.sqrt(3) * r) * np.exp(-np.sqrt(3) * r)),
        (np.inf, lambda r: np.exp(-0.5 * r**2)),
    ],
)
def test_matern_has_its_standard_deviation_and_correlation(smoothness, correlation):
    C = covariance(op.Matern(length=0.6, std=2e-3, smoothness=smoothness))
    assert np.sqrt(np.diag(C)) == pytest.approx(2e-3, rel=1e-12)
    centre = np.ravel_multi_index((8, 10), SHAPE)
    distance = np.hypot(X - X[8, 10], Y - Y[8, 10]).ravel()
    # The spectrum ends at the mesh, and the field is mirrored at the edges: 2% at a length of 2.4 elements.
    assert C[centre] / 4e-6 == pytest.approx(correlation(distance / 0.6), abs=0.02)


def test_the_prior_does_not_depend_on_the_unit_of_pressure():
    white = jax.random.normal(jax.random.key(0), SHAPE)
    mega, pascal = (op.Matern(0.6, std).expand(white, SPACING) for std in (2e-3, 2e3))
    assert pascal == pytest.approx(1e6 * np.asarray(mega), rel=1e-12)


@pytest.mark.parametrize("prior", [op.Matern(0.6, 2e-3), op.Tikhonov(1, 50.0), op.Tikhonov(2, 50.0)])
def test_whitening_undoes_expanding(prior):
    white = jax.random.normal(jax.random.key(1), SHAPE)
    assert prior.whiten(prior.expand(white, SPACING), SPACING) == pytest.approx(np.asarray(white), abs=1e-9)


@pytest.mark.parametrize("order", [1, 2])
def test_tikhonov_is_the_integral_of_the_squared_derivative(order):
    """Of one cosine over the field its slopes are known."""
    weight, amplitude, m = 40.0, 3e-3, 2
    width = SPACING[0] * SHAPE[1]  # nodes stand for cells, whose faces mirror
    k = m * np.pi / width
    field = amplitude * np.cos(k * (0.25 * np.arange(SHAPE[1]) + 0.125)) * np.ones((SHAPE[0], 1))
    prior = op.Tikhonov(order, weight)
    penalty = np.sum((prior.mode_weight(SHAPE) * prior.whiten(jnp.asarray(field), SPACING)) ** 2)
    area = width * SPACING[1] * SHAPE[0]
    assert penalty == pytest.approx(weight**2 * k ** (2 * order) * amplitude**2 / 2 * area, rel=1e-9)


def test_tikhonov_hardly_holds_the_mean():
    prior = op.Tikhonov(1, 50.0)
    flat = prior.mode_weight(SHAPE) * prior.whiten(jnp.full(SHAPE, 1e-3), SPACING)
    tilted = prior.mode_weight(SHAPE) * prior.whiten(jnp.asarray(1e-3 * X / X.max()), SPACING)
    assert jnp.sum(flat**2) < 1e-5 * jnp.sum(tilted**2)


def test_derivatives_by_hyper_parameters():
    white = jax.random.normal(jax.random.key(2), SHAPE)

    def field(length, std):
        return op.Matern(length, std).expand(white, SPACING)

    _, slope = jax.jvp(field, (0.6, 2e-3), (1.0, 1e-3))
    step = 1e-5
    difference = (field(0.6 + step, 2e-3 + 1e-3 * step) - field(0.6 - step, 2e-3 - 1e-3 * step)) / (2 * step)
    assert slope == pytest.approx(np.asarray(difference), rel=1e-6, abs=1e-10)


def test_errors_name_field_and_unit():
    with pytest.raises(ValueError, match=r"Matern\.length \[mm\]"):
        op.Matern(length=0.0, std=1e-3)
    with pytest.raises(ValueError, match=r"Matern\.std \[MPa\]"):
        op.Matern(length=0.2, std=-1e-3)
    with pytest.raises(ValueError, match=r"Tikhonov\.order"):
        op.Tikhonov(3, 1.0)
    with pytest.raises(ValueError, match=r"Tikhonov\.weight"):
        op.Tikhonov(1, 0.0)
    with pytest.raises(ValueError, match=r"Matern\.mean \[MPa\].*\(17, 21\).*\(3, 3\)"):
        on_nodes(op.Matern(0.2, 1e-3, mean=np.zeros((3, 3))), SHAPE)


def test_total_variation_is_quadratic_where_smooth_and_counts_the_height_of_an_edge():
    weight, slope = 30.0, 2e-3
    prior = op.TotalVariation(weight, slope)

    def energy(field):
        white = prior.whiten(jnp.asarray(field), SPACING)
        return 0.5 * sum(float(jnp.sum(part**2)) for part in prior.residual(white, SPACING))

    width, height = SPACING[0] * (SHAPE[1] - 1), SPACING[1] * (SHAPE[0] - 1)
    gentle = 0.02 * slope
    quadratic = 0.5 * weight / slope * gentle**2 * width * height
    assert energy(gentle * X) == pytest.approx(quadratic, rel=1e-3)
    step = 0.05  # MPa within one element: 100 times the slope
    one, two = (energy(step * (X > 2.4)), energy(0.5 * step * (X > 2.4) + 0.5 * step * (X > 3.6)))
    edge = weight * height * (step - slope * SPACING[0])
    assert one == pytest.approx(edge, rel=0.01)
    # Two edges of half the height cost as much as one.
    assert two == pytest.approx(one, rel=0.02)


def test_total_variation_sees_a_checkerboard():
    prior = op.TotalVariation(30.0, 2e-3)
    rows, columns = np.indices(SHAPE)
    field = 1e-4 * (-1.0) ** (rows + columns)
    slopes, _ = prior.residual(prior.whiten(jnp.asarray(field), SPACING), SPACING)
    assert jnp.min(jnp.sum(slopes**2, axis=(0, 1))) > 0


@pytest.mark.parametrize("prior", [op.Matern(0.7, 2e-3), op.Tikhonov(1, 300.0), op.TotalVariation(30.0, 2e-3)])
def test_log_normaliser_is_half_the_log_determinant_of_the_covariance(prior):
    shape, spacing = (5, 6), (0.2, 0.3)
    root = jax.vmap(lambda white: prior.expand(white, spacing).ravel())(jnp.eye(30).reshape(30, *shape))
    sign, log_determinant = np.linalg.slogdet(np.asarray(root.T @ root))
    assert sign > 0
    assert prior.log_normaliser(shape, spacing) == pytest.approx(0.5 * log_determinant, rel=1e-10)


def test_length_below_an_element_is_refused():
    with pytest.raises(ValueError, match=r"Matern.length \[mm\] must be at least an element, 0.3, got 0.25"):
        op.Matern(0.25, 2e-3).check_resolved((0.2, 0.3))
    op.Matern(0.35, 2e-3).check_resolved((0.2, 0.3))
    op.Tikhonov(1, 300.0).check_resolved((0.2, 0.3))
