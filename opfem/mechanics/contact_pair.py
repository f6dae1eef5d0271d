"""Contact and friction of two deformable faces: points of the lower body's face against the upper body's.

Each face point of the lower body is projected along z onto a smooth surface through the moving nodes of the upper
body's face (`smooth_face`). Law and friction are those of a face against a rigid surface. The weights of that surface
distribute the reaction to the upper body's nodes, so that action and reaction are equal to round-off. The friction
history refers to material points of the upper body: rigid motion of both gives no slip.

Source:
    Zimmerman and Ateshian, J. Biomech. Eng. 140 (2018) 081013 (ray tracing from face points).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .contact_face import ContactFace
from .contact_state import ContactIterate, Corners, FacePoints, PointContact, SlipHistory, TangentLaw
from .face import CORNERS, area_vector, quadrature, size, surface_tangents, to_corners
from .friction import positive_part
from .kinematics import contract
from .smooth_face import BEYOND, Place, continued, mirrored, patch

# Newton steps of the projection of a point, from its position on the undeformed upper face.
_FINDING_STEPS = 6
# Highest contact stiffness of the upper body in the preconditioner, over that of an element of the lower one (its
# confined modulus over its height): the lower body is solved with the full contact stiffness, then the upper one with
# this, as if in series with a seventh of that element. The reverse order requires the upper body's contact stiffness to
# 1 %, and element matrices cannot represent that of the smooth surface. Krylov steps per Newton step of the published
# ridged sample on 20×20×(2+8) elements, at 10, 28, 66 and 85 % of the load: 11, 17, 42 and 64 at 0.02; 12, 15, 18 and
# 21 at 2; 12, 13, 16 and 18 at 7; 12, 14, 16 and 16 at 23, which needs 13 instead of 9 Newton steps to first contact.
SOFT = 7.0

UpperNodes = Float[Array, "3 my mx"]


class PairPoints(NamedTuple):
    """Positions of the points of the lower face, and their projections onto the upper face.

    Attributes:
        at: The points, and the upper face's height and slope there.
        place: Material point of the projection, x and y, in cells of the upper face's grid.
        overlap: Share of the point that the upper face covers [-]: 1 except at its rim.
    """

    at: FacePoints
    place: Place
    overlap: Float[Array, "points *faces"]


class PairForce(NamedTuple):
    """Force [N] at the corners of the lower body's faces, and at the nodes of the upper body's face."""

    lower: Corners
    upper: UpperNodes


class ContactPair(eqx.Module):
    """Contact between the faces of two deformable bodies.

    Attributes:
        face: Law, friction and quadrature of the lower face; its rigid surface is not used.
        spacing: Spacing of the upper face's grid [mm].
        lower_spacing: Spacing of the lower face's grid [mm].
        rims: Whether the upper face ends at x0, x1, y0, y1; at a plane of symmetry it does not.
        soft: Contact stiffness of the upper body in the preconditioner [MPa/mm] (`SOFT`).
    """

    face: ContactFace
    spacing: Float[Array, "2"]
    lower_spacing: Float[Array, "2"]
    soft: Array
    rims: tuple[bool, bool, bool, bool] = eqx.field(static=True)

    def initial_history(self, x: Corners) -> SlipHistory:
        """Build the history of faces without slip."""
        history = self.face.initial_history(x)
        return eqx.tree_at(lambda h: h.position, history, self._unmoved(history.position))

    def locate(self, fraction: Array, x: Corners, upper: UpperNodes, history: SlipHistory) -> PairPoints:
        """Project the points of faces with corners x [mm] onto the face with nodes `upper` [mm].

        The search has no derivative; two Newton steps after it provide first and second derivatives.
        """
        position, *tangents = surface_tangents(x, self.face.rule)
        surface = continued(upper, self.rims)
        found = self._find(jax.lax.stop_gradient(position[:2]), jax.lax.stop_gradient(surface))
        around = patch(surface, found)
        place = jax.lax.fori_loop(0, 2, lambda _, place: place + around.at(place).step_towards(position[:2]), found)
        place = jnp.where(_is_near(found, surface), place, found)
        met = around.at(place)
        anchor = patch(surface, history.position).at(history.position).position[:2]
        at = FacePoints(fraction, position, jnp.stack(tangents), met.position[2], met.slope, None, anchor)
        return PairPoints(at, place, self._overlap(place, upper))

    def at_points(self, points: PairPoints, history: SlipHistory, law: TangentLaw | None = None) -> PointContact:
        """Evaluate contact at the points, by the nonlinear law or a linearised one."""
        return self.face.at_points(points.at, history, law)

    def area(self, points: PairPoints) -> Float[Array, "points *faces"]:
        """Compute the area per unit of (ξ, η) that is in contact, or would be [mm²]."""
        return points.overlap * size(area_vector(*points.at.tangents))

    def force(self, points: PairPoints, upper: UpperNodes, history: SlipHistory, law: TangentLaw | None) -> PairForce:
        """Compute the forces on both faces [N]; of `upper`, only its shape is needed."""
        density = (self.at_points(points, history, law).traction * self.area(points)).astype(upper.dtype)
        weights = jnp.asarray(quadrature(self.face.rule).weights[:, None], upper.dtype)

        def under(nodes):
            return patch(mirrored(nodes), jax.lax.stop_gradient(points.place)).at(points.place).position

        (onto,) = jax.vjp(under, jnp.zeros_like(upper))[1](density * weights)
        return PairForce(to_corners(jnp.moveaxis(density, 1, 0), self.face.rule), -onto)

    def linearised(
        self, fraction: Array, x: Corners, upper: UpperNodes, history: SlipHistory, law: TangentLaw | None
    ) -> Callable[[Corners, UpperNodes], PairForce]:
        """Linearise the forces [N] by the positions of both faces [mm]."""
        curvature = 1.0 if law is None else law.curvature

        def partly(v):
            return curvature * v + (1.0 - curvature) * jax.lax.stop_gradient(v)

        def force(x, upper):
            points = self.locate(fraction, x, upper, history)
            at = points.at._replace(slope=partly(points.at.slope), tangents=partly(points.at.tangents))
            points = PairPoints(at, partly(points.place), partly(points.overlap))
            return self.force(points, upper, history, None if law is None else law.at_its_pressure())

        return jax.linearize(force, x, upper)[1]

    def guards(
        self, points: PairPoints, upper: UpperNodes, history: SlipHistory, law: TangentLaw | None
    ) -> tuple[Float[Array, "4 4 3 3 faces"], Float[Array, "4 4 3 3 upper_faces"]]:
        """Compute the contact stiffness of each body's preconditioner [N/mm], as face matrices: lower, upper."""
        face, at = self.face, points.at
        clearance = face.clearance(at)
        own = face.own_law(history) if law is None else law
        pressure, slope = jax.jvp(own, (clearance,), (jnp.ones_like(clearance),))
        friction = face.friction(pressure, at, history, None if law is None else law.sticks)

        def softened(k):
            return k * self.soft / (k + self.soft)

        area = self.area(points)
        full = positive_part(at.normal, -slope, friction.stiffness, friction) * area
        soft = positive_part(at.normal, softened(-slope), softened(friction.stiffness), friction) * area
        q = quadrature(face.rule)
        lower = contract(np.einsum("q,qa,qb->abq", q.weights, q.N, q.N), jnp.moveaxis(full, 2, 0))
        return lower, self._gathered(points.place, soft * q.weights[:, None], upper)

    def tangent_law(
        self, points: PairPoints, history: SlipHistory, iterate: ContactIterate, curvature: Array
    ) -> TangentLaw:
        """Linearise contact at the points."""
        return self.face.tangent_law(points.at, history, iterate, curvature)

    def follow(
        self, points: PairPoints, change: Corners, upper: UpperNodes, history: SlipHistory, law: TangentLaw
    ) -> ContactIterate:
        """Update the contact iterate after a part of the step of both faces."""
        at = points.at
        step = jnp.moveaxis(contract(quadrature(self.face.rule).N, change), 1, 0)
        separation = patch(continued(upper, self.rims), points.place).at(points.place).position - step
        opening = separation[2] - at.slope[0] * separation[0] - at.slope[1] * separation[1]
        clearance = self.face.clearance(at) + opening / at.stretch
        point = self.at_points(points, history, law)
        return ContactIterate(law.pressure, jnp.where(point.sliding, point.elastic, 0.0), law(clearance) - law.pressure)

    def advance(self, points: PairPoints, history: SlipHistory) -> SlipHistory:
        """Compute the history at the end of an increment."""
        point = self.at_points(points, history)
        work = self.area(points) * jnp.sum(point.friction * point.slid, axis=0)
        dissipated = history.dissipated - jnp.sum(jnp.tensordot(quadrature(self.face.rule).weights, work, 1))
        return SlipHistory(points.place, point.elastic, history.slip + point.slid, dissipated, point.pressure)

    def _unmoved(self, xy: Float[Array, "2 *points"]) -> Place:
        return xy / self.spacing.reshape(2, *[1] * (xy.ndim - 1))

    def _find(self, xy: Float[Array, "2 *points"], surface: Array) -> Place:
        def closer(_, place):
            return _clipped(place + patch(surface, place).at(place).step_towards(xy), surface)

        return jax.lax.fori_loop(0, _FINDING_STEPS, closer, _clipped(self._unmoved(xy), surface))

    def _overlap(self, place: Place, upper: UpperNodes) -> Float[Array, "points *faces"]:
        """Compute the share of each point that the upper face covers.

        Without it, a point that slides off a rim at full pressure makes Newton's method cycle between two states.
        Bodies with coincident rims have a margin of a quarter of a point's width.
        """
        q = quadrature(self.face.rule)
        outermost = float(np.min(q.N @ np.array([x for x, _ in CORNERS])))
        reach = 2.0 * outermost if outermost > 0 else 1.0
        share = jnp.ones_like(place[0])
        for axis, n in enumerate(upper.shape[:0:-1]):
            width = reach * self.lower_spacing[axis] / self.spacing[axis]
            inside = (place[axis], n - 1.0 - place[axis])
            for distance, is_rim in zip(inside, self.rims[2 * axis : 2 * axis + 2], strict=True):
                if is_rim:
                    share = share * jnp.clip(0.75 + distance / width, 0.0, 1.0)
        return share

    def _gathered(
        self, place: Place, stiffness: Float[Array, "3 3 points faces"], upper: UpperNodes
    ) -> Float[Array, "4 4 3 3 upper_faces"]:
        """Assemble contact stiffness of points into face matrices of the upper body, bilinear within faces."""
        my, mx = upper.shape[1:]
        cell = patch(mirrored(upper), place).cell
        x, y = jnp.clip(place - cell, 0.0, 1.0)
        weights = jnp.stack([(x if i else 1.0 - x) * (y if j else 1.0 - y) for i, j in CORNERS])
        each = weights[:, None, None, None] * weights[None, :, None, None] * stiffness
        index = (cell[1] * (mx - 1) + cell[0]).reshape(-1)
        whole = jnp.zeros((4, 4, 3, 3, (my - 1) * (mx - 1)), stiffness.dtype)
        return whole.at[..., index].add(each.reshape(4, 4, 3, 3, -1))


def _clipped(place: Place, surface: Array) -> Place:
    return jnp.clip(place, -BEYOND, _last(place, surface) + BEYOND)


def _is_near(place: Place, surface: Array) -> Array:
    """Return whether a search ended on the upper face, or next to its rim."""
    return jnp.all((place > -BEYOND) & (place < _last(place, surface) + BEYOND), axis=0)


def _last(place: Place, surface: Array) -> Array:
    """Place of the last node along each axis, without ghost nodes."""
    return jnp.asarray(np.array(surface.shape[:0:-1]).reshape(2, *[1] * (place.ndim - 1)) - 3.0, place.dtype)
