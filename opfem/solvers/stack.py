"""The discrete problem of two deformable bodies in contact with each other, each with its rigid surfaces.

Block Gauss–Seidel preconditions the linear systems body by body: the lower one with the full contact stiffness, exact
at the quadrature points of its face; then the upper one with nearly none. Column blocks through both bodies would lose
their structure once the bodies slide.
"""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ..mechanics.boundary import Touching, put, take, to_touching
from ..mechanics.contact_pair import ContactPair, PairForce
from .equations import AbstractProblem, State
from .equilibrium import Forces, Problem, single
from .in_plane_hold import HoldBalance
from .stencil import Nodal
from .tangent import Tangent, Unknowns

# V-cycles of the lower body for one of the upper one: the residual of stiff contact after one dominates the soft
# contact stiffness of the upper body. On 12×12×(2+6) elements with the exponential law and friction 0.05, one cycle,
# three without frictional coupling, and three with it take 96, 77 and 24 iterations per Newton step.
_LOWER_CYCLES = 3

UpperNodal = Float[Array, "3 uz uy ux"]


class StackForces(NamedTuple):
    """Nodal forces [N] on both bodies, lower first."""

    bodies: tuple[Forces, ...]

    @property
    def own(self) -> Unknowns:
        """Internal forces [N] and volume residual, the derivative of an energy."""
        return Unknowns(tuple(f.internal for f in self.bodies), tuple(f.volume for f in self.bodies))

    def with_own(self, own: Unknowns) -> "StackForces":
        """Replace them."""
        bodies = zip(self.bodies, own.u, own.mean_stress, strict=True)
        return StackForces(tuple(f.with_own(Unknowns(u, stress)) for f, u, stress in bodies))

    @property
    def smallest_J(self) -> Array:
        """Smallest volume ratio of both bodies."""
        return jnp.minimum(self.bodies[0].smallest_J, self.bodies[1].smallest_J)


class Stack(AbstractProblem):
    """A lower body, an upper one, and the contact between them.

    Attributes:
        lower: The lower body; its upper face, "sample", is in contact with the upper body.
        upper: The upper body; its lower face, "window", is in contact with the lower body.
        pair: The contact between them.
        viscosity: Viscous regularisation during a snap-through [-], else 0.
    """

    lower: Problem
    upper: Problem
    pair: ContactPair
    viscosity: Array
    left_transpose: ClassVar[bool] = False

    @property
    def bodies(self) -> tuple[Problem, Problem]:
        """The bodies, lower first, with the viscosity."""
        lower, upper = (eqx.tree_at(lambda b: b.viscosity, b, self.viscosity) for b in (self.lower, self.upper))
        return lower, upper

    @property
    def free(self) -> tuple:
        """Mask of the unknowns of each body, 1 where free."""
        return self.lower.free, self.upper.free

    @property
    def element_depth(self) -> Array:
        """Mean height of an element of the lower body [mm]."""
        return self.lower.element_depth

    @property
    def typical_stiffness(self) -> Array:
        """A typical stiffness of a node of the lower body [N/mm]."""
        return self.lower.typical_stiffness

    @property
    def stress_scale(self) -> Array:
        """Scale of mean stress over displacement in norms [MPa/mm]; times volume, a force."""
        return self.lower.stress_scale

    def holds(self, hold_active: Array) -> tuple[Array, Array]:
        """Return whether the hold of each body is active, from whether that of the stack is.

        Friction between the bodies cannot constrain both: without friction at window and plate the hold of the lower
        body remains active.
        """
        if self.lower.drift_modes is None or self.upper.drift_modes is None:
            return hold_active, hold_active
        ends = [face for face in (self.lower.contacts.window, self.upper.contacts.sample) if face is not None]
        rubs = [face.own_contact.friction > 0 for face in ends]
        return hold_active | ~jnp.any(jnp.stack([jnp.asarray(False), *rubs])), hold_active

    def own_forces(self, x: Unknowns, state: State) -> StackForces:
        """Compute internal, viscous and hold-spring forces [N], without applied ones."""
        return StackForces(tuple(body.own_forces(own, at) for body, own, at in self._each(x, state)))

    def locate(self, u: PyTree, fraction: Array, state: State, bends: bool = False) -> tuple:
        """Locate the points of all contacts: of each body with its rigid surfaces, and between the bodies."""
        own = [body.locate(v, fraction, at, bends) for body, v, at in zip(self.bodies, u, parts(state), strict=True)]
        pair = self.pair.locate(fraction, self._lower_corners(u), self._upper_nodes(u), state.histories[2])
        return (*own, pair)

    def with_contact(
        self, forces: StackForces, points: tuple, fraction: Array, state: State, laws: tuple | None = None
    ) -> StackForces:
        """Replace the applied forces by those of linearised contact laws; None: of the nonlinear laws."""
        laws = laws or (None, None, None)
        own = [
            body.with_contact(f, at, fraction, before, law)
            for body, f, at, before, law in zip(
                self.bodies, forces.bodies, points[:2], parts(state), laws[:2], strict=True
            )
        ]
        between = self.pair.force(points[2], forces.bodies[1].internal[:, 0], state.histories[2], laws[2])
        lower = Touching(to_touching(between.lower, self.lower.elements).face, None)
        return StackForces((_touched(own[0], sample=lower), _touched(own[1], window=Touching(between.upper, None))))

    def tangent_laws(self, points: tuple, state: State, iterates: tuple, curvature: Array) -> tuple:
        """Linearise contact."""
        own = [
            body.tangent_laws(at, before, iterate, curvature)
            for body, at, before, iterate in zip(self.bodies, points[:2], parts(state), iterates[:2], strict=True)
        ]
        return (*own, self.pair.tangent_law(points[2], state.histories[2], iterates[2], curvature))

    def follow(self, points: tuple, change: PyTree, state: State, laws: tuple) -> tuple:
        """Update the contact iterate after a part of the step `change`."""
        own = [
            body.follow(at, step, before, law)
            for body, at, step, before, law in zip(self.bodies, points[:2], change, parts(state), laws[:2], strict=True)
        ]
        corners, upper = take(change[0], "sample", with_sides=False), change[1][:, 0]
        return (*own, self.pair.follow(points[2], corners, upper, state.histories[2], laws[2]))

    def initial_iterates(self, state: State) -> tuple:
        """Initialise the contact iterate from a converged state."""
        own = [body.initial_iterates(before) for body, before in zip(self.bodies, parts(state), strict=True)]
        return (*own, self.pair.face.initial_iterate(state.histories[2]))

    def missed_gap(self, before: State, after: State) -> Array:
        """Compute the largest gap or penetration [mm] of hard contact after an increment."""
        gaps = [
            body.missed_gap(*states) for body, *states in zip(self.bodies, parts(before), parts(after), strict=True)
        ]
        gaps.append(self.pair.face.missed_gap(before.histories[2], after.histories[2]))
        return jnp.max(jnp.stack(gaps))

    def residual(self, forces: StackForces, hold_active: Array) -> Unknowns:
        """Compute the unbalanced force [N] of the free unknowns, without the part that the hold balances."""
        rest = [
            body.residual(f, own)
            for body, f, own in zip(self.bodies, forces.bodies, self.holds(hold_active), strict=True)
        ]
        return Unknowns(tuple(r.u for r in rest), tuple(r.mean_stress for r in rest))

    def project(self, r: PyTree, hold_active: Array) -> PyTree:
        """Project the rigid motions of each body's active hold out of nodal fields."""
        return tuple(body.project(v, own) for body, v, own in zip(self.bodies, r, self.holds(hold_active), strict=True))

    def without_drift(self, u: PyTree, hold_active: Array) -> PyTree:
        """Translate and rotate each body until its lower face has no rigid motion of the active hold."""
        return tuple(
            body.without_drift(v, own) for body, v, own in zip(self.bodies, u, self.holds(hold_active), strict=True)
        )

    def limited(self, change: PyTree, step_limit: float | int | Array) -> PyTree:
        """Limit the outliers of a step: displacements of single nodes."""
        return tuple(body.limited(v, step_limit) for body, v in zip(self.bodies, change, strict=True))

    def with_imposed(self, u: PyTree, fraction: Array) -> PyTree:
        """Set the prescribed displacements."""
        return tuple(body.with_imposed(v, fraction) for body, v in zip(self.bodies, u, strict=True))

    def force_scale(self, forces: StackForces) -> Array:
        """Compute the force scale of the residual [N]."""
        scales = [body.force_scale(f) for body, f in zip(self.bodies, forces.bodies, strict=True)]
        return jnp.sqrt(scales[0] ** 2 + scales[1] ** 2)

    def hold_balances(self, forces: StackForces, state: State) -> Sequence[HoldBalance]:
        """Compute the hold force of each body, the friction that could replace it, and the normal force."""
        between = self.pair.face.own_contact.friction * jnp.abs(forces.bodies[0].applied.sample.total[2])
        balances = [
            balance._replace(capacity=balance.capacity + between)
            for body, f, at in zip(self.bodies, forces.bodies, parts(state), strict=True)
            for balance in body.hold_balances(f, at)
            if body.drift_modes is not None
        ]
        none = jnp.zeros_like(state.fraction)
        return balances or [HoldBalance(none, none, none)]

    def advance(
        self,
        x: Unknowns,
        fraction: Array,
        state: State,
        hold_active: Array,
        forces: StackForces,
        points: tuple | None = None,
    ) -> State:
        """Build the state at the end of an increment, friction history included."""
        points = points or self.locate(x.u, fraction, state)
        own = [
            body.advance(v, fraction, before, hold_active, f, at)
            for (body, v, before), f, at in zip(self._each(x, state), forces.bodies, points[:2], strict=True)
        ]
        return joined(own, self.pair.advance(points[2], state.histories[2]))

    def tangent(
        self,
        x: Unknowns,
        fraction: Array,
        state: State,
        laws: tuple | None = None,
        transposed: bool = False,
        points: tuple | None = None,
    ) -> "StackTangent":
        """Assemble the tangent, in float32."""
        points = points or self.locate(x.u, fraction, state, bends=True)
        laws = laws or (None, None, None)
        pair, history, law, at = single((self.pair, state.histories[2], laws[2], points[2]))
        corners, upper = single((self._lower_corners(x.u), self._upper_nodes(x.u)))
        between = pair.linearised(single(fraction), corners, upper, history, law)
        if transposed:
            between = _transposed(between, corners, upper)
        full, soft = pair.guards(at, upper, history, law)
        own = [
            body.tangent(v, fraction, before, law, transposed, at, {face: coupling}, self.stress_scale)
            for (body, v, before), law, at, face, coupling in zip(
                self._each(x, state), laws[:2], points[:2], ("sample", "window"), (full, soft), strict=True
            )
        ]
        return StackTangent((own[0], own[1]), between, transposed)

    def precondition(self, tangent: "StackTangent", r: Unknowns, hold_active: Array) -> Unknowns:
        """Solve the lower body, then the upper one with the resulting contact force; in reverse order where transposed.

        Rigid motions of the hold are projected out body by body: those of one body would compress the other.
        """
        lower, upper = _split(jax.tree.map(lambda part: part.astype(jnp.float32), r))
        holds_lower, holds_upper = self.holds(hold_active)

        if tangent.is_transposed:
            above = self.upper.precondition(tangent.bodies[1], upper, holds_upper)
            push = tangent.push(jnp.zeros_like(lower.u), above.u)[0]
            lower = lower._replace(u=self.lower.project(lower.u + push, holds_lower))
            return _together([self._solve_lower(tangent, lower, holds_lower), above])
        below = self._solve_lower(tangent, lower, holds_lower)
        push = tangent.push(below.u, jnp.zeros_like(upper.u))[1]
        upper = upper._replace(u=self.upper.project(upper.u + push, holds_upper))
        return _together([below, self.upper.precondition(tangent.bodies[1], upper, holds_upper)])

    def _solve_lower(self, tangent: "StackTangent", r: Unknowns, hold_active: Array) -> Unknowns:
        """Solve the lower body against a fixed upper one, frictional coupling included, by V-cycles."""
        body, still = tangent.bodies[0], jnp.zeros(self.upper.positions.shape, jnp.float32)

        def improve(_, x):
            rest = jax.tree.map(jnp.subtract, r, body.apply(x))
            rest = rest._replace(u=self.lower.project(rest.u + tangent.push(x.u, still)[0], hold_active))
            return jax.tree.map(jnp.add, x, self.lower.precondition(body, rest, hold_active))

        return jax.lax.fori_loop(0, _LOWER_CYCLES, improve, jax.tree.map(jnp.zeros_like, r))

    def initial_state(self) -> State:
        """Build the undeformed state at load fraction zero."""
        corners = take(self.lower.positions, "sample", with_sides=False)
        own = [body.initial_state() for body in self.bodies]
        return joined(own, self.pair.initial_history(corners))

    def _each(self, x: Unknowns, state: State) -> list[tuple[Problem, Unknowns, State]]:
        """Iterate over the bodies, with the unknowns and the state of each."""
        own = [Unknowns(u, stress) for u, stress in zip(x.u, x.mean_stress, strict=True)]
        return list(zip(self.bodies, own, parts(state), strict=True))

    def _lower_corners(self, u: PyTree) -> Array:
        return take(self.lower.positions + u[0], "sample", with_sides=False)

    def _upper_nodes(self, u: PyTree) -> Array:
        return (self.upper.positions + u[1])[:, 0]


class StackTangent(NamedTuple):
    """The linear operator of one Newton step of a stack, in float32, and the parts of its preconditioner.

    Attributes:
        bodies: Operator of each body, lower first; mutual contact stiffness is in their preconditioners only.
        between: Derivative of the mutual contact forces by displacements of the lower face's corners and the upper
            face's nodes; transposed where the operator is.
        is_transposed: Whether the operator is transposed.
    """

    bodies: tuple[Tangent, Tangent]
    between: Callable[[Array, Array], PairForce]
    is_transposed: bool

    def apply(self, x: Unknowns) -> Unknowns:
        """Compute the product with unknowns."""
        own = [body.apply(v) for body, v in zip(self.bodies, _split(x), strict=True)]
        pushed = self.push(x.u[0], x.u[1])
        return _together([f._replace(u=f.u - push) for f, push in zip(own, pushed, strict=True)])

    def push(self, lower: Nodal, upper: UpperNodal) -> tuple[Nodal, UpperNodal]:
        """Compute the change of the mutual contact forces with displacements."""
        lower, upper = (_inside(v, body) for v, body in zip((lower, upper), self.bodies, strict=True))
        force = self.between(take(lower, "sample", with_sides=False), upper[:, 0])
        nz, ny, nx = (n - 1 for n in lower.shape[1:])
        below = put(Touching(to_touching(force.lower, (nz, ny, nx)).face, None), "sample", lower.shape)
        above = put(Touching(force.upper, None), "window", upper.shape)
        return _inside(below, self.bodies[0]), _inside(above, self.bodies[1])


def parts(state: State) -> list[State]:
    """Extract the states of the bodies from that of a stack."""
    return [
        State(
            state.u[k],
            state.mean_stress[k],
            state.fraction,
            state.histories[k],
            state.hold_active,
            state.applied[k],
            state.work[k],
        )
        for k in range(2)
    ]


def joined(bodies: Sequence[State], between: Any) -> State:
    """Combine the states of the bodies and the history of their mutual contact into that of a stack."""
    first = bodies[0]
    return State(
        u=tuple(s.u for s in bodies),
        mean_stress=tuple(s.mean_stress for s in bodies),
        fraction=first.fraction,
        histories=(*(s.histories for s in bodies), between),
        hold_active=first.hold_active,
        applied=tuple(s.applied for s in bodies),
        work=tuple(s.work for s in bodies),
    )


def _split(x: Unknowns) -> list[Unknowns]:
    return [Unknowns(u, stress) for u, stress in zip(x.u, x.mean_stress, strict=True)]


def _together(bodies: Sequence[Unknowns]) -> Unknowns:
    return Unknowns(tuple(x.u for x in bodies), tuple(x.mean_stress for x in bodies))


def _inside(v: Nodal, body: Tangent) -> Nodal:
    v = v.astype(jnp.float32)
    return v if body.free is None else body.free * v


def _touched(forces: Forces, **by: Touching) -> Forces:
    return forces._replace(applied=forces.applied._replace(**by))


def _transposed(between: Callable, corners: Array, upper: Array) -> Callable[[Array, Array], PairForce]:
    transpose = jax.linear_transpose(between, corners, upper)
    return lambda corners, upper: PairForce(*transpose(PairForce(corners, upper)))
