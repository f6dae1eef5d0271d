"""Small decks as text, as Abaqus/CAE and the published toolbox write them; numbered here by plain loops."""

import numpy as np

LAYER = "Layer"
STEEL = ["*Material, name=Rigid", "*Density", "1e-9,", "*Elastic", "1., 0."]
RUBBER = ["*Material, name=Rubber", "*Density", "1e-09,", "*Hyperelastic, mooney-rivlin", "0.00223, 0.000703, 0"]


def block(x, y, z, top=None):
    """Nodes and hexahedra of a box: lines of each, counted from 1; columns are as high as `top` (y, x) says."""
    nodes, number = [], {}
    for k, height in enumerate(z):
        for j, row in enumerate(y):
            for i, column in enumerate(x):
                number[i, j, k] = len(nodes) + 1
                at = height if top is None else height / z[-1] * top[j][i]
                nodes.append(f"{len(nodes) + 1}, {column!r}, {row!r}, {at!r}")
    elements = []
    for k in range(len(z) - 1):
        for j in range(len(y) - 1):
            for i in range(len(x) - 1):
                ring = ((0, 0), (1, 0), (1, 1), (0, 1))
                corners = [number[i + di, j + dj, k + dk] for dk in (0, 1) for di, dj in ring]
                elements.append(", ".join(map(str, [len(elements) + 1, *corners])))
    return nodes, elements


def part(name, kind, x, y, z, material, top=None):
    """A part with sets of all, and surfaces of its lower and upper face."""
    x, y, z = ([float(v) for v in values] for values in (x, y, z))
    nodes, elements = block(x, y, z, top)
    face = (len(x) - 1) * (len(y) - 1)
    return [
        f"*Part, name={name}", "*Node", *nodes, f"*Element, type={kind}", *elements,
        f"*Nset, nset={name}All, generate", f"1, {len(nodes)}, 1",
        f"*Elset, elset={name}All, generate", f"1, {len(elements)}, 1",
        f"*Elset, elset={name}Low_S, internal, generate", f"1, {face}",
        f"*Elset, elset={name}High_S, internal", ", ".join(str(len(elements) - face + 1 + n) for n in range(face)),
        f"*Surface, type=ELEMENT, name={name}Low", f"{name}Low_S, S1",
        f"*Surface, type=ELEMENT, name={name}High", f"{name}High_S, S2",
        f"*Solid Section, elset={name}All, material={material}", ",", "*End Part",
    ]  # fmt: skip


def imprint_deck(uz=-0.05, layer_kind="C3D8", steps=1):
    """A layer of 1 × 1.5 × 0.5 mm on a window, a rigid body above it, moved by `uz` (a number) in each step."""
    x, y = np.linspace(0.0, 1.0, 5), np.linspace(0.0, 1.5, 4)
    wide_x, wide_y = np.linspace(-0.5, 1.5, 9), np.linspace(-0.5, 2.0, 6)
    lines = ["*Heading", "** a small one", "made by a test"]
    lines += part(LAYER, layer_kind, x, y, (0.0, 0.25, 0.5), "Rubber")
    lines += part("Window", "C3D8R", (-1, 3), (-1, 3), (-0.5, 0.0), "Rigid")
    lines += part("Imp", "C3D8R", wide_x, wide_y, (0.51, 1.0), "Rigid")
    lines += [*STEEL, *RUBBER, "*Assembly, name=Assembly"]
    for name in (LAYER, "Window", "Imp"):
        lines += [f"*Instance, name={name}-1, part={name}", "*End Instance"]
    lines += [
        "*End Assembly", "*Amplitude, name=Amp, definition=SMOOTH STEP", "0, 0, 1, 1",
        "*Surface Interaction, name=Soft", "*Friction", "0.05,",
        "*Surface Behavior, pressure-overclosure=EXPONENTIAL", "0.01, 2.",
        "*Surface Interaction, name=Stiff", "*Friction", "0.15,", "*Surface Behavior, pressure-overclosure=HARD",
        "*Boundary", "Window-1.WindowAll, 1, 3", "*Boundary", "Imp-1.ImpAll, 1, 2",
        "*Contact Pair, interaction=Soft, mechanical constraint=KINEMATIC", "Layer-1.LayerHigh, Imp-1.ImpLow",
        "*Contact Pair, interaction=Stiff", "Layer-1.LayerLow, Window-1.WindowHigh",
    ]  # fmt: skip
    for number in range(steps):
        lines += [f"*Step, name=S{number}, nlgeom=YES", "*Dynamic, Explicit", ", 1.", "*Bulk Viscosity", "0.06, 1.2"]
        lines += ["*Fixed Mass Scaling, factor=25", "*Boundary, amplitude=Amp"]
        lines += [f"Assembly.Imp-1.{node + 1}, 3, 3, {uz!r}" for node in range(wide_x.size * wide_y.size)]
        lines += ["*Output, field, number interval=20", "*Node Output", "U, RF", "*End Step"]
    return lines


def stacked_deck():
    """A ridged sample under a layer, as the published experiment stands: window above, moved down by 0.1 mm."""
    x, y = np.linspace(0.0, 1.0, 5), np.linspace(0.0, 1.0, 5)
    ridge = [[float(1.0 + 0.05 * np.sin(6.0 * column)) for column in x] for _ in y]
    crest = float(np.max(ridge))
    low, high = crest + 0.01, crest + 0.51
    lines = part("Sample", "C3D8H", x, y, np.linspace(0.0, 1.0, 4), "Rubber", top=ridge)
    lines += part(LAYER, "C3D8H", x, y, np.linspace(low, high, 3), "Rubber")
    lines += part("Plate", "C3D8", (-1, 3), (-1, 3), (-0.5, 0.0), "Rigid")
    lines += part("Window", "C3D8", (-1, 3), (-1, 3), (high, high + 0.5), "Rigid")
    lines += [*STEEL, *RUBBER, "*Assembly, name=Assembly"]
    for name in ("Sample", LAYER, "Plate", "Window"):
        lines += [f"*Instance, name={name}, part={name}", "*End Instance"]
    lines += [
        "*End Assembly", "*Boundary", "Plate.PlateAll, ENCASTRE", "*Boundary", "Window.WindowAll, 1, 2",
        "*Surface Interaction, name=Soft", "1.,", "*Friction, slip tolerance=0.005", "0.1,",
        "*Surface Behavior, pressure-overclosure=EXPONENTIAL", "0.01, 2.",
        "*Surface Interaction, name=Stiff", "*Friction, elastic slip=1e-3", "0.3,",
        "*Contact Pair, interaction=Stiff, type=SURFACE TO SURFACE", "Layer.LayerHigh, Window.WindowLow",
        "*Contact Pair, interaction=Soft, type=SURFACE TO SURFACE", "Sample.SampleHigh, Layer.LayerLow",
        "*Contact Pair, interaction=Stiff, type=SURFACE TO SURFACE", "Sample.SampleLow, Plate.PlateHigh",
    ]  # fmt: skip
    for name, moved in (("Preload", -0.1), ("Actuation", -0.106)):
        lines += [f"*Step, name={name}, nlgeom=YES", "*Static", "0.01, 1., 1e-05, 1.", "*Boundary"]
        lines += [f"Window.WindowAll, 3, 3, {moved!r}", "*End Step"]
    return lines


def text(lines):
    """Join the lines of a deck."""
    return "\n".join(lines) + "\n"
