"""The experiment: a layer between window and sample, its field, its mesh and its sides."""

from collections.abc import Mapping
from typing import Any, Literal, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import as_leaf, check_positive, concrete
from .._repr import with_units
from .contact import Bonded, Contact, Roller, Side
from .layer import Layer
from .mesh import LayerMesh

SIDES = ("x0", "x1", "y0", "y1")
Element = Literal["mean_dilatation", "full", "reduced", "hybrid", "tet4", "tet10"]
ELEMENTS = get_args(Element)


class Palpation(eqx.Module):
    """A layer pressed between the window and the sample.

    Args:
        layer: The layer.
        extent: (Lx, Ly) [mm]: the layer covers 0..Lx, 0..Ly.
        elements: (nx, ny, nz).
        window: `Contact`, `Bonded` or `Roller` at z = 0.
        sample: `Contact`, `Bonded` or `Roller` at the sample–layer interface.
        sides: "free", "roller", a dict of these by x0, x1, y0, y1 (missing ones are free), or all four in this
            order, as they are stored (so that `dataclasses.replace` works).
        element: Strain measure of an element. Hexahedra: "mean_dilatation" (locking-free up to a bulk
            modulus of about 1000 shear moduli), "hybrid" (the same with the mean stress as an unknown: any
            bulk modulus, also `jnp.inf`), "full" (2×2×2 points; locks), "reduced" (one point with hourglass
            control; soft in bending). Tetrahedra that divide the same box: "tet4" (six to an element; locks
            worse than "full") and "tet10" (quadratic, six to 2×2×2 elements with their nodes: nx, ny, nz even).
            Contact acts on tetrahedra at their nodes, weighted by their triangles; in "tet10" only edge midpoints
            have weight, and a layer squeezed to 60% between rollers does not converge.
        side_contact: Whether free sides that bulge onto window or sample are in contact with it; never with `Explicit`,
            as in the published decks. Without, `stats["side_overlap"]` is their overlap with a body.
        hold: Constraint of rigid in-plane motion that friction does not prevent. None: mean in-plane displacement and
            rotation at the window are zero until friction can balance the hold force. A number [N/mm]: a uniform
            in-plane spring under the whole layer instead, so that it can drift.

    Raises:
        ValueError: If an argument is out of range or unknown.
    """

    layer: Layer
    extent: Float[Array, "2"] = eqx.field(metadata={"unit": "mm"})
    elements: tuple[int, int, int] = eqx.field(static=True)
    window: Side
    sample: Side
    sides: tuple[str, str, str, str] = eqx.field(static=True)
    element: Element = eqx.field(static=True)
    side_contact: bool = eqx.field(static=True)
    hold: Array | None = eqx.field(metadata={"unit": "N/mm"})

    def __init__(
        self,
        layer: Layer,
        extent,
        elements: tuple[int, int, int],
        window: Side,
        sample: Side,
        sides: str | Mapping[str, str] | tuple[str, str, str, str] = "free",
        element: Element = "mean_dilatation",
        hold=None,
        side_contact: bool = True,
    ):
        if not isinstance(layer, Layer):
            raise ValueError(f"Palpation.layer must be a Layer, got {type(layer).__name__}.")
        if np.shape(extent) != (2,):
            raise ValueError(f"Palpation.extent [mm] must be (Lx, Ly), got {extent!r}.")
        extent = as_leaf(extent, "Palpation.extent", "mm")
        check_positive("Palpation.extent", "mm", extent)
        counts = tuple(int(n) for n in elements)
        if len(counts) != 3 or min(counts) < 1 or counts != tuple(elements):
            raise ValueError(f"Palpation.elements must be three whole numbers (nx, ny, nz) ≥ 1, got {elements!r}.")
        for name, side in (("window", window), ("sample", sample)):
            if not isinstance(side, (Bonded, Roller, Contact)):
                raise ValueError(
                    f"Palpation.{name} must be Bonded(), Roller() or Contact(law, friction), got {side!r}."
                )
        if element not in ELEMENTS:
            raise ValueError(f"Palpation.element must be one of {ELEMENTS}, got {element!r}.")
        if element == "tet10" and any(n % 2 for n in counts):
            raise ValueError(f'Palpation.elements must be even numbers for element="tet10", got {elements!r}.')
        bulk = concrete(layer.material.bulk)
        if element != "hybrid" and bulk is not None and not np.all(np.isfinite(bulk)):
            raise ValueError(
                f"Palpation.element={element!r} needs a finite bulk modulus [MPa], got {bulk}. For an incompressible "
                'layer pass element="hybrid".'
            )
        hold = None if hold is None else as_leaf(hold, "Palpation.hold", "N/mm")
        if hold is not None:
            check_positive("Palpation.hold", "N/mm", hold)
        self.layer = layer
        self.extent = extent
        self.elements = counts
        self.window = window
        self.sample = sample
        self.sides = named_sides("Palpation", sides)
        self.element = element
        self.side_contact = bool(side_contact)
        self.hold = hold

    def __pdoc__(self, **options: Any) -> Any:
        return with_units(self, **options)

    def mesh(self) -> LayerMesh:
        """Build the mesh, with the layer's thickness sampled at its nodes."""
        nx, ny, nz = self.elements
        flat = LayerMesh(jnp.zeros((ny + 1, nx + 1), self.extent.dtype), self.extent, nz)
        return LayerMesh(self.layer.thickness_at(*flat.plane()), self.extent, nz)


def named_sides(owner: str, sides: str | Mapping[str, str] | tuple[str, ...]) -> tuple[str, str, str, str]:
    """Return the boundary condition of each side, in the order of `SIDES`.

    Args:
        owner: Name of the owner, for messages.
        sides: As `Palpation` takes them.

    Raises:
        ValueError: If they are none of these.
    """
    if isinstance(sides, str):
        chosen = (sides,) * len(SIDES)
    elif isinstance(sides, Mapping) and set(sides) <= set(SIDES):
        chosen = tuple(sides.get(side, "free") for side in SIDES)
    else:
        chosen = tuple(sides)
    if len(chosen) != len(SIDES) or not set(chosen) <= {"free", "roller"}:
        raise ValueError(
            f'{owner}.sides must be "free", "roller", a dict of these by {SIDES} or one for each of them, '
            f"got {sides!r}."
        )
    x0, x1, y0, y1 = chosen
    return x0, x1, y0, y1
