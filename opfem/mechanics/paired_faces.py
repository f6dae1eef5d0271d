"""Contact faces of several bodies that are evaluated together, where they have the same quadrature."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from .boundary import Bodies
from .contact_face import ContactFace
from .contact_state import SlipHistory, joined_histories
from .paired_contact import PairedContact, PairedSurface, split


class Touch(NamedTuple):
    """Contact faces that are evaluated together, and the bodies they belong to."""

    names: tuple[str, ...]
    face: ContactFace

    def history(self, histories: Bodies) -> SlipHistory:
        """Concatenate the friction histories of the bodies."""
        return joined_histories([getattr(histories, name) for name in self.names])

    def split(self, values: Any) -> dict[str, Any]:
        """Split values of all faces into those of each body."""
        return dict(zip(self.names, split(values, len(self.names)), strict=True))


def paired(faces: Sequence[ContactFace]) -> ContactFace:
    """Combine several contact faces into one (`can_pair`)."""
    first, count = faces[0], len(faces)
    if count == 1:
        return first

    def side_by_side(values):
        return None if values[0] is None else jnp.concatenate(values, axis=-1)

    return ContactFace(
        contact=PairedContact(tuple(face.own_contact for face in faces)),
        surface=PairedSurface(tuple(face.surface for face in faces)),
        offset=jnp.stack([face.offset for face in faces]),
        imposed=None,
        element_size=first.element_size,
        stiffness=first.stiffness,
        above=tuple(bool(face.above) for face in faces),
        rule=first.rule,
        sides=side_by_side([face.sides for face in faces]),
        shares=side_by_side([face.shares for face in faces]),
    )


def can_pair(faces: Sequence[ContactFace]) -> bool:
    """Return whether contact faces have the same quadrature, so that they can be evaluated together."""
    alike = {(face.rule, face.sides is None) for face in faces}
    return len(alike) == 1 and all(face.imposed is None for face in faces)
