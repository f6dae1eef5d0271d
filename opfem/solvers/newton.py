"""Newton's method for one load increment, and its settings.

Displacement and contact pressure are unknowns; the pressure is eliminated point by point (`TangentLaw`). Each step
assembles the tangent, solves it by preconditioned GMRES, limits displacements of outlying nodes, and is halved only
where an element would invert.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import check_positive
from ..mechanics.contact_state import ContactIterate
from ..mechanics.face import FaceRule
from .equations import AbstractProblem, State
from .krylov import KrylovResult, fgmres
from .tangent import AbstractTangent, Unknowns

# Relative residual below which the tangent includes curvature and area change. Above, pressures have not converged,
# and these terms, proportional to pressure, would make the tangent indefinite.
_SETTLED = 0.3
# An increment is cut after this many steps in a row that end above; on the coin, those that converge have at most six.
_MOST_UNSETTLED = 10
# Directions GMRES keeps before it restarts.
_KRYLOV_BASIS = 30
# An increment is cut when this many of its linear systems could not be solved: their residual is above the second
# number after `krylov_steps`. Tolerances below it, of cut increments, cannot always be met; without it problems 44 and
# 88 of `benchmarks/robustness.py` fail, on some processors, because every increment is cut.
_MOST_UNSOLVED, _UNSOLVED = 3, 0.1


class Newton(eqx.Module):
    """Implicit statics: load increments, Newton steps, multigrid-preconditioned Krylov solver.

    The load is applied in `increments` equal parts. An increment that does not converge is cut
    and repeated from the last converged state, its friction history restored; increments grow
    again up to that size. Snap-through is solved with viscous regularisation (`stepping`).

    Args:
        rtol: Unbalanced force over contact force [-] at convergence (Euclidean norms). The coin's map is within 2e-6
            and its force within 1e-7 of a solve to 1e-9; half the increments change the map by 0.8 %. Also the gap or
            penetration that remains of hard contact, over the depth of an element. Tighten it to 1e-10 before
            comparing with finite differences.
        increments: Load increments when none is cut.
        max_steps: Newton steps per increment before it is cut.
        min_increment: Smallest load increment [-]; the solve fails below it.
        max_increments: Limit of increments, repeated ones included.
        krylov_rtol: Relative residual of each linear solve [-]; a tenth of it in an increment that was cut. The coin
            takes a sixth longer with 1e-2, and longer with 1e-1 and 1e-3.
        krylov_steps: Limit of preconditioner applications per linear solve.
        max_backtracks: Halvings of a Newton step that inverts an element, before the increment is cut.
        step_limit: Limit of a node's displacement in one Newton step, in mean thicknesses of the layer, where it
            exceeds four times the mean: a corner that slips over a ridge must not distort its neighbours.
        max_path: Limit of accepted increments for derivatives: under `jax.grad` and the like, a solve stores as many
            displacement fields. Beyond, derivatives are NaN.
        face_rule: Quadrature of contact: "gauss2" (2×2), "gauss3" (3×3) or "nodes". Tetrahedra, and a
            sample of exact hard contact, always at the nodes.

    Raises:
        ValueError: If a number is not positive.
    """

    rtol: float | int | Array = 1e-5
    increments: float | int | Array = 8
    max_steps: float | int | Array = 20
    min_increment: float | int | Array = 1e-4
    krylov_rtol: float | int | Array = 3e-2
    krylov_steps: float | int | Array = 120
    max_backtracks: float | int | Array = 6
    step_limit: float | int | Array = 0.025
    max_increments: int = eqx.field(static=True, default=1500)
    max_path: int = eqx.field(static=True, default=64)
    face_rule: FaceRule = eqx.field(static=True, default="gauss2")

    def as_leaves(self) -> "Newton":
        """Convert every number to an array, so that another value needs no compilation."""
        return jax.tree.map(lambda v: jnp.asarray(float(v) if isinstance(v, np.floating) else v), self)

    def __check_init__(self):
        for name in (
            "rtol",
            "increments",
            "max_steps",
            "min_increment",
            "max_increments",
            "max_path",
            "krylov_rtol",
            "krylov_steps",
        ):
            check_positive(f"Newton.{name}", "-", getattr(self, name))
        if self.face_rule not in ("gauss2", "gauss3", "nodes"):
            raise ValueError(f'Newton.face_rule must be "gauss2", "gauss3" or "nodes", got {self.face_rule!r}.')


class IncrementResult(NamedTuple):
    """Outcome of one load increment; `state` is only meaningful when `converged`."""

    state: State
    converged: Array
    steps: Array
    krylov: Array
    residual: Array  # relative to the force scale
    forces: Any


class _Iterate(NamedTuple):
    """State of the iteration: the next trial point is `x + length × direction`, with length at most 1."""

    x: Unknowns
    direction: Unknowns
    contact: tuple  # of ContactIterate
    forces: Any  # at x, as points, size and tolerance
    points: tuple
    size: Array
    tolerance: Array
    steps: Array
    krylov: Array
    unsolved: Array  # linear solves that ended at krylov_steps
    unsettled: Array  # steps in a row that ended far from equilibrium
    finished: Array


class _Increment(NamedTuple):
    """The equations of one load increment: what Newton's method iterates on."""

    problem: AbstractProblem
    state: State
    fraction: Array
    hold_active: Array
    settings: Newton

    def evaluate(self, x: Unknowns) -> tuple[tuple[Any, tuple], Array, Array]:
        """Compute forces and contact points at x; the residual's size, infinite where an element inverts; tolerance."""
        problem = self.problem
        points = problem.locate(x.u, self.fraction, self.state, bends=True)
        forces = problem.with_contact(problem.own_forces(x, self.state), points, self.fraction, self.state)
        size = problem.size(problem.residual(forces, self.hold_active))
        size = jnp.where((forces.smallest_J > 0) & jnp.isfinite(size), size, jnp.inf)
        return (forces, points), size, self.settings.rtol * problem.force_scale(forces)

    def is_settled(self, size: Array, tolerance: Array) -> Array:
        """Return whether pressures have converged far enough for curvature in the tangent."""
        return size < _SETTLED / self.settings.rtol * tolerance

    def begin(self, guess: Unknowns) -> _Iterate:
        """Initialise the iteration, without an evaluation."""
        x = guess._replace(u=self.problem.with_imposed(guess.u, self.fraction))
        zero, far = jnp.zeros((), int), jnp.full((), jnp.inf, self.fraction.dtype)
        forces, points = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), jax.eval_shape(self.evaluate, x)[0])
        return _Iterate(
            x=x,
            direction=jax.tree.map(jnp.zeros_like, x),
            contact=self.problem.initial_iterates(self.state),
            forces=forces,
            points=points,
            size=far,
            tolerance=far,
            steps=zero,
            krylov=zero,
            unsolved=zero,
            unsettled=zero,
            finished=jnp.asarray(False),
        )

    def take_step(self, it: _Iterate) -> _Iterate:
        """Take the step, halved until no element inverts, and evaluate the residual there."""

        def moved(length):
            return jax.tree.map(lambda v, d: v + length * d, it.x, it.direction)

        def shorten(carry):
            length, count, *_ = carry
            length = jnp.where(count == 0, 1.0, 0.5 * length)
            return length, count + 1, *self.evaluate(moved(length))

        def inadmissible(carry):
            return ~jnp.isfinite(carry[3]) & (carry[1] <= self.settings.max_backtracks)

        start = (jnp.ones_like(it.size), 0, (it.forces, it.points), jnp.full_like(it.size, jnp.inf), it.tolerance)
        length, _, (forces, points), size, tolerance = jax.lax.while_loop(inadmissible, shorten, start)
        unsettled = jnp.where(self.is_settled(size, tolerance), 0, it.unsettled + (it.steps > 0))
        failed = (it.unsolved >= _MOST_UNSOLVED) | (unsettled >= _MOST_UNSETTLED) | ~jnp.isfinite(size)
        return it._replace(
            x=moved(length),
            contact=jax.tree.map(
                lambda c: c.after(length), it.contact, is_leaf=lambda c: isinstance(c, ContactIterate)
            ),
            forces=forces,
            points=points,
            size=size,
            tolerance=tolerance,
            unsettled=unsettled,
            finished=(size <= tolerance) | (it.steps >= self.settings.max_steps) | failed,
        )

    def find_step(self, it: _Iterate) -> _Iterate:
        """Linearise contact, assemble the tangent and solve for the next step."""
        problem, state, settings = self.problem, self.state, self.settings
        curvature = jnp.where(self.is_settled(it.size, it.tolerance), 1.0, 0.0)
        laws = problem.tangent_laws(it.points, state, it.contact, curvature)
        forces = problem.with_contact(it.forces, it.points, self.fraction, state, laws)
        r = problem.residual(forces, self.hold_active)
        tangent = problem.tangent(it.x, self.fraction, state, laws, points=it.points)
        solution = solve_tangent(problem, tangent, jax.tree.map(jnp.negative, r), self.hold_active, settings)
        change = problem.admissible(problem.limited(solution.x.u, settings.step_limit), self.hold_active)
        return it._replace(
            direction=solution.x._replace(u=change),
            contact=problem.follow(it.points, change, state, laws),
            steps=it.steps + 1,
            krylov=it.krylov + solution.iterations,
            unsolved=it.unsolved
            + ((solution.iterations >= settings.krylov_steps) & (solution.relative_residual > _UNSOLVED)),
        )

    def iterate(self, it: _Iterate) -> _Iterate:
        """Take the step of the previous pass and solve for the next: in this order the residual is compiled once."""
        it = self.take_step(it)
        return jax.lax.cond(it.finished, lambda it: it, self.find_step, it)


def solve_increment(
    problem: AbstractProblem, state: State, guess: Unknowns, fraction: Array, hold_active: Array, settings: Newton
) -> IncrementResult:
    """Find equilibrium at a load fraction, from a converged state and an initial guess."""
    increment = _Increment(problem, state, fraction, hold_active, settings)
    end = jax.lax.while_loop(lambda it: ~it.finished, increment.iterate, increment.begin(guess))
    return IncrementResult(
        state=problem.advance(end.x, fraction, state, hold_active, end.forces, end.points),
        converged=end.size <= end.tolerance,
        steps=end.steps,
        krylov=end.krylov,
        residual=end.size / end.tolerance * settings.rtol,
        forces=end.forces,
    )


def solve_tangent(
    problem: AbstractProblem,
    tangent: AbstractTangent,
    b: Unknowns,
    hold_active: Array,
    settings: Newton,
    from_left: bool = False,
    preconditioned: Unknowns | None = None,
) -> KrylovResult:
    """Solve one linear system with the tangent on free unknowns, without the rigid motions of the active hold.

    In float32, like the tangent. Left preconditioning gives a transposed system the Krylov space of the preconditioned
    tangent. Right preconditioning would include displacements that compress stiff contact, for which the friction of a
    transposed tangent is a large force. A known preconditioned, scaled b is not computed again.
    """
    scale = problem.stress_scale
    b = b.scaled(scale)
    size = jnp.sqrt(sum(jnp.vdot(part, part) for part in jax.tree.leaves(b)))
    size = jnp.where(size > 0, size, 1.0)
    b = jax.tree.map(lambda part: (part / size).astype(jnp.float32), b)

    def inside(x: Unknowns) -> Unknowns:
        return x._replace(u=problem.project(x.u, hold_active))

    def multiply(v):
        return inside(tangent.apply(v))

    def precondition(v):
        return problem.precondition(tangent, v, hold_active)

    start = b
    if from_left and preconditioned is None:
        start = precondition(b)
    elif from_left:
        start = jax.tree.map(lambda part: (part / size).astype(jnp.float32), preconditioned)
    result = fgmres(
        (lambda v: precondition(multiply(v))) if from_left else multiply,
        (lambda v: v) if from_left else precondition,
        start,
        settings.krylov_rtol,
        basis=_KRYLOV_BASIS,
        max_iterations=settings.krylov_steps,
    )
    x = jax.tree.map(lambda part: size * part, result.x)
    return result._replace(x=x.scaled(scale))
