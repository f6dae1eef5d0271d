"""State of contact at face points: positions, friction history, and the linearised law of a Newton step.

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
    """Friction history at the end of an increment, per face point.

    Attributes:
        position: (x, y) of the points `(2, points, *faces)` [mm]; on a deformable body, its material points [cells].
        elastic: Elastic part of the slip `(2, points, *faces)` [mm].
        slip: Plastic slip since the start, along x and y `(2, points, *faces)` [mm].
        dissipated: Frictional dissipation of the whole face since the start [N mm]; of each body of paired faces.
        pressure: Contact pressure at the points [MPa], initial guess of the next increment.
    """

    position: Float[Array, "2 points *faces"]
    elastic: Float[Array, "2 points *faces"]
    slip: Float[Array, "2 points *faces"]
    dissipated: Float[Array, "*bodies"]
    pressure: Float[Array, "points *faces"]


class ContactIterate(NamedTuple):
    """Contact iterate of a face: unknowns of Newton's method other than displacement.

    Attributes:
        pressure: Contact pressure at the points [MPa], an independent unknown.
        direction: Slip of a sliding point in the last step `(2, points, *faces)` [mm], zero for stick.
        change: Pressure increment of the pending Newton step [MPa].
    """

    pressure: Float[Array, "points *faces"]
    direction: Float[Array, "2 points *faces"]
    change: Float[Array, "points *faces"]

    def after(self, length: Array) -> "ContactIterate":
        """Take a step of a length from 0 to 1."""
        return self._replace(pressure=jnp.maximum(self.pressure + length * self.change, 0.0))


def joined_histories(histories: Sequence[SlipHistory]) -> SlipHistory:
    """Concatenate the histories of several faces."""
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
    pressure follows the linearised clearance, independent of the curvature of the surface along
    which a point slides: stiff laws then converge in few full steps.
    A sliding point whose slip reverses sticks for one step: sliding has no stiffness along the
    slip, and without this rule the iteration cycles.
    """

    pressure: Float[Array, "points *faces"]
    clearance: Float[Array, "points *faces"] | None
    slope: Float[Array, "points *faces"]
    sticks: Array
    curvature: Array | float = 1.0

    def __call__(self, clearance: Array) -> Array:
        """Evaluate the pressure [MPa]; a closed point may have tension for one step."""
        if self.clearance is None:
            return self.pressure + self.slope * (clearance - jax.lax.stop_gradient(clearance))
        return self.pressure + self.slope * (clearance - self.clearance)

    def at_its_pressure(self) -> "TangentLaw":
        """Return the law with value `pressure` and the same slope: for the geometric part of the tangent."""
        return self._replace(clearance=None)


class FacePoints(NamedTuple):
    """Positions of face points, and the rigid surface at their x and y.

    Attributes:
        fraction: Load fraction [-].
        position: Position of the points [mm].
        tangents: dx/dξ and dx/dη there `(2, 3, points, *faces)` [mm].
        height: Height of the surface [mm].
        slope: Slope of the surface along x and y `(2, points, *faces)` [-].
        bend: Second derivatives of the surface `(2, 2, points, *faces)` [1/mm]; None where only forces are computed.
        anchor: x and y [mm] of the surface's material point in contact at the last increment; None on a rigid surface,
            which needs none.
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
    slips: Array  # friction at its limit, or just below it after an increment of relaxation
