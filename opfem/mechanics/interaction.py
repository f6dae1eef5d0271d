"""Contact and friction of one face of the layer with a rigid surface, at its face points.

Pressure follows the overclosure law along the surface's true normal, on the current area.
Friction is Coulomb's with elastic slip and a return map; the slip of a point is measured along
the surface, in the surface's own (x, y), and its history is carried from increment to increment.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..model import Contact, HeightField
from .face import FaceRule, area_vector, gather_face, quadrature, size, surface_tangents, to_nodes
from .kinematics import contract

Face = Float[Array, "3 my mx"]
PointVector = Float[Array, "3 points ny nx"]


class SlipHistory(eqx.Module):
    """What friction remembers at the end of an increment, per face point.

    Attributes:
        position: (x, y) of the points `(2, points, ny, nx)` [mm].
        elastic: Elastic part of the slip `(2, points, ny, nx)` [mm].
        slip: Slip slid so far, along x and y `(2, points, ny, nx)` [mm].
        dissipated: Work done by friction so far on the whole face [N mm].
        pressure: Contact pressure at the points [MPa], where the next increment starts from.
    """

    position: Float[Array, "2 points ny nx"]
    elastic: Float[Array, "2 points ny nx"]
    slip: Float[Array, "2 points ny nx"]
    dissipated: Float[Array, ""]
    pressure: Float[Array, "points ny nx"]


class ContactIterate(NamedTuple):
    """What a Newton iteration remembers of a face besides displacement.

    Attributes:
        pressure: Contact pressure at the points [MPa], an unknown of its own.
        direction: Slip that a sliding point had in the last step `(2, points, ny, nx)` [mm], zero
            where it stuck.
    """

    pressure: Float[Array, "points ny nx"]
    direction: Float[Array, "2 points ny nx"]


class TangentLaw(NamedTuple):
    """Contact linearised for one Newton step: p = pressure + slope (g - clearance).

    Newton's method on displacement and pressure together, with the pressure eliminated. The
    pressure follows the linearised clearance, so that the curvature of a surface that a point
    slides along does not throw it off: what makes stiff laws converge in few full steps.
    A sliding point whose slip reverses sticks for one step: a sliding point has no stiffness
    along its slip, so that without this it would jump back and forth for ever.
    """

    pressure: Float[Array, "points ny nx"]
    clearance: Float[Array, "points ny nx"] | None
    slope: Float[Array, "points ny nx"]
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
    pressure: Float[Array, "points ny nx"]
    clearance: Float[Array, "points ny nx"]
    elastic: Float[Array, "2 points ny nx"]
    slid: Float[Array, "2 points ny nx"]
    friction: Float[Array, "2 points ny nx"]  # conjugate to slip in the surface's (x, y)
    sliding: Array
    guard: Float[Array, "3 3 points ny nx"]  # symmetric positive part of -d(traction)/dx


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


class ImposedPressure(eqx.Module):
    """A dead pressure per reference area, applied elsewhere, that bounds friction here.

    Attributes:
        start: Nodal pressure at load fraction 0 `(ny+1, nx+1)` [MPa].
        end: The same at load fraction 1.
        area: Reference area per unit of (ξ, η) at the points [mm²].
    """

    start: Float[Array, "my mx"]
    end: Float[Array, "my mx"]
    area: Float[Array, "points ny nx"]

    def at_points(self, fraction: Array, rule: FaceRule) -> Float[Array, "points ny nx"]:
        """Interpolate the pressure [MPa] at the points; tension bounds friction by zero."""
        nodal = (1.0 - fraction) * self.start + fraction * self.end
        return jnp.maximum(contract(quadrature(rule).N, gather_face(nodal[None]))[:, 0], 0.0)


class ContactFace(eqx.Module):
    """One face in contact with a rigid surface.

    Attributes:
        contact: Law and friction.
        surface: The rigid surface.
        offset: Shift of the surface away from the layer [mm].
        imposed: For a `Traction` load, whose dead pressure only bounds friction.
        element_size: Size of an element [mm]; default elastic slip is a fraction of it.
        stiffness: Stiffness of an element per area [MPa/mm], the scale of hard contact.
        above: True for the sample, False for the window.
        rule: Where contact is integrated.
        rolls: A side face, which the surface only pushes where it has turned towards it.
    """

    contact: Contact
    surface: RigidSurface
    offset: Array
    imposed: "ImposedPressure | None"
    element_size: Array
    stiffness: Array
    above: bool = eqx.field(static=True)
    rule: FaceRule = eqx.field(static=True)
    rolls: bool = eqx.field(static=True, default=False)

    def initial_history(self, x: Face) -> SlipHistory:
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
        pressure, stiffness = self._pressure(fraction, clearance, law or self._law)
        friction = self._friction(pressure, position, history, slope_x, slope_y, None if law is None else law.sticks)
        push = 0.0 if self.imposed is not None else side * pressure
        traction = friction.traction - push * normal
        eye = jnp.eye(3, dtype=position.dtype)[:, :, None, None, None]
        along = normal[:, None] * normal[None]
        slid_along = friction.direction[:, None] * friction.direction[None]
        guard = stiffness * along + friction.stiffness * (eye - along - slid_along)
        return PointContact(
            traction, pressure, clearance, friction.elastic, friction.slid, friction.conjugate, friction.sliding, guard
        )

    def _law(self, clearance: Array) -> Array:
        return self.contact.law.pressure(clearance, self.stiffness)

    def _pressure(self, fraction: Array, clearance: Array, law) -> tuple[Array, Array]:
        if self.imposed is not None:
            return self.imposed.at_points(fraction, self.rule), jnp.zeros_like(clearance)
        pressure, slope = jax.jvp(law, (clearance,), (jnp.ones_like(clearance),))
        return pressure, -slope

    def initial_iterate(self, history: SlipHistory) -> ContactIterate:
        """Start from the pressure of the last increment, as if every point had stuck."""
        return ContactIterate(history.pressure, jnp.zeros_like(history.elastic))

    def tangent_law(
        self, fraction: Array, x: Face, history: SlipHistory, iterate: ContactIterate, curvature: Array
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
        pressure = jnp.maximum(iterate.pressure, jnp.minimum(self._law(clearance), most))
        at = self.contact.law.clearance(pressure, self.stiffness)
        slope = jax.jvp(self._law, (at,), (jnp.ones_like(at),))[1]
        # Whether a point opens is decided with the layer's own stiffness: the stiff law's would
        # open half of a face at the first micrometre of error.
        closed = (pressure - self.stiffness * (clearance - at) >= 0) & (slope < 0)
        return TangentLaw(jnp.where(closed, pressure, 0.0), at, jnp.where(closed, slope, 0.0), sticks, curvature)

    def follow(
        self, fraction: Array, x: Face, change: Face, history: SlipHistory, law: TangentLaw, length: Array
    ) -> ContactIterate:
        """Compute what the next iteration remembers after a step of `length` along `change`.

        The pressure follows the clearance's linear change.
        """

        def clearance(face):
            return self.at_points(fraction, surface_tangents(face, self.rule)[0], history).clearance

        now, slope = jax.jvp(clearance, (x,), (change,))
        pressure = jnp.maximum(law.pressure + length * (law(now + slope) - law.pressure), 0.0)
        point = self.at_points(fraction, surface_tangents(x, self.rule)[0], history, law)
        return ContactIterate(pressure, jnp.where(point.sliding, point.elastic, 0.0))

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
        )

    def _density(self, fraction: Array, y: Float[Array, "9 points ny nx"], history: SlipHistory, law) -> PointVector:
        """Force on the layer per unit of (ξ, η): y stacks position and the two tangents."""
        area = self._area(y) if law is None else _scaled_slope(self._area(y), law.curvature)
        return self.at_points(fraction, y[:3], history, law).traction * area

    def _area(self, y: Float[Array, "9 points ny nx"]) -> Float[Array, "points ny nx"]:
        if self.imposed is not None:
            return self.imposed.area
        area = area_vector(y[3:6], y[6:])
        return jnp.maximum(area[2] if self.above else -area[2], 0.0) if self.rolls else size(area)

    def force(self, fraction: Array, x: Face, history: SlipHistory, law: TangentLaw | None = None) -> Face:
        """Compute the nodal force on the layer [N]."""
        y = jnp.concatenate(surface_tangents(x, self.rule))
        return to_nodes(jnp.moveaxis(self._density(fraction, y, history, law), 1, 0), self.rule)

    def stiffness_matrices(
        self, fraction: Array, x: Face, history: SlipHistory, law: TangentLaw | None = None
    ) -> tuple[Array, Array]:
        """Compute -d(force)/dx of every face `(4 a, 4 b, 3, 3, ny, nx)` [N/mm].

        Returns:
            The exact matrix (not symmetric when points slide), and its symmetric positive part
            for the preconditioner: without curvature, area change and sliding's coupling.
        """
        q = quadrature(self.rule)
        y = jnp.concatenate(surface_tangents(x, self.rule))
        basis = jnp.broadcast_to(jnp.eye(9, dtype=y.dtype)[:, :, None, None, None], (9, *y.shape))
        at_law = None if law is None else law.at_its_pressure()
        slopes = jax.vmap(lambda e: jax.jvp(lambda v: self._density(fraction, v, history, at_law), (y,), (e,))[1])(
            basis
        )
        by_point = slopes.reshape(3, 3, *slopes.shape[1:])  # (N | dN_ξ | dN_η), j, i, points, ny, nx
        by_point = jnp.transpose(by_point, (3, 0, 2, 1, 4, 5))
        weights = q.N * q.weights[:, None]
        tangents = np.concatenate([q.N[:, None], q.dN], axis=1)
        pairs = np.einsum("qa,qmb->abqm", weights, tangents).reshape(4, 4, -1)
        exact = -contract(pairs, by_point.reshape(-1, *by_point.shape[2:]))
        point = self.at_points(fraction, y[:3], history, at_law)
        guard = jnp.moveaxis(point.guard * self._area(y), 2, 0)
        mass = np.einsum("qa,qb->abq", weights, q.N)
        return exact, contract(mass, guard)

    def advance(self, fraction: Array, x: Face, history: SlipHistory) -> SlipHistory:
        """Compute the history at the end of an increment."""
        y = jnp.concatenate(surface_tangents(x, self.rule))
        point = self.at_points(fraction, y[:3], history)
        weights = quadrature(self.rule).weights[:, None, None]
        work = jnp.sum(weights * self._area(y) * jnp.sum(point.friction * point.slid, axis=0))
        return SlipHistory(y[:2], point.elastic, history.slip + point.slid, history.dissipated - work, point.pressure)


class _Friction(NamedTuple):
    traction: Array
    stiffness: Array
    direction: Array
    elastic: Array
    slid: Array
    conjugate: Array
    sliding: Array


def _scaled_slope(value: Array, share: Array | float) -> Array:
    """Keep a value, and a share of its derivative."""
    still = jax.lax.stop_gradient(value)
    return still + share * (value - still)
