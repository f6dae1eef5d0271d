"""Contact and friction of faces of the layer with a rigid surface, at their face points.

Pressure follows the overclosure law along the surface's true normal, on the current area.
Friction is Coulomb's with elastic slip and a return map; the slip of a point is measured along
the surface, in the surface's own (x, y), and its history is carried from increment to increment.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..model import Contact, HeightField
from ..model.surface import Patches
from .face import FaceRule, area_vector, quadrature, size, surface_tangents, to_corners
from .kinematics import contract
from .staging import apart

# Share of the largest elastic slip from which a point counts as slipping.
_AT_LIMIT = 0.9

Corners = Float[Array, "4 3 *faces"]  # nodal values at the corners of every face
PointVector = Float[Array, "3 points *faces"]


class SlipHistory(eqx.Module):
    """What friction remembers at the end of an increment, per face point.

    Attributes:
        position: (x, y) of the points `(2, points, *faces)` [mm].
        elastic: Elastic part of the slip `(2, points, *faces)` [mm].
        slip: Slip slid so far, along x and y `(2, points, *faces)` [mm].
        dissipated: Work done by friction so far on the whole face [N mm].
        pressure: Contact pressure at the points [MPa], where the next increment starts from.
    """

    position: Float[Array, "2 points *faces"]
    elastic: Float[Array, "2 points *faces"]
    slip: Float[Array, "2 points *faces"]
    dissipated: Float[Array, ""]
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
    guard: Float[Array, "3 3 points *faces"]  # symmetric positive part of -d(traction)/dx


class RigidSurface(eqx.Module):
    """A rigid body's surface: a height field that moves from `start` to `end` along z.

    None for both is the plane z = 0.
    """

    start: HeightField | None
    end: HeightField | None

    def at(self, fraction: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Evaluate height [mm] and slopes [-] when a fraction of the motion is done."""
        if self.start is None or self.end is None:
            zero = jnp.zeros_like(x)
            return zero, zero, zero
        low, high = self.start.coefficients, self.end.coefficients
        return eqx.tree_at(lambda f: f.coefficients, self.end, (1.0 - fraction) * low + fraction * high)(x, y)

    def around(self, x: Array, y: Array) -> "RigidPatches | None":
        """Collect what the surface is made of around points [mm]; None for the plane z = 0."""
        if self.start is None or self.end is None:
            return None
        return RigidPatches(self.start.around(x, y), self.end.around(x, y))


class RigidPatches(eqx.Module):
    """A rigid surface around points, at the start and at the end of its motion."""

    start: Patches
    end: Patches

    def at(self, fraction: Array, x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Evaluate height [mm], slopes [-] and rise per load fraction [mm]."""
        low, high = self.start.powers, self.end.powers
        height, slope_x, slope_y = eqx.tree_at(lambda p: p.powers, self.end, low + fraction * (high - low))(x, y)
        return height, slope_x, slope_y, eqx.tree_at(lambda p: p.powers, self.end, high - low).height(x, y)


class ImposedPressure(eqx.Module):
    """A pressure per reference area that bounds friction: a dead one, applied elsewhere, and a bed of springs.

    Attributes:
        start: Dead pressure at the corners of the faces at load fraction 0 `(4, *faces)` [MPa].
        end: The same at load fraction 1.
        area: Reference area per unit of (ξ, η) at the points [mm²].
        height: Of the points where the springs are at rest [mm]; None: there are no springs.
        stiffness: Of the springs at load fractions 0 and 1 [MPa/mm].
    """

    start: Float[Array, "4 *faces"]
    end: Float[Array, "4 *faces"]
    area: Float[Array, "points *faces"]
    height: Float[Array, "points *faces"] | None = None
    stiffness: tuple[Array, Array] | None = None

    def springs(self, fraction: Array, z: Float[Array, "points *faces"]) -> Float[Array, "points *faces"]:
        """Compute the springs' pressure [MPa] at heights [mm]; negative where they pull."""
        if self.height is None or self.stiffness is None:
            return jnp.zeros_like(z)
        start, end = self.stiffness
        return ((1.0 - fraction) * start + fraction * end) * (z - self.height)

    def bounding(self, fraction: Array, rule: FaceRule, springs: Array | float) -> Float[Array, "points *faces"]:
        """Compute the pressure [MPa] at the points with that of the springs; tension bounds friction by zero."""
        corners = (1.0 - fraction) * self.start + fraction * self.end
        return jnp.maximum(contract(quadrature(rule).N, corners) + springs, 0.0)


class ContactFace(eqx.Module):
    """Faces in contact with one rigid surface.

    Attributes:
        contact: Law and friction.
        surface: The rigid surface.
        offset: Shift of the surface away from the layer [mm].
        imposed: For a `Traction` load, whose dead pressure only bounds friction, and whose springs push.
        element_size: Size of an element [mm]; default elastic slip is a fraction of it.
        stiffness: Stiffness of an element per area [MPa/mm], the scale of hard contact.
        above: True for the sample, False for the window.
        rule: Where contact is integrated.
        sides: Which faces are sides, pushed only where they have turned towards the surface; None: none.
        shares: What each point stands for where the points of a face are not alike (`node_shares`).
    """

    contact: Contact
    surface: RigidSurface
    offset: Array
    imposed: "ImposedPressure | None"
    element_size: Array
    stiffness: Array
    above: bool = eqx.field(static=True)
    rule: FaceRule = eqx.field(static=True)
    sides: Bool[Array, " *faces"] | None = None
    shares: Float[Array, "points *faces"] | None = None

    def initial_history(self, x: Corners) -> SlipHistory:
        """Build the history of a face that has not slipped."""
        position = surface_tangents(x, self.rule)[0][:2]
        zero = jnp.zeros_like(position)
        return SlipHistory(position, zero, zero, jnp.zeros((), position.dtype), zero[0])

    def at_points(
        self, fraction: Array, position: PointVector, history: SlipHistory, law: TangentLaw | None = None
    ) -> PointContact:
        """Evaluate contact at face points [mm], with the contact's own law or a linearised one."""
        height, slope_x, slope_y = self.surface.at(fraction, position[0], position[1])
        side = 1.0 if self.above else -1.0
        if law is not None:
            slope_x, slope_y = (_scaled_slope(s, law.curvature) for s in (slope_x, slope_y))
        stretch = jnp.sqrt(1.0 + slope_x**2 + slope_y**2)
        normal = jnp.stack([-slope_x, -slope_y, jnp.ones_like(slope_x)]) / stretch
        clearance = (side * (height - position[2]) + self.offset) / stretch
        pressure, push, stiffness = self._pressure(fraction, position[2], clearance, law or self._law(history))
        friction = self._friction(pressure, position, history, slope_x, slope_y, None if law is None else law.sticks)
        traction = friction.traction - side * push * normal
        eye = jnp.eye(3, dtype=position.dtype).reshape(3, 3, *[1] * pressure.ndim)
        along = normal[:, None] * normal[None]
        slid_along = friction.direction[:, None] * friction.direction[None]
        guard = stiffness * along + friction.stiffness * (eye - along - slid_along)
        return PointContact(
            traction,
            pressure,
            clearance,
            friction.elastic,
            friction.slid,
            friction.conjugate,
            friction.sliding,
            friction.slips,
            guard,
        )

    @property
    def is_exact(self) -> bool:
        """Whether the pressure is to be reached without penetration."""
        return self.contact.law.exact and self.imposed is None

    def _carried(self, history: SlipHistory) -> Array | float:
        """Compute the clearance [mm] that the law is shifted by: exact hard contact carries its pressure without."""
        return self.contact.law.clearance(history.pressure, self.stiffness) if self.is_exact else 0.0

    def _law(self, history: SlipHistory) -> Callable[[Array], Array]:
        carried = self._carried(history)
        return lambda clearance: self.contact.law.pressure(clearance + carried, self.stiffness)

    def missed_gap(self, before: SlipHistory, after: SlipHistory) -> Array:
        """Compute the largest gap or penetration [mm] that an increment left to exact contact; 0 for other laws."""
        if not self.is_exact:
            return jnp.zeros_like(after.dissipated)
        gap = self.contact.law.clearance(after.pressure - before.pressure, self.stiffness)
        return jnp.max(jnp.where(after.pressure > 0, jnp.abs(gap), 0.0))

    def _pressure(self, fraction: Array, z: Array, clearance: Array, law) -> tuple[Array, Array, Array]:
        """Compute the pressure that bounds friction, that which pushes, and how fast it rises [MPa/mm]."""
        if self.imposed is not None:
            push, slope = jax.jvp(lambda z: self.imposed.springs(fraction, z), (z,), (jnp.ones_like(z),))
            return self.imposed.bounding(fraction, self.rule, push), push, slope
        pressure, slope = jax.jvp(law, (clearance,), (jnp.ones_like(clearance),))
        return pressure, pressure, -slope

    def initial_iterate(self, history: SlipHistory) -> ContactIterate:
        """Start from the pressure of the last increment, as if every point had stuck."""
        return ContactIterate(history.pressure, jnp.zeros_like(history.elastic), jnp.zeros_like(history.pressure))

    def tangent_law(
        self, fraction: Array, x: Corners, history: SlipHistory, iterate: ContactIterate, curvature: Array
    ) -> TangentLaw:
        """Linearise contact for the state x.

        A point without pressure that has come to touch takes what the law gives there, at most
        the pressure that shortens an element by a thousandth.
        """
        position = surface_tangents(x, self.rule)[0]
        trial = history.elastic + position[:2] - history.position
        sticks = jnp.sum(trial * iterate.direction, axis=0) < 0
        clearance = self.at_points(fraction, position, history).clearance
        most = 1e-3 * self.stiffness * self.element_size
        law = self._law(history)
        pressure = jnp.maximum(iterate.pressure, jnp.minimum(law(clearance), most))
        at = self.contact.law.clearance(pressure, self.stiffness) - self._carried(history)
        slope = jax.jvp(law, (at,), (jnp.ones_like(at),))[1]
        # Whether a point opens is decided with the layer's own stiffness: the stiff law's would
        # open half of a face at the first micrometre of error.
        closed = (pressure - self.stiffness * (clearance - at) >= 0) & (slope < 0)
        return TangentLaw(jnp.where(closed, pressure, 0.0), at, jnp.where(closed, slope, 0.0), sticks, curvature)

    def follow(
        self, fraction: Array, x: Corners, change: Corners, history: SlipHistory, law: TangentLaw
    ) -> ContactIterate:
        """Compute what the next iteration remembers once a part of the step `change` is taken (`after`).

        The pressure follows the clearance's linear change.
        """

        def clearance(corners):
            return self.at_points(fraction, surface_tangents(corners, self.rule)[0], history).clearance

        now, slope = jax.jvp(clearance, (x,), (change,))
        point = self.at_points(fraction, surface_tangents(x, self.rule)[0], history, law)
        return ContactIterate(
            law.pressure, jnp.where(point.sliding, point.elastic, 0.0), law(now + slope) - law.pressure
        )

    def _friction(self, pressure, position, history, slope_x, slope_y, sticks) -> "_Friction":
        trial = history.elastic + position[:2] - history.position
        rise = slope_x * trial[0] + slope_y * trial[1]
        squared = trial[0] ** 2 + trial[1] ** 2 + rise**2
        length = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
        length = jnp.where(squared > 0, length, 0.0)
        limit = self.contact.slip_limit(pressure, self.element_size)
        sliding = length > limit if sticks is None else (length > limit) & ~sticks
        ratio = jnp.where(sliding, limit / jnp.where(sliding, length, 1.0), 1.0)
        closed = pressure > 0
        elastic = jnp.where(closed, ratio * trial, 0.0)
        stiffness = self.contact.stick_stiffness(pressure, self.element_size)
        climb = slope_x * elastic[0] + slope_y * elastic[1]
        tangent = jnp.stack([elastic[0], elastic[1], climb])
        conjugate = -stiffness * jnp.stack([elastic[0] + slope_x * climb, elastic[1] + slope_y * climb])
        unit = jnp.stack([trial[0], trial[1], rise]) / jnp.where(sliding, length, 1.0)
        return _Friction(
            traction=-stiffness * tangent,
            stiffness=stiffness * ratio,
            direction=jnp.where(sliding, unit, 0.0),
            elastic=elastic,
            slid=jnp.where(closed, trial - elastic, 0.0),
            conjugate=conjugate,
            sliding=closed & sliding,
            slips=closed & (length > _AT_LIMIT * limit),
        )

    def _area(self, tangents: Float[Array, "2 3 points *faces"]) -> Float[Array, "points *faces"]:
        """Compute the area per unit of (ξ, η) that the surface pushes on [mm²]."""
        area = self._whole_area(tangents)
        return area if self.shares is None else area * self.shares

    def _whole_area(self, tangents: Float[Array, "2 3 points *faces"]) -> Float[Array, "points *faces"]:
        if self.imposed is not None:
            return self.imposed.area
        area = area_vector(tangents[0], tangents[1])
        if self.sides is None:
            return size(area)
        towards = jnp.maximum(area[2] if self.above else -area[2], 0.0)
        return jnp.where(self.sides, towards, size(area))

    def force(self, fraction: Array, x: Corners, history: SlipHistory, law: TangentLaw | None = None) -> Corners:
        """Compute the force on the layer at the corners of the faces [N]."""
        position, *tangents = surface_tangents(x, self.rule)
        area = self._area(jnp.stack(tangents))
        area = area if law is None else _scaled_slope(area, law.curvature)
        density = self.at_points(fraction, position, history, law).traction * area
        return to_corners(jnp.moveaxis(density, 1, 0), self.rule)

    def stiffness_matrices(
        self, fraction: Array, x: Corners, history: SlipHistory, law: TangentLaw | None = None
    ) -> tuple[Array, Array]:
        """Compute -d(force)/dx of every face `(4 a, 4 b, 3, 3, *faces)` [N/mm].

        Returns:
            The exact matrix (not symmetric when points slide), and its symmetric positive part
            for the preconditioner: without curvature, area change and sliding's coupling.
        """
        q = quadrature(self.rule)
        position, *tangents = surface_tangents(x, self.rule)
        at_law = None if law is None else law.at_its_pressure()

        def traction(moved):
            point = self.at_points(fraction, moved, history, at_law)
            return point.traction, point

        def linearised(position):
            now, change, point = jax.linearize(traction, position, has_aux=True)
            unit = jnp.eye(3, dtype=x.dtype).reshape(3, 3, *[1] * (position.ndim - 1))
            by_position = jax.vmap(change)(jnp.broadcast_to(unit, (3, *position.shape)))  # j, i, points
            return now, by_position, point

        now, by_position, point = apart(linearised, position)
        area, pull_back = jax.vjp(self._area, jnp.stack(tangents))
        (by_tangents,) = pull_back(jnp.broadcast_to(1.0 if law is None else law.curvature, area.shape))
        slopes = jnp.concatenate([(by_position * area)[None], by_tangents[:, :, None] * now])
        slopes = jnp.moveaxis(slopes, (3, 0, 2, 1), (0, 1, 2, 3))  # points, (N, dN_ξ, dN_η), i, j
        weights = q.N * q.weights[:, None]
        both = np.concatenate([q.N[:, None], q.dN], axis=1)
        pairs = np.einsum("qa,qmb->abqm", weights, both).reshape(4, 4, -1)
        exact = -contract(pairs, slopes.reshape(-1, *slopes.shape[2:]))
        guard = jnp.moveaxis(point.guard * area, 2, 0)
        mass = np.einsum("qa,qb->abq", weights, q.N)
        return exact, contract(mass, guard)

    def advance(self, fraction: Array, x: Corners, history: SlipHistory) -> SlipHistory:
        """Compute the history at the end of an increment."""
        position, *tangents = surface_tangents(x, self.rule)
        point = self.at_points(fraction, position, history)
        weights = quadrature(self.rule).weights
        work = self._area(jnp.stack(tangents)) * jnp.sum(point.friction * point.slid, axis=0)
        dissipated = history.dissipated - jnp.sum(jnp.tensordot(weights, work, 1))
        return SlipHistory(position[:2], point.elastic, history.slip + point.slid, dissipated, point.pressure)


class _Friction(NamedTuple):
    traction: Array
    stiffness: Array
    direction: Array
    elastic: Array
    slid: Array
    conjugate: Array
    sliding: Array
    slips: Array


def _scaled_slope(value: Array, share: Array | float) -> Array:
    """Keep a value, and a share of its derivative."""
    still = jax.lax.stop_gradient(value)
    return still + share * (value - still)
