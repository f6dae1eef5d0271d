"""The experiment's constructor."""

import numpy as np
import pytest

import opfem as op

LAYER = op.Layer(0.5, op.NeoHooke(1e-3, 0.1))


def palpation(**changes):
    given = {"layer": LAYER, "extent": (2.0, 1.0), "elements": (4, 2, 1), "window": op.Bonded(), "sample": op.Roller()}
    return op.Palpation(**(given | changes))


@pytest.mark.parametrize(
    ("sides", "expected"),
    [
        ("free", ("free", "free", "free", "free")),
        ("roller", ("roller", "roller", "roller", "roller")),
        ({}, ("free", "free", "free", "free")),
        ({"y0": "roller"}, ("free", "free", "roller", "free")),
        ({"x1": "roller", "y1": "roller", "x0": "free"}, ("free", "roller", "free", "roller")),
        (("free", "roller", "free", "roller"), ("free", "roller", "free", "roller")),
    ],
)
def test_sides(sides, expected):
    assert palpation(sides=sides).sides == expected


def test_numbers_are_kept():
    made = palpation(hold=2, element="full")
    np.testing.assert_array_equal(made.extent, [2.0, 1.0])
    assert made.elements == (4, 2, 1)
    assert made.element == "full"
    assert made.hold == 2.0
    assert palpation().element == "mean_dilatation"
    assert palpation().hold is None


@pytest.mark.parametrize("elements", [(4.0, 2.0, 1.0), np.array([4, 2, 1])])
def test_whole_numbers_of_another_type_are_counts(elements, annotations_unchecked):
    assert palpation(elements=tuple(elements)).elements == (4, 2, 1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"layer": 0.5}, r"Palpation\.layer must be a Layer, got float\."),
        ({"extent": 2.0}, r"Palpation\.extent \[mm\] must be \(Lx, Ly\), got 2\.0\."),
        ({"extent": (2.0, 1.0, 0.5)}, r"Palpation\.extent \[mm\] must be \(Lx, Ly\), got \(2\.0, 1\.0, 0\.5\)\."),
        ({"extent": (2.0, 0.0)}, r"Palpation\.extent \[mm\] must be positive, got values from 0 to 2\."),
        ({"elements": (4, 2)}, r"three whole numbers \(nx, ny, nz\) ≥ 1, got \(4, 2\)\."),
        ({"elements": (4, 0, 1)}, r"three whole numbers \(nx, ny, nz\) ≥ 1, got \(4, 0, 1\)\."),
        ({"elements": (4, 2.5, 1)}, r"three whole numbers \(nx, ny, nz\) ≥ 1, got \(4, 2\.5, 1\)\."),
        (
            {"window": "bonded"},
            r"Palpation\.window must be Bonded\(\), Roller\(\) or Contact\(law, friction\), got 'bonded'\.",
        ),
        ({"sample": op.HardOverclosure()}, r"Palpation\.sample must be Bonded\(\), Roller\(\) or Contact"),
        ({"element": "quadratic"}, r"Palpation\.element must be one of .*'full'.*, got 'quadratic'\."),
        ({"sides": "fixed"}, r'Palpation\.sides must be "free", "roller", a dict .*, got \'fixed\'\.'),
        ({"sides": ("free", "roller")}, r"Palpation\.sides must be .* got \('free', 'roller'\)\."),
        ({"sides": {"z0": "roller"}}, r"a dict of these by \('x0', 'x1', 'y0', 'y1'\) .* got \{'z0': 'roller'\}\."),
        ({"sides": {"x0": "fixed"}}, r"Palpation\.sides must be .* got \{'x0': 'fixed'\}\."),
        ({"hold": 0.0}, r"Palpation\.hold \[N/mm\] must be positive, got 0\.0\."),
    ],
)
def test_constructor_names_field_unit_and_value(changes, message, annotations_unchecked):
    with pytest.raises(ValueError, match=message):
        palpation(**changes)
