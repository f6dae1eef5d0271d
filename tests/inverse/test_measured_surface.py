"""The measured map on the mesh's splines: exact where it can be, with the right noise, at deformed places."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.inverse.measured_surface import interface_heights, noise_std, project_map

FIELD = (5.0, 4.0)


@pytest.fixture(scope="module")
def mesh():
    side = op.Contact(op.HardOverclosure(), 0.1)
    layer = op.Layer(0.5, op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=0.117))
    return op.Palpation(layer, FIELD, (20, 16, 2), side, side).mesh()


def surface(x, y):
    """A smooth surface [mm]."""
    return 0.4 + 0.03 * np.sin(1.3 * x) * np.cos(1.7 * y) + 0.01 * x


def pixels(shape=(161, 201), origin=(0.0, 0.0), extent=FIELD):
    """Places of pixels [mm]."""
    x, y = (start + np.linspace(0.0, side, n) for start, side, n in zip(origin, extent, shape[::-1], strict=True))
    return np.meshgrid(x, y)


def measured(values, std=2e-3, **more):
    return op.ThicknessMap(values, extent=FIELD, std=std, **more)


def test_a_cubic_surface_is_taken_over_exactly(mesh):
    x, y = pixels()
    x_node, y_node = mesh.plane()
    cubic = lambda x, y: 0.4 + 1e-3 * (x**3 - 2 * x**2 * y + 0.5 * y**3)  # noqa: E731
    seen = project_map(mesh, measured(cubic(x, y)), 2e-3)
    # But for the splines' own slight stiffness, 1e-6 of the pixels'.
    assert seen.surface == pytest.approx(np.asarray(cubic(x_node, y_node)), abs=1e-7)
    assert seen.representation_rms < 1e-8
    assert seen.informed == x_node.size


def test_masked_pixels_count_for_nothing(mesh):
    x, y = pixels()
    mask = np.random.default_rng(0).random(x.shape) < 0.3
    clean = surface(x, y)
    spoilt = np.where(mask, 0.1, clean)
    a, b = (project_map(mesh, measured(v, mask=mask), 2e-3) for v in (clean, spoilt))
    assert a.surface == pytest.approx(b.surface, abs=0)
    assert jnp.all(b.representation == jnp.where(mask, 0.0, b.representation))
    assert a.misfit(a.surface + 1e-3)[3, 5] == (0.0 if mask[3, 5] else pytest.approx(0.5))


def test_a_masked_block_and_a_map_that_ends_early_leave_nodes_without_data(mesh):
    x, y = pixels()
    mask = (x > 1.0) & (x < 3.0) & (y > 1.0) & (y < 3.0)
    seen = project_map(mesh, measured(surface(x, y), mask=mask), 2e-3)
    inside = 7 * 7  # nodes strictly within; splines of those next to the rim reach out
    assert seen.surface.size - inside <= seen.informed < seen.surface.size
    small = op.ThicknessMap(surface(x, y), extent=(2.5, 4.0), std=2e-3)
    # 11 of 21 columns of nodes lie on it; splines of two more reach it.
    assert 11 * 17 <= project_map(mesh, small, 2e-3).informed <= 13 * 17


def test_misfit_of_pure_noise_is_one_per_coefficient(mesh):
    x, y = pixels()
    truth = jnp.asarray(surface(*mesh.plane()))
    rng = np.random.default_rng(1)
    totals = [
        float(
            jnp.sum(
                project_map(mesh, measured(surface(x, y) + 2e-3 * rng.standard_normal(x.shape)), 2e-3).misfit(truth)
                ** 2
            )
        )
        for _ in range(20)
    ]
    n = truth.size
    assert np.mean(totals) == pytest.approx(n, abs=4.0 * np.sqrt(2.0 * n / 20))


def test_noise_that_is_correlated_counts_for_less(mesh):
    """Over long waves, noise smoothed to a length has the power of white noise that is spread over its area."""
    x, y = pixels()
    truth = jnp.asarray(surface(*mesh.plane()))
    rng = np.random.default_rng(2)
    totals = []
    for _ in range(20):
        white = measured(surface(x, y) + 2e-3 * rng.standard_normal(x.shape))
        smooth = white.smoothed(fwhm=0.1)
        totals.append(float(jnp.sum(project_map(mesh, smooth, smooth.std).misfit(truth) ** 2)))
    # Smoothing also takes some of the waves near the mesh's own: below one per coefficient, never above.
    assert 0.75 * truth.size < np.mean(totals) < 1.02 * truth.size


def test_error_of_the_model_counts_once_per_element(mesh):
    """Whatever the pixels: heights that are off by 1 µm from node to node, under pixels that are far surer."""
    truth = jnp.asarray(surface(*mesh.plane()))
    rng = np.random.default_rng(3)
    for shape in ((161, 201), (81, 101)):
        x, y = pixels(shape)
        seen = project_map(mesh, measured(surface(x, y)), 1e-5, model_std=1e-3)
        totals = [float(jnp.sum(seen.misfit(truth + 1e-3 * rng.standard_normal(truth.shape)) ** 2)) for _ in range(20)]
        # Splines between nodes hold less power than their values at them.
        assert 0.5 * truth.size < np.mean(totals) < truth.size


def test_interface_is_seen_at_deformed_places(mesh):
    x, y = mesh.plane()
    ux, uy = 0.1 * np.sin(x) * np.cos(0.5 * y), 0.05 * np.cos(y) + 0.02 * x
    u = jnp.stack([ux, uy, surface(x + ux, y + uy) - 0.5])
    inner = np.s_[2:-2, 2:-2]
    assert interface_heights(mesh, u)[inner] == pytest.approx(np.asarray(surface(x, y))[inner], abs=1e-5)


@pytest.mark.parametrize("bulge", [0.0, 0.5])
def test_interface_derivatives(mesh, bulge):
    """Also where a side bulges so that its fibres are nearly twice as long as they were."""
    x, y = mesh.plane()
    u = jnp.stack([0.1 * jnp.sin(x), 0.05 * jnp.cos(y) - bulge * jnp.exp(-y / 0.25), surface(x, y) - 0.5])
    change = 0.01 * jax.random.normal(jax.random.key(0), u.shape)
    _, slope = jax.jvp(lambda u: interface_heights(mesh, u), (u,), (change,))
    step = 1e-5
    difference = (interface_heights(mesh, u + step * change) - interface_heights(mesh, u - step * change)) / (2 * step)
    assert slope == pytest.approx(np.asarray(difference), abs=1e-9)
    weights = jax.random.normal(jax.random.key(1), x.shape)
    _, pull = jax.vjp(lambda u: interface_heights(mesh, u), u)
    assert jnp.vdot(pull(weights)[0], change) == pytest.approx(float(jnp.vdot(weights, slope)), rel=1e-10)


def test_an_interface_at_rest_is_its_thickness(mesh):
    assert interface_heights(mesh, jnp.zeros((3, 17, 21))) == pytest.approx(np.asarray(mesh.thickness), abs=1e-14)


def test_noise_must_be_known_and_positive():
    values = np.full((5, 5), 0.4)
    with pytest.raises(ValueError, match=r"standard deviation.*\[mm\], got None"):
        noise_std("fit_traction", op.ThicknessMap(values, extent=(1.0, 1.0)))
    with pytest.raises(ValueError, match=r"must be positive.*got 0"):
        noise_std("fit_traction", op.ThicknessMap(values, extent=(1.0, 1.0), std=0.0))
