"""Two deformable bodies on top of each other, each with its rigid surfaces, in contact: the discrete problem.

The linear systems of a stack are preconditioned body by body (block Gauss–Seidel): the lower one with all of its
contact springs, which stand at its own face points and so are exact there, then the upper one almost without. Columns
through both bodies would be spoilt as soon as the bodies slide.
"""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ..mechanics.boundary import Touching, put, take, to_touching
from ..mechanics.contact_pair import ContactPair, PairForce
from .equations import AbstractProblem, HoldBalance, State
from .equilibrium import Forces, Problem, single
from .stencil import Nodal
from .tangent import Tangent, Unknowns

# V-cycles of the lower body for one of the upper one. What is left of stiff contact after one would count against the
# upper body's soft springs: on 12×12×(2+6) elements with the exponential law and friction 0.05, one, three with
# friction's coupling left out, and three with it take 96, 77 and 24 iterations a Newton step.
_LOWER_CYCLES = 3

UpperNodal = Float[Array, "3 uz uy ux"]


class StackForces(NamedTuple):
    """Nodal forces [N] on both bodies, lower first."""

    bodies: tuple[Forces, ...]

    @property
    def own(self) -> Unknowns:
        """Internal forces [N] and missed volume, which derive from an energy."""
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
        viscosity: Of the medium that slows both on their way through a snap [-], else 0.
    """

    lower: Problem
    upper: Problem
    pair: ContactPair
    viscosity: Array
    left_transpose: ClassVar[bool] = False

    @property
    def bodies(self) -> tuple[Problem, Problem]:
        """The bodies, lower first, in the medium."""
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
        """Mean stress that weighs as much as a displacement of 1 mm [MPa/mm]; times volume, a force."""
        return self.lower.stress_scale

    def holds(self, held: Array) -> tuple[Array, Array]:
        """Tell whether rigid motion of each body is held, given whether friction between them has not taken over.

        Friction between the bodies never holds both: without any at window and plate the lower one stays held.
        """
        if self.lower.drift_modes is None or self.upper.drift_modes is None:
            return held, held
        ends = [face for face in (self.lower.contacts.window, self.upper.contacts.sample) if face is not None]
        rubs = [face.own_contact.friction > 0 for face in ends]
        return held | ~jnp.any(jnp.stack([jnp.asarray(False), *rubs])), held

    def own_forces(self, x: Unknowns, state: State) -> StackForces:
        """Compute the forces of bodies, medium and springs [N], none applied."""
        return StackForces(tuple(body.own_forces(own, at) for body, own, at in self._each(x, state)))

    def locate(self, u: PyTree, fraction: Array, state: State, bends: bool = False) -> tuple:
        """Locate the points of all contacts: of each body with its rigid surfaces, and between them."""
        own = [body.locate(v, fraction, at, bends) for body, v, at in zip(self.bodies, u, parts(state), strict=True)]
        pair = self.pair.locate(fraction, self._lower_corners(u), self._upper_nodes(u), state.histories[2])
        return (*own, pair)

    def with_contact(
        self, forces: StackForces, points: tuple, fraction: Array, state: State, laws: tuple | None = None
    ) -> StackForces:
        """Replace the applied forces by those of linearised contact laws; without, the contact's own."""
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
        """Compute what the next iteration remembers once a part of the step `change` is taken."""
        own = [
            body.follow(at, step, before, law)
            for body, at, step, before, law in zip(self.bodies, points[:2], change, parts(state), laws[:2], strict=True)
        ]
        corners, upper = take(change[0], "sample", with_sides=False), change[1][:, 0]
        return (*own, self.pair.follow(points[2], corners, upper, state.histories[2], laws[2]))

    def initial_iterates(self, state: State) -> tuple:
        """Start the iteration from the contact of a converged state."""
        own = [body.initial_iterates(before) for body, before in zip(self.bodies, parts(state), strict=True)]
        return (*own, self.pair.face.initial_iterate(state.histories[2]))

    def missed_gap(self, before: State, after: State) -> Array:
        """Compute the largest gap or penetration [mm] that an increment left to hard contact."""
        gaps = [
            body.missed_gap(*states) for body, *states in zip(self.bodies, parts(before), parts(after), strict=True)
        ]
        gaps.append(self.pair.face.missed_gap(before.histories[2], after.histories[2]))
        return jnp.max(jnp.stack(gaps))

    def residual(self, forces: StackForces, held: Array) -> Unknowns:
        """Compute the unbalanced force [N] of the free unknowns, the hold's share taken out."""
        rest = [
            body.residual(f, own) for body, f, own in zip(self.bodies, forces.bodies, self.holds(held), strict=True)
        ]
        return Unknowns(tuple(r.u for r in rest), tuple(r.mean_stress for r in rest))

    def project(self, r: PyTree, held: Array) -> PyTree:
        """Take the held rigid motions of each body out of nodal fields."""
        return tuple(body.project(v, own) for body, v, own in zip(self.bodies, r, self.holds(held), strict=True))

    def without_drift(self, u: PyTree, held: Array) -> PyTree:
        """Move each body as a whole so that its lower face has none of the held rigid motions."""
        return tuple(body.without_drift(v, own) for body, v, own in zip(self.bodies, u, self.holds(held), strict=True))

    def limited(self, change: PyTree, step_limit: float | int | Array) -> PyTree:
        """Shorten the moves of single nodes that stand out of a step."""
        return tuple(body.limited(v, step_limit) for body, v in zip(self.bodies, change, strict=True))

    def with_imposed(self, u: PyTree, fraction: Array) -> PyTree:
        """Set the prescribed displacements."""
        return tuple(body.with_imposed(v, fraction) for body, v in zip(self.bodies, u, strict=True))

    def force_scale(self, forces: StackForces) -> Array:
        """Compute the size of the forces [N] that the residual is measured against."""
        scales = [body.force_scale(f) for body, f in zip(self.bodies, forces.bodies, strict=True)]
        return jnp.sqrt(scales[0] ** 2 + scales[1] ** 2)

    def hold_balances(self, forces: StackForces, state: State) -> Sequence[HoldBalance]:
        """Compare what the hold carries of each body with what friction could, and with the normal force."""
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
        held: Array,
        forces: StackForces,
        points: tuple | None = None,
    ) -> State:
        """Build the state at the end of an increment, friction history included."""
        points = points or self.locate(x.u, fraction, state)
        own = [
            body.advance(v, fraction, before, held, f, at)
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
            body.tangent(v, fraction, before, law, transposed, at, {face: springs}, self.stress_scale)
            for (body, v, before), law, at, face, springs in zip(
                self._each(x, state), laws[:2], points[:2], ("sample", "window"), (full, soft), strict=True
            )
        ]
        return StackTangent((own[0], own[1]), between, transposed)

    def precondition(self, tangent: "StackTangent", r: Unknowns, held: Array) -> Unknowns:
        """Solve the lower body, then the upper one with what that pushes; the other way round where transposed.

        Held rigid motions are taken out body by body: one body's would press on the other.
        """
        lower, upper = _split(jax.tree.map(lambda part: part.astype(jnp.float32), r))
        holds_lower, holds_upper = self.holds(held)

        if tangent.is_transposed:
            above = self.upper.precondition(tangent.bodies[1], upper, holds_upper)
            push = tangent.push(jnp.zeros_like(lower.u), above.u)[0]
            lower = lower._replace(u=self.lower.project(lower.u + push, holds_lower))
            return _together([self._solve_lower(tangent, lower, holds_lower), above])
        below = self._solve_lower(tangent, lower, holds_lower)
        push = tangent.push(below.u, jnp.zeros_like(upper.u))[1]
        upper = upper._replace(u=self.upper.project(upper.u + push, holds_upper))
        return _together([below, self.upper.precondition(tangent.bodies[1], upper, holds_upper)])

    def _solve_lower(self, tangent: "StackTangent", r: Unknowns, held: Array) -> Unknowns:
        """Solve the lower body against a fixed upper one, friction's coupling included, by V-cycles."""
        body, still = tangent.bodies[0], jnp.zeros(self.upper.positions.shape, jnp.float32)

        def improve(_, x):
            rest = jax.tree.map(jnp.subtract, r, body.apply(x))
            rest = rest._replace(u=self.lower.project(rest.u + tangent.push(x.u, still)[0], held))
            return jax.tree.map(jnp.add, x, self.lower.precondition(body, rest, held))

        return jax.lax.fori_loop(0, _LOWER_CYCLES, improve, jax.tree.map(jnp.zeros_like, r))

    def initial_state(self) -> State:
        """Build the undeformed state at load fraction zero."""
        corners = take(self.lower.positions, "sample", with_sides=False)
        own = [body.initial_state() for body in self.bodies]
        return joined(own, self.pair.initial_history(corners))

    def _each(self, x: Unknowns, state: State) -> list[tuple[Problem, Unknowns, State]]:
        """Go through the bodies, what is unknown of each, and its own state."""
        own = [Unknowns(u, stress) for u, stress in zip(x.u, x.mean_stress, strict=True)]
        return list(zip(self.bodies, own, parts(state), strict=True))

    def _lower_corners(self, u: PyTree) -> Array:
        return take(self.lower.positions + u[0], "sample", with_sides=False)

    def _upper_nodes(self, u: PyTree) -> Array:
        return (self.upper.positions + u[1])[:, 0]


class StackTangent(NamedTuple):
    """The linear operator of one Newton step of a stack, in float32, and the parts of its preconditioner.

    Attributes:
        bodies: Of each body alone, lower first; the springs of contact between them only in their preconditioners.
        between: Change of the forces of contact between them by the motion of the lower face's corners and of the upper
            face's nodes; transposed where the operator is.
        is_transposed: Whether it is.
    """

    bodies: tuple[Tangent, Tangent]
    between: Callable[[Array, Array], PairForce]
    is_transposed: bool

    def apply(self, x: Unknowns) -> Unknowns:
        """Multiply with unknowns."""
        own = [body.apply(v) for body, v in zip(self.bodies, _split(x), strict=True)]
        pushed = self.push(x.u[0], x.u[1])
        return _together([f._replace(u=f.u - push) for f, push in zip(own, pushed, strict=True)])

    def push(self, lower: Nodal, upper: UpperNodal) -> tuple[Nodal, UpperNodal]:
        """Compute how forces of contact between the bodies change with their motion."""
        lower, upper = (_inside(v, body) for v, body in zip((lower, upper), self.bodies, strict=True))
        force = self.between(take(lower, "sample", with_sides=False), upper[:, 0])
        nz, ny, nx = (n - 1 for n in lower.shape[1:])
        below = put(Touching(to_touching(force.lower, (nz, ny, nx)).face, None), "sample", lower.shape)
        above = put(Touching(force.upper, None), "window", upper.shape)
        return _inside(below, self.bodies[0]), _inside(above, self.bodies[1])


def parts(state: State) -> list[State]:
    """Take the states of the bodies out of that of a stack."""
    return [
        State(
            state.u[k],
            state.mean_stress[k],
            state.fraction,
            state.histories[k],
            state.held,
            state.applied[k],
            state.work[k],
        )
        for k in range(2)
    ]


def joined(bodies: Sequence[State], between: Any) -> State:
    """Make the state of a stack of those of its bodies, and of the history of the contact between them."""
    first = bodies[0]
    return State(
        u=tuple(s.u for s in bodies),
        mean_stress=tuple(s.mean_stress for s in bodies),
        fraction=first.fraction,
        histories=(*(s.histories for s in bodies), between),
        held=first.held,
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
