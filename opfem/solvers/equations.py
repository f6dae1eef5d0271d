"""Interface of the equations that Newton's method solves: states, residuals, tangents, and the in-plane hold.

A problem is one body between rigid surfaces (`equilibrium`), or a stack of bodies in contact with each other (`stack`).
Displacements are PyTrees: an array of nodes, or a tuple of them, one for each body.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .in_plane_hold import HoldBalance
from .tangent import AbstractTangent, Unknowns


class State(eqx.Module):
    """A converged state with its friction history; in a stack, tuples over bodies.

    Attributes:
        u: Displacement [mm].
        mean_stress: Mean stress of the elements [MPa] where it is an independent unknown (`hybrid`), else None.
        fraction: Load fraction [-].
        histories: Friction history (`SlipHistory`) of the contact with each rigid body; in a stack, that of the
            contact between the bodies last.
        hold_active: Whether the in-plane hold constrains rigid motion.
        applied: Forces of the contacts and loads of each body (`Touching`) [N].
        work: Their work on the body since the start [N mm].
    """

    u: PyTree
    mean_stress: PyTree
    fraction: Float[Array, ""]
    histories: Any
    hold_active: Array
    applied: Any
    work: Any

    @property
    def unknowns(self) -> Unknowns:
        """What Newton's method solves for."""
        return Unknowns(self.u, self.mean_stress)


class AbstractProblem(eqx.Module):
    """A discrete problem, at load fractions from 0 (start) to 1 (end).

    Attributes:
        viscosity: Viscous regularisation during a snap-through [-], else 0.
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
        """Scale of mean stress over displacement in norms [MPa/mm]; times volume, a force."""
        raise NotImplementedError

    def own_forces(self, x: Unknowns, state: State) -> Any:
        """Compute internal, viscous and hold-spring forces [N], without applied ones."""
        raise NotImplementedError

    def locate(self, u: PyTree, fraction: Array, state: State, bends: bool = False) -> tuple:
        """Locate the points of all contacts; evaluate the surfaces there, `bends` to second order."""
        raise NotImplementedError

    def with_contact(self, forces: Any, points: tuple, fraction: Array, state: State, laws: tuple | None = None) -> Any:
        """Replace the applied forces by those of linearised contact laws; None: of the nonlinear laws."""
        raise NotImplementedError

    def residual(self, forces: Any, hold_active: Array) -> Unknowns:
        """Compute the unbalanced force [N] of the free unknowns, without the part that the hold balances."""
        raise NotImplementedError

    def project(self, r: PyTree, hold_active: Array) -> PyTree:
        """Project the rigid motions of the active hold out of a nodal field."""
        raise NotImplementedError

    def tangent_laws(self, points: tuple, state: State, iterates: tuple, curvature: Array) -> tuple:
        """Linearise contact."""
        raise NotImplementedError

    def follow(self, points: tuple, change: PyTree, state: State, laws: tuple) -> tuple:
        """Update the contact iterate after a part of the step `change`."""
        raise NotImplementedError

    def initial_state(self) -> State:
        """Build the undeformed state at load fraction zero."""
        raise NotImplementedError

    def initial_iterates(self, state: State) -> tuple:
        """Initialise the contact iterate from a converged state."""
        raise NotImplementedError

    def missed_gap(self, before: State, after: State) -> Array:
        """Compute the largest gap or penetration [mm] of hard contact after an increment."""
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
        """Assemble the tangent, in float32: it only has to reduce the residual, which is float64.

        Args:
            x: Displacement [mm], and mean stress [MPa] where it is an unknown.
            fraction: Load fraction [-].
            state: Initial state of the increment.
            laws: Linearised contact laws; None: the tangent of the nonlinear ones.
            transposed: Whether to return the transposed tangent.
            points: `locate(x.u, fraction, state, bends=True)`, if computed before.
        """
        raise NotImplementedError

    def precondition(self, tangent: Any, r: Unknowns, hold_active: Array) -> Unknowns:
        """Apply the preconditioner to a tangent system, without the rigid motions of the active hold."""
        raise NotImplementedError

    def advance(
        self, x: Unknowns, fraction: Array, state: State, hold_active: Array, forces: Any, points: tuple | None = None
    ) -> State:
        """Build the state at the end of an increment, friction history included.

        `points` is `locate(x.u, fraction, state)`, if computed before. The work of an increment is integrated by the
        trapezoidal rule.
        """
        raise NotImplementedError

    def force_scale(self, forces: Any) -> Array:
        """Compute the force scale of the residual [N]."""
        raise NotImplementedError

    def limited(self, change: PyTree, step_limit: float | int | Array) -> PyTree:
        """Limit the outliers of a step: displacements of single nodes."""
        raise NotImplementedError

    def hold_balances(self, forces: Any, state: State) -> Sequence[HoldBalance]:
        """Compute the hold force of each body, the friction that could replace it, and the normal force."""
        raise NotImplementedError

    def without_drift(self, u: PyTree, hold_active: Array) -> PyTree:
        """Translate and rotate bodies until they have no rigid motion of the active hold."""
        raise NotImplementedError

    def with_imposed(self, u: PyTree, fraction: Array) -> PyTree:
        """Set the prescribed displacements."""
        raise NotImplementedError

    def forces(self, x: Unknowns, fraction: Array, state: State) -> Any:
        """Compute internal and applied nodal forces [N]."""
        return self.with_contact(self.own_forces(x, state), self.locate(x.u, fraction, state), fraction, state)

    def admissible(self, u: PyTree, hold_active: Array) -> PyTree:
        """Project a step onto free unknowns without rigid motions of the active hold."""
        return jax.tree.map(jnp.multiply, self.project(u, hold_active), self.free)

    def inside(self, r: Unknowns, hold_active: Array) -> Unknowns:
        """Project a residual onto free unknowns without rigid motions of the active hold."""
        return r._replace(
            u=self.project(jax.tree.map(jnp.multiply, jax.tree.map(jnp.asarray, self.free), r.u), hold_active)
        )

    def balance(
        self, x: Unknowns, fraction: Array, state: State, hold_active: Array, own: Any | None = None
    ) -> Unknowns:
        """Compute the equilibrium equations, as many as unknowns [N].

        The residual of the free unknowns; a penalty on the deviation from the prescribed value for the others, and from
        the last state for rigid motion of the active hold. `own` are the forces of `own_forces`, if computed before.
        """
        points = self.locate(x.u, fraction, state)
        residual = self.residual(
            self.with_contact(own or self.own_forces(x, state), points, fraction, state), hold_active
        )

        def off(free, u, before, placed):
            free = jnp.asarray(free)
            return free * (u - before) + (1.0 - free) * (u - placed)

        misplaced = jax.tree.map(off, self.free, x.u, state.u, self.with_imposed(x.u, fraction))
        moved = self.inside(Unknowns(misplaced), hold_active).u
        k = self.typical_stiffness
        return residual._replace(u=jax.tree.map(lambda r, off, d: r + k * (off - d), residual.u, misplaced, moved))

    def size(self, r: Unknowns) -> Array:
        """Compute the Euclidean norm of a residual [N]."""
        parts = jax.tree.leaves(r.scaled(self.stress_scale))
        return jnp.sqrt(sum((jnp.vdot(part, part) for part in parts), start=jnp.zeros((), parts[0].dtype)))
