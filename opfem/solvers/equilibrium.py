"""The discrete problem: residual, tangent and supports of a palpation under one load.

Everything a Newton step needs, with the load fraction as a number from 0 (start) to 1 (end) and
the friction history of the last converged increment.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics.face import tributary_area
from ..mechanics.interaction import ContactFace, ContactIterate, SlipHistory, TangentLaw
from ..mechanics.internal import LayerBody
from ..model.palpation import SIDES
from .stencil import Nodal, Stencil, assemble_stencil, held, with_unit_diagonal


class Supports(NamedTuple):
    """Which displacements are prescribed: static, so that it shapes the compiled solve."""

    window: str  # "contact", "roller" or "bonded"
    interface: str  # "contact", "traction", "uz" or "bonded"
    sides: tuple[str, str, str, str]
    spring: bool  # an in-plane spring holds the window face

    def free(self, node_shape: tuple[int, ...]) -> np.ndarray:
        """Build the mask of unknowns, 1 where free, `(3, nz+1, ny+1, nx+1)`."""
        free = np.ones((3, *node_shape))
        for side, kind in zip(SIDES, self.sides, strict=True):
            if kind == "roller":
                component, where = ("x", "y").index(side[0]), 0 if side[1] == "0" else -1
                free[(component, ..., where) if component == 0 else (component, slice(None), where)] = 0.0
        for kind, layer in ((self.window, 0), (self.interface, -1)):
            if kind in ("roller", "uz"):
                free[2, layer] = 0.0
            if kind == "bonded":
                free[:, layer] = 0.0
        return free

    @property
    def drifts(self) -> tuple[bool, bool, bool]:
        """Rigid in-plane motions that only friction resists: along x, along y, about z."""
        if self.spring or "bonded" in (self.window, self.interface):
            return (False, False, False)
        x = "roller" not in self.sides[:2]
        y = "roller" not in self.sides[2:]
        return (x, y, x and y)


class State(eqx.Module):
    """A converged state, with the history that the next increment starts from.

    Attributes:
        u: Displacement [mm].
        fraction: Load fraction [-].
        window: Friction history at the window, or None.
        sample: Friction history at the interface, or None.
        held: Whether the in-plane hold carries rigid motion.
    """

    u: Nodal
    fraction: Float[Array, ""]
    window: SlipHistory | None
    sample: SlipHistory | None
    held: Array


class Forces(NamedTuple):
    """Nodal forces on the layer [N] at one state, and the smallest volume ratio."""

    internal: Nodal
    sample: Float[Array, "3 my mx"]
    window: Float[Array, "3 my mx"]
    spring: Float[Array, "2 my mx"] | None
    smallest_J: Array


class TangentLaws(NamedTuple):
    """Linearised contact laws; None where the face has none, or to take its own law."""

    window: TangentLaw | None
    sample: TangentLaw | None


class ContactIterates(NamedTuple):
    """What a Newton iteration remembers of both faces; None where a face is not in contact."""

    window: ContactIterate | None
    sample: ContactIterate | None


class Problem(eqx.Module):
    """A palpation and its load, discretised."""

    body: LayerBody
    positions: Nodal
    window: ContactFace | None
    sample: ContactFace | None
    dead: tuple[Array, Array] | None  # nodal force at the interface [N], at fraction 0 and 1
    imposed: tuple[Array, Array] | None  # u_z at the interface [mm], at fraction 0 and 1
    spring: Array | None  # in-plane stiffness under each node of the window face [N/mm]
    supports: Supports = eqx.field(static=True)

    @property
    def free(self) -> np.ndarray:
        """Mask of the unknowns, 1 where free."""
        return self.supports.free(self.positions.shape[1:])

    def forces(self, u: Nodal, fraction: Array, state: State) -> Forces:
        """Compute internal and applied nodal forces [N]."""
        internal, smallest_J = self.body.internal_force(u)
        spring = None if self.spring is None else -self.spring * u[:2, 0]
        forces = Forces(internal, internal[:, -1], internal[:, 0], spring, smallest_J)
        return self.with_contact(forces, u, fraction, state, TangentLaws(None, None))

    def with_contact(self, forces: Forces, u: Nodal, fraction: Array, state: State, laws: TangentLaws) -> Forces:
        """Replace the applied forces by those of the given laws; None means the contact's own."""
        internal = forces.internal
        sample = jnp.zeros_like(internal[:, -1])
        window = jnp.zeros_like(internal[:, 0])
        if self.sample is not None and state.sample is not None:
            sample = self.sample.force(fraction, self.positions[:, -1] + u[:, -1], state.sample, laws.sample)
        if self.dead is not None:
            sample = sample + (1.0 - fraction) * self.dead[0] + fraction * self.dead[1]
        if self.window is not None and state.window is not None:
            window = self.window.force(fraction, self.positions[:, 0] + u[:, 0], state.window, laws.window)
        return forces._replace(sample=sample, window=window)

    def tangent_laws(
        self, u: Nodal, fraction: Array, state: State, iterates: ContactIterates, curvature: Array
    ) -> TangentLaws:
        """Linearise contact on both faces."""
        laws = [
            None
            if face is None
            else face.tangent_law(fraction, self.positions[:, layer] + u[:, layer], history, iterate, curvature)
            for face, history, iterate, layer in self._faces(state, iterates)
        ]
        return TangentLaws(*laws)

    def follow(
        self, u: Nodal, change: Nodal, fraction: Array, state: State, laws: TangentLaws, length: Array
    ) -> ContactIterates:
        """Compute what the next iteration remembers after a step of `length` along `change`."""
        iterates = [
            None
            if face is None
            else face.follow(fraction, self.positions[:, layer] + u[:, layer], change[:, layer], history, law, length)
            for face, history, law, layer in self._faces(state, laws)
        ]
        return ContactIterates(*iterates)

    def initial_iterates(self, state: State) -> ContactIterates:
        """Start the iteration from the contact of a converged state."""
        return ContactIterates(
            *(
                None if face is None else face.initial_iterate(history)
                for face, history, _, _ in self._faces(state, (None, None))
            )
        )

    def _faces(self, state: State, each: tuple) -> tuple[tuple[ContactFace | None, Any, Any, int], ...]:
        return ((self.window, state.window, each[0], 0), (self.sample, state.sample, each[1], -1))

    def reactions(self, forces: Forces) -> Forces:
        """Add the reactions of prescribed displacements to the forces of window and sample."""
        unbalanced = self._unbalanced(forces)
        prescribed = {
            "contact": (0, 0, 0),
            "traction": (0, 0, 0),
            "roller": (0, 0, 1),
            "uz": (0, 0, 1),
            "bonded": (1, 1, 1),
        }
        top, bottom = (
            np.array(prescribed[kind])[:, None, None] for kind in (self.supports.interface, self.supports.window)
        )
        return forces._replace(
            sample=forces.sample + top * unbalanced[:, -1], window=forces.window + bottom * unbalanced[:, 0]
        )

    def _unbalanced(self, forces: Forces) -> Nodal:
        nz = forces.internal.shape[1] - 1
        window = forces.window
        if forces.spring is not None:
            window = window + jnp.concatenate([forces.spring, jnp.zeros_like(forces.spring[:1])])
        applied = jnp.concatenate(
            [window[:, None], jnp.zeros_like(forces.internal[:, 1:nz]), forces.sample[:, None]], axis=1
        )
        return forces.internal - applied

    def residual(self, forces: Forces, held: Array) -> Nodal:
        """Compute the unbalanced force [N] of the free unknowns, the hold's share taken out."""
        return self.project(jnp.asarray(self.free) * self._unbalanced(forces), held)

    def force_scale(self, forces: Forces) -> Array:
        """Compute the size of the forces [N] that the residual is measured against."""
        forces = self.reactions(forces)
        applied = jnp.sum(forces.sample**2) + jnp.sum(forces.window**2)
        hx, hy = self.body.geometry.spacing
        nodes = self.positions[0, 0].size
        # Below a thousandth of the shear modulus on the whole field, forces count as none.
        floor = 1e-3 * self.body.material.shear * hx * hy * np.sqrt(nodes)
        return jnp.sqrt(applied + floor**2)

    def drift_modes(self) -> list[Float[Array, "2 my mx"]]:
        """Build orthonormal rigid motions of the window face that no support prevents.

        Weighted by area: what they measure is the mean in-plane motion of the face.
        """
        X = self.positions[:2, 0]
        area = tributary_area(self.positions[:, 0])
        centred = X - jnp.sum(area * X, axis=(1, 2), keepdims=True) / jnp.sum(area)
        zero = jnp.zeros_like(area)
        candidates = (jnp.stack([area, zero]), jnp.stack([zero, area]), area * jnp.stack([-centred[1], centred[0]]))
        modes: list[Array] = []
        for drifts, mode in zip(self.supports.drifts, candidates, strict=True):
            if drifts:
                for other in modes:
                    mode = mode - jnp.sum(mode * other) * other
                modes.append(mode / jnp.sqrt(jnp.sum(mode**2)))
        return modes

    def project(self, r: Nodal, held: Array) -> Nodal:
        """Take the held rigid motions out of a nodal field."""
        face = r[:2, 0]
        for mode in self.drift_modes():
            face = face - jnp.where(held, jnp.sum(mode * face), 0.0) * mode
        bottom = jnp.concatenate([face, r[2:, 0]])
        return jnp.concatenate([bottom[:, None], r[:, 1:]], axis=1)

    def hold_force(self, forces: Forces, held: Array) -> Float[Array, "2 my mx"]:
        """Compute the nodal force [N] of the in-plane hold on the layer's window face."""
        if forces.spring is not None:
            return forces.spring
        unbalanced = (self.free * self._unbalanced(forces))[:2, 0]
        modes = self.drift_modes()
        if not modes:
            return jnp.zeros_like(unbalanced)
        return jnp.sum(jnp.stack([jnp.where(held, jnp.sum(mode * unbalanced), 0.0) * mode for mode in modes]), axis=0)

    def tangent(self, u: Nodal, fraction: Array, state: State, laws: TangentLaws) -> tuple[Stencil, Array, Array]:
        """Assemble the tangent, in float32: it only has to shorten the residual, which is float64.

        Returns:
            The exact stencil [N/mm], the guarded element matrices for the preconditioner, and
            a typical stiffness.
        """
        K = guarded = _single(self.body).stiffness(_single(u))
        for face, history, law, layer in self._faces(state, laws):
            if face is not None:
                exact, guard = face.stiffness_matrices(fraction, self.positions[:, layer] + u[:, layer], history, law)
                K = _add_face(K, _single(exact), layer)
                guarded = _add_face(guarded, _single(guard), layer)
        hx, hy = self.body.geometry.spacing
        depth = jnp.mean(self.body.geometry.depth)
        scale = self.body.material.shear * hx * hy / depth
        if self.spring is not None:
            K = _add_face(K, _single(self._foundation(jnp.sum(self.spring))), 0)
        if self.spring is not None or any(self.supports.drifts):
            # Rigid motion must not make the preconditioner singular.
            guarded = _add_face(guarded, _single(self._foundation(1e-3 * scale * self.positions[0, 0].size)), 0)
        free = self.free
        if not free.all():
            K = held(K, jnp.asarray(free))
        return with_unit_diagonal(assemble_stencil(K), scale), guarded, scale

    def _foundation(self, stiffness: Array) -> Float[Array, "4 4 3 3 ny nx"]:
        """Spread an in-plane stiffness [N/mm] evenly over the faces at the window, lumped at nodes."""
        ny, nx = (n - 1 for n in self.positions.shape[2:])
        lumped = np.eye(4)[:, :, None, None] * np.diag([1.0, 1.0, 0.0])
        each = stiffness / (4.0 * nx * ny) * lumped[..., None, None]
        return jnp.broadcast_to(each, (4, 4, 3, 3, ny, nx))

    def advance(self, u: Nodal, fraction: Array, state: State, held: Array) -> State:
        """Build the state at the end of an increment, friction history included."""
        window = sample = None
        if self.window is not None and state.window is not None:
            window = self.window.advance(fraction, self.positions[:, 0] + u[:, 0], state.window)
        if self.sample is not None and state.sample is not None:
            sample = self.sample.advance(fraction, self.positions[:, -1] + u[:, -1], state.sample)
        return State(u, jnp.asarray(fraction, u.dtype), window, sample, held)

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
        window = None if self.window is None else self.window.initial_history(self.positions[:, 0])
        sample = None if self.sample is None else self.sample.initial_history(self.positions[:, -1])
        u = jnp.zeros_like(self.positions)
        return State(u, jnp.zeros((), u.dtype), window, sample, jnp.asarray(True))


def _single(tree: Any) -> Any:
    """Turn every floating-point number into float32."""
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf, tree)


def _add_face(K: Array, face: Array, layer: int) -> Array:
    """Add face matrices `(4, 4, 3, 3, ny, nx)` to the bottom (0) or top (-1) element nodes."""
    first = 0 if layer == 0 else 4
    at = (0 if layer == 0 else K.shape[0] - 1, first, first, 0, 0, 0, 0)
    block = jax.lax.dynamic_slice(K, at, (1, *face.shape))
    return jax.lax.dynamic_update_slice(K, block + face[None], at)
