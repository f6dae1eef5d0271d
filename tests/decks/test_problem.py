"""From a deck to palpation, experiment, loads and solver: published decks, small ones, and what is no such problem."""

import gzip
import re

import numpy as np
import pytest

import opfem as op
from tests.decks.texts import imprint_deck, stacked_deck, text

PUBLISHED = {
    # c10, c01 and bulk are the same in all; friction of window and sample, extent, elements, thickness [mm]
    "validate_coin_t1_125um": (0.15, 0.05, (40, 40, 4), 0.5),
    "sol_sin_t2": (0.30, 0.05, (40, 40, 4), 0.5),
    "sim_frict_low_0p5N_0p12": (0.12, 0.05, (50, 50, 6), 0.4769376),
    "sim_frict_med_0p5N_0p15_2": (0.15, 0.01, (50, 50, 3), 0.5188308),
}


@pytest.fixture
def read(tmp_path):
    """Read lines of a deck."""

    def from_lines(lines, **options):
        (tmp_path / "small.inp").write_text(text(lines))
        return op.read_inp(tmp_path / "small.inp", **options)

    return from_lines


def published(shared, name):
    return op.read_inp(shared / "data" / "decks" / f"fQOCE_{name}.inp.gz")


def refusal(of) -> str:
    with pytest.raises(op.DeckError) as told:
        of()
    return str(told.value)


def changed(lines, **changes):
    """Replace text in lines; keys are given as pairs of old and new."""
    return [changes.get(line, line) for line in lines]


@pytest.mark.parametrize("name", PUBLISHED)
def test_published_inverse_decks(shared, name):
    window, sample, elements, thickness = PUBLISHED[name]
    deck = published(shared, name)
    palpation = deck.experiment()
    assert isinstance(palpation, op.Palpation)
    assert (float(palpation.window.friction), float(palpation.sample.friction)) == (window, sample)
    assert palpation.elements == elements
    assert float(palpation.layer.thickness) == pytest.approx(thickness, abs=1e-12)
    np.testing.assert_allclose(palpation.extent, 5.0)
    material = palpation.layer.material
    assert (float(material.c10), float(material.c01)) == (0.00223, 0.000703)
    assert float(material.bulk) == pytest.approx(20.0 * 2.0 * (0.00223 + 0.000703))
    assert palpation.element == "mean_dilatation"
    assert any("D = 0 is read as a bulk modulus of 0.11732 MPa (20 shear moduli" in said for said in deck.assumed())
    solver = deck.solver()
    assert isinstance(solver, op.Explicit)
    assert solver.mass_scaling == (5.0 if name.startswith("sol") else 25.0)
    assert (solver.duration, solver.output_every, solver.bulk_viscosity) == (1.0, 0.05, (0.06, 1.2))


def test_imprint_is_where_the_deck_moves_its_nodes(shared):
    """Displacements read from the text by `re`: L1 = L0 + u_z, since the body starts at its law's clearance."""
    path = shared / "data" / "decks" / "fQOCE_sol_sin_t2.inp.gz"
    steps = gzip.decompress(path.read_bytes()).decode().split("*Step")[1:]
    first, second = (
        np.array([float(z) for z in re.findall(r"impAssembly\.\d+, 3, 3, +(\S+)", step)]).reshape(57, 57)
        for step in steps
    )
    loads = published(shared, "sol_sin_t2").loads()
    assert [tuple(load.thickness.origin.tolist()) for load in loads] == [(-1.0, -1.0)] * 2
    np.testing.assert_allclose(loads[0].thickness.extent, 7.0)
    np.testing.assert_allclose(loads[0].thickness.values, 0.5 + first, atol=1e-12)
    np.testing.assert_allclose(loads[1].thickness.values, 0.5 + first + second, atol=1e-12)


def test_friction_decks_press_a_flat_plate(shared):
    (load,) = published(shared, "sim_frict_low_0p5N_0p12").loads()
    np.testing.assert_allclose(load.thickness.values, 0.4769376 - 0.1997982, atol=1e-12)
    assert tuple(load.thickness.origin.tolist()) == (-2.0, -2.0)


def test_published_experiment(shared):
    """The deck stands upside down and says D = 0 for hybrid elements; its sample's ridge is 2 + 0.125 sin(1.8 π x)."""
    deck = published(shared, "sim_sin_t1")
    experiment = deck.experiment()
    assert isinstance(experiment, op.Experiment)
    assert experiment.elements == ((40, 40, 4), (40, 40, 17))
    assert experiment.element == ("hybrid", "hybrid")
    assert np.isinf(experiment.layer.material.bulk)
    frictions = [float(side.friction) for side in (experiment.window, experiment.interface, experiment.plate)]
    assert frictions == [0.3, 0.1, 0.3]
    x = np.linspace(0.0, 5.0, 41)
    ridge = 2.0 + 0.125 * np.sin(2.0 * np.pi * 0.9 * x)
    np.testing.assert_allclose(experiment.sample.thickness.values, np.tile(ridge, (41, 1)), atol=1e-6)
    assert [float(load.approach) for load in deck.loads()] == pytest.approx([0.5, 0.506], abs=1e-5)
    assert any("upside down" in said for said in deck.assumed())
    assert isinstance(deck.solver(), op.Newton)


def test_calculix_decks_are_the_stored_cases(shared):
    """The reference's own decks state the problems that `tests.reference.cases` states from its arrays."""
    from tests.reference import cases

    folder = shared / "reference" / "ccx" / "decks"
    name = "coin_ccxcontact_muwin0p15_mutop0p05_lam0p02_C3D8"
    deck = op.read_inp(folder / f"{name}.inp.gz")
    assert deck.code == "calculix"
    assert repr(deck.experiment()) == repr(cases.coin(0.15, 0.05, 10.0))
    case, _ = cases.load_case(shared, name)
    # The deck's window stands 1e-6 mm high, to start in contact.
    np.testing.assert_allclose(deck.loads()[0].thickness.values, cases.imprint_map(case).values, atol=1.1e-6)
    prescribed = op.read_inp(folder / "coin_presc_uz_bottom_slip_C3D8.inp.gz", code="calculix")
    palpation = prescribed.experiment()
    assert (type(palpation.window), type(palpation.sample), palpation.element) == (op.Roller, op.Roller, "full")
    assert float(palpation.hold) == pytest.approx(1e-7 * 41**2)
    case, _ = cases.load_case(shared, "coin_presc_uz_bottom_slip_C3D8")
    np.testing.assert_allclose(prescribed.loads()[0].uz, cases.nodal_map(case, 2, 40), atol=1e-6)
    with pytest.raises(op.DeckError, match=r"ELAY is no block of hexahedra.*C3D20R"):
        op.read_inp(folder / "fam_B1_C3D20R_n8_k20.inp.gz").experiment()


def test_explicit_steps_add_up_and_static_ones_replace(read):
    first, second = read(imprint_deck(uz=-0.05, steps=2)).loads()
    np.testing.assert_allclose(first.thickness.values, 0.45, atol=1e-12)
    np.testing.assert_allclose(second.thickness.values, 0.40, atol=1e-12)
    static = [line for line in imprint_deck(uz=-0.05, steps=2) if line != ", 1." and "Viscosity" not in line]
    static = [line for line in static if line != "0.06, 1.2" and "Mass Scaling" not in line]
    static = [line.replace("*Dynamic, Explicit", "*Static").replace(", amplitude=Amp", "") for line in static]
    linear = read([line.replace("nlgeom=YES", "nlgeom=NO") for line in static])
    assert "*STEP without NLGEOM is linear; opfem solves large strain" in refusal(linear.loads)
    deck = read(static)
    with pytest.raises(op.DeckError, match=r"has D = 0, which Abaqus/Standard takes in hybrid elements only"):
        deck.experiment()
    assert float(deck.experiment(bulk=0.3).layer.material.bulk) == 0.3
    for load in deck.loads():
        np.testing.assert_allclose(load.thickness.values, 0.45, atol=1e-12)


def test_upside_down_is_the_same(read):
    """Turned about x by 180°, window and layer above: the same palpation, the map mirrored along y."""
    lines = imprint_deck()
    for name in ("Layer", "Window", "Imp"):
        at = lines.index(f"*Instance, name={name}-1, part={name}") + 1
        lines[at:at] = ["0., 0., 0.", "0., 0.75, 0., 1., 0.75, 0., 180."]
    lines = [line.replace(", 3, 3, -0.05", ", 3, 3, 0.05") for line in lines]
    turned, upright = read(lines), read(imprint_deck())
    # What was the lower face by name is the upper one by place, which nothing here goes by.
    assert repr(turned.experiment()) == repr(upright.experiment())
    np.testing.assert_allclose(turned.loads()[0].thickness.values, upright.loads()[0].thickness.values, atol=1e-9)
    assert any("upside down" in said for said in turned.assumed())


def test_experiment_between_plates(read):
    deck = read(stacked_deck())
    experiment = deck.experiment(bulk=0.2)
    assert float(experiment.layer.material.bulk) == 0.2
    assert float(experiment.plate.elastic_slip) == 1e-3
    assert [float(load.approach) for load in deck.loads()] == pytest.approx([0.1, 0.106])
    assert experiment.elements == ((4, 4, 2), (4, 4, 3))
    renamed = [line.replace("Layer", "Upper") for line in stacked_deck()]
    other = read(renamed)
    assert refusal(other.experiment).startswith("small.inp:1: which of SAMPLE and UPPER is the layer?")
    assert repr(other.experiment(layer="upper")) == repr(deck.experiment())
    assert float(other.loads(layer="Upper")[0].approach) == pytest.approx(0.1)


def test_several_materials_of_a_sample(read):
    lines = stacked_deck()
    at = lines.index("*Solid Section, elset=SampleAll, material=Rubber")
    lines[at : at + 2] = [
        "*Elset, elset=Hard", "1, 2, 17, 18", "*Elset, elset=Soft, generate", "3, 16", "19, 48",
        "*Solid Section, elset=Hard, material=Stiffer", ",", "*Solid Section, elset=Soft, material=Rubber", ",",
    ]  # fmt: skip
    at = lines.index("*Material, name=Rigid")
    lines[at:at] = ["*Material, name=Stiffer", "*Hyperelastic, neo hooke", "0.02, 0."]
    law = read(lines).experiment(bulk=0.5).sample_material()
    assert isinstance(law, op.MooneyRivlin)
    c10 = np.full((3, 4, 4), 0.00223)
    c10[1:, 0, :2] = 0.02  # from the layer's side on: the deck's lower two levels are the last two
    np.testing.assert_allclose(law.c10, c10)


NO_PROBLEM = {
    "a node moved": ("30, 1.0, 0.5, 0.25", "30, 1.0, 0.55, 0.25", r"LAYER-1 is no block of hexahedra"),
    "corners swapped": ("1, 1, 2, 7, 6, 21, 22, 27, 26", "1, 1, 2, 7, 31, 21, 22, 27, 26", r"no block of hexahedra"),
    "no such node": ("1, 1, 2, 7, 6, 21, 22, 27, 26", "1, 1, 2, 7, 600, 21, 22, 27, 26", r"there is no node 600\."),
    "elastic layer": ("*Hyperelastic, mooney-rivlin", "*Elastic", r"\*ELASTIC takes 2 numbers"),
    "sideways": ("Imp-1.ImpAll, 1, 2", "Imp-1.ImpAll, 1, 2, 0.1", r"IMP-1 moves sideways"),
    "free": ("Imp-1.ImpAll, 1, 2", "Imp-1.ImpAll, 1, 1", r"IMP-1 is neither soft \(no \*HYPERELASTIC\) nor rigid"),
    "element": ("*Element, type=C3D8", "*Element, type=C3D8I", r"LAYER-1 has elements C3D8I; of abaqus's opfem solves"),
    "no material": ("*Material, name=Rubber", "*Material, name=Gum", r"LAYER-1: there is no \*MATERIAL RUBBER\."),
    "part of a face": ("Layer-1.LayerHigh, Imp-1.ImpLow", "Layer-1.Any, Imp-1.ImpLow", r"no surface Layer-1\.Any"),
    "linear": ("*Step, name=S0, nlgeom=YES", "*Step, name=S0, nlgeom=NO", ""),
    "no density": ("1e-09,", "0,", r"Explicit\.density"),
    "negative D": ("0.00223, 0.000703, 0", "0.00223, 0.000703, -1", r"D1 must be positive, got -1"),
    "unstable": ("0.00223, 0.000703, 0", "0.00223, -0.00703, 0", r"its shear modulus must be positive"),
}  # fmt: skip


@pytest.mark.parametrize("what", NO_PROBLEM)
def test_what_is_no_problem_for_opfem(read, what):
    old, new, pattern = NO_PROBLEM[what]
    lines = imprint_deck()
    assert old in lines

    def use():
        deck = read(changed(lines, **{old: new}))
        return deck.experiment(), deck.loads(), deck.solver()

    if not pattern:  # large strain is all that explicit dynamics knows
        use()
        return
    said = refusal(use)
    assert re.search(pattern, said), said
    assert re.match(r"small\.inp:\d+: ", said)


def test_sides_pins_and_springs(read):
    sides = ["*Nset, nset=Left", *(f"{k}," for k in range(1, 61, 5)), "*Nset, nset=Pin", "8,"]
    springs = [
        "*Element, type=SPRING1, elset=SX",
        *(f"{100 + k}, {k}" for k in range(1, 21)),
        "*Spring, elset=SX",
        "1",
        "1e-3",
    ]
    springs += [
        "*Element, type=SPRING1, elset=SY",
        *(f"{200 + k}, {k}" for k in range(1, 21)),
        "*Spring, elset=SY",
        "2",
        "1e-3",
    ]
    lines = imprint_deck()
    at = lines.index("*Solid Section, elset=LayerAll, material=Rubber")
    held = lines[:at] + sides + lines[at:]
    at = held.index("*Boundary")
    rolled = read([*held[:at], "*Boundary", "Layer-1.Left, XSYMM", *held[at:]]).experiment()
    assert (rolled.sides, rolled.hold) == (("roller", "free", "free", "free"), None)
    pinned = [*held[:at], "*Boundary", "Layer-1.Pin, 1, 2", *held[at:]]
    assert read(pinned).experiment().hold is None
    assert any("nodes constrained in the plane" in said for said in read(pinned).assumed())
    for held_so, words in (
        ("1, 2", "40 displacements of LAYER-1 are constrained"),
        ("3", "are constrained along z besides"),
    ):
        bottom = ["*Nset, nset=Bottom, generate", "1, 20"]
        at = lines.index("*Solid Section, elset=LayerAll, material=Rubber")
        both = lines[:at] + bottom + lines[at:]
        at = both.index("*Boundary")
        assert words in refusal(read([*both[:at], "*Boundary", f"Layer-1.Bottom, {held_so}", *both[at:]]).experiment)
    at = lines.index("*Solid Section, elset=LayerAll, material=Rubber")
    assert float(read(lines[:at] + springs + lines[at:]).experiment().hold) == pytest.approx(0.02)
    wrong = [*held[:at], *held[at:]]
    at = wrong.index("*Boundary")
    said = refusal(read([*wrong[:at], "*Boundary", "Layer-1.Left, 2", *wrong[at:]]).experiment)
    assert "12 displacements of LAYER-1 are constrained that are no whole face of it, such as y of node 1." in said


def test_materials(read):
    laws = {
        "neo hooke": ("0.003, 2.", op.NeoHooke(0.003, 1.0)),
        "yeoh": ("0.003, 1e-4, 1e-5, 2., 0., 0.", op.Yeoh(0.003, 1e-4, 1e-5, 1.0)),
        "ogden, n=2": ("0.003, 2., 0.001, -2., 2., 0.", op.Ogden([0.003, 0.001], [2.0, -2.0], 1.0)),
        "reduced polynomial, n=1": ("0.003, 2.", op.NeoHooke(0.003, 1.0)),
        "polynomial": ("0.003, 0.001, 2.", op.MooneyRivlin(0.003, 0.001, 1.0)),
    }
    for name, (numbers, law) in laws.items():
        new = {"*Hyperelastic, mooney-rivlin": f"*Hyperelastic, {name}", "0.00223, 0.000703, 0": numbers}
        assert repr(read(changed(imprint_deck(), **new)).experiment().layer.material) == repr(law)


def test_contact_laws(read):
    laws = {
        ("LINEAR", "20."): op.LinearOverclosure(20.0),
        ("TABULAR", "0., -0.01\n0.1, 0."): op.TabularOverclosure([0.0, 0.1], [0.01, 0.0]),
        ("EXPONENTIAL", "0.01, 2."): op.ExponentialOverclosure(2.0, 0.01),
    }
    old = "*Surface Behavior, pressure-overclosure=EXPONENTIAL"
    for (name, numbers), law in laws.items():
        new = {old: f"*Surface Behavior, pressure-overclosure={name}", "0.01, 2.": numbers}
        assert repr(read(changed(imprint_deck(), **new)).experiment().sample.law) == repr(law)
    told = refusal(
        lambda: read(changed(imprint_deck(), **{"*Friction": "*Friction, slip tolerance=0.01"})).experiment()
    )
    assert "opfem's slip tolerance is 0.005 of an element, got 0.01" in told
