"""Contact of faces of the layer with a rigid surface, integrated at their face points.

Pressure follows the overclosure law along the surface's true normal, on the current area. Friction is Coulomb's, with
elastic slip and a return map. The slip of a point is measured along the surface, in (x, y) of the surface, with a
history over the increments.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..model import Contact
from .contact_body import ImposedPressure, RigidPlate, RigidSurface
from .contact_state import (
    ContactIterate,
    Corners,
    FacePoints,
    PointContact,
    PointVector,
    SlipHistory,
    TangentLaw,
)
from .face import FaceRule, area_vector, quadrature, size, surface_tangents, to_corners
from .friction import Friction, positive_part, return_map, trial_slip
from .kinematics import contract
from .paired_contact import PairedContact, PairedSurface
from .unfused import unfused


class ContactFace(eqx.Module):
    """Faces in contact with one rigid surface.

    Attributes:
        contact: Law and friction.
        surface: The rigid surface.
        offset: Shift of the surface away from the layer [mm]; of each of them where they are paired.
        imposed: Pressure of a `Traction` load: its dead part only bounds friction, its elastic foundation acts.
        element_size: Size of an element [mm]; default elastic slip is a fraction of it.
        stiffness: Stiffness of an element per area [MPa/mm], the scale of hard contact.
        above: True for the sample, False for the window; of each of them where they are paired.
        rule: Quadrature of contact.
        sides: Mask of faces that are sides, in contact only where they have turned towards the surface; None: none.
        shares: Weight of each point where the points of a face differ (`node_shares`).
    """

    contact: Contact | PairedContact
    surface: RigidSurface | RigidPlate | PairedSurface
    offset: Array
    imposed: "ImposedPressure | None"
    element_size: Array
    stiffness: Array
    above: bool | tuple[bool, ...] = eqx.field(static=True)
    rule: FaceRule = eqx.field(static=True)
    sides: Bool[Array, " *faces"] | None = None
    shares: Float[Array, "points *faces"] | None = None

    @property
    def own_contact(self) -> Contact:
        """Law and friction of faces that are not paired."""
        assert isinstance(self.contact, Contact)
        return self.contact

    def initial_history(self, x: Corners) -> SlipHistory:
        """Build the history of a face without slip."""
        position = surface_tangents(x, self.rule)[0][:2]
        zero = jnp.zeros_like(position)
        return SlipHistory(position, zero, zero, jnp.zeros((), position.dtype), zero[0])

    def locate(self, fraction: Array, x: Corners, bends: bool = False) -> FacePoints:
        """Locate the points of faces with corners x [mm]; evaluate the surface there, with `bends` to second order."""
        position, *tangents = surface_tangents(x, self.rule)
        order = 2 if bends else 1

        def under(surface, fraction, position):
            return surface.derivatives(fraction, position[0], position[1], order)

        d = (
            under(self.surface, fraction, position)
            if self.surface.is_plane
            else unfused(under, self.surface, fraction, position)
        )
        bend = jnp.stack([jnp.stack([d[0, 2], d[1, 1]]), jnp.stack([d[1, 1], d[2, 0]])]) if bends else None
        return FacePoints(fraction, position, jnp.stack(tangents), d[0, 0], jnp.stack([d[0, 1], d[1, 0]]), bend)

    def at_points(self, points: FacePoints, history: SlipHistory, law: TangentLaw | None = None) -> PointContact:
        """Evaluate contact at face points, by the nonlinear law or a linearised one."""
        clearance = self.clearance(points)
        pressure, push, _, _ = self._pressure(points, clearance, law or self.own_law(history))
        friction = self.friction(pressure, points, history, None if law is None else law.sticks)
        return PointContact(
            friction.traction - self._side(push) * push * points.normal,
            pressure,
            clearance,
            friction.elastic,
            friction.slid,
            friction.conjugate,
            friction.sliding,
            friction.slips,
        )

    def _side(self, points: Array) -> np.ndarray:
        """Return the side of the layer that the surface is on: 1 above, -1 below; broadcasts to points."""
        side = np.where(self.above, 1.0, -1.0)
        return np.repeat(side, points.shape[-1] // side.size) if side.ndim else side

    def clearance(self, points: FacePoints) -> Float[Array, "points *faces"]:
        """Compute the gap along the surface's normal [mm]."""
        towards = (points.height - points.position[2]) * self._side(points.height)
        offset = (
            jnp.repeat(self.offset, points.height.shape[-1] // self.offset.size) if self.offset.ndim else self.offset
        )
        return (towards + offset) / points.stretch

    @property
    def is_exact(self) -> bool:
        """Whether the method of multipliers removes penetration."""
        return self.own_contact.law.exact and self.imposed is None

    def _shift(self, history: SlipHistory) -> Array | float:
        """Compute the shift of the law's clearance [mm] by the multiplier of exact hard contact."""
        return 0.0 if self.imposed is not None else self.contact.law.multiplier_shift(history.pressure, self.stiffness)

    def own_law(self, history: SlipHistory) -> Callable[[Array], Array]:
        """Return the pressure as a function of clearance [mm], shifted by the multiplier of exact contact."""
        shift = self._shift(history)
        return lambda clearance: self.contact.law.pressure_at(clearance + shift, self.stiffness)

    def missed_gap(self, before: SlipHistory, after: SlipHistory) -> Array:
        """Compute the largest gap or penetration [mm] of exact contact after an increment; 0 for other laws."""
        if not self.is_exact:
            return jnp.zeros_like(after.dissipated)
        gap = self.contact.law.clearance_at(after.pressure - before.pressure, self.stiffness)
        return jnp.max(jnp.where(after.pressure > 0, jnp.abs(gap), 0.0))

    def _pressure(self, points: FacePoints, clearance: Array, law) -> tuple[Array, Array, Array, Array]:
        """Compute the pressure that bounds friction and the applied one [MPa], and their slopes [MPa/mm].

        Slopes are derivatives by clearance; by height under an imposed pressure.
        """
        imposed = self.imposed
        if imposed is not None:
            z = points.position[2]
            push, slope = jax.jvp(lambda z: imposed.foundation_pressure(points.fraction, z), (z,), (jnp.ones_like(z),))
            pressure = imposed.bounding(points.fraction, self.rule, push)
            return pressure, push, jnp.where(pressure > 0, slope, 0.0), slope
        pressure, slope = jax.jvp(law, (clearance,), (jnp.ones_like(clearance),))
        return pressure, pressure, slope, slope

    def initial_iterate(self, history: SlipHistory) -> ContactIterate:
        """Initialise with the pressure of the last increment and stick at every point."""
        return ContactIterate(history.pressure, jnp.zeros_like(history.elastic), jnp.zeros_like(history.pressure))

    def tangent_law(
        self, points: FacePoints, history: SlipHistory, iterate: ContactIterate, curvature: Array
    ) -> TangentLaw:
        """Linearise contact at face points.

        A newly closed point has the pressure of the law, bounded by that which shortens an element by a thousandth.
        """
        sticks = jnp.sum(trial_slip(points, history) * iterate.direction, axis=0) < 0
        clearance = self.clearance(points)
        most = 1e-3 * self.stiffness * self.element_size
        law = self.own_law(history)
        pressure = jnp.maximum(iterate.pressure, jnp.minimum(law(clearance), most))
        at = self.contact.law.clearance_at(pressure, self.stiffness) - self._shift(history)
        slope = jax.jvp(law, (at,), (jnp.ones_like(at),))[1]
        # Opening of a point is decided with the stiffness of the layer: that of a stiff law would open half of a face
        # at the first micrometre of error.
        closed = (pressure - self.stiffness * (clearance - at) >= 0) & (slope < 0)
        return TangentLaw(jnp.where(closed, pressure, 0.0), at, jnp.where(closed, slope, 0.0), sticks, curvature)

    def follow(self, points: FacePoints, change: Corners, history: SlipHistory, law: TangentLaw) -> ContactIterate:
        """Update the contact iterate after a part of the step `change` (`after`).

        The pressure follows the linear change of the clearance.
        """
        step = jnp.moveaxis(contract(quadrature(self.rule).N, change), 1, 0)
        clearance = self.clearance(points)
        further = jnp.sum(self._clearance_slope(points, clearance, 1.0) * step, axis=0)
        point = self.at_points(points, history, law)
        return ContactIterate(
            law.pressure, jnp.where(point.sliding, point.elastic, 0.0), law(clearance + further) - law.pressure
        )

    def _clearance_slope(self, points: FacePoints, clearance: Array, curvature: Array | float) -> PointVector:
        """Compute the derivative of the clearance by the points' positions [-], with a share of the curvature."""
        return points.normal * -self._side(clearance) - clearance / points.stretch * _stretch_slope(points, curvature)

    def friction(self, pressure: Array, points: FacePoints, history: SlipHistory, sticks: Array | None) -> Friction:
        """Compute Coulomb friction at face points; points in `sticks` stick."""
        return return_map(pressure, self._stick(pressure), self._limit(pressure), points, history, sticks)

    def _linearised(
        self, points: FacePoints, history: SlipHistory, law: TangentLaw | None
    ) -> tuple[PointVector, Array, Array]:
        """Compute the traction [MPa], its derivative by the points' positions, and the guard [MPa/mm].

        All in closed form: component i by position j `(3 i, 3 j, points, *faces)`. The guard is the symmetric positive
        part of minus the derivative: without curvature and frictional coupling.
        """
        curvature, sticks = (1.0, None) if law is None else (law.curvature, law.sticks)
        assert points.bend is not None
        normal, stretch, clearance = points.normal, points.stretch, self.clearance(points)
        own = self.own_law(history) if law is None else law.at_its_pressure()
        pressure, push, slope, push_slope = self._pressure(points, clearance, own)
        if self.imposed is None:
            by_clearance = self._clearance_slope(points, clearance, curvature)
        else:
            by_clearance = jnp.zeros_like(normal).at[2].set(1.0)  # the foundation depends on height instead
        by_pressure, by_push = slope * by_clearance, push_slope * by_clearance
        bend = jnp.pad(curvature * points.bend, [(0, 1), (0, 1)] + [(0, 0)] * pressure.ndim)
        by_normal = -(bend + normal[:, None] * _stretch_slope(points, curvature)) / stretch

        friction = self.friction(pressure, points, history, sticks)
        climbing = jnp.pad(points.slope, [(0, 1)] + [(0, 0)] * pressure.ndim)
        rising = climbing + bend[0] * friction.reach[0] + bend[1] * friction.reach[1]
        plane = np.diag([1.0, 1.0, 0.0]).reshape(3, 3, *[1] * pressure.ndim)
        up = np.array([0.0, 0.0, 1.0]).reshape(3, 1, *[1] * pressure.ndim)
        by_reach = plane + up * rising
        _, softer = jax.jvp(self._stick, (pressure,), (jnp.ones_like(pressure),))
        _, strength = jax.jvp(lambda p: self._stick(p) * self._limit(p), (pressure,), (jnp.ones_like(pressure),))
        length = jnp.where(friction.limited, friction.length, 1.0)
        shrinking = friction.stiffness / length * jnp.sum(friction.reach[:, None] / length * by_reach, axis=0)
        by_stiffness = jnp.where(friction.limited, strength / length * by_pressure - shrinking, softer * by_pressure)
        rubbing = friction.reach[:, None] * by_stiffness + friction.stiffness * by_reach
        side = self._side(push)
        pressing = side * (normal[:, None] * by_push + push * by_normal)
        by_position = -jnp.where(pressure > 0, rubbing, 0.0) - pressing

        pushing = push_slope if self.imposed is not None else -slope
        guard = positive_part(normal, pushing, friction.stiffness, friction)
        return friction.traction - side * push * normal, by_position, guard

    def _stick(self, pressure: Array) -> Array:
        return self.contact.stick_stiffness(pressure, self.element_size)

    def _limit(self, pressure: Array) -> Array:
        return self.contact.slip_limit(pressure, self.element_size)

    def _area(self, tangents: Float[Array, "2 3 points *faces"]) -> Float[Array, "points *faces"]:
        """Compute the contact area per unit of (ξ, η) [mm²]."""
        area = self._whole_area(tangents)
        return area if self.shares is None else area * self.shares

    def _whole_area(self, tangents: Float[Array, "2 3 points *faces"]) -> Float[Array, "points *faces"]:
        if self.imposed is not None:
            return self.imposed.area
        area = area_vector(tangents[0], tangents[1])
        if self.sides is None:
            return size(area)
        towards = jnp.maximum(self._side(area[2]) * area[2], 0.0)
        return jnp.where(self.sides, towards, size(area))

    def force(self, points: FacePoints, history: SlipHistory, law: TangentLaw | None = None) -> Corners:
        """Compute the force on the layer at the corners of the faces [N]."""
        density = self.at_points(points, history, law).traction * self._area(points.tangents)
        return to_corners(jnp.moveaxis(density, 1, 0), self.rule)

    def stiffness_matrices(
        self, points: FacePoints, history: SlipHistory, law: TangentLaw | None = None
    ) -> tuple[Array, Array]:
        """Compute -d(force)/dx of every face `(4 a, 4 b, 3, 3, *faces)` [N/mm].

        Returns:
            The exact matrix (not symmetric when points slide), and its symmetric positive part
            for the preconditioner: without curvature, area change and frictional coupling.
        """
        q = quadrature(self.rule)
        now, by_position, guard = unfused(lambda face, *args: face._linearised(*args), self, points, history, law)
        area, pull_back = jax.vjp(self._area, points.tangents)
        (by_tangents,) = pull_back(jnp.broadcast_to(1.0 if law is None else law.curvature, area.shape))
        slopes = jnp.concatenate([(by_position * area)[None], by_tangents[:, None] * now[None, :, None]])
        slopes = jnp.moveaxis(slopes, 3, 0)  # points, (N, dN_ξ, dN_η), i, j
        weights = q.N * q.weights[:, None]
        both = np.concatenate([q.N[:, None], q.dN], axis=1)
        pairs = np.einsum("qa,qmb->abqm", weights, both).reshape(4, 4, -1)
        exact = -contract(pairs, slopes.reshape(-1, *slopes.shape[2:]))
        mass = np.einsum("qa,qb->abq", weights, q.N)
        return exact, contract(mass, jnp.moveaxis(guard * area, 2, 0))

    def advance(self, points: FacePoints, history: SlipHistory) -> SlipHistory:
        """Compute the history at the end of an increment."""
        point = self.at_points(points, history)
        weights = quadrature(self.rule).weights
        work = self._area(points.tangents) * jnp.sum(point.friction * point.slid, axis=0)
        dissipated = jnp.tensordot(weights, work, 1).reshape(*history.dissipated.shape, -1)  # paired: of each body
        dissipated = history.dissipated - jnp.sum(dissipated, axis=-1)
        return SlipHistory(points.position[:2], point.elastic, history.slip + point.slid, dissipated, point.pressure)


def _stretch_slope(points: FacePoints, curvature: Array | float) -> PointVector:
    """Compute the derivative of the surface's stretch by position [1/mm], with a share of the curvature."""
    assert points.bend is not None
    along = points.slope[0] * points.bend[0] + points.slope[1] * points.bend[1]
    return jnp.concatenate([curvature * along / points.stretch, jnp.zeros_like(along[:1])])
