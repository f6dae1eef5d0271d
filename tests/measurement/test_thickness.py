"""ThicknessMap: what it refuses, what each step does, and that all of it traces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from opfem.measurement import Step, ThicknessMap
from opfem.measurement.filtering import WHITE_NOISE_LENGTH
from tests.tolerances import FINITE_DIFFERENCE, ROUNDOFF, SAMPLING

SHAPE = (9, 13)
EXTENT = (2.4, 1.2)  # spacing 0.2, 0.15


def field(seed=0, shape=SHAPE):
    return np.random.default_rng(seed).uniform(0.3, 0.5, shape)


def hole(shape=SHAPE):
    mask = np.zeros(shape, bool)
    mask[2:5, 3:6] = True
    return mask


@pytest.fixture
def measured():
    return ThicknessMap(field(), extent=EXTENT, std=0.003, origin=(1.0, -2.0))


@pytest.fixture
def holed():
    return ThicknessMap(field(), extent=EXTENT, std=0.003, mask=hole())


class TestConstructor:
    def test_grid_from_extent(self, measured):
        assert measured.shape == SHAPE
        np.testing.assert_allclose(measured.spacing, (0.2, 0.15), ROUNDOFF)
        np.testing.assert_allclose(measured.x, 1.0 + np.linspace(0, 2.4, 13), ROUNDOFF)
        np.testing.assert_allclose(measured.y, -2.0 + np.linspace(0, 1.2, 9), ROUNDOFF)

    @pytest.mark.parametrize(("spacing", "extent"), [((0.2, 0.15), (2.4, 1.2)), (0.1, (1.2, 0.8))])
    def test_grid_from_spacing(self, spacing, extent):
        np.testing.assert_allclose(ThicknessMap(field(), spacing=spacing).extent, extent, ROUNDOFF)

    def test_defaults(self):
        plain = ThicknessMap(field(), extent=EXTENT)
        assert plain.std is None
        assert plain.noise_length == 0
        assert plain.steps == ()
        assert not plain.mask.any()
        assert not plain.is_filled

    def test_is_frozen(self, measured):
        with pytest.raises(AttributeError):
            measured.values = jnp.zeros(SHAPE)

    def test_integers_become_floats(self):
        assert ThicknessMap(np.full((3, 4), 2), extent=(1, 1)).values.dtype == jnp.float64

    def test_masked_pixels_of_a_masked_array_are_no_data(self):
        values = np.full((3, 4), 0.4)
        values[1, 2], values[0, 0] = np.nan, 9999.0
        thickness = ThicknessMap(np.ma.masked_array(values, ~(values < 1.0)), extent=(3.0, 2.0), mask=values > 1.0)
        np.testing.assert_array_equal(thickness.mask, ~(values < 1.0))
        assert float(thickness.filled().values.max()) == pytest.approx(0.4)

    def test_masked_pixel_may_hold_any_finite_number(self):
        values = field()
        values[hole()] = -7.0
        assert ThicknessMap(values, extent=EXTENT, mask=hole()).mask.sum() == hole().sum()

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"extent": None}, r"either extent=\(Lx, Ly\) or spacing=\(dx, dy\) \[mm\], got neither.*\(9, 13\)"),
            ({"spacing": 0.1}, "got both"),
            ({"values": field()[0]}, r"must be 2-D \(ny, nx\), got shape \(13,\).*vmap"),
            ({"values": field()[None]}, r"got shape \(1, 9, 13\)"),
            ({"values": field()[:1]}, r"at least 2 by 2 samples \(ny, nx\), got shape \(1, 13\)"),
            ({"values": field() * 1e3}, r"spans 30\d\.\d+ to 49\d\.\d+ mm; is it in µm\? Multiply by 0\.001"),
            ({"values": np.arange(1, 118).reshape(SHAPE)}, r"spans 1 to 117 mm; is it in µm or pixels\?"),
            ({"values": field() * 1e-3}, r"is it in metres\? Multiply by 1000"),
            ({"extent": (5.0, 0.0)}, r"extent \(Lx, Ly\) \[mm\] must be positive, got \(5\.0, 0\.0\)"),
            ({"extent": (5.0, np.nan)}, "must be positive"),
            ({"extent": (5.0, 5.0, 5.0)}, r"must be two numbers, got shape \(3,\)"),
            ({"extent": None, "spacing": -0.1}, r"ThicknessMap\.spacing \(dx, dy\) \[mm\] must be positive, got -0\.1"),
            ({"origin": (np.inf, 0.0)}, r"origin \(x, y\) \[mm\] must be finite"),
            ({"std": 0.0}, r"std \[mm\] must be positive and finite, got 0 .*std=None"),
            ({"std": np.ones(3)}, r"std \[mm\] must be one number or have shape \(9, 13\).*got \(3,\)"),
            ({"mask": hole().astype(int)}, r"mask must be bool of shape \(9, 13\).*got int64"),
            ({"mask": hole((4, 9))}, r"got bool of shape \(4, 9\)"),
            ({"mask": np.ones(SHAPE, bool)}, "must leave data, got True in every pixel"),
            ({"noise_length": -1.0}, r"noise_length \[mm\] must be zero or positive, got -1"),
        ],
    )
    def test_refuses(self, change, message):
        arguments = {"values": field(), "extent": EXTENT} | change
        with pytest.raises(ValueError, match=message):
            ThicknessMap(**arguments)

    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_refuses_what_is_not_finite_even_under_a_mask(self, bad):
        values = field()
        values[2, 3] = values[4, 5] = bad
        for mask in (None, hole()):
            with pytest.raises(ValueError, match=r"2 of 117 pixels, first at \[y=2, x=3\].*read_thickness.*mask="):
                ThicknessMap(values, extent=EXTENT, mask=mask)

    def test_refuses_what_is_not_positive(self):
        values = field()
        values[7, 1] = -0.25
        with pytest.raises(ValueError, match=r"must be positive, got -0\.25 in 1 of 117 pixels, first at \[y=7, x=1\]"):
            ThicknessMap(values, extent=EXTENT, mask=hole())


class TestTracing:
    def test_works_inside_jit_grad_and_vmap(self):
        def mean(values, std):
            made = ThicknessMap(values, extent=EXTENT, std=std, mask=hole())
            return made.filled().smoothed(0.3).values.mean()

        values = jnp.array(field())
        eager = mean(values, 0.003)
        np.testing.assert_allclose(jax.jit(mean)(values, 0.003), eager, ROUNDOFF)
        np.testing.assert_allclose(jax.vmap(mean, (0, None))(values[None], 0.003)[0], eager, ROUNDOFF)
        assert jnp.isfinite(jax.grad(mean)(values, 0.003)).all()

    def test_maps_of_one_shape_share_one_compilation(self):
        traces = []

        @jax.jit
        def total(thickness):
            traces.append(1)
            return thickness.values.sum()

        def made(seed, fwhm):
            step = Step("read", missing_pixels=seed)
            return ThicknessMap(field(seed), extent=(2.0 + seed, 1.0), std=0.003, mask=hole(), steps=(step,)).filled()

        assert total(made(0, 0.2)) != total(made(1, 0.3))
        assert len(traces) == 1

    def test_steps_record_names_and_numbers(self, holed):
        steps = holed.filled().smoothed(0.3).cropped(x=(0.2, 2.0)).resampled(shape=(5, 6)).steps
        assert [step.name for step in steps] == ["filled", "smoothed", "cropped", "resampled"]
        assert steps[0].numbers["pixels"] == 9
        assert steps[1].numbers["fwhm"] == 0.3
        np.testing.assert_allclose(steps[2].numbers["extent"], (1.8, 1.2), ROUNDOFF)
        np.testing.assert_allclose(steps[3].numbers["spacing"], (0.36, 0.3), ROUNDOFF)

    def test_every_step_is_the_same_under_jit_and_vmap(self, holed):
        def process(thickness):
            made = thickness.filled().smoothed(0.3).resampled(shape=(6, 7))
            return made.values, made.std, made.noise_length, made.mask, made.sample(made.x[:3], made.y[:3])

        eager = process(holed)
        batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), holed)
        for ours, jitted, mapped in zip(eager, jax.jit(process)(holed), jax.vmap(process)(batch), strict=True):
            np.testing.assert_allclose(jitted, ours, ROUNDOFF)
            np.testing.assert_allclose(mapped[1], ours, ROUNDOFF)


class TestFilled:
    def test_keeps_data_and_mask(self, holed):
        filled = holed.filled()
        assert filled.is_filled
        np.testing.assert_array_equal(filled.mask, hole())
        np.testing.assert_array_equal(filled.values[~hole()], holed.values[~hole()])
        assert not np.array_equal(filled.values[hole()], holed.values[hole()])
        assert filled.std == holed.std

    def test_says_when_it_fails(self, holed, monkeypatch):
        monkeypatch.setattr(
            "opfem.measurement.thickness.harmonic_fill", lambda values, mask, _: jnp.where(mask, jnp.nan, values)
        )
        with pytest.raises(ValueError, match=r"did not converge.*9 masked of 117 pixels"):
            holed.filled()


class TestSmoothed:
    def test_refuses_holes(self, holed):
        with pytest.raises(ValueError, match=r"Cannot smooth .* 9 masked pixels .*filled\(\)"):
            holed.smoothed(0.3)

    def test_holes_under_jit_give_nan(self, holed, measured):
        assert jnp.isnan(jax.jit(lambda m: m.smoothed(0.3).values)(holed)).all()
        assert jnp.isfinite(jax.jit(lambda m: m.smoothed(0.3).values)(measured)).all()

    @pytest.mark.parametrize(("fwhm", "message"), [(-0.1, "zero or positive, got -0.1"), (0.7, "half .* 0.6, got 0.7")])
    def test_refuses_width(self, measured, fwhm, message):
        with pytest.raises(ValueError, match=message):
            measured.smoothed(fwhm)

    def test_reduces_noise_as_seen_in_draws(self):
        std = 0.01
        draws = 0.45 + std * jax.random.normal(jax.random.key(1), (3000, *SHAPE))
        spread = jax.vmap(lambda draw: ThicknessMap(draw, extent=EXTENT).smoothed(0.4).values)(draws).std(axis=0)
        stated = ThicknessMap(draws[0], extent=EXTENT, std=std).smoothed(0.4)
        # 3000 draws know a std to 1.3%, one standard error.
        np.testing.assert_allclose(spread, stated.std, SAMPLING)
        assert stated.noise_length == 0.4

    def test_twice_is_once_with_widths_in_quadrature(self):
        """Away from the edges, and for widths of at least two pixels, where sampled Gaussians compose."""
        wide = ThicknessMap(field(shape=(61, 61)), spacing=0.05, std=0.01)
        twice, once = wide.smoothed(0.15).smoothed(0.2), wide.smoothed(0.25)
        inside = (slice(20, -20), slice(20, -20))
        np.testing.assert_allclose(twice.values[inside], once.values[inside], 1e-4)
        np.testing.assert_allclose(twice.std[inside], once.std[inside], 1e-4)
        np.testing.assert_allclose(twice.noise_length, once.noise_length, ROUNDOFF)

    def test_unknown_noise_stays_unknown(self):
        assert ThicknessMap(field(), extent=EXTENT).smoothed(0.3).std is None

    def test_width_zero_changes_nothing(self, measured):
        same = measured.smoothed(0.0)
        np.testing.assert_array_equal(same.values, measured.values)
        np.testing.assert_allclose(same.std, 0.003, ROUNDOFF)
        assert same.noise_length == 0

    def test_derivatives(self, measured):
        def energy(values, fwhm):
            made = ThicknessMap(values, extent=EXTENT, std=0.003).smoothed(fwhm)
            return (made.values**2).sum() + 1e4 * (made.std**2).sum() + made.noise_length

        values, fwhm, step = measured.values, 0.35, 1e-5
        direction = jnp.array(np.random.default_rng(3).normal(size=SHAPE))
        by_values, by_fwhm = jax.grad(energy, (0, 1))(values, fwhm)
        central = (energy(values, fwhm + step) - energy(values, fwhm - step)) / (2 * step)
        np.testing.assert_allclose(by_fwhm, central, FINITE_DIFFERENCE)
        central = (energy(values + step * direction, fwhm) - energy(values - step * direction, fwhm)) / (2 * step)
        np.testing.assert_allclose((by_values * direction).sum(), central, FINITE_DIFFERENCE)


class TestCropped:
    def test_keeps_samples_where_they_are(self, measured):
        part = measured.cropped(x=(1.35, 2.6), y=(-1.7, -1.1))
        assert part.shape == (5, 7)
        np.testing.assert_array_equal(part.values, measured.values[2:7, 2:9])
        np.testing.assert_allclose(part.x, measured.x[2:9], ROUNDOFF)
        np.testing.assert_allclose(part.y, measured.y[2:7], ROUNDOFF)

    def test_bounds_on_samples_are_included(self, measured):
        assert measured.cropped(x=(1.2, 1.8)).shape == (9, 4)
        assert measured.cropped().shape == SHAPE

    def test_cuts_std_and_mask(self):
        std = np.linspace(0.001, 0.002, 117).reshape(SHAPE)
        part = ThicknessMap(field(), extent=EXTENT, std=std, mask=hole()).cropped(x=(0.5, 1.3), y=(0.25, 0.7))
        np.testing.assert_array_equal(part.std, std[2:5, 3:7])
        np.testing.assert_array_equal(part.mask, hole()[2:5, 3:7])

    def test_refuses_to_leave_no_data(self, holed):
        with pytest.raises(ValueError, match="must leave data"):
            holed.cropped(x=(0.6, 1.0), y=(0.3, 0.6))

    @pytest.mark.parametrize("bounds", [(1.21, 1.39), (8.0, 9.0), (2.0, 1.0)])
    def test_refuses_too_little(self, measured, bounds):
        with pytest.raises(ValueError, match=r"cropped\.x \[mm\] must keep at least 2 samples of 1 to 3\.4 mm"):
            measured.cropped(x=bounds)

    def test_says_that_it_cannot_trace(self, measured):
        with pytest.raises(ValueError, match="crop before jit"):
            jax.jit(lambda m: m.cropped(x=(1.0, 2.0)).values)(measured)


class TestResampled:
    def test_keeps_a_bilinear_field(self):
        x, y = np.meshgrid(np.linspace(0, 2.4, 13), np.linspace(0, 1.2, 9))
        bilinear = 0.4 + 0.02 * x - 0.03 * y + 0.01 * x * y
        new = ThicknessMap(bilinear, extent=EXTENT, origin=(1.0, 2.0)).resampled(shape=(7, 30))
        x, y = np.meshgrid(np.linspace(0, 2.4, 30), np.linspace(0, 1.2, 7))
        np.testing.assert_allclose(new.values, 0.4 + 0.02 * x - 0.03 * y + 0.01 * x * y, ROUNDOFF)
        np.testing.assert_allclose(new.extent, EXTENT, ROUNDOFF)
        np.testing.assert_allclose(new.origin, (1.0, 2.0), ROUNDOFF)

    def test_same_grid_changes_nothing(self, measured):
        same = measured.resampled(spacing=(0.2, 0.15))
        np.testing.assert_allclose(same.values, measured.values, ROUNDOFF)
        np.testing.assert_allclose(same.noise_length, 0.0, atol=1e-9)

    def test_spacing_is_rounded_to_divide_the_extent(self, measured):
        assert measured.resampled(spacing=0.25).shape == (6, 11)

    def test_masked_pixels_spread_to_what_they_touch(self):
        mask = np.zeros(SHAPE, bool)
        mask[4, 6] = True
        same = ThicknessMap(field(), extent=EXTENT, mask=mask).resampled(shape=SHAPE)
        np.testing.assert_array_equal(same.mask, mask)
        finer = ThicknessMap(field(), extent=EXTENT, mask=mask).resampled(shape=(17, 25))
        touched = np.zeros((17, 25), bool)
        touched[7:10, 11:14] = True
        np.testing.assert_array_equal(finer.mask, touched)

    def test_noise_keeps_its_power_per_area_on_a_finer_grid(self):
        """A mean over the whole map is no better known after interpolation than before."""
        coarse = ThicknessMap(field(), extent=EXTENT, std=0.003)
        finer = coarse.resampled(shape=(65, 97))
        np.testing.assert_allclose(finer.std, 0.003, ROUNDOFF)
        area = 0.2 * 0.15 * (1 - 1 / 64)
        np.testing.assert_allclose(finer.noise_length, WHITE_NOISE_LENGTH * np.sqrt(area), ROUNDOFF)

    def test_std_is_an_upper_bound(self):
        draws = 0.45 + 0.01 * jax.random.normal(jax.random.key(2), (2000, *SHAPE))
        spread = jax.vmap(lambda draw: ThicknessMap(draw, extent=EXTENT).resampled(shape=(14, 20)).values)(draws).std(0)
        assert spread.max() <= 0.01 * (1 + SAMPLING)

    def test_coarser_grid_leaves_white_noise_white(self, measured):
        assert measured.resampled(shape=(5, 7)).noise_length == 0

    def test_varying_std_is_interpolated(self):
        std = np.linspace(0.001, 0.002, 117).reshape(SHAPE)
        new = ThicknessMap(field(), extent=EXTENT, std=std).resampled(shape=(17, 25))
        np.testing.assert_allclose(new.std[::2, ::2], std, ROUNDOFF)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({}, "got neither"),
            ({"spacing": 0.1, "shape": (4, 4)}, "got both"),
            ({"spacing": 0.0}, r"resampled\.spacing \(dx, dy\) \[mm\] must be positive"),
            ({"spacing": 9.0}, "at least 2 by 2"),
            ({"shape": (1, 5)}, r"at least 2 by 2 samples, got \(1, 5\)"),
        ],
    )
    def test_refuses(self, measured, arguments, message):
        with pytest.raises(ValueError, match=message):
            measured.resampled(**arguments)

    def test_spacing_under_jit_gives_advice(self, measured):
        with pytest.raises(ValueError, match=r"under jit or vmap pass shape="):
            jax.jit(lambda m: m.resampled(spacing=0.1).values)(measured)


class TestSample:
    def test_returns_the_samples(self, measured):
        x, y = jnp.meshgrid(measured.x, measured.y)
        np.testing.assert_allclose(measured.sample(x, y), measured.values, ROUNDOFF)

    def test_interpolates(self, measured):
        middle = measured.values[2:4, 5:7].mean()
        np.testing.assert_allclose(measured.sample(jnp.array(2.1), jnp.array(-1.625)), middle, ROUNDOFF)

    def test_continues_at_edge_values(self, measured):
        x, y = jnp.array([-9.0, 9.0, 1.0, 9.0]), jnp.array([-2.0, -2.0, 9.0, 9.0])
        corners = [measured.values[j, i] for j, i in ((0, 0), (0, -1), (-1, 0), (-1, -1))]
        np.testing.assert_allclose(measured.sample(x, y), jnp.array(corners), ROUNDOFF)

    def test_missing_pixels_give_nan_until_filled(self, holed):
        x, y = holed.x[jnp.array([4, 2, 2])], holed.y[jnp.array([3, 3, 3])] + jnp.array([0.0, 0.0, 0.01])
        assert jnp.isnan(holed.sample(x, y)).tolist() == [True, False, False]
        assert jnp.isnan(holed.sample(x + 0.1, y)).tolist() == [True, True, True]
        assert jnp.isfinite(holed.filled().sample(x + 0.1, y)).all()

    def test_derivatives(self, measured):
        rng = np.random.default_rng(5)
        x, y = jnp.array(1 + 2.4 * rng.random(20)), jnp.array(-2 + 1.2 * rng.random(20))
        direction = jnp.array(rng.normal(size=SHAPE))

        def energy(values, shift):
            return (ThicknessMap(values, extent=EXTENT, origin=(1.0, -2.0)).sample(x + shift, y - shift) ** 2).sum()

        step = 1e-6
        by_values, by_shift = jax.grad(energy, (0, 1))(measured.values, 0.0)
        central = (energy(measured.values, step) - energy(measured.values, -step)) / (2 * step)
        np.testing.assert_allclose(by_shift, central, FINITE_DIFFERENCE)
        ahead, behind = (energy(measured.values + s * direction, 0.0) for s in (step, -step))
        np.testing.assert_allclose((by_values * direction).sum(), (ahead - behind) / (2 * step), FINITE_DIFFERENCE)


def test_float32_stays_float32():
    with jax.enable_x64(False):
        made = ThicknessMap(field().astype(np.float32), extent=EXTENT, std=0.003, mask=hole()).filled().smoothed(0.3)
        made = made.resampled(shape=(6, 7))
        leaves = [made.values, made.extent, made.origin, made.std, made.noise_length]
        assert {leaf.dtype.name for leaf in leaves} == {"float32"}
