"""`read_inp`: the format in its variants gives the same deck; what is wrong is refused in one line with its number."""

import gzip
import re

import numpy as np
import pytest

import opfem as op
from tests.decks.texts import imprint_deck, part, text

EXPECTED = imprint_deck()


@pytest.fixture
def read(tmp_path):
    """Read lines of a deck."""

    def from_lines(lines, name="small.inp", **options):
        path = tmp_path / name
        content = lines if isinstance(lines, bytes) else text(lines).encode()
        path.write_bytes(gzip.compress(content) if name.endswith(".gz") else content)
        return op.read_inp(path, **options)

    return from_lines


def refused(read, lines) -> str:
    def use():
        deck = read(lines)
        return deck.experiment(), deck.loads(), deck.solver()

    with pytest.raises(op.DeckError) as told:
        use()
    said = str(told.value)
    assert "\n" not in said
    return said


def line_of(lines, start) -> int:
    return next(number for number, line in enumerate(lines, 1) if line.startswith(start))


def replaced(start, *new):
    """The deck with one line replaced."""
    at = line_of(EXPECTED, start) - 1
    return [*EXPECTED[:at], *new, *EXPECTED[at + 1 :]]


def same(deck, other) -> bool:
    def arrays(d):
        parts = d.parts.values()
        return [a for p in parts for a in (p.numbers, p.positions, *p.node_sets.values(), *p.element_sets.values())]

    equal = all(np.array_equal(a, b) for a, b in zip(arrays(deck), arrays(other), strict=True))
    return equal and str(deck.loads()) == str(other.loads()) and str(deck.experiment()) == str(other.experiment())


def test_structure(read):
    deck = read(EXPECTED)
    layer = deck.parts["LAYER"]
    assert layer.positions.shape == (5 * 4 * 3, 3)
    assert layer.elements[0].nodes[0].tolist() == [1, 2, 7, 6, 21, 22, 27, 26]
    assert layer.element_sets["LAYERHIGH_S"].tolist() == list(range(13, 25))
    assert list(deck.instances) == ["LAYER-1", "WINDOW-1", "IMP-1"]
    assert deck.interactions["SOFT"].numbers == (0.01, 2.0)
    assert deck.interactions["STIFF"].friction == 0.15
    assert [(step.kind, step.mass_scaling, step.frames) for step in deck.steps] == [("explicit", 25.0, 20)]
    assert deck.steps[0].outputs == ["OUTPUT FIELD NUMBER INTERVAL", "NODE OUTPUT: U, RF"]
    assert deck.code == "abaqus"
    said = "\n".join(deck.ignored)
    for name in ("*HEADING", "*CONTACT PAIR, MECHANICAL CONSTRAINT", "*ELSET, INTERNAL"):
        assert f": {name}: " in said
    assert deck.ignored[0].startswith("small.inp:1: ")


VARIANTS = {
    "crlf": lambda lines: text(lines).replace("\n", "\r\n").encode(),
    "cr": lambda lines: text(lines).replace("\n", "\r").encode(),
    "bom": lambda lines: b"\xef\xbb\xbf" + text(lines).encode(),
    "no end": lambda lines: text(lines).rstrip().encode(),
    "lower": lambda lines: text(lines).lower().encode(),
    "upper": lambda lines: text(lines).upper().encode(),
    "blank lines": lambda lines: text(lines).replace("\n", "\n\n").encode(),
    "comments": lambda lines: text(lines).replace("\n", "\n** *Node, and so on\n").encode(),
    "spaces": lambda lines: text(lines).replace(", ", " ,\t ").encode(),
    "keyword goes on": lambda lines: text(lines).replace("type=ELEMENT, ", "type=ELEMENT,\n ").encode(),
    "element goes on": lambda lines: text(lines).replace("1, 2, 7, 6,", "1, 2, 7, 6,\n").encode(),
    "quoted": lambda lines: text(lines).replace("interaction=Soft", 'interaction="Soft"').encode(),
    "Fortran": lambda lines: text(lines).replace("-0.05", "-5.D-2").encode(),
    "a blank set": lambda lines: text(lines).replace("1, 60, 1", "1, 60").encode(),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_variants_of_the_format(read, variant):
    assert same(read(VARIANTS[variant](EXPECTED)), read(EXPECTED))


def test_compressed(read):
    assert same(read(EXPECTED, "small.inp.gz"), read(EXPECTED))


def test_includes(read, tmp_path):
    first = EXPECTED.index("*Node")
    count = 5 * 4 * 3
    (tmp_path / "mesh").mkdir()
    (tmp_path / "mesh" / "nodes.txt").write_text(text(EXPECTED[first + 1 : first + 1 + count]))
    lines = [*EXPECTED[:first], "*Node, input=mesh/nodes.txt", *EXPECTED[first + 1 + count :]]
    assert same(read(lines), read(EXPECTED))
    lines = [*EXPECTED[:first], "*Node", "*Include, input=mesh/nodes.txt", *EXPECTED[first + 1 + count :]]
    assert same(read(lines), read(EXPECTED))
    (tmp_path / "a.inp").write_text("*Heading\n*Include, input=a.inp\n")
    with pytest.raises(op.DeckError, match=r"^a\.inp:2: \*INCLUDE: a\.inp includes itself\.$"):
        op.read_inp(tmp_path / "a.inp")
    assert "small.inp:1: *INCLUDE: " in refused(read, ["*Include, input=none.inp"])


def test_instances_are_moved_and_turned(read):
    """The layer's part lies elsewhere on its side; its instance brings it to its place."""
    moved = list(part("Layer", "C3D8", np.linspace(0, 1, 5), np.linspace(0, 1.5, 4), (0, 0.25, 0.5), "Rubber"))
    first = moved.index("*Node") + 1
    for at in range(first, first + 60):
        number, x, y, z = moved[at].split(", ")
        moved[at] = f"{number}, {float(x) - 2.0!r}, {float(z) - 1.0!r}, {-float(y) + 3.0!r}"
    begin, end = EXPECTED.index("*Part, name=Layer"), EXPECTED.index("*Part, name=Window")
    lines = [*EXPECTED[:begin], *moved, *EXPECTED[end:]]
    at = lines.index("*Instance, name=Layer-1, part=Layer") + 1
    lines[at:at] = ["2., 1., -3.", "0., 0., 0., 1., 0., 0., 90."]
    turned, expected = read(lines).experiment(), read(EXPECTED).experiment()
    assert repr(turned) == repr(expected)


def test_sets_of_the_assembly(read):
    """Abaqus/CAE states sets and surfaces in the assembly."""
    lines = [line.replace("Layer-1.LayerHigh, Imp-1.ImpLow", "Top, Imp-1.ImpLow") for line in EXPECTED]
    lines = [line.replace("Window-1.WindowAll", "Fixed") for line in lines]
    at = lines.index("*End Assembly")
    lines[at:at] = [
        "*Nset, nset=Fixed, instance=Window-1, generate", "1, 8, 1",
        "*Elset, elset=_Top_S2, internal, instance=Layer-1", "13, 14, 15, 16,", "17, 18, 19, 20, 21, 22, 23, 24",
        "*Surface, type=ELEMENT, name=Top", "_Top_S2, S2",
    ]  # fmt: skip
    assert same(read(lines), read(EXPECTED))
    wrong = [line.replace("_Top_S2, S2", "_Top, S2") for line in lines]
    assert refused(read, wrong) == f"small.inp:{line_of(lines, '_Top_S2, S2')}: *SURFACE: there is no element set _Top."


REFUSED = {
    "unknown keyword": ("*Bulk", "*Viscoelastic", r"\*VISCOELASTIC is not supported\."),
    "unknown option": ("*Friction", "*Friction, rough", r"\*FRICTION, ROUGH is not supported\. opfem has Coulomb"),
    "no number": ("1, 0.0, 0.0, 0.0", "1, 0.0, zero, 0.0", r"\*NODE: expected a number, got 'zero'\."),
    "nan": ("1, 0.0, 0.0, 0.0", "1, 0.0, nan, 0.0", r"\*NODE: expected a number, got 'nan'\."),
    "too large": ("1, 0.0, 0.0, 0.0", "1, 0.0, 1e999, 0.0", r"\*NODE: expected a number, got '1e999'\."),
    "too few": ("1, 0.0, 0.0, 0.0", "1, 0.0, 0.0", r"\*NODE needs 4 numbers here, got 3\."),
    "element type": ("*Element, type=C3D8", "*Element, type=S4R", r"\*ELEMENT, TYPE=S4R is not supported"),
    "procedure": ("*Dynamic, Explicit", "*Dynamic", r"\*DYNAMIC without EXPLICIT is not supported\."),
    "law": ("*Surface Behavior, pressure-overclosure=EXPO", "*Surface Behavior, pressure-overclosure=VISCOUS",
            r"PRESSURE-OVERCLOSURE=VISCOUS is not supported"),
    "no amplitude": ("*Boundary, amplitude=Amp", "*Boundary, amplitude=Other", r"there is no such \*AMPLITUDE\."),
    "no set": ("Window-1.WindowAll, 1, 3", "Window-1.All, 1, 3", r"\*BOUNDARY: there is no node set Window-1\.All\."),
    "no instance": ("Window-1.WindowAll, 1, 3", "Win.All, 1, 3", r"\*BOUNDARY of Win\.All: there is no instance WIN\."),
    "no surface": ("Layer-1.LayerLow, ", "Layer-1.Low, Window-1.WindowHigh", r"there is no surface Layer-1\.Low\."),
    "twice": ("*Amplitude, name=Amp", "*Amplitude, name=Amp, name=B", r"\*AMPLITUDE has 'NAME' twice\."),
    "never ends": ("*End Step", "** end", r"\*STEP without \*END STEP"),
    "generate": ("1, 60, 1", "1, 999999999999, 1", r"GENERATE from 1 to 999999999999: there are 60 to choose from\."),
    "misplaced": ("*Density", "*Bulk Viscosity", r"\*BULK VISCOSITY belongs into a step, got it in the model\."),
    "data first": ("*Heading", "5.0", r"a deck begins with a keyword such as \*HEADING, got '5\.0'\."),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_refusals_name_the_line(read, what):
    start, new, pattern = REFUSED[what]
    said = refused(read, replaced(start, new))
    assert re.search(pattern, said), said
    line = line_of(EXPECTED, "*Step") if what == "never ends" else line_of(EXPECTED, start)
    assert re.match(rf"small\.inp:{line + (what == 'generate')}: ", said) or what == "generate", said


def test_no_deck_at_all(read, tmp_path):
    assert "holds no keyword" in refused(read, b"")
    assert "no mesh" in refused(read, ["*Heading"])
    (tmp_path / "broken.inp.gz").write_bytes(gzip.compress(text(EXPECTED).encode())[:200])
    with pytest.raises(op.DeckError, match="cannot be unpacked"):
        op.read_inp(tmp_path / "broken.inp.gz")
    with pytest.raises(op.DeckError, match="larger than max_bytes"):
        read(EXPECTED, max_bytes=1000)
    with pytest.raises(FileNotFoundError):
        op.read_inp(tmp_path / "none.inp")


def test_a_comma_too_many_joins_no_book(read):
    lines = ["*Heading", "*Nset, nset=A,", *(["1, 2, 3,"] * 10_000)]
    assert refused(read, lines).startswith("small.inp:2: a keyword of more than 10000 letters")
    assert refused(read, ["*Heading", '*Node, nset="' + "a, " * 100_000]).startswith("small.inp:2: a keyword of more")


def test_code_is_told_by_what_only_one_knows(read):
    assert read(EXPECTED, code="abaqus").code == "abaqus"
    with pytest.raises(op.DeckError, match='this is Abaqus\', but code="calculix" was passed'):
        read(EXPECTED, code="calculix")
    flat = ["*Node", "1, 0., 0., 0.", "*Surface Interaction, name=I", "*Friction", "0.1, 0.5"]
    assert read(flat).code == "calculix"
    assert read(flat).interactions["I"].slip == ("slope", 0.5)
