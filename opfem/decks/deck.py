"""What a deck says, neither Abaqus' nor opfem's: parts, instances, materials, contact, steps, as `read_inp` finds them.

Host data in NumPy arrays. `problem` turns it into what `solve` takes.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from .cards import Place

if TYPE_CHECKING:
    from ..model import Compression, Displacement, Experiment, Imprint, Palpation, Traction
    from ..model.surface import Interpolation
    from ..solvers import Explicit, Newton

Code = Literal["abaqus", "calculix"]
Members = dict[str, np.ndarray]
"""Numbers of nodes or elements by the instance that they belong to."""
Face = tuple[Members, int]
"""Elements, and which of their faces, from 1."""


@dataclass(frozen=True)
class Elements:
    """Elements of one type.

    Attributes:
        kind: Type, such as "C3D8R".
        numbers: Their numbers `(n,)`.
        nodes: Numbers of their nodes `(n, k)`.
        place: Where the deck lists them.
    """

    kind: str
    numbers: np.ndarray
    nodes: np.ndarray
    place: Place


@dataclass(frozen=True)
class Section:
    """The material of an element set."""

    elements: np.ndarray
    material: str
    place: Place


@dataclass
class Part:
    """Nodes and elements in their own frame; the only one of a deck without *PART has the name "".

    Attributes:
        numbers: Of the nodes `(n,)`.
        positions: Of the nodes `(n, 3)` [mm].
        elements: By type, in the order of the deck.
        node_sets: Numbers by name in capitals.
        element_sets: Numbers by name in capitals.
        surfaces: Faces by name in capitals.
        sections: Materials.
        springs: Stiffness [N/mm] and direction 0 to 2 of *SPRING, by element set.
        place: Where the part begins.
    """

    name: str
    place: Place
    numbers: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    positions: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    elements: list[Elements] = field(default_factory=list)
    node_sets: dict[str, np.ndarray] = field(default_factory=dict)
    element_sets: dict[str, np.ndarray] = field(default_factory=dict)
    surfaces: dict[str, list[Face]] = field(default_factory=dict)
    sections: list[Section] = field(default_factory=list)
    springs: list[tuple[np.ndarray, int, float]] = field(default_factory=list)


@dataclass(frozen=True)
class Instance:
    """A part in its place: shifted, then turned about an axis through `centre`."""

    name: str
    part: str
    shift: np.ndarray
    rotation: np.ndarray
    centre: np.ndarray
    place: Place

    def placed(self, positions: np.ndarray) -> np.ndarray:
        """Move positions `(n, 3)` [mm] of the part to where the instance stands."""
        moved = positions + self.shift
        if np.array_equal(self.rotation, np.eye(3)):
            return moved
        return (moved - self.centre) @ self.rotation.T + self.centre


@dataclass
class Material:
    """A material.

    Attributes:
        kind: "elastic", or the name of a hyperelastic law: "mooney-rivlin", "neo-hooke", "yeoh", "ogden".
        numbers: Coefficients as the deck has them, those of D last.
        density: [t/mm³]; None where the deck has none.
        damping: Proportional to mass [1/s].
    """

    name: str
    place: Place
    kind: str = ""
    numbers: tuple[float, ...] = ()
    density: float | None = None
    damping: float = 0.0


@dataclass
class Interaction:
    """Properties of a contact.

    Attributes:
        law: "hard", "exponential", "linear" or "tabular".
        numbers: Of the law, as the deck has them.
        friction: Coefficient [-].
        slip: How sticking slips: ("tolerance", over the element's size), ("elastic", mm) or ("slope", MPa/mm); None
            where the deck leaves it to the code.
    """

    name: str
    place: Place
    law: str = "hard"
    numbers: tuple[float, ...] = ()
    friction: float = 0.0
    slip: tuple[str, float] | None = None


@dataclass(frozen=True)
class Pair:
    """Two surfaces in contact, each the faces of elements."""

    slave: tuple[Face, ...]
    master: tuple[Face, ...]
    interaction: str
    place: Place


@dataclass(frozen=True)
class Condition:
    """Prescribed displacements [mm], or forces [N], along one axis of nodes of an instance."""

    instance: str
    nodes: np.ndarray
    component: int
    values: np.ndarray
    amplitude: str
    place: Place


@dataclass(frozen=True)
class Amplitude:
    """A factor over time [s], linear between points or with smooth steps."""

    name: str
    times: np.ndarray
    factors: np.ndarray
    is_smooth: bool
    is_total: bool
    place: Place

    def at(self, time: float) -> float:
        """Evaluate the factor; constant before the first and after the last point."""
        times, factors = self.times, self.factors
        if not self.is_smooth:
            return float(np.interp(time, times, factors))
        k = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, times.size - 1))
        if k == times.size - 1 or time <= times[0]:
            return float(factors[k])
        t = (time - times[k]) / (times[k + 1] - times[k])
        return float(factors[k] + (factors[k + 1] - factors[k]) * t**3 * (10.0 - 15.0 * t + 6.0 * t**2))


@dataclass
class Step:
    """One step of the analysis.

    Attributes:
        kind: "static" or "explicit".
        time: Its duration [s].
        first: First increment [s] of a static step; None where the deck leaves it to the code.
        largest: Largest increment [s] of a static step.
        is_nonlinear: Whether it follows large displacements (NLGEOM).
        prescribed: Displacements.
        forces: Concentrated forces.
        is_new: Whether displacements of earlier steps no longer hold (OP=NEW).
        bulk_viscosity: Linear and quadratic.
        mass_scaling: Factor on the density.
        outputs: What it asks for, in the deck's words.
        frames: Outputs of the fields over the step.
    """

    name: str
    place: Place
    kind: str = ""
    time: float = 1.0
    first: float | None = None
    largest: float | None = None
    is_nonlinear: bool = False
    prescribed: list[Condition] = field(default_factory=list)
    forces: list[Condition] = field(default_factory=list)
    is_new: bool = False
    bulk_viscosity: tuple[float, float] = (0.06, 1.2)
    mass_scaling: float = 1.0
    outputs: list[str] = field(default_factory=list)
    frames: int | None = None


@dataclass(frozen=True)
class Deck:
    """What an Abaqus or CalculiX input file says, made by `read_inp` and not changed any more.

    Names are in capitals, as both codes take them; units are the deck's, for opfem mm, N, MPa, s, tonne.

    Attributes:
        name: Of the file.
        code: Whose semantics it has: "abaqus" or "calculix".
        parts: By name; a flat deck has one, "".
        instances: By name; of a flat deck one, "".
        materials: By name.
        interactions: By name.
        amplitudes: By name.
        pairs: Surfaces in contact; of two definitions of one pair the later.
        prescribed: Displacements that hold in all steps.
        steps: In order.
        ignored: What changes no solution of opfem and is left out, each with its place and why.
    """

    name: str
    code: Code
    parts: dict[str, Part]
    instances: dict[str, Instance]
    materials: dict[str, Material]
    interactions: dict[str, Interaction]
    amplitudes: dict[str, Amplitude]
    pairs: tuple[Pair, ...]
    prescribed: tuple[Condition, ...]
    steps: tuple[Step, ...]
    ignored: tuple[str, ...]

    def __repr__(self) -> str:
        nodes = sum(self.parts[instance.part].numbers.size for instance in self.instances.values())
        names = ", ".join(name for name in self.instances if name) or "one flat part"
        return f"Deck({self.name}: {names}; {nodes} nodes; {len(self.steps)} steps; for {self.code})"

    @cached_property
    def _found(self) -> Any:
        from .finding import find_problem

        return find_problem(self)

    def experiment(self, bulk: float | None = None, layer: str | None = None) -> "Palpation | Experiment":
        """Build what the deck presses: a `Palpation` between rigid bodies, or an `Experiment` with a soft sample.

        Args:
            bulk: Bulk modulus [MPa] of materials with D = 0, which says none; `jnp.inf` for incompressible. None: what
                the deck's own code takes for it, which `assumed` names: 20 shear moduli in Abaqus/Explicit and in
                CalculiX, incompressible in hybrid elements.
            layer: Instance that is the layer, where two bodies are soft and neither or both are called so.

        Raises:
            DeckError: If the deck is no layer between window and sample, in blocks of hexahedra on a regular grid.
        """
        return self._problem(layer).experiment(bulk)

    def loads(
        self, interpolation: "Interpolation" = "cubic", layer: str | None = None
    ) -> "tuple[Imprint | Displacement | Traction | Compression, ...]":
        """Build the load of each step, at its end; solve one after the other with `start=`.

        Args:
            interpolation: How the surface of an `Imprint` runs between the nodes of the deck's rigid body, whose own
                faces are "bilinear".
            layer: As in `experiment`.

        Raises:
            DeckError: If a step loads the layer in another way.
        """
        return self._problem(layer).loads(interpolation)

    def solver(self) -> "Newton | Explicit":
        """Build the solver of the deck's first step: `Explicit` with its mass scaling and viscosity, or `Newton`.

        Raises:
            DeckError: If steps need different ones.
        """
        from .procedure import solver_of

        return solver_of(self)

    def assumed(self, bulk: float | None = None, layer: str | None = None) -> tuple[str, ...]:
        """Say what the deck leaves open or says otherwise, and how `experiment` and `loads` take it."""
        return self._problem(layer).assumed(bulk)

    def _problem(self, layer: str | None) -> Any:
        if layer is None:
            return self._found
        from .finding import find_problem

        return find_problem(self, layer)
