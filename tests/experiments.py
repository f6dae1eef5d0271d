"""The published experiment, small: a bump pressed into a soft layer, as most tests of whole solves need it.

A compiled program depends on the mesh, the element, the kinds of contact and load and the pixels of the map, not on
their numbers. Tests that are content with these share one; another of these kinds costs seconds of compiling.
"""

import numpy as np

import opfem as op
from opfem._types import ScalarLike
from opfem.model import AbstractMaterial, Side

SIDE, L0 = 2.0, 0.5  # mm
EXTENT = (SIDE, SIDE)
ELEMENTS = (6, 6, 2)
PIXELS = (17, 21)  # rows and columns of every map
# Of the published deck; bulk is what Abaqus/Explicit makes of its D=0, K/µ = 20.
MATERIAL = op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=0.11732)  # MPa
_HOLDS = (op.Bonded, op.Roller, op.Contact)
HARD, EXPONENTIAL = op.HardOverclosure(), op.ExponentialOverclosure(pressure=2.0, clearance=0.01)


def published_palpation(
    window: ScalarLike | Side = 0.15,
    sample: ScalarLike | Side = 0.05,
    material: AbstractMaterial = MATERIAL,
    thickness: float | op.ThicknessMap = L0,
    extent: tuple[float, float] = EXTENT,
    elements: tuple[int, int, int] = ELEMENTS,
    **options,
) -> op.Palpation:
    """State the published experiment; window and sample are friction coefficients, or what holds the face."""
    return op.Palpation(
        op.Layer(thickness, material),
        extent,
        elements,
        window if isinstance(window, _HOLDS) else op.Contact(HARD, window),
        sample if isinstance(sample, _HOLDS) else op.Contact(EXPONENTIAL, sample),
        **options,
    )


INCLUSION = op.Cylinder(centre=(0.8, 1.1), radius=0.45, depth=(0.2, 0.7))


def inclusion_experiment(**changes) -> op.Experiment:
    """State a small virtual experiment: a stiff cylinder in a soft sample under the published layer."""
    sample = op.Sample(1.0, op.NeoHooke(3e-3, 0.12)).with_inclusion(INCLUSION, op.NeoHooke(2e-2, 0.8))
    given = {"layer": op.Layer(L0, MATERIAL), "sample": sample, "extent": EXTENT, "elements": ((6, 6, 2), (5, 5, 4))}
    given |= {"window": op.Contact(HARD, 0.15), "interface": op.Contact(EXPONENTIAL, 0.05)}
    return op.Experiment(**(given | {"plate": op.Contact(HARD, 0.15)} | changes))


def bumpy_map(depth: float = 0.08, tilt: float = 0.0) -> op.ThicknessMap:
    """Press one bump off centre [mm] into the layer, on top of 0.03 mm; a tilt pushes the layer sideways."""
    x, y = np.meshgrid(*(np.linspace(0.0, SIDE, n) for n in reversed(PIXELS)))
    bump = depth * np.exp(-(((x - 0.8) / 0.5) ** 2) - ((y - 1.1) / 0.6) ** 2)
    return op.ThicknessMap(L0 - 0.03 - bump - tilt * (x - 1.0), extent=EXTENT)


def flat_map(thickness: float, extent: tuple[float, float] = EXTENT) -> op.ThicknessMap:
    """Press the whole layer to one thickness [mm]."""
    return op.ThicknessMap(np.full(PIXELS, thickness), extent=extent)
