"""The virtual experiment's constructor, meshes and materials."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.model import BlockMesh
from opfem.model.plausible import check_approach
from tests.oracles import warped_thickness
from tests.tolerances import FINITE_DIFFERENCE, ROUNDOFF

LAYER = op.Layer(0.5, op.MooneyRivlin(2.2e-3, 7e-4, 0.116))
SOFT, HARD = op.NeoHooke(3e-3, 0.12), op.NeoHooke(2e-2, 0.8)
SAMPLE = op.Sample(1.0, SOFT)
CONTACT = op.Contact(op.ExponentialOverclosure(2.0, 0.01), 0.05)
BALL = op.Sphere(centre=(1.0, 1.0, 0.5), radius=0.4)


def experiment(**changes):
    given = {"layer": LAYER, "sample": SAMPLE, "extent": (2.0, 2.0), "elements": (8, 8, (2, 4))}
    given |= {"window": op.Bonded(), "interface": CONTACT, "plate": op.Roller()}
    return op.Experiment(**(given | changes))


def ridged(nx=9, ny=9):
    x = np.linspace(0.0, 2.0, nx)
    return op.ThicknessMap(np.tile(1.0 + 0.2 * np.sin(2.0 * x) ** 2, (ny, 1)), extent=(2.0, 2.0))


def test_a_flat_sample_stands_between_layer_and_plate():
    made = experiment()
    np.testing.assert_allclose(made.plate_height, 1.5, ROUNDOFF)
    mesh = made.sample_mesh()
    assert mesh.elements == made.sample_elements == (8, 8, 4)
    assert made.layer_mesh().elements == made.layer_elements == (8, 8, 2)
    x, y, z = mesh.positions()
    np.testing.assert_allclose(z[:, 3, 5], [0.5, 0.75, 1.0, 1.25, 1.5], ROUNDOFF)
    np.testing.assert_allclose(x[2, 3], 0.25 * np.arange(9), ROUNDOFF)
    np.testing.assert_allclose(y[2, :, 3], 0.25 * np.arange(9), ROUNDOFF)
    np.testing.assert_allclose(mesh.thickness, np.full((9, 9), 1.0), ROUNDOFF)


def test_an_uneven_sample_touches_the_layer_at_its_highest_point():
    uneven = op.ThicknessMap(warped_thickness(8, 8, (2.0, 2.0)), extent=(2.0, 2.0))
    made = experiment(
        layer=op.Layer(uneven, LAYER.material),
        sample=op.Sample(ridged(), SOFT, levels=(0, 0.1, 0.4, 1)),
        elements=(8, 8, (2, 3)),
    )
    mesh = made.sample_mesh()
    gap = np.asarray(mesh.heights[0]) - np.asarray(uneven.values)
    np.testing.assert_allclose(gap.min(), 0.0, atol=1e-15)
    assert (gap > 0.01).any()
    np.testing.assert_allclose(mesh.heights[-1], np.full((9, 9), float(made.plate_height)), ROUNDOFF)
    np.testing.assert_allclose(mesh.heights[1], mesh.heights[0] + 0.1 * mesh.thickness, ROUNDOFF)
    np.testing.assert_allclose(mesh.thickness, ridged().values, ROUNDOFF)


def test_grids_need_not_match():
    made = experiment(elements=((9, 6, 2), (8, 8, 5)))
    assert made.layer_mesh().node_shape == (3, 7, 10)
    assert made.sample_mesh().node_shape == (6, 9, 9)
    assert made.sample_mesh().layers == 5


def test_elements_take_the_material_at_their_centres():
    sample = op.Sample(ridged(), SOFT).with_inclusion(BALL, HARD)
    made = experiment(sample=sample)
    mesh = made.sample_mesh()
    X = np.asarray(mesh.positions())
    law = made.sample_material()
    assert law.c10.shape == (4, 8, 8)
    top = X[2].min()
    hard = 0
    for k, j, i in np.ndindex(4, 8, 8):
        x, y, z = X[:, k : k + 2, j : j + 2, i : i + 2].reshape(3, 8).mean(axis=1)
        inside = (x - 1.0) ** 2 + (y - 1.0) ** 2 + (z - top - 0.5) ** 2 <= 0.4**2
        hard += inside
        assert law.c10[k, j, i] == (2e-2 if inside else 3e-3)
    assert hard > 8
    assert experiment().sample_material() is SOFT


def test_numbers_follow_their_derivative_through_meshes_and_materials():
    def total(thickness, soft):
        made = experiment(
            layer=op.Layer(0.5 * thickness, LAYER.material),
            sample=op.Sample(thickness, op.NeoHooke(soft, 0.12)).with_inclusion(BALL, HARD),
        )
        return jnp.sum(made.sample_mesh().positions()[2]) + jnp.sum(made.sample_material().c10)

    at = (1.05, 3e-3)
    slopes = jax.jit(jax.grad(total, (0, 1)))(*at)
    for k, slope in enumerate(slopes):
        step = 1e-6 * at[k]
        ahead, behind = (total(*(value + sign * step * (n == k) for n, value in enumerate(at))) for sign in (1, -1))
        np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), FINITE_DIFFERENCE)


def test_arguments_are_kept():
    made = experiment(sides={"x0": "roller"}, element=("hybrid", "full"), hold=2)
    assert made.sides == ("roller", "free", "free", "free")
    assert made.element == ("hybrid", "full")
    assert experiment().element == ("mean_dilatation", "mean_dilatation")
    assert made.hold == 2.0
    again = dataclasses.replace(made, extent=(3.0, 3.0))
    assert again.elements == made.elements
    assert again.element == made.element


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"layer": 0.5}, r"Experiment\.layer must be a Layer, got float"),
        ({"sample": LAYER}, r"Experiment\.sample must be a Sample, got Layer"),
        ({"extent": 2.0}, r"Experiment\.extent \[mm\] must be \(Lx, Ly\)"),
        ({"elements": (8, 8, 4)}, r"\(nx, ny, \(nz of the layer, nz of the sample\)\), or .*, got \(8, 8, 4\)"),
        ({"elements": (8, 8, (2, 0))}, r"whole numbers ≥ 1"),
        ({"elements": ((8, 8, 2), (8, 8))}, r"whole numbers ≥ 1"),
        ({"elements": (8, 8.5, (2, 4))}, r"whole numbers ≥ 1"),
        ({"elements": 8}, r"whole numbers ≥ 1"),
        ({"window": "bonded"}, r"Experiment\.window must be Bonded\(\), Roller\(\) or Contact"),
        ({"plate": None}, r"Experiment\.plate must be Bonded\(\), Roller\(\) or Contact"),
        ({"interface": op.Roller()}, r"Experiment\.interface must be Contact\(law, friction\) or Bonded\(\)"),
        ({"sides": "fixed"}, r"Experiment\.sides must be"),
        ({"element": "tet10"}, r"Experiment\.element must be one of .*, got 'tet10'"),
        ({"hold": 0.0}, r"Experiment\.hold \[N/mm\] must be positive"),
        ({"sample": op.Sample(1.0, op.NeoHooke(3e-3, np.inf))}, r"of the sample needs a finite bulk modulus"),
        ({"layer": op.Layer(0.5, op.NeoHooke(3e-3, np.inf))}, r"of the layer needs a finite bulk modulus"),
        ({"sample": op.Sample(1.0, SOFT, levels=(0.0, 1.0))}, r"must be nz\+1 = 5 numbers"),
        ({"elements": ((8, 8, 2), (13, 8, 4))}, r"too coarse for contact, 8 × 8 elements against 13 × 8"),
        ({"elements": ((8, 8, 2), (8, 10, 4)), "interface": op.Bonded()}, r"the same nx and ny in layer and sample"),
        ({"element": ("full", "hybrid"), "interface": op.Bonded()}, r"element must be the same for both, got \('full'"),
        ({"sample": op.Sample(ridged(), SOFT), "interface": op.Bonded()}, r"lies up to 0\.1\d+ mm off the layer's"),
        (
            {"sample": SAMPLE.with_inclusion(op.Sphere((1.0, 5.0, 0.5), 0.3), HARD)},
            r"inclusion 1 \(Sphere\) holds no centre .* outside the sample \(x 0 to 2, y 0 to 2, depth 0 to 1 mm\)",
        ),
        ({"sample": SAMPLE.with_inclusion(op.Sphere((1.0, 1.0, 0.5), 0.01), HARD)}, r"is smaller than an element"),
        ({"sample": SAMPLE.with_inclusion(np.ones((3, 8, 8), bool), HARD)}, r"the sample has \(4, 8, 8\)"),
    ],
)
def test_what_cannot_be_meant_is_refused(changes, message, annotations_unchecked):
    with pytest.raises(ValueError, match=message):
        experiment(**changes)


def test_faces_that_fill_the_space_may_be_bonded():
    layer = warped_thickness(8, 8, (2.0, 2.0))
    both = (op.ThicknessMap(values, extent=(2.0, 2.0)) for values in (layer, 1.5 - layer))
    made = experiment(
        layer=op.Layer(next(both), LAYER.material), sample=op.Sample(next(both), SOFT), interface=op.Bonded()
    )
    np.testing.assert_allclose(made.sample_mesh().heights[0], layer, ROUNDOFF)


@pytest.mark.parametrize(
    ("first", "second", "what"),
    [
        (BALL, op.Sphere((1.3, 1.0, 0.5), 0.4), "cuts into"),
        (BALL, op.Sphere((1.0, 1.0, 0.5), 0.6), "hides"),
        (BALL, op.Sphere((1.0, 1.0, 0.5), 0.3), None),
        (op.Sphere((0.4, 1.0, 0.5), 0.3), op.Sphere((1.5, 1.0, 0.5), 0.3), None),
    ],
)
def test_overlaps_are_warned_of_unless_one_lies_in_the_other(first, second, what):
    sample = SAMPLE.with_inclusion(first, HARD).with_inclusion(second, op.NeoHooke(5e-2, 2.0))
    if what is None:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            experiment(sample=sample)
    else:
        with pytest.warns(UserWarning, match=f"inclusion 2 {what} inclusion 1; the later one wins"):
            experiment(sample=sample)


def test_an_approach_leaves_room_between_window_and_plate():
    check_approach(1.3, 1.5)
    for approach, message in (
        (1.6, r"of the 1\.5 mm .* got 1\.6: the plate would pass the window"),
        (1.4, r"got 1\.4\."),
    ):
        with pytest.raises(ValueError, match=message):
            check_approach(approach, 1.5)
    with pytest.raises(ValueError, match=r"Compression\.approach \[mm\] must be positive, got 0"):
        op.Compression(0.0)
    assert repr(op.Compression(0.25)) == "Compression(approach=0.25 mm)"


def test_a_block_has_what_its_heights_say():
    heights = jnp.array([0.0, 0.3, 1.0])[:, None, None] + 0.1 * jnp.arange(3.0)
    mesh = BlockMesh(jnp.broadcast_to(heights, (3, 5, 3)), jnp.array([1.0, 4.0]))
    assert mesh.elements == (2, 4, 2)
    assert mesh.layers == 2
    np.testing.assert_allclose(mesh.spacing, [0.5, 1.0], ROUNDOFF)
    np.testing.assert_allclose(mesh.element_size, np.sqrt(0.5), ROUNDOFF)
    np.testing.assert_allclose(mesh.positions()[:, 1, 2, 2], [1.0, 2.0, 0.5], ROUNDOFF)
