"""The discrete problem of one body under one load: residual, tangent and supports.

The load fraction is a number from 0 (start) to 1 (end); the friction history is that of the last converged increment.
"""

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics.boundary import Bodies, Body, Corners, Touching, add_matrices, put, take, to_touching, touched
from ..mechanics.contact_state import (
    ContactIterate,
    FacePoints,
    TangentLaw,
    separate_histories,
)
from ..mechanics.internal import LayerBody
from ..mechanics.paired_faces import Touch, can_pair, paired
from .equations import AbstractProblem, State
from .in_plane_hold import HoldBalance, lateral_size, rigid_part, without_drift, without_rigid_part
from .multigrid import build_multigrid
from .stencil import Nodal
from .supports import Supports
from .tangent import Tangent, Unknowns, couple_volume


class Forces(NamedTuple):
    """Nodal forces on the layer [N] at one state, those of each body, and the smallest volume ratio."""

    internal: Nodal
    volume: Array | None  # volume residual of the elements [mm³], where mean stress is an unknown
    applied: Bodies  # of Touching
    spring: Float[Array, "2 my mx"] | None
    smallest_J: Array

    @property
    def own(self) -> Unknowns:
        """Internal forces [N] and volume residual, the derivative of an energy."""
        return Unknowns(self.internal, self.volume)

    def with_own(self, own: Unknowns) -> "Forces":
        """Replace them."""
        return self._replace(internal=own.u, volume=own.mean_stress)


class Problem(AbstractProblem):
    """One body between rigid surfaces, and its load, discretised."""

    body: LayerBody
    low_order: LayerBody | None  # elements of the same nodes for the preconditioner
    positions: Nodal
    contacts: Bodies  # of ContactFace
    dead: tuple[Array, Array] | None  # nodal force at the interface [N], at fraction 0 and 1
    imposed: tuple[Array, Array] | None  # u_z at the interface [mm], at fraction 0 and 1
    spring: Array | None  # in-plane stiffness under each node of the window face [N/mm]
    viscosity: Array  # viscous regularisation during a snap-through [-], else 0
    drift_modes: Float[Array, "modes 2 my mx"] | None  # see `drift_modes`; None where supports prevent them all
    supports: Supports = eqx.field(static=True)

    @property
    def elements(self) -> tuple[int, int, int]:
        """Elements (nz, ny, nx)."""
        nz, ny, nx = (n - 1 for n in self.positions.shape[1:])
        return nz, ny, nx

    @property
    def free(self) -> np.ndarray:
        """Mask of the unknowns, 1 where free."""
        return self.supports.free(self.positions.shape[1:])

    def own_forces(self, x: Unknowns, state: State) -> Forces:
        """Compute internal, viscous and hold-spring forces [N], without applied ones."""
        u, mean_stress = x
        internal, smallest_J = self.body.internal_force(u, mean_stress)
        volume = None if mean_stress is None else self.body.volume_residual(u, mean_stress)
        internal = internal + self._drag(self.viscosity) * _node_share(u.shape[1:]) * (u - state.u)
        spring = None if self.spring is None else -self.spring * u[:2, 0]
        return Forces(internal, volume, Bodies(), spring, smallest_J)

    @property
    def faces(self) -> tuple[Touch, ...]:
        """The contacts, of window and sample together where they can be evaluated as one."""
        there = [(name, face) for name, face in zip(Bodies._fields, self.contacts, strict=True) if face is not None]
        groups = [there] if can_pair([face for _, face in there]) else [[one] for one in there]
        return tuple(Touch(tuple(name for name, _ in group), paired([face for _, face in group])) for group in groups)

    def locate(self, u: Nodal, fraction: Array, state: State, bends: bool = False) -> tuple[FacePoints, ...]:
        """Locate the quadrature points of `faces`; evaluate the surfaces there, `bends` to second order."""
        x = self.positions + u
        return tuple(touch.face.locate(fraction, self._take(x, touch), bends) for touch in self.faces)

    def with_contact(
        self, forces: Forces, points: tuple, fraction: Array, state: State, laws: tuple | None = None
    ) -> Forces:
        """Replace the applied forces by those of linearised contact laws; None: of the nonlinear laws."""
        none = Touching(jnp.zeros_like(forces.internal[:, 0]), None)
        applied = Bodies(none, none)
        for touch, at, law in self._each(points, laws):
            corners = touch.face.force(at, touch.history(state.histories), law)
            applied = applied._replace(
                **{name: to_touching(own, self.elements) for name, own in touch.split(corners).items()}
            )
        if self.dead is not None:
            face = applied.sample.face + (1.0 - fraction) * self.dead[0] + fraction * self.dead[1]
            applied = applied._replace(sample=applied.sample._replace(face=face))
        return forces._replace(applied=applied)

    def _each(self, *of_faces: tuple | None) -> Iterator[tuple]:
        """Iterate over `faces` and the values of each."""
        nothing = (None,) * len(self.faces)
        return zip(self.faces, *(values or nothing for values in of_faces), strict=True)

    def _take(self, values: Nodal, touch: Touch) -> Corners:
        sides = touch.face.sides is not None
        return jnp.concatenate([take(values, name, with_sides=sides) for name in touch.names], axis=-1)

    def tangent_laws(self, points: tuple, state: State, iterates: tuple, curvature: Array) -> tuple[TangentLaw, ...]:
        """Linearise contact."""
        return tuple(
            touch.face.tangent_law(at, touch.history(state.histories), iterate, curvature)
            for touch, at, iterate in self._each(points, iterates)
        )

    def follow(self, points: tuple, change: Nodal, state: State, laws: tuple) -> tuple[ContactIterate, ...]:
        """Update the contact iterate after a part of the step `change`."""
        return tuple(
            touch.face.follow(at, self._take(change, touch), touch.history(state.histories), law)
            for touch, at, law in self._each(points, laws)
        )

    def missed_gap(self, before: State, after: State) -> Array:
        """Compute the largest gap or penetration [mm] of hard contact after an increment."""
        gaps = self.contacts.map(
            lambda _, face, *histories: face.missed_gap(*histories), before.histories, after.histories
        )
        return jnp.max(jnp.stack([jnp.zeros_like(after.fraction), *jax.tree.leaves(gaps)]))

    def initial_iterates(self, state: State) -> tuple[ContactIterate, ...]:
        """Initialise the contact iterate from a converged state."""
        return tuple(touch.face.initial_iterate(touch.history(state.histories)) for touch in self.faces)

    def reactions(self, forces: Forces) -> Forces:
        """Add the reactions of prescribed displacements to the forces of window and sample."""
        prescribed = {"roller": (0, 0, 1), "uz": (0, 0, 1), "bonded": (1, 1, 1)}
        kinds = self.supports.interface, self.supports.window
        top, bottom = (np.array(prescribed.get(kind, (0, 0, 0)))[:, None, None] for kind in kinds)
        if not (top.any() or bottom.any()):  # reverse mode need not go through the internal force
            return forces
        unbalanced = self.unbalanced(forces)
        window, sample = forces.applied
        window = window._replace(face=window.face + bottom * unbalanced[:, 0])
        sample = sample._replace(face=sample.face + top * unbalanced[:, -1])
        return forces._replace(applied=Bodies(window, sample))

    def unbalanced(self, forces: Forces) -> Nodal:
        """Compute internal minus applied forces [N], supports left out."""
        unbalanced = forces.internal
        for body, touching in zip(Bodies._fields, forces.applied, strict=True):
            unbalanced = unbalanced - put(touching, body, unbalanced.shape)
        if forces.spring is not None:
            spring = jnp.concatenate([forces.spring, jnp.zeros_like(forces.spring[:1])])
            unbalanced = unbalanced - put(Touching(spring, None), "window", unbalanced.shape)
        return unbalanced

    def residual(self, forces: Forces, hold_active: Array) -> Unknowns:
        """Compute the unbalanced force [N] of the free unknowns, without the part that the hold balances."""
        return Unknowns(self.project(jnp.asarray(self.free) * self.unbalanced(forces), hold_active), forces.volume)

    @property
    def element_depth(self) -> Array:
        """Mean height of an element [mm]."""
        return self.body.cells.element_depth

    @property
    def typical_stiffness(self) -> Array:
        """A typical stiffness of a node [N/mm]."""
        hx, hy = self.body.cells.element_spacing
        return self.body.shear * hx * hy / self.body.cells.element_depth

    @property
    def stress_scale(self) -> Array:
        """Scale of mean stress over displacement in norms [MPa/mm]; times volume, a force."""
        return self.body.shear / self.body.cells.element_depth

    def force_scale(self, forces: Forces) -> Array:
        """Compute the force scale of the residual [N]."""
        applied = self.reactions(forces).applied
        contact = jnp.sum(applied.sample.face**2) + jnp.sum(applied.window.face**2)
        hx, hy = self.body.cells.element_spacing
        nodes = self.positions[0, 0].size
        # Lower bound of the scale: a thousandth of the shear modulus on the whole field.
        floor = 1e-3 * self.body.shear * hx * hy * np.sqrt(nodes)
        return jnp.sqrt(contact + floor**2)

    def project(self, r: Nodal, hold_active: Array) -> Nodal:
        """Project the rigid motions of the active hold out of a nodal field."""
        return without_rigid_part(self.drift_modes, r, hold_active)

    def without_drift(self, u: Nodal, hold_active: Array) -> Nodal:
        """Translate and rotate the body until its window face has no rigid motion of the active hold."""
        return without_drift(self.positions, self.drift_modes, self.supports, u, hold_active)

    def limited(self, change: Nodal, step_limit: float | int | Array) -> Nodal:
        """Limit the outliers of a step: displacements of single nodes."""
        reach = jnp.sqrt(jnp.sum(change**2, axis=0))
        thickness = self.elements[0] * self.element_depth
        longest = step_limit * thickness + 4.0 * jnp.mean(reach)
        return change * jnp.minimum(1.0, longest / jnp.where(reach > 0, reach, 1.0))

    def hold_force(self, forces: Forces, hold_active: Array) -> Float[Array, "2 my mx"]:
        """Compute the nodal force [N] of the in-plane hold on the layer's window face."""
        if forces.spring is not None:
            return forces.spring
        face = (jnp.asarray(self.free) * self.unbalanced(forces))[:2, 0]
        return jnp.where(hold_active, rigid_part(self.drift_modes, face), 0.0)

    def hold_balances(self, forces: Forces, state: State) -> tuple[HoldBalance]:
        """Compute the hold force, the friction that could replace it, and the normal force."""
        forces = self.reactions(forces)
        force = lateral_size(self.positions, self.hold_force(forces, state.hold_active))
        capacity = jnp.zeros((), force.dtype)
        for face, touching in zip(self.contacts, forces.applied, strict=True):
            if face is not None:
                capacity = capacity + face.contact.friction * jnp.abs(touching.total[2])
        return (HoldBalance(force, capacity, jnp.abs(forces.applied.sample.total[2])),)

    def tangent(
        self,
        x: Unknowns,
        fraction: Array,
        state: State,
        laws: tuple[TangentLaw, ...] | None = None,
        transposed: bool = False,
        points: tuple[FacePoints, ...] | None = None,
        coupling: Mapping[str, Array] = MappingProxyType({}),
        stress_scale: Array | None = None,
    ) -> Tangent:
        """Assemble the tangent, in float32.

        Args:
            x: Displacement [mm], and mean stress [MPa] where it is an unknown.
            fraction: Load fraction [-].
            state: Initial state of the increment.
            laws: Linearised contact laws; None: the tangent of the nonlinear ones.
            transposed: Whether to return the transposed tangent.
            points: `locate(x.u, fraction, state, bends=True)`, if computed before.
            coupling: Face matrices of contact with another body, for the preconditioner only [N/mm], by the names of
                `Bodies`.
            stress_scale: Scale of mean stress; None: that of this body.
        """
        u, mean_stress = x
        body, low_order = single(self.body), single(self.low_order or self.body)
        drag = single(self._drag(self.viscosity))
        K = low_order.cell_stiffness(single(u), single(mean_stress), more=drag * _LUMPED)
        pointwise = None if self.low_order is None else body.point_tangent(single(u))
        volume = None
        if mean_stress is not None:
            volume, stiffness = couple_volume(
                body, self.free, single(u), single(self.stress_scale if stress_scale is None else stress_scale)
            )
            K = K + stiffness
        faces = {}
        for name, matrices in coupling.items():
            K = add_matrices(K, single(matrices), name)
            faces[name] = -single(matrices)
        for touch, at, law in self._each(points or self.locate(u, fraction, state, bends=True), laws):
            both = single(touch.face.stiffness_matrices(at, touch.history(state.histories), law))
            for name, (exact, guard) in touch.split(both).items():
                K = add_matrices(K, guard, name)
                faces[name] = exact if pointwise is not None else exact - guard
        scale = self.typical_stiffness
        spring = jnp.zeros(()) if self.spring is None else jnp.sum(self.spring)
        support = jnp.zeros(())
        if self.spring is not None or any(self.supports.drifts):
            # Rigid motion must not make the preconditioner singular.
            support = 1e-3 * scale * self.positions[0, 0].size
            K = add_matrices(K, single(self._foundation(spring + support)), "window")
        shape = u.shape[1:]
        diagonal = -support * _window_share(shape)
        if pointwise is not None:
            diagonal = spring * _window_share(shape) + drag * _node_share(shape)
        free = self.free
        tangent = Tangent(
            multigrid=build_multigrid(K, None if free.all() else free, scale),
            faces=Bodies(**faces),
            diagonal=single(diagonal),
            free=None if free.all() else jnp.asarray(free, jnp.float32),
            cells=body.cells,
            points=pointwise,
            volume=volume,
        )
        return tangent.transposed() if transposed else tangent

    def precondition(self, tangent: Tangent, r: Unknowns, hold_active: Array) -> Unknowns:
        """Apply the preconditioner to a tangent system, without the rigid motions of the active hold."""
        # The hold acts on the window face, but constrains motion of the whole body.
        x = tangent.precondition(r)
        return x._replace(u=self.without_drift(x.u, hold_active))

    def _drag(self, viscosity: Array) -> Array:
        """Compute the viscous force per displacement from the last state [N/mm], by node."""
        return viscosity * self.body.shear * self.body.cells.element_depth

    def _foundation(self, stiffness: Array) -> Float[Array, "4 4 3 3 faces"]:
        """Spread an in-plane stiffness [N/mm] evenly over the faces at the window, lumped at nodes."""
        _, ny, nx = self.elements
        lumped = np.eye(4)[:, :, None, None] * np.diag([1.0, 1.0, 0.0])
        each = stiffness / (4.0 * nx * ny) * lumped[..., None]
        return jnp.broadcast_to(each, (4, 4, 3, 3, ny * nx))

    def advance(
        self,
        x: Unknowns,
        fraction: Array,
        state: State,
        hold_active: Array,
        forces: Forces,
        points: tuple[FacePoints, ...] | None = None,
    ) -> State:
        """Build the state at the end of an increment, friction history included.

        `points` is `locate(x.u, fraction)`, if computed before. The work of an increment is integrated by the
        trapezoidal rule.
        """
        u = x.u
        applied = self.reactions(forces).applied

        moved = u - state.u

        def work(body, before, after, so_far):
            own = touched(moved, body, with_sides=after.sides is not None)
            parts = jax.tree.map(lambda b, a, d: 0.5 * jnp.vdot(b + a, d), before, after, own)
            return sum(jax.tree.leaves(parts), start=so_far)

        histories = {}
        for touch, at in self._each(points or self.locate(u, fraction, state)):
            history = touch.face.advance(at, touch.history(state.histories))
            histories |= dict(zip(touch.names, separate_histories(history, len(touch.names)), strict=True))
        return State(
            u=u,
            mean_stress=x.mean_stress,
            fraction=jnp.asarray(fraction, u.dtype),
            histories=Bodies(**histories),
            hold_active=hold_active,
            applied=applied,
            work=state.applied.map(work, applied, state.work),
        )

    def _corners(self, values: Nodal, body: Body) -> Corners:
        return take(values, body, with_sides=getattr(self.contacts, body).sides is not None)

    def with_imposed(self, u: Nodal, fraction: Array) -> Nodal:
        """Set the prescribed displacements."""
        u = u * self.free
        if self.imposed is None:
            return u
        uz = (1.0 - fraction) * self.imposed[0] + fraction * self.imposed[1]
        top = jnp.concatenate([u[:2, -1], uz[None]])
        return jnp.concatenate([u[:, :-1], top[:, None]], axis=1)

    def initial_state(self) -> State:
        """Build the undeformed state at load fraction zero."""
        histories = self.contacts.map(lambda body, face: face.initial_history(self._corners(self.positions, body)))
        u = jnp.zeros_like(self.positions)
        mean_stress = jnp.zeros(self.elements, u.dtype) if self.body.form == "hybrid" else None
        zero = jnp.zeros((), u.dtype)
        nothing = self.contacts.map(lambda body, _: to_touching(0.0 * self._corners(u, body), self.elements))
        applied = Bodies(*(touching or Touching(u[:, 0], None) for touching in nothing))
        return State(u, mean_stress, zero, histories, jnp.asarray(True), applied, Bodies(zero, zero))


# Every corner's share of its element, as an element matrix.
_LUMPED = (np.eye(8)[:, :, None, None] / 8.0 * np.eye(3)).astype(np.float32)


def _node_share(shape: tuple[int, ...]) -> np.ndarray:
    """Compute the number of elements per node, `_LUMPED` assembled: 1 inside, half on a face."""
    z, y, x = (np.where(np.isin(np.arange(n), (0, n - 1)), 0.5, 1.0) for n in shape)
    return z[:, None, None] * y[:, None] * x


def _window_share(shape: tuple[int, ...]) -> np.ndarray:
    """Compute each node's share of the window face along x and y, `(3, *shape)`, of sum 1 each."""
    share = np.zeros((3, *shape))
    share[:2, 0] = 2.0 * _node_share(shape)[0]
    return share / ((shape[1] - 1) * (shape[2] - 1))


def single(tree: Any) -> Any:
    """Convert every floating-point number to float32."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf, tree)
