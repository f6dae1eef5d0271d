"""From a deck to what `solve` takes: which body is layer, sample, window and plate, and what each step does.

A deck may stand upside down, as the published experiment does; opfem counts z from the window. Materials are isotropic,
so that a mirrored deck has the same answer, x and y as they are.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import jax.numpy as jnp
import numpy as np

from ..measurement import ThicknessMap
from ..mechanics.face import tributary_area
from ..model import (
    AbstractMaterial,
    Bonded,
    Compression,
    Contact,
    Displacement,
    Experiment,
    HardOverclosure,
    Imprint,
    Layer,
    Palpation,
    Roller,
    Sample,
    Side,
    Traction,
)
from ..model.palpation import Element
from ..model.surface import Interpolation
from .bodies import SAME, Block
from .cards import DeckError
from .deck import Deck
from .faces import Constrained, Supports, Surface, is_flat, supports
from .laws import contact_of, element_of, law_of, said_of_bulk, zero_d
from .motion import forces

HINT = "A deck for opfem is a soft layer between two rigid bodies, with or without a soft sample on it."
# Springs this weak, over the layer's own stiffness in shear, only help a solver where two nodes are pinned besides.
_WEAK = 1e-2


@dataclass(frozen=True, eq=False)
class Problem:
    """A deck whose bodies are known; blocks count z from the window.

    Attributes:
        deck: The deck.
        layer: The layer.
        sample: The soft sample; None where a rigid body presses the layer.
        is_flipped: Whether the deck stands upside down.
        window: What the layer stands on.
        interface: Contact of layer and sample, where there is one.
        top: What presses: the rigid sample, or the plate.
    """

    deck: Deck
    layer: Block
    sample: Block | None
    is_flipped: bool
    window: Surface | Constrained
    interface: Contact | None
    top: Surface | Constrained

    @property
    def sign(self) -> float:
        """Of opfem's z in the deck's."""
        return -1.0 if self.is_flipped else 1.0

    @property
    def size(self) -> float:
        """Largest dimension of the layer [mm]."""
        return float(np.ptp(self.layer.body.X, axis=0).max())

    @cached_property
    def floor(self) -> np.ndarray:
        """Height of the window in the deck at rest and at the end of every step `(1 + steps,)` [mm]."""
        end = self.window
        if isinstance(end, Surface):
            heights = np.concatenate([end.rest[None], end.heights])
        elif end.uz is not None:
            heights = np.concatenate([end.rest[None], end.rest + end.uz])
        else:
            raise self.layer.body.place.refuse(f"nothing holds {self.layer.body.name} at its window. {HINT}")
        if not is_flat(heights, self.size):
            raise self.layer.body.place.refuse(f"the window of {self.layer.body.name} is not flat.")
        return heights[:, 0, 0]

    @cached_property
    def heights(self) -> np.ndarray:
        """Heights of the layer's nodes over its own face at the window `(nz+1, ny+1, nx+1)` [mm]."""
        z = self.sign * self.layer.z
        if not is_flat(z[0], self.size):
            raise self.layer.body.place.refuse(f"the face of {self.layer.body.name} at the window is not flat.")
        heights = z - z[0, 0, 0]
        even = np.arange(len(z))[:, None, None] / (len(z) - 1) * heights[-1]
        if np.abs(heights - even).max() > SAME * self.size:
            raise self.layer.body.place.refuse(
                f"the elements of {self.layer.body.name} are not of equal height in every column."
            )
        return heights

    @property
    def extent(self) -> tuple[float, float]:
        """Lx, Ly [mm]."""
        return float(self.layer.x[-1] - self.layer.x[0]), float(self.layer.y[-1] - self.layer.y[0])

    def experiment(self, bulk: float | None) -> Palpation | Experiment:
        """Build the palpation or the experiment."""
        support = supports(self.layer, self.deck)
        element = cast(Element, element_of(self.layer.body, self.deck))
        materials = set(self.layer.body.material.tolist())
        if len(materials) > 1:
            raise self.layer.body.place.refuse(
                f"{self.layer.body.name}, the layer, has {len(materials)} materials; opfem's layer has one."
            )
        law = law_of(self.deck.materials[materials.pop()], self.deck, element, bulk)
        nx, ny, nz = self.layer.counts
        window = self._side(self.window)
        hold = self._hold(support, law)
        try:
            layer = Layer(_map(self.heights[-1], self.extent, self.size), law)
            if self.sample is None:
                return Palpation(
                    layer, self.extent, (nx, ny, nz), window, self._side(self.top), support.sides, element, hold
                )
            return self._with_sample(layer, window, support, element, bulk, hold)
        except DeckError:
            raise
        except ValueError as cause:
            raise self.layer.body.place.refuse(str(cause)) from None

    def _side(self, end: Surface | Constrained) -> Side:
        if isinstance(end, Surface):
            if not self._covers(end):
                raise end.place.refuse(f"*CONTACT PAIR: {end.body.name} is smaller than the layer; it must cover it.")
            return contact_of(end.interaction, self.deck)
        if end.uz is None:  # forces press, and what they stand for has no law
            return Contact(HardOverclosure(), 0.0)
        return Bonded() if end.lateral else Roller()

    def _covers(self, end: Surface) -> bool:
        room = SAME * self.size
        return all(
            theirs[0] <= own[0] + room and theirs[-1] >= own[-1] - room
            for theirs, own in ((end.plane.x, self.layer.x), (end.plane.y, self.layer.y))
        )

    def _hold(self, support: Supports, law: AbstractMaterial) -> float | None:
        """Take springs to ground [N/mm] as they are, but none that only help a solver beside pinned nodes."""
        lx, ly = self.extent
        stiffness = float(law.shear) * lx * ly / float(self.heights[-1].mean())
        is_help = support.pins > 0 and support.hold < _WEAK * stiffness
        return None if not support.hold or is_help else support.hold

    def _with_sample(
        self, layer: Layer, window: Side, support: Supports, element: str, bulk: float | None, hold: float | None
    ) -> Experiment:
        block = self.sample
        assert block is not None
        assert self.interface is not None
        body = block.body
        other = supports(block, self.deck)
        if other.sides != support.sides:
            raise body.place.refuse(f"the sides of {body.name} must be constrained as the layer's are.")
        for own, theirs in ((self.layer.x, block.x), (self.layer.y, block.y)):
            if max(abs(own[0] - theirs[0]), abs(own[-1] - theirs[-1])) > SAME * self.size:
                raise body.place.refuse(f"{body.name} must lie over the whole layer and no further.")
        form = element_of(body, self.deck)
        thickness, levels = self._sample_shape()
        laws = [law_of(self.deck.materials[name], self.deck, form, bulk) for name in self._sample_materials()]
        sample = Sample(_map(thickness, self.extent, self.size), laws[0], levels)
        if len(laws) > 1:
            names = body.material[block.cells]
            labels = np.zeros(block.cells.shape, int)
            for label, name in enumerate(self._sample_materials()):
                labels[names == name] = label
            sample = sample.with_inclusion(labels, laws[1:])
        plate = self._side(self.top)
        return Experiment(
            layer, sample, self.extent, (self.layer.counts, block.counts), window, self.interface, plate, support.sides,
            cast(Any, (element, form)), hold,
        )  # fmt: skip

    def _sample_materials(self) -> list[str]:
        """Name the sample's materials, that of most elements first."""
        assert self.sample is not None
        names, counts = np.unique(self.sample.body.material.astype(str), return_counts=True)
        return names[np.argsort(-counts, kind="stable")].tolist()

    def _sample_shape(self) -> tuple[np.ndarray, list[float] | None]:
        """Find the sample's thickness [mm] `(ny+1, nx+1)`, and the levels of its nodes where they are not equal."""
        block = self.sample
        assert block is not None
        z = self.sign * block.z
        if not is_flat(z[-1], self.size):
            raise block.body.place.refuse(f"the face of {block.body.name} at the plate is not flat.")
        thickness = z[-1] - z[0]
        fractions = (z - z[0]) / thickness
        levels = fractions.mean(axis=(1, 2))
        if np.abs((fractions - levels[:, None, None]) * thickness).max() > SAME * self.size:
            raise block.body.place.refuse(
                f"the nodes of {block.body.name} do not stand at the same fractions of its thickness in every column."
            )
        even = np.linspace(0.0, 1.0, len(z))
        if np.abs(levels - even).max() * thickness.max() <= SAME * self.size:
            return thickness, None
        levels[0], levels[-1] = 0.0, 1.0
        return thickness, levels.tolist()

    def loads(self, interpolation: Interpolation) -> tuple[Imprint | Displacement | Traction | Compression, ...]:
        """Build the load of every step."""
        steps = range(len(self.deck.steps))
        return tuple(self._load(k, interpolation) for k in steps)

    def _load(self, step: int, interpolation: Interpolation) -> Imprint | Displacement | Traction | Compression:
        place = self.deck.steps[step].place
        try:
            if self.sample is not None:
                return Compression(self._approach(step))
            if isinstance(self.top, Surface):
                clearance = float(contact_of(self.top.interaction, self.deck).law.zero_pressure_clearance)
                thickness = self.sign * (self.top.heights[step] - self.floor[1 + step]) - clearance
                plane = self.top.plane
                corner = (float(plane.x[0] - self.layer.x[0]), float(plane.y[0] - self.layer.y[0]))
                reach = (float(plane.x[-1] - plane.x[0]), float(plane.y[-1] - plane.y[0]))
                loaded = ThicknessMap(thickness, extent=reach, origin=corner)
                return Imprint(loaded, interpolation=interpolation)
            if self.top.uz is not None:
                sunk = self.floor[1 + step] - self.floor[0]
                uz = self.sign * (self.top.uz[step] - sunk)
                return Displacement(uz, lateral="fixed" if self.top.lateral else "free")
            return self._traction(step)
        except DeckError:
            raise
        except ValueError as cause:
            raise place.refuse(str(cause)) from None

    def _approach(self, step: int) -> float:
        """Compute how far window and plate have come together, from where the bodies just touch [mm]."""
        layer, (thickness, _) = self.heights[-1], self._sample_shape()
        top = self.top
        block = self.sample
        assert block is not None
        assert self.interface is not None
        if isinstance(top, Surface):
            ends = top.heights[step]
        elif top.uz is not None:
            ends = top.rest + top.uz[step]
        else:
            raise block.body.place.refuse(f"nothing presses {block.body.name}. {HINT}")
        if not is_flat(ends, self.size):
            raise block.body.place.refuse(f"the plate under {block.body.name} is not flat.")
        sides = [self.interface, *(self._side(end) for end in (self.window, top))]
        clearances = sum(float(side.law.zero_pressure_clearance) for side in sides if isinstance(side, Contact))
        over = ThicknessMap(thickness, extent=self.extent).sample(*self._nodes())
        height = float((layer + np.asarray(over)).max())
        return height + clearances - self.sign * float(ends[0, 0] - self.floor[1 + step])

    def _nodes(self) -> list[jnp.ndarray]:
        """Compute x and y of the layer's columns [mm] `(ny+1, nx+1)`."""
        nx, ny, _ = self.layer.counts
        across, along = (jnp.linspace(0.0, length, n + 1) for length, n in zip(self.extent, (nx, ny), strict=True))
        return jnp.meshgrid(across, along)

    def _traction(self, step: int) -> Traction:
        body = self.layer.body
        acting = forces(body, self.deck)[step]
        face = self.layer.nodes[-1]
        if not np.any(acting[face]) or np.any(np.delete(acting, np.unique(face), axis=0)):
            place = self.deck.steps[step].place
            raise place.refuse(f"nothing presses {body.name} on its face away from the window. {HINT}")
        X = np.moveaxis(body.X[face], -1, 0)
        area = np.asarray(tributary_area(jnp.asarray(X)))
        traction = np.moveaxis(acting[face], -1, 0) / area
        return Traction(-self.sign * traction[2], traction[:2])

    def assumed(self, bulk: float | None) -> tuple[str, ...]:
        """Say what is taken otherwise than the deck has it, or is left open by it."""
        said = []
        for block in (self.layer, self.sample):
            if block is None:
                continue
            element = element_of(block.body, self.deck)
            for name in sorted(set(block.body.material.tolist())):
                if zero_d(self.deck.materials[name]):
                    said.append(said_of_bulk(self.deck.materials[name], self.deck, element, bulk))
            if element == "reduced":
                said.append(f"{block.body.name}: C3D8R has opfem's own hourglass control")
        if self.is_flipped:
            said.append("the deck stands upside down: opfem's z runs from its window downwards, x and y as they are")
        if isinstance(self.top, Surface) and self.sample is None and not is_flat(self.top.heights, self.size):
            said.append(
                f"{self.top.body.name}: the surface runs smoothly through its nodes, where the deck has facets "
                '(interpolation="bilinear")'
            )
        support = supports(self.layer, self.deck)
        if support.pins:
            said.append(
                f"{self.layer.body.name}: nodes constrained in the plane stand for opfem's hold of its mean motion"
            )
        if support.pins and support.hold:
            said.append(f"{self.layer.body.name}: springs of {support.hold:.3g} N/mm in total beside them are left out")
        if isinstance(self.top, Constrained) and self.top.uz is None:
            said.append("forces press the layer; the contact law of the sample has no part in it")
        said += self._said_of_start()
        return tuple(said)

    def _said_of_start(self) -> list[str]:
        """Say where surfaces do not start where their laws do; the end of every step is as the deck has it."""
        if self.sample is not None or not isinstance(self.top, Surface):
            return []
        clearance = float(contact_of(self.top.interaction, self.deck).law.zero_pressure_clearance)
        if not is_flat(self.top.rest, self.size):
            return []
        off = float(np.abs(self.sign * (self.top.rest[0, 0] - self.layer.z[-1]) - clearance).max())
        if off <= SAME * self.size:
            return []
        return [f"{self.top.body.name} starts {off:.3g} mm from where its contact law does; only its end counts here"]


def _map(values: np.ndarray, extent: tuple[float, float], size: float) -> float | ThicknessMap:
    """Take a thickness [mm] that is the same all over as a number."""
    return float(values[0, 0]) if is_flat(values, size) else ThicknessMap(values, extent=extent)
