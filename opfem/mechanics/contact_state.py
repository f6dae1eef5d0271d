"""What is known of contact at the points of faces: where they are, their history, and a Newton step's linear law.

Fields carry their components first, then points, then faces; `interaction` computes and uses them.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .paired_contact import join, split

Corners = Float[Array, "4 3 *faces"]  # nodal values at the corners of every face
PointVector = Float[Array, "3 points *faces"]


class SlipHistory(eqx.Module):
    """What friction remembers at the end of an increment, per face point.

    Attributes:
        position: (x, y) of the points `(2, points, *faces)` [mm]; on a deformable body, its material points [cells].
        elastic: Elastic part of the slip `(2, points, *faces)` [mm].
        slip: Slip slid so far, along x and y `(2, points, *faces)` [mm].
        dissipated: Work done by friction so far on the whole face [N mm]; of each body where faces are paired.
        pressure: Contact pressure at the points [MPa], where the next increment starts from.
    """

    position: Float[Array, "2 points *faces"]
    elastic: Float[Array, "2 points *faces"]
    slip: Float[Array, "2 points *faces"]
    dissipated: Float[Array, "*bodies"]
    pressure: Float[Array, "points *faces"]


class ContactIterate(NamedTuple):
    """What a Newton iteration remembers of a face besides displacement.

    Attributes:
        pressure: Contact pressure at the points [MPa], an unknown of its own.
        direction: Slip that a sliding point had in the last step `(2, points, *faces)` [mm], zero
            where it stuck.
        change: What the step found, but not yet taken, changes the pressure by [MPa].
    """

    pressure: Float[Array, "points *faces"]
    direction: Float[Array, "2 points *faces"]
    change: Float[Array, "points *faces"]

    def after(self, length: Array) -> "ContactIterate":
        """Take a step of a length from 0 to 1."""
        return self._replace(pressure=jnp.maximum(self.pressure + length * self.change, 0.0))


def joined_histories(histories: Sequence[SlipHistory]) -> SlipHistory:
    """Put the histories of several faces side by side."""
    if len(histories) == 1:
        return histories[0]
    return join([dataclasses.replace(history, dissipated=history.dissipated[None]) for history in histories])


def separate_histories(history: SlipHistory, count: int) -> list[SlipHistory]:
    """Undo `joined_histories`."""
    if count == 1:
        return [history]
    return [dataclasses.replace(part, dissipated=part.dissipated[0]) for part in split(history, count)]


class TangentLaw(NamedTuple):
    """Contact linearised for one Newton step: p = pressure + slope (g - clearance).

    Newton's method on displacement and pressure together, with the pressure eliminated. The
    pressure follows the linearised clearance, so that the curvature of a surface that a point
    slides along does not throw it off: what makes stiff laws converge in few full steps.
    A sliding point whose slip reverses sticks for one step: a sliding point has no stiffness
    along its slip, so that without this it would jump back and forth for ever.
    """

    pressure: Float[Array, "points *faces"]
    clearance: Float[Array, "points *faces"] | None
    slope: Float[Array, "points *faces"]
    sticks: Array
    curvature: Array | float = 1.0

    def __call__(self, clearance: Array) -> Array:
        """Evaluate the pressure [MPa]; a closed point may pull for one step."""
        if self.clearance is None:
            return self.pressure + self.slope * (clearance - jax.lax.stop_gradient(clearance))
        return self.pressure + self.slope * (clearance - self.clearance)

    def at_its_pressure(self) -> "TangentLaw":
        """Keep the slope, but give `pressure` itself: for the geometric part of the tangent."""
        return self._replace(clearance=None)


class FacePoints(NamedTuple):
    """Where the points of faces are, and the rigid surface at their x and y.

    Attributes:
        fraction: Load fraction [-].
        position: Of the points [mm].
        tangents: dx/dξ and dx/dη there `(2, 3, points, *faces)` [mm].
        height: Of the surface [mm].
        slope: Of the surface along x and y `(2, points, *faces)` [-].
        bend: Second derivatives of the surface `(2, 2, points, *faces)` [1/mm]; None where only forces are asked for.
        anchor: x and y [mm] of the surface's material point that each point met at the last increment; None on a rigid
            surface, which has none.
    """

    fraction: Array
    position: PointVector
    tangents: Float[Array, "2 3 points *faces"]
    height: Float[Array, "points *faces"]
    slope: Float[Array, "2 points *faces"]
    bend: Float[Array, "2 2 points *faces"] | None
    anchor: Float[Array, "2 points *faces"] | None = None

    @property
    def stretch(self) -> Float[Array, "points *faces"]:
        """Area of the surface over that of its projection on the plane z = 0 [-]."""
        return jnp.sqrt(1.0 + self.slope[0] ** 2 + self.slope[1] ** 2)

    @property
    def normal(self) -> PointVector:
        """Normal of the surface, upward."""
        return jnp.concatenate([-self.slope, jnp.ones_like(self.slope[:1])]) / self.stretch


class PointContact(NamedTuple):
    """Contact at face points: tractions per current area [MPa], and the history after it."""

    traction: PointVector  # on the layer, pressure and friction
    pressure: Float[Array, "points *faces"]
    clearance: Float[Array, "points *faces"]
    elastic: Float[Array, "2 points *faces"]
    slid: Float[Array, "2 points *faces"]
    friction: Float[Array, "2 points *faces"]  # conjugate to slip in the surface's (x, y)
    sliding: Array
    slips: Array  # friction at its limit, or just below after an increment that only settles
