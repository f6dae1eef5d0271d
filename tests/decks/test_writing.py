"""`write_inp`: what is written reads back as the same problem; what a code cannot say exactly is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests.experiments import (
    ELEMENTS,
    EXPONENTIAL,
    EXTENT,
    MATERIAL,
    bumpy_map,
    inclusion_experiment,
    published_palpation,
)

PRINTED = 1e-12  # relative: numbers have 13 digits, as both codes read 20 characters


def soft(stiffness, friction, slope):
    return op.Contact(op.LinearOverclosure(stiffness), friction, stick_slope=slope)


def with_map_on_the_mesh():
    """A map on the mesh's grid that reaches past the layer."""
    h = EXTENT[0] / ELEMENTS[0]
    x, y = np.meshgrid(h * np.arange(-2, 9), h * np.arange(-3, 9))
    return op.ThicknessMap(0.45 + 0.01 * np.sin(x) * y, spacing=h, origin=(-2.0 * h, -3.0 * h))


UNEVEN = op.ThicknessMap(0.5 + 0.02 * np.random.default_rng(0).random((7, 7)), extent=EXTENT)
PALPATIONS = {
    "imprint": (published_palpation(), op.Imprint(with_map_on_the_mesh()), "abaqus"),
    "elastic slip": (
        published_palpation(window=op.Contact(op.HardOverclosure(), 0.1, elastic_slip=1e-3)),
        op.Imprint(with_map_on_the_mesh()),
        "abaqus",
    ),
    "table": (
        published_palpation(sample=op.Contact(op.TabularOverclosure([0.0, 0.1, 0.3], [0.01, 0.0, -0.002]), 0.05)),
        op.Imprint(with_map_on_the_mesh()),
        "abaqus",
    ),
    "calculix": (
        published_palpation(window=soft(10.0, 0.15, 0.1), sample=soft(10.0, 0.05, 0.02), element="full"),
        op.Imprint(with_map_on_the_mesh()),
        "calculix",
    ),
    "springs": (
        published_palpation(window=op.Roller(), sample=op.Roller(), element="full", hold=1e-3),
        op.Displacement(np.full((7, 7), -0.05)),
        "calculix",
    ),
    "held sides": (
        published_palpation(window=op.Bonded(), sample=op.Bonded(), sides={"x0": "roller", "y1": "roller"}),
        op.Displacement(np.linspace(-0.06, -0.04, 49).reshape(7, 7), "fixed"),
        "abaqus",
    ),
    "traction": (
        published_palpation(window=op.Bonded(), sample=op.Contact(op.HardOverclosure(), 0.0)),
        op.Traction(np.linspace(0.01, 0.02, 49).reshape(7, 7), np.full((2, 7, 7), 0.001)),
        "abaqus",
    ),
    "uneven": (
        published_palpation(thickness=UNEVEN, sample=op.Roller()),
        op.Displacement(np.full((7, 7), -0.02)),
        "abaqus",
    ),
    "incompressible": (
        published_palpation(
            material=op.MooneyRivlin(2e-3, 1e-3, np.inf),
            sample=op.Roller(),
            window=op.Roller(),
            element="hybrid",
            sides="roller",
        ),
        op.Displacement(np.full((7, 7), -0.02)),
        "abaqus",
    ),
    "ogden": (
        published_palpation(material=op.Ogden([4e-3, -1e-3], [2.0, -2.0], 0.2), window=op.Bonded(), sample=op.Roller()),
        op.Displacement(np.full((7, 7), -0.02)),
        "abaqus",
    ),
    "yeoh": (
        published_palpation(material=op.Yeoh(3e-3, -1e-4, 1e-5, 0.2), window=op.Bonded(), sample=op.Roller()),
        op.Displacement(np.full((7, 7), -0.02)),
        "abaqus",
    ),
}


def same(one, other):
    """Compare two problems, or loads, number by number."""
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(a, b, rtol=PRINTED, atol=PRINTED)


@pytest.mark.parametrize("name", PALPATIONS)
def test_palpation_reads_back(tmp_path, name):
    palpation, load, code = PALPATIONS[name]
    op.write_inp(tmp_path / "deck.inp", palpation, load, op.Newton(increments=5), code=code)
    deck = op.read_inp(tmp_path / "deck.inp")
    assert deck.code == code
    same(deck.experiment(), palpation)
    (back,) = deck.loads()
    same(back, load)
    assert deck.solver() == op.Newton(increments=5)
    assert max(len(line) for line in (tmp_path / "deck.inp").read_text().splitlines()) <= 132


def test_steps_read_back(tmp_path):
    """Explicit steps are written as changes, a map off the mesh at the nodes that opfem puts its surface through."""
    loads = [op.Imprint(bumpy_map()), op.Imprint(bumpy_map(0.09)), op.Imprint(bumpy_map(0.05))]
    solver = op.Explicit(duration=0.5, mass_scaling=10.0, bulk_viscosity=(0.05, 1.0), amplitude="ramp", damping=2.0)
    op.write_inp(tmp_path / "deck.inp", published_palpation(), loads, solver)
    deck = op.read_inp(tmp_path / "deck.inp")
    same(deck.experiment(), published_palpation())
    assert deck.solver() == dataclasses.replace(solver, output_every=0.5 / 20)
    for back, load in zip(deck.loads(), loads, strict=True):
        x, y = jnp.meshgrid(back.thickness.x, back.thickness.y)
        np.testing.assert_allclose(back.thickness.values, load.thickness.sample(x, y), atol=1e-12)
        h = EXTENT[0] / ELEMENTS[0]
        np.testing.assert_allclose(back.thickness.spacing, h)
        assert float(back.thickness.origin[0]) == pytest.approx(-4 * h)


@pytest.mark.parametrize(
    "changes",
    [{}, {"plate": op.Bonded(), "hold": 1e-3}, {"window": op.Roller(), "sides": "roller", "plate": op.Roller()}],
)
def test_experiment_reads_back(tmp_path, changes):
    experiment = inclusion_experiment(**changes)
    op.write_inp(tmp_path / "deck.inp", experiment, [op.Compression(0.2), op.Compression(0.21)])
    deck = op.read_inp(tmp_path / "deck.inp")
    back = deck.experiment()
    same(back.sample_material(), experiment.sample_material())
    assert [float(load.approach) for load in deck.loads()] == pytest.approx([0.2, 0.21], rel=PRINTED)
    same(dataclasses.replace(back, sample=experiment.sample), experiment)


def test_uneven_sample_on_levels_reads_back(tmp_path):
    x = np.linspace(0.0, 1.0, 6)
    ridges = op.ThicknessMap(np.tile(1.0 + 0.05 * np.sin(9.0 * x), (6, 1)), extent=EXTENT)
    sample = op.Sample(ridges, MATERIAL, levels=[0.0, 0.1, 0.3, 0.6, 1.0])
    experiment = inclusion_experiment(sample=sample, window=op.Contact(EXPONENTIAL, 0.1))
    op.write_inp(tmp_path / "deck.inp", experiment, op.Compression(0.2))
    deck = op.read_inp(tmp_path / "deck.inp")
    same(deck.experiment(), experiment)
    same(deck.loads()[0], op.Compression(0.2))


CALCULIX = {"code": "calculix"}
FULL = published_palpation(window=op.Bonded(), sample=op.Roller(), element="full")
REFUSED = {
    "hard": (
        published_palpation(element="full"),
        op.Imprint(bumpy_map()),
        CALCULIX,
        "CalculiX cannot say HardOverclosure",
    ),
    "exponential": (
        published_palpation(window=op.Roller(), element="full"),
        op.Imprint(bumpy_map()),
        CALCULIX,
        "its EXPONENTIAL is another law",
    ),
    "slope": (
        published_palpation(window=op.Roller(), sample=op.Contact(op.LinearOverclosure(10.0), 0.1), element="full"),
        op.Imprint(bumpy_map()),
        CALCULIX,
        "sticks with a constant slope",
    ),
    "C3D8 of CalculiX": (PALPATIONS["held sides"][0], PALPATIONS["held sides"][1], CALCULIX, "take element='full'"),
    "C3D8 of Abaqus": (FULL, op.Displacement(-0.02), {}, "take element='mean_dilatation'"),
    "reduced": (published_palpation(element="reduced"), op.Imprint(bumpy_map()), {}, "another hourglass control"),
    "tetrahedra": (published_palpation(element="tet4"), op.Imprint(bumpy_map()), {}, "decks are written of hexahedra"),
    "Hencky": (
        published_palpation(material=op.Hencky(0.006, 0.1)),
        op.Imprint(bumpy_map()),
        {},
        "neither Abaqus nor CalculiX has",
    ),
    "constant slope": (
        published_palpation(window=soft(10.0, 0.1, 0.1)),
        op.Imprint(bumpy_map()),
        {},
        "no constant stick slope",
    ),
    "approach": (
        published_palpation(),
        op.Imprint(bumpy_map(), correct_approach=True),
        {},
        "correct_approach depends on",
    ),
    "friction decides": (published_palpation(), op.Traction(0.01), {}, "needs lateral="),
    "drifts": (
        published_palpation(window=op.Roller(), sample=0.0),
        op.Imprint(bumpy_map()),
        {},
        "nothing holds the layer in the plane",
    ),
    "explicit of CalculiX": (
        FULL,
        op.Displacement(-0.02),
        {**CALCULIX, "solver": op.Explicit()},
        "Explicit is written for",
    ),
    "no load": (FULL, [], {}, "needs a load"),
    "mass": (
        published_palpation(),
        op.Imprint(bumpy_map()),
        {"solver": op.Explicit(mass_scaling="variable", increment=1e-4)},
        "mass_scaling must be one factor",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_a_code_cannot_say_is_refused(tmp_path, name):
    problem, load, options, words = REFUSED[name]
    with pytest.raises(ValueError, match=words):
        op.write_inp(tmp_path / "deck.inp", problem, load, **options)
    assert not (tmp_path / "deck.inp").exists()
