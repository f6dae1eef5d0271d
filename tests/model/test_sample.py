"""The deformable sample: materials from place to place, and where its nodes stand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.model import AbstractMaterial
from opfem.model.material_field import numbers_of
from tests.tolerances import FINITE_DIFFERENCE, ROUNDOFF

SOFT = op.NeoHooke(3e-3, 0.12)
HARD = op.NeoHooke(2e-2, 0.8)
BALL = op.Sphere(centre=(1.0, 1.0, 0.5), radius=0.3)


def grid(n: int = 5) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Points (depth, y, x) over 2 × 2 × 1 mm."""
    depth, y, x = jnp.meshgrid(jnp.linspace(0.0, 1.0, n), *2 * [jnp.linspace(0.0, 2.0, n)], indexing="ij")
    return x, y, depth


def test_a_uniform_sample_keeps_its_law():
    assert op.Sample(2.0, SOFT).material_at(*grid()) is SOFT


def test_points_take_the_law_of_the_last_inclusion_around_them():
    core = op.NeoHooke(0.1, 4.0)
    sample = op.Sample(2.0, SOFT).with_inclusion(BALL, HARD).with_inclusion(op.Sphere((1.0, 1.0, 0.5), 0.1), core)
    law = sample.material_at(*grid())
    assert isinstance(law, op.NeoHooke)
    assert law.c10.shape == law.bulk.shape == (5, 5, 5)
    for k, j, i in np.ndindex(5, 5, 5):
        distance = np.hypot(np.hypot(0.5 * i - 1.0, 0.5 * j - 1.0), 0.25 * k - 0.5)
        expected = core if distance <= 0.1 else HARD if distance <= 0.3 else SOFT
        assert law.c10[k, j, i] == expected.c10
        assert law.bulk[k, j, i] == expected.bulk


def test_a_mask_and_a_label_image_take_elements():
    labels = np.zeros((5, 5, 5), int)
    labels[0], labels[3, 2] = 1, 2
    many = op.Sample(2.0, SOFT).with_inclusion(labels, [HARD, op.NeoHooke(0.1, 4.0)]).material_at(*grid())
    np.testing.assert_array_equal(many.c10, np.array([3e-3, 2e-2, 0.1])[labels])
    one = op.Sample(2.0, SOFT).with_inclusion(labels == 1, HARD).material_at(*grid())
    np.testing.assert_array_equal(one.bulk, np.where(labels == 1, 0.8, 0.12))


def test_a_law_may_have_a_number_for_each_element():
    c10 = np.linspace(1e-3, 2e-3, 125).reshape(5, 5, 5)
    law = op.Sample(2.0, op.NeoHooke(c10, 0.1)).with_inclusion(BALL, HARD).material_at(*grid())
    inside = np.asarray(BALL.contains(*grid()))
    np.testing.assert_array_equal(law.c10, np.where(inside, 2e-2, c10))
    plain = op.Sample(2.0, op.NeoHooke(c10, 0.1)).material_at(*grid())
    np.testing.assert_array_equal(plain.c10, c10)
    np.testing.assert_array_equal(plain.bulk, np.full((5, 5, 5), 0.1))


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("wider", [op.MooneyRivlin(2e-3, 1e-3, 0.2), op.Yeoh(2e-3, -1e-4, 1e-4, 0.2)])
def test_a_law_becomes_the_wider_one_of_which_it_is_a_special_case(wider, order):
    base, inclusion = (SOFT, wider)[::order]
    law = op.Sample(2.0, base).with_inclusion(BALL, inclusion).material_at(*grid())
    assert type(law) is type(wider)
    inside = np.asarray(BALL.contains(*grid()))
    H = 0.1 * jax.random.normal(jax.random.key(0), (3, 3, 5, 5, 5))
    expected = jnp.where(inside, inclusion.energy(H), base.energy(H))
    np.testing.assert_allclose(law.energy(H), expected, ROUNDOFF, 1e-18)


@pytest.mark.parametrize(
    ("base", "inclusion", "message"),
    [
        (op.Hencky(1e-3, 0.1), SOFT, r"of one kind, or NeoHooke beside .*; got Hencky and NeoHooke\. State them all"),
        (op.MooneyRivlin(2e-3, 1e-3, 0.2), op.Yeoh(2e-3, 0.0, 0.0, 0.2), r"got MooneyRivlin and Yeoh"),
        (op.Ogden([1e-3], [2.0], 0.1), op.Ogden([1e-3], [2.0], 0.1), r"Ogden's numbers are one for each of its terms"),
    ],
)
def test_laws_that_cannot_stand_side_by_side_are_refused(base, inclusion, message):
    with pytest.raises(ValueError, match=message):
        op.Sample(2.0, base).with_inclusion(BALL, inclusion)


def test_a_uniform_sample_may_follow_any_law():
    law: AbstractMaterial = op.Ogden([1e-3, 2e-3], [2.0, -2.0], 0.1)
    assert op.Sample(2.0, law).material_at(*grid()) is law


def test_every_number_has_its_derivative():
    inside = np.asarray(BALL.contains(*grid()))

    def mean(soft, hard):
        sample = op.Sample(2.0, op.NeoHooke(soft, 0.1)).with_inclusion(BALL, op.MooneyRivlin(hard, 1e-4, 0.2))
        law = sample.material_at(*grid())
        return jnp.mean(law.shear + law.bulk)

    by_soft, by_hard = jax.jit(jax.grad(mean, (0, 1)))(3e-3, 2e-2)
    np.testing.assert_allclose([by_soft, by_hard], [2.0 * np.mean(~inside), 2.0 * np.mean(inside)], FINITE_DIFFERENCE)


def test_levels_are_kept_and_counted():
    np.testing.assert_allclose(op.Sample(2.0, SOFT).fractions(4), [0.0, 0.25, 0.5, 0.75, 1.0], ROUNDOFF)
    graded = op.Sample(2.0, SOFT, levels=(0.0, 0.2, 1.0))
    np.testing.assert_array_equal(graded.fractions(2), [0.0, 0.2, 1.0])
    assert graded.with_inclusion(BALL, HARD).levels is not None
    with pytest.raises(ValueError, match=r"must be nz\+1 = 4 numbers for 3 elements through the sample, got 3"):
        graded.fractions(3)


def test_an_uneven_sample_is_sampled_from_its_map():
    values = np.array([[1.0, 2.0], [1.0, 2.0]])
    sample = op.Sample(op.ThicknessMap(values, extent=(2.0, 2.0)), SOFT)
    np.testing.assert_allclose(sample.thickness_at(jnp.array([0.0, 0.5]), jnp.array([1.0, 1.0])), [1.0, 1.25], ROUNDOFF)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: op.Sample(-1.0, SOFT), r"Sample\.thickness \[mm\] must be positive, got -1"),
        (lambda: op.Sample(2000.0, SOFT), r"Sample\.thickness \[mm\] .* got 2000; is it in µm\?"),
        (lambda: op.Sample(np.ones((3, 3)), SOFT), r"Pass ThicknessMap\(values, extent"),
        (lambda: op.Sample(1.0, 3e-3), r"materials must be laws such as NeoHooke"),
        (lambda: op.Sample(1.0, SOFT, levels=(0.0, 0.5)), r"from 0 \(the layer's side\) to 1 \(the plate\), got"),
        (lambda: op.Sample(1.0, SOFT, levels=(0.0, 0.6, 0.5, 1.0)), r"must rise from node to node"),
        (lambda: op.Sample(1.0, SOFT, levels=0.5), r"must be a row of nz\+1 numbers, got shape \(\)"),
        (lambda: op.Sample(1.0, SOFT).with_inclusion(np.ones((2, 2), bool), HARD), r"an array \(nz, ny, nx\)"),
        (lambda: op.Sample(1.0, SOFT).with_inclusion(np.ones((2, 2, 2)), HARD), r"booleans or whole numbers, got"),
        (lambda: op.Sample(1.0, SOFT).with_inclusion(np.full((2, 2, 2), 3), [HARD]), r"each label 1 to 3, got 1"),
        (lambda: op.Sample(1.0, SOFT).with_inclusion(BALL, [HARD]), r"one law for a shape"),
    ],
)
def test_numbers_out_of_range_are_named(make, message, annotations_unchecked):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    "sample",
    [
        op.Sample(2.0, SOFT).with_inclusion(np.ones((2, 5, 5), bool), HARD),
        op.Sample(2.0, op.NeoHooke(np.full((2, 5, 5), 1e-3), 0.1)),
    ],
)
def test_arrays_for_another_number_of_elements_are_refused(sample):
    with pytest.raises(ValueError, match=r"\(2, 5, 5\) elements \(nz, ny, nx\); the sample has \(5, 5, 5\)"):
        sample.material_at(*grid())


def test_numbers_of_a_law_are_its_arguments():
    assert list(numbers_of(op.MooneyRivlin(2e-3, 1e-3, 0.2))) == ["c10", "c01", "bulk"]


def test_an_incompressible_inclusion_in_a_compressible_sample():
    law = op.Sample(2.0, SOFT).with_inclusion(BALL, op.NeoHooke(2e-2, np.inf)).material_at(*grid())
    inside = np.asarray(BALL.contains(*grid()))
    np.testing.assert_array_equal(law.bulk, np.where(inside, np.inf, 0.12))
    with pytest.raises(ValueError, match=r"NeoHooke\.bulk \[MPa\] must be positive, .*got values from -1 to 0\.1"):
        op.NeoHooke(1e-3, np.array([[[-1.0, 0.1, np.inf]]]))
