"""The virtual experiment: a layer on the window, a deformable sample on it, and a plate that presses them together.

z runs from the window (z = 0); the plate stands where the sample's highest point touches the unloaded layer.
"""

import itertools
import warnings
from collections.abc import Mapping
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._checks import as_leaf, check_positive, concrete
from .._repr import with_units
from .contact import Bonded, Contact, Roller, Side
from .inclusion import AbstractInclusion
from .layer import Layer
from .material import AbstractMaterial
from .material_field import numbers_of, widened
from .mesh import BlockMesh, LayerMesh
from .palpation import named_sides
from .sample import Sample

Hexahedron = Literal["mean_dilatation", "hybrid", "full", "reduced"]
HEXAHEDRA = get_args(Hexahedron)
Counts = tuple[int, int, int]
Sides = tuple[str, str, str, str]

# A layer face that is coarser than this integrates contact badly: forces on the sample's nodes are 3 to 23% off for
# uniform pressure at 2 times the sample's element, below 5% at 1.35 times.
_COARSEST = 1.5
_CONFORMING = 1e-6
"""Gap between faces with shared nodes, over the sample's thickness."""


class Experiment(eqx.Module):
    """A layer and a deformable sample between window and plate.

    Args:
        layer: The layer.
        sample: The sample.
        extent: (Lx, Ly) [mm]: both cover 0..Lx, 0..Ly.
        elements: (nx, ny, (nz of the layer, nz of the sample)); or (nx, ny, nz) of the layer and of the sample, for
            faces whose nodes do not meet.
        window: `Contact`, `Bonded` or `Roller` at z = 0.
        interface: `Contact` between layer and sample, or `Bonded`: then they share nodes, and the sample's face must
            lie on the layer's.
        plate: `Contact`, `Bonded` or `Roller` between sample and plate.
        sides: "free", "roller", a dict of these by x0, x1, y0, y1 (missing ones are free), or all four in this
            order; of both bodies.
        element: "mean_dilatation", "hybrid", "full" or "reduced", as in `Palpation`; or one for the layer and one for
            the sample.
        hold: What keeps bodies in place that friction cannot, as in `Palpation` [N/mm].

    Raises:
        ValueError: If an argument is out of range or unknown, or an inclusion takes no element.
    """

    layer: Layer
    sample: Sample
    extent: Float[Array, "2"] = eqx.field(metadata={"unit": "mm"})
    elements: tuple[Counts, Counts] = eqx.field(static=True)
    window: Side
    interface: Bonded | Contact
    plate: Side
    sides: Sides = eqx.field(static=True)
    element: tuple[Hexahedron, Hexahedron] = eqx.field(static=True)
    hold: Array | None = eqx.field(metadata={"unit": "N/mm"})

    def __init__(
        self,
        layer: Layer,
        sample: Sample,
        extent,
        elements,
        window: Side,
        interface: Bonded | Contact,
        plate: Side,
        sides: str | Mapping[str, str] | Sides = "free",
        element: Hexahedron | tuple[Hexahedron, Hexahedron] = "mean_dilatation",
        hold=None,
    ):
        for name, part, kind in (("layer", layer, Layer), ("sample", sample, Sample)):
            if not isinstance(part, kind):
                raise ValueError(f"Experiment.{name} must be a {kind.__name__}, got {type(part).__name__}.")
        if np.shape(extent) != (2,):
            raise ValueError(f"Experiment.extent [mm] must be (Lx, Ly), got {extent!r}.")
        extent = as_leaf(extent, "Experiment.extent", "mm")
        check_positive("Experiment.extent", "mm", extent)
        for name, side in (("window", window), ("plate", plate)):
            if not isinstance(side, (Bonded, Roller, Contact)):
                raise ValueError(
                    f"Experiment.{name} must be Bonded(), Roller() or Contact(law, friction), got {side!r}."
                )
        if not isinstance(interface, (Bonded, Contact)):
            raise ValueError(f"Experiment.interface must be Contact(law, friction) or Bonded(), got {interface!r}.")
        hold = None if hold is None else as_leaf(hold, "Experiment.hold", "N/mm")
        if hold is not None:
            check_positive("Experiment.hold", "N/mm", hold)
        self.layer = layer
        self.sample = sample
        self.extent = extent
        self.elements = _counts(elements)
        self.window = window
        self.interface = interface
        self.plate = plate
        self.sides = named_sides("Experiment", sides)
        self.element = _forms(element)
        self.hold = hold

    def __check_init__(self):
        _check_grids(self.elements, isinstance(self.interface, Bonded))
        self.sample.fractions(self.sample_elements[2])
        law = self.sample_material()
        for name, form, material in zip(("layer", "sample"), self.element, (self.layer.material, law), strict=True):
            bulk = concrete(material.bulk)
            if form != "hybrid" and bulk is not None and not np.all(np.isfinite(bulk)):
                raise ValueError(
                    f"Experiment.element={form!r} of the {name} needs a finite bulk modulus [MPa], got inf. For an "
                    'incompressible body pass element="hybrid".'
                )
        if isinstance(self.interface, Bonded):
            _check_bonded(self.layer_mesh(), self.sample_mesh())
            self.bonded_material()
            if self.element[0] != self.element[1]:
                raise ValueError(
                    "Experiment.interface=Bonded() makes one block of layer and sample: element must be the same for "
                    f"both, got {self.element}."
                )
        _check_inclusions(self)

    def __pdoc__(self, **options: Any) -> Any:
        return with_units(self, **options)

    @property
    def layer_elements(self) -> Counts:
        """Counts (nx, ny, nz) of the layer."""
        return self.elements[0]

    @property
    def sample_elements(self) -> Counts:
        """Counts (nx, ny, nz) of the sample."""
        return self.elements[1]

    @property
    def plate_height(self) -> Array:
        """Height of the plate over the window [mm] where no node of the layer lies deeper than on the sample."""
        layer = self.layer_mesh()
        return jnp.max(layer.thickness + self.sample.thickness_at(*layer.plane()))

    def layer_mesh(self) -> LayerMesh:
        """Build the layer's mesh, with its thickness sampled at the nodes."""
        nx, ny, nz = self.layer_elements
        flat = LayerMesh(jnp.zeros((ny + 1, nx + 1), self.extent.dtype), self.extent, nz)
        return LayerMesh(self.layer.thickness_at(*flat.plane()), self.extent, nz)

    def sample_mesh(self) -> BlockMesh:
        """Build the sample's mesh: k = 0 at the layer, the last nodes on the flat plate."""
        nx, ny, nz = self.sample_elements
        flat = BlockMesh(jnp.zeros((nz + 1, ny + 1, nx + 1), self.extent.dtype), self.extent)
        thickness = self.sample.thickness_at(*flat.plane())
        below = (1.0 - self.sample.fractions(nz))[:, None, None] * thickness  # of the plate
        return BlockMesh(self.plate_height - below, self.extent)

    def bonded_mesh(self) -> BlockMesh:
        """Build the mesh of layer and sample as one block, where they share nodes."""
        heights = jnp.concatenate([self.layer_mesh().node_heights(), self.sample_mesh().heights[1:]])
        return BlockMesh(heights, self.extent)

    def bonded_material(self) -> AbstractMaterial:
        """Build the law of layer and sample as one block, with a number for each element `(nz, ny, nx)`.

        Raises:
            ValueError: If their laws are of kinds that neither includes.
        """
        nx, ny, _ = self.layer_elements
        laws = widened([self.layer.material, self.sample_material()])
        numbers = [
            {name: jnp.broadcast_to(value, (nz, ny, nx)) for name, value in numbers_of(law).items()}
            for law, (_, _, nz) in zip(laws, self.elements, strict=True)
        ]
        return type(laws[0])(**jax.tree.map(lambda *parts: jnp.concatenate(parts), *numbers))

    def sample_centres(self) -> tuple[Array, Array, Array]:
        """Compute x, y and depth [mm] of the centres of the sample's elements, each `(nz, ny, nx)`.

        Depth counts from the highest of the sample's nodes towards the plate.
        """
        X = self.sample_mesh().positions()
        nz, ny, nx = (n - 1 for n in X.shape[1:])
        corners = itertools.product((0, 1), repeat=3)
        x, y, z = jnp.mean(jnp.stack([X[:, k : k + nz, j : j + ny, i : i + nx] for k, j, i in corners]), axis=0)
        return x, y, z - jnp.min(X[2])

    def sample_material(self) -> AbstractMaterial:
        """Build the sample's law with a number for each element `(nz, ny, nx)`, or one for all where it is uniform.

        An element takes the material at its centre.

        Raises:
            ValueError: If material or an inclusion is given for another number of elements.
        """
        return self.sample.material_at(*self.sample_centres())


def _counts(elements: Any) -> tuple[Counts, Counts]:
    try:
        if len(elements) == 3:
            nx, ny, through = elements
            given = [(nx, ny, nz) for nz in through]
        else:
            given = [tuple(triple) for triple in elements]
        counts = [tuple(int(n) for n in triple) for triple in given]
    except (TypeError, ValueError):
        given, counts = [], []
    if len(counts) == 2 and counts == given and all(len(triple) == 3 and min(triple) >= 1 for triple in counts):
        (ax, ay, az), (bx, by, bz) = counts
        return (ax, ay, az), (bx, by, bz)
    raise ValueError(
        "Experiment.elements must be (nx, ny, (nz of the layer, nz of the sample)), or (nx, ny, nz) of each, in whole "
        f"numbers ≥ 1, got {elements!r}."
    )


def _forms(element: Any) -> tuple[Hexahedron, Hexahedron]:
    forms: Any = (element, element) if isinstance(element, str) else tuple(element)
    if len(forms) != 2 or not set(forms) <= set(HEXAHEDRA):
        raise ValueError(
            f"Experiment.element must be one of {HEXAHEDRA}, or one for the layer and one for the sample, got "
            f"{element!r}."
        )
    return forms[0], forms[1]


def _check_grids(elements: tuple[Counts, Counts], bonded: bool) -> None:
    layer, sample = elements
    if bonded and layer[:2] != sample[:2]:
        raise ValueError(
            f"Experiment.interface=Bonded() shares nodes: elements must have the same nx and ny in layer and sample, "
            f"got {layer} and {sample}."
        )
    if any(theirs > _COARSEST * own for own, theirs in zip(layer[:2], sample[:2], strict=True)):
        raise ValueError(
            f"Experiment.elements: the layer's face is too coarse for contact, {layer[0]} × {layer[1]} elements "
            f"against {sample[0]} × {sample[1]} of the sample. Contact is integrated on the layer's face, which may be "
            f"at most {_COARSEST:g} times coarser: take more elements in the layer, or fewer in the sample."
        )


def _check_bonded(layer: LayerMesh, sample: BlockMesh) -> None:
    faces = concrete(layer.thickness), concrete(sample.heights[0]), concrete(sample.thickness)
    if any(face is None for face in faces):
        return
    interface, face, thickness = (np.asarray(face) for face in faces)
    gap = np.max(np.abs(face - interface))
    if gap > _CONFORMING * np.max(thickness):
        raise ValueError(
            f"Experiment.interface=Bonded() shares nodes, but the sample's face lies up to {gap:.4g} mm off the "
            "layer's. Take Contact(law, friction), or thicknesses that fill the space between window and plate."
        )


def _check_inclusions(experiment: Experiment) -> None:
    """Refuse inclusions that take no element, and warn of those that cut into or hide others."""
    masks = [concrete(mask) for mask in experiment.sample.inside(*experiment.sample_centres())]
    known = [(number, mask) for number, mask in enumerate(masks, start=1) if mask is not None]
    for number, mask in known:
        where = experiment.sample.inclusions[number - 1][0]
        if not mask.any():
            name = type(where).__name__ if isinstance(where, AbstractInclusion) else "array"
            raise ValueError(
                f"Sample: inclusion {number} ({name}) holds no centre of an element. It lies outside the sample "
                f"({_written(experiment)}), or is smaller than an element: move it, or take more elements."
            )
    for (first, below), (second, above) in itertools.combinations(known, 2):
        if (above & below).any() and not (below | ~above).all():
            what = "hides" if not (below & ~above).any() else "cuts into"
            warnings.warn(
                f"Sample: inclusion {second} {what} inclusion {first}; the later one wins where they overlap.",
                stacklevel=4,
            )


def _written(experiment: Experiment) -> str:
    """Write where the sample lies, for messages."""
    extent, thickness = concrete(experiment.extent), concrete(experiment.sample_mesh().thickness)
    if extent is None or thickness is None:
        return "x, y and depth in mm"
    return f"x 0 to {extent[0]:.4g}, y 0 to {extent[1]:.4g}, depth 0 to {np.max(thickness):.4g} mm"
