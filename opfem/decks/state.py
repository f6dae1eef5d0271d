"""What has been read of a deck so far, and how names in it are found; handlers of keywords fill it."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from .cards import Card, Place
from .deck import Amplitude, Code, Condition, Deck, Face, Instance, Interaction, Material, Members, Pair, Part, Step


@dataclass(frozen=True)
class Keyword:
    """How a keyword is read.

    Attributes:
        handle: Reads it.
        options: That it knows.
        unused: That change nothing here and are listed.
        within: "the model", "a step" or "anywhere".
        advice: What to do instead of an option that is not known.
    """

    handle: Callable[[Card, "State"], None]
    options: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    within: str = "the model"
    advice: str = ""


# Digits of the largest number of a node or an element.
_LONGEST = 12


def _label(name: str, card: Card, place: Place) -> np.ndarray:
    if len(name) > _LONGEST:
        raise card.refuse(f": the number {name[:40]} is too large.", place)
    return np.array([int(name)])


@dataclass
class State:
    """A deck in the making."""

    name: str
    parts: dict[str, Part] = field(default_factory=dict)
    instances: dict[str, Instance] = field(default_factory=dict)
    materials: dict[str, Material] = field(default_factory=dict)
    interactions: dict[str, Interaction] = field(default_factory=dict)
    amplitudes: dict[str, Amplitude] = field(default_factory=dict)
    pairs: dict[tuple, Pair] = field(default_factory=dict)
    prescribed: list[Condition] = field(default_factory=list)
    steps: list[Step] = field(default_factory=list)
    ignored: dict[str, None] = field(default_factory=dict)
    node_sets: dict[str, Members] = field(default_factory=dict)
    element_sets: dict[str, Members] = field(default_factory=dict)
    surfaces: dict[str, list[Face]] = field(default_factory=dict)
    assembly: str | None = None  # its name, once it has begun
    part: Part | None = None
    instance: Instance | None = None
    material: Material | None = None
    interaction: Interaction | None = None
    step: Step | None = None
    calculix: Place | None = None  # where the deck says what only CalculiX knows
    abaqus: Place | None = None  # where it says what only Abaqus knows

    def ignore(self, card: Card, why: str, option: str = "") -> None:
        """List a keyword, or an option of it, as ignored; once."""
        name = f"*{card.name}, {option}" if option else f"*{card.name}"
        if not any(line.partition(": ")[2].startswith(f"{name}: ") for line in self.ignored):
            self.ignored[f"{card.place}: {name}: {why}."] = None

    def own_part(self, card: Card) -> Part:
        """Return the part that nodes and elements go to; of a flat deck the one without a name."""
        if self.part is not None:
            return self.part
        if self.assembly is not None or any(name for name in self.parts):
            raise card.refuse(" belongs into a *PART here.")
        if "" not in self.parts:
            self.parts[""] = Part("", card.place)
            self.instances[""] = Instance("", "", np.zeros(3), np.eye(3), np.zeros(3), card.place)
        return self.parts[""]

    def part_of(self, instance: str) -> Part:
        """Return the part of an instance."""
        return self.parts[self.instances[instance].part]

    def scope(self, word: str, card: Card, place: Place) -> tuple[str, str]:
        """Split `Assembly.instance.name` into the instance and the name; "" for the assembly's own names."""
        parts = word.upper().split(".")
        if len(parts) > 1 and self.assembly is not None and parts[0] == self.assembly:
            parts = parts[1:]
        if len(parts) == 1:
            return "", parts[0]
        instance, name = ".".join(parts[:-1]), parts[-1]
        if instance not in self.instances:
            raise card.refuse(f" of {word[:60]}: there is no instance {instance[:60]}.", place)
        return instance, name

    def nodes(self, word: str, card: Card, place: Place) -> Members:
        """Find the nodes that a word names: a number or a set, of an instance or of the assembly."""
        instance, name = self.scope(word, card, place)
        if name.isdecimal():
            if instance not in self.instances:
                raise card.refuse(f": node {name} is of no instance; write instance.{name}.", place)
            return {instance: _label(name, card, place)}
        if not instance and name in self.node_sets:
            return self.node_sets[name]
        if instance in self.instances and name in self.part_of(instance).node_sets:
            return {instance: self.part_of(instance).node_sets[name]}
        raise card.refuse(f": there is no node set {word[:60]}.", place)

    def elements(self, word: str, card: Card, place: Place) -> Members:
        """Find the elements that a word names."""
        instance, name = self.scope(word, card, place)
        if name.isdecimal():
            if instance not in self.instances:
                raise card.refuse(f": element {name} is of no instance; write instance.{name}.", place)
            return {instance: _label(name, card, place)}
        if not instance and name in self.element_sets:
            return self.element_sets[name]
        if instance in self.instances and name in self.part_of(instance).element_sets:
            return {instance: self.part_of(instance).element_sets[name]}
        raise card.refuse(f": there is no element set {word[:60]}.", place)

    def surface(self, word: str, card: Card, place: Place) -> tuple[Face, ...]:
        """Find the faces of a surface."""
        instance, name = self.scope(word, card, place)
        if not instance and name in self.surfaces:
            return tuple(self.surfaces[name])
        if instance in self.instances and name in self.part_of(instance).surfaces:
            return tuple(({instance: members[""]}, face) for members, face in self.part_of(instance).surfaces[name])
        raise card.refuse(f": there is no surface {word[:60]}.", place)

    def deck(self, code: Code | None) -> Deck:
        """Finish the deck.

        Raises:
            DeckError: If something is missing that all of it needs.
        """
        if not self.instances:
            raise Place(self.name, 1).refuse("the deck has no mesh: no *NODE, or a *PART without *INSTANCE.")
        if code is None:
            code = "calculix" if self.calculix is not None and self.abaqus is None else "abaqus"
        elif code == "abaqus" and self.calculix is not None:
            raise self.calculix.refuse('this is CalculiX\'s, but code="abaqus" was passed.')
        elif code == "calculix" and self.abaqus is not None:
            raise self.abaqus.refuse('this is Abaqus\', but code="calculix" was passed.')
        return Deck(
            self.name,
            code,
            self.parts,
            self.instances,
            self.materials,
            self.interactions,
            self.amplitudes,
            tuple(self.pairs.values()),
            tuple(self.prescribed),
            tuple(self.steps),
            tuple(self.ignored),
        )
