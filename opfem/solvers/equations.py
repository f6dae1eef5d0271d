"""The equations that Newton's method solves, whatever bodies they are of: states, residuals, and what is held.

A problem is one body between rigid surfaces (`equilibrium`), or a stack of bodies in contact with each other (`stack`).
Displacements are PyTrees: an array of nodes, or a tuple of them, one for each body.
"""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .tangent import AbstractTangent, Unknowns


class State(eqx.Module):
    """A converged state, with the history that the next increment starts from; in a stack, tuples over bodies.

    Attributes:
        u: Displacement [mm].
        mean_stress: Mean stress of the elements [MPa] where it is an unknown of its own (`hybrid`), else None.
        fraction: Load fraction [-].
        histories: Friction history (`SlipHistory`) of the contact with each rigid body; in a stack, that of the
            contact between the bodies last.
        held: Whether the in-plane hold carries rigid motion.
        applied: Forces of what touches each body (`Touching`) [N].
        work: Their work on the body so far [N mm].
    """

    u: PyTree
    mean_stress: PyTree
    fraction: Float[Array, ""]
    histories: Any
    held: Array
    applied: Any
    work: Any

    @property
    def unknowns(self) -> Unknowns:
        """What Newton's method solves for."""
        return Unknowns(self.u, self.mean_stress)


class HoldBalance(NamedTuple):
    """What the in-plane hold carries of one body, what friction could, and the normal force on it [N]."""

    carried: Array
    capacity: Array
    normal: Array


class AbstractProblem(eqx.Module):
    """A discrete problem, at load fractions from 0 (start) to 1 (end).

    Attributes:
        viscosity: Of the medium that slows bodies on their way through a snap [-], else 0.
        left_transpose: Whether the transposed tangent is preconditioned from the left (`solve_tangent`).
    """

    viscosity: eqx.AbstractVar[Array]
    left_transpose: ClassVar[bool] = True

    @property
    def free(self) -> PyTree:
        """Mask of the unknowns, 1 where free."""
        raise NotImplementedError

    @property
    def element_depth(self) -> Array:
        """Mean height of an element [mm]."""
        raise NotImplementedError

    @property
    def typical_stiffness(self) -> Array:
        """A typical stiffness of a node [N/mm]."""
        raise NotImplementedError

    @property
    def stress_scale(self) -> Array:
        """Mean stress that weighs as much as a displacement of 1 mm [MPa/mm]; times volume, a force."""
        raise NotImplementedError

    def own_forces(self, x: Unknowns, state: State) -> Any:
        """Compute the forces of bodies, medium and spring [N], none applied."""
        raise NotImplementedError

    def locate(self, u: PyTree, fraction: Array, state: State, bends: bool = False) -> tuple:
        """Locate the points of all contacts; evaluate the surfaces there, `bends` to second order."""
        raise NotImplementedError

    def with_contact(self, forces: Any, points: tuple, fraction: Array, state: State, laws: tuple | None = None) -> Any:
        """Replace the applied forces by those of linearised contact laws; without, the contact's own."""
        raise NotImplementedError

    def residual(self, forces: Any, held: Array) -> Unknowns:
        """Compute the unbalanced force [N] of the free unknowns, the hold's share taken out."""
        raise NotImplementedError

    def project(self, r: PyTree, held: Array) -> PyTree:
        """Take the held rigid motions out of a nodal field."""
        raise NotImplementedError

    def tangent_laws(self, points: tuple, state: State, iterates: tuple, curvature: Array) -> tuple:
        """Linearise contact."""
        raise NotImplementedError

    def follow(self, points: tuple, change: PyTree, state: State, laws: tuple) -> tuple:
        """Compute what the next iteration remembers once a part of the step `change` is taken."""
        raise NotImplementedError

    def initial_state(self) -> State:
        """Build the undeformed state at load fraction zero."""
        raise NotImplementedError

    def initial_iterates(self, state: State) -> tuple:
        """Start the iteration from the contact of a converged state."""
        raise NotImplementedError

    def missed_gap(self, before: State, after: State) -> Array:
        """Compute the largest gap or penetration [mm] that an increment left to hard contact."""
        raise NotImplementedError

    def tangent(
        self,
        x: Unknowns,
        fraction: Array,
        state: State,
        laws: tuple | None = None,
        transposed: bool = False,
        points: tuple | None = None,
    ) -> AbstractTangent:
        """Assemble the tangent, in float32: it only has to shorten the residual, which is float64.

        Args:
            x: Displacement [mm], and mean stress [MPa] where it is an unknown.
            fraction: Load fraction [-].
            state: Where the increment started.
            laws: Linearised contact laws; None for the contact's own.
            transposed: Whether to return the transposed tangent.
            points: `locate(x.u, fraction, state, bends=True)`, where that is known.
        """
        raise NotImplementedError

    def precondition(self, tangent: Any, r: Unknowns, held: Array) -> Unknowns:
        """Approximate the solution of a tangent system, without the held rigid motions."""
        raise NotImplementedError

    def advance(
        self, x: Unknowns, fraction: Array, state: State, held: Array, forces: Any, points: tuple | None = None
    ) -> State:
        """Build the state at the end of an increment, friction history included.

        `points` is `locate(x.u, fraction, state)`, where that is known.
        The work of an increment is taken as if forces changed linearly along it.
        """
        raise NotImplementedError

    def force_scale(self, forces: Any) -> Array:
        """Compute the size of the forces [N] that the residual is measured against."""
        raise NotImplementedError

    def limited(self, change: PyTree, step_limit: float | int | Array) -> PyTree:
        """Shorten the moves of single nodes that stand out of a step."""
        raise NotImplementedError

    def hold_balances(self, forces: Any, state: State) -> Sequence[HoldBalance]:
        """Compare what the hold carries of each body with what friction could, and with the normal force."""
        raise NotImplementedError

    def without_drift(self, u: PyTree, held: Array) -> PyTree:
        """Move bodies as a whole so that they have none of the held rigid motions where these are held."""
        raise NotImplementedError

    def with_imposed(self, u: PyTree, fraction: Array) -> PyTree:
        """Set the prescribed displacements."""
        raise NotImplementedError

    def forces(self, x: Unknowns, fraction: Array, state: State) -> Any:
        """Compute internal and applied nodal forces [N]."""
        return self.with_contact(self.own_forces(x, state), self.locate(x.u, fraction, state), fraction, state)

    def admissible(self, u: PyTree, held: Array) -> PyTree:
        """Take held rigid motions and prescribed displacements out of a step."""
        return jax.tree.map(jnp.multiply, self.project(u, held), self.free)

    def inside(self, r: Unknowns, held: Array) -> Unknowns:
        """Take supports and held rigid motions out of a residual."""
        return r._replace(u=self.project(jax.tree.map(jnp.multiply, jax.tree.map(jnp.asarray, self.free), r.u), held))

    def balance(self, x: Unknowns, fraction: Array, state: State, held: Array, own: Any | None = None) -> Unknowns:
        """Compute the equations that a converged displacement fulfils, as many as unknowns [N].

        The residual of the free unknowns; a spring to the prescribed value for the others, and to the
        last state for the rigid motion that is held. `own` are the bodies' own forces where they are known.
        """
        points = self.locate(x.u, fraction, state)
        residual = self.residual(self.with_contact(own or self.own_forces(x, state), points, fraction, state), held)

        def off(free, u, before, placed):
            free = jnp.asarray(free)
            return free * (u - before) + (1.0 - free) * (u - placed)

        misplaced = jax.tree.map(off, self.free, x.u, state.u, self.with_imposed(x.u, fraction))
        moved = self.inside(Unknowns(misplaced), held).u
        k = self.typical_stiffness
        return residual._replace(u=jax.tree.map(lambda r, off, d: r + k * (off - d), residual.u, misplaced, moved))

    def size(self, r: Unknowns) -> Array:
        """Compute the Euclidean norm of a residual [N]."""
        parts = jax.tree.leaves(r.scaled(self.stress_scale))
        return jnp.sqrt(sum((jnp.vdot(part, part) for part in parts), start=jnp.zeros((), parts[0].dtype)))
