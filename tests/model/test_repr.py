"""How materials, laws, layers, maps and loads are written: by numbers and units."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests.experiments import EXTENT, MATERIAL, flat_map, published_palpation


@pytest.mark.parametrize(
    ("part", "written"),
    [
        (op.MooneyRivlin(2.2e-3, 7e-4, 0.116), "MooneyRivlin(c10=0.0022 MPa, c01=0.0007 MPa, bulk=0.116 MPa)"),
        (op.NeoHooke(1e-3, jnp.inf), "NeoHooke(c10=0.001 MPa, bulk=inf MPa)"),
        (op.Hencky(2e-3, 0.1), "Hencky(shear=0.002 MPa, bulk=0.1 MPa)"),
        (op.Ogden([1e-3, 2e-3], [2.0, -2.0], 0.1), "Ogden(mu=(0.001, 0.002) MPa, alpha=(2, -2), bulk=0.1 MPa)"),
        (op.NeoHooke(np.full((2, 3, 4), 1e-3), 0.1), "NeoHooke(c10=0.001 MPa [2, 3, 4], bulk=0.1 MPa)"),
        (op.ExponentialOverclosure(2.0, 0.01), "ExponentialOverclosure(pressure=2 MPa, clearance=0.01 mm)"),
        (op.LinearOverclosure(7.0), "LinearOverclosure(stiffness=7 MPa/mm)"),
        (
            op.Contact(op.LinearOverclosure(7.0), 0.1),
            "Contact(law=LinearOverclosure(stiffness=7 MPa/mm), friction=0.1)",
        ),
        (op.Traction(np.array([[1e-3, 2e-3]])), "Traction(normal=0.001 to 0.002 MPa [1, 2])"),
        (op.Displacement(-0.1), "Displacement(uz=-0.1 mm, lateral='free')"),
        (flat_map(0.45), "ThicknessMap(21 × 17 pixels, 0.45 mm, extent (2, 2) mm)"),
    ],
)
def test_numbers_and_units(part, written):
    assert repr(part) == written


def test_a_map_says_what_is_known_of_it():
    values, mask = np.linspace(0.4, 0.5, 12).reshape(3, 4), np.zeros((3, 4), bool)
    mask[0, 0] = True
    measured = op.ThicknessMap(values, extent=EXTENT, origin=(-1.0, 0.5), std=0.002, mask=mask)
    before = (
        "ThicknessMap(4 × 3 pixels, 0.4091 to 0.5 mm, extent (2, 2) mm, origin (-1, 0.5) mm, std 0.002 mm, 1 missing"
    )
    assert repr(measured) == f"{before})"
    assert repr(measured.filled()) == f"{before} and filled)"


def test_parts_are_written_within_what_holds_them():
    palpation = published_palpation()
    text = repr(palpation)
    assert repr(MATERIAL) in text
    assert "thickness=0.5 mm" in text
    assert "extent=(2, 2) mm" in text
    assert "f64[]" not in text
    assert "0.45 mm" in repr(op.Imprint(flat_map(0.45)))


def test_traced_and_stacked_numbers_are_written_too():
    seen = []
    jax.jit(lambda law: seen.append(repr(law)))(op.NeoHooke(1e-3, 0.1))
    assert seen == ["NeoHooke(c10=traced float64[] MPa, bulk=traced float64[] MPa)"]
    many = jax.vmap(lambda c10: op.NeoHooke(c10, 0.1))(1e-3 * jnp.arange(1.0, 4.0))
    assert repr(many) == "NeoHooke(c10=(0.001, 0.002, 0.003) MPa, bulk=(0.1, 0.1, 0.1) MPa)"
    jax.grad(lambda std: seen.append(repr(op.ThicknessMap(np.full((2, 3), 0.4), extent=EXTENT, std=std))) or std)(0.002)
    assert "std traced float64[] mm" in seen[-1]
    maps = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), flat_map(0.45))
    assert repr(maps).startswith("ThicknessMap(")
    assert "True" in repr(jax.tree.map(lambda _: True, MATERIAL))
