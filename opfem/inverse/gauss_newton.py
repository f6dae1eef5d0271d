"""Gauss–Newton steps for optimistix, their linear systems solved by preconditioned conjugate gradients.

Nothing is materialised: one iteration multiplies once with the Jacobian and once with its transpose. What iterations
find out of the Gauss–Newton matrix preconditions the next system (BFGS on top of the preconditioner). The curvature of
the residuals, which Gauss–Newton leaves out, is learnt from the steps taken (BFGS on top of the Gauss–Newton matrix):
where a layer slips and opens, it is several times what Gauss–Newton knows.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.core import Tracer
from jaxtyping import Array, PyTree

# A point is accepted where the least of the sum of squares along the way lies beyond this part of it; else the next is
# that least, but between these parts of the last.
_BEYOND = 0.6
_SHORTEST, _LONGEST = 0.1, 0.5
# Steps shorter than this may raise the sum of squares by this part.
_SHORT, _RISE = 0.05, 5e-3
# A system is solved no closer than its last direction changed the residuals, but at least to this.
_ROUGHEST = 0.03
# No direction of Gauss–Newton changes the residuals by more than their norm, but for rounding.
_MOST_PROMISED = 1.01
# Steps whose curvature is remembered, and iterations of linear systems.
_MEMORY = 20
_MEMORY_OF_ITERATIONS = 60


class LeastSquares(NamedTuple):
    """Solution of a linear least-squares problem.

    Attributes:
        x: The solution.
        rest: What it leaves of b.
        gradient: Jᵀb.
        relative_gradient: What is left of the right-hand side, in the preconditioner's norm.
        iterations: How many it took.
        secants: What was known of JᵀJ, and what these iterations found.
    """

    x: PyTree
    rest: PyTree
    gradient: PyTree
    relative_gradient: Array
    iterations: Array
    secants: "Secants | None"


def least_squares(
    jacobian: Callable[[PyTree], PyTree],
    transpose: Callable[[PyTree], PyTree],
    precondition: Callable[[PyTree], PyTree],
    b: PyTree,
    rtol: float | Array,
    most: int | Array,
    negligible: float | Array = 0.0,
    further: Callable[[PyTree], PyTree] | None = None,
    secants: "Secants | None" = None,
) -> LeastSquares:
    """Minimise |J x - b|² / 2 - further(Jᵀb) · x by conjugate gradients on the normal equations.

    Driven from the host unless b is traced: each product is then a call.

    Args:
        jacobian: Multiply with J.
        transpose: Multiply with its transpose.
        precondition: Approximate inverse of JᵀJ, symmetric positive; only nearly linear is enough.
        b: What J x is to match.
        rtol: Relative tolerance of the gradient Jᵀ(b - J x) + further(Jᵀb), in the preconditioner's norm.
        most: Most iterations.
        negligible: Enough is also a gradient of this norm: the length of what is left to go, measured by J.
        further: What to add to the right-hand side Jᵀb, made from it; None: nothing.
        secants: What is known of JᵀJ, to correct the preconditioner with; None: nothing, and nothing is learnt.

    Source:
        Björck, Numerical Methods for Least Squares Problems, algorithm 7.4.1 (CGLS), preconditioned;
        Notay, SIAM J. Sci. Comput. 22 (2000) 1444 for a preconditioner that is not quite linear;
        Morales and Nocedal, SIAM J. Optim. 10 (2000) 1079 for one that learns from the last system.
    """

    def iterate(carry: tuple["_Iteration", "Secants | None"]) -> tuple["_Iteration", "Secants | None"]:
        it, found = carry
        it = _along(it, jacobian(it.p))
        return turn(it, transpose(it.rest), found)

    def turn(it: "_Iteration", gradient: PyTree, found: "Secants | None") -> tuple["_Iteration", "Secants | None"]:
        if further is not None:
            it = _with_added(it, gradient, further)
        turned = _turned(it, gradient, precondition if found is None else Learnt(precondition, found))
        return turned, None if found is None else _learnt(found, it, turned)

    def begin(like: PyTree) -> "_Iteration":
        zeros = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), like)
        zero = jnp.zeros((), jnp.result_type(*jax.tree.leaves(like)))
        limits = (jnp.asarray(limit) for limit in (rtol, most, negligible))
        return _Iteration(zeros, b, zeros, zeros, zeros, zeros, zeros, zero, zero, jnp.zeros((), int), *limits)

    if is_traced(b):
        # The first pass only finds the gradient: so each product appears, and is compiled, once.
        start = begin(jax.eval_shape(transpose, b)), secants
        end, found = jax.lax.while_loop(lambda carry: _unfinished(carry[0]), iterate, start)
    else:
        gradient = transpose(b)
        end, found = turn(begin(gradient), gradient, secants)
        while _unfinished(end):
            end, found = iterate((end, found))
    relative_gradient = jnp.sqrt(end.size / jnp.where(end.first > 0, end.first, 1.0))
    return LeastSquares(end.x, end.rest, end.pulled, relative_gradient, end.count - 1, found)


class _Iteration(NamedTuple):
    x: PyTree
    rest: PyTree
    pulled: PyTree  # Jᵀb
    added: PyTree  # what `further` adds to it
    before: PyTree  # the last gradient
    p: PyTree
    moved: PyTree  # the last step along p
    size: Array
    first: Array
    count: Array
    rtol: Array
    most: Array
    negligible: Array


@eqx.filter_jit
def _unfinished(it: _Iteration) -> Array:
    enough = jnp.maximum(it.rtol**2 * it.first, it.negligible**2)
    return (it.count == 0) | ((it.size > enough) & (it.count <= it.most))


@eqx.filter_jit
def _along(it: _Iteration, q: PyTree) -> _Iteration:
    """Go along p, whose product with J is q, as far as residuals fall."""
    squared = dot(q, q)
    step = jnp.where(squared > 0, it.size / jnp.where(squared > 0, squared, 1.0), 0.0)
    moved = jax.tree.map(lambda v: step * v, it.p)
    return it._replace(x=plus(it.x, moved), rest=plus(it.rest, q, -step), moved=moved)


@eqx.filter_jit
def _with_added(it: _Iteration, gradient: PyTree, further: Callable) -> _Iteration:
    """Find in the first pass what is to be added to the right-hand side."""
    return it._replace(added=jax.lax.cond(it.count == 0, lambda: further(gradient), lambda: it.added))


@eqx.filter_jit
def _turned(it: _Iteration, gradient: PyTree, precondition: Callable) -> _Iteration:
    """Find the next direction."""
    now = plus(gradient, it.added)
    z = precondition(now)
    new = dot(now, z)
    change = new - dot(it.before, z)
    return it._replace(
        pulled=jax.tree.map(lambda new, old: jnp.where(it.count == 0, new, old), gradient, it.pulled),
        before=now,
        p=plus(z, it.p, jnp.where(it.size > 0, change / jnp.where(it.size > 0, it.size, 1.0), 0.0)),
        size=new,
        first=jnp.where(it.count == 0, new, it.first),
        count=it.count + 1,
    )


@eqx.filter_jit
def _learnt(found: "Secants", it: _Iteration, turned: _Iteration) -> "Secants":
    """Learn of JᵀJ from the last step; in the first pass there was none."""
    return found.followed_by(it.moved, plus(it.before, turned.before, -1.0))


def is_traced(tree: PyTree) -> bool:
    """Tell whether values are those of a trace."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def dot(a: PyTree, b: PyTree) -> Array:
    """Sum the products of all numbers."""
    return sum((jnp.vdot(v, w) for v, w in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)), start=0.0)


def plus(a: PyTree, b: PyTree, factor: Array | float = 1.0) -> PyTree:
    """Compute a + factor b."""
    return jax.tree.map(lambda v, w: v + factor * w, a, b)


class Secants(NamedTuple):
    """Steps taken and what they changed the gradient by, newest last; zero where there is none yet."""

    step: PyTree
    change: PyTree

    @classmethod
    def none(cls, like: PyTree, memory: int) -> "Secants":
        """Remember nothing yet."""
        zeros = jax.tree.map(lambda v: jnp.zeros((memory, *v.shape), v.dtype), like)
        return cls(zeros, zeros)

    def followed_by(self, step: PyTree, change: PyTree) -> "Secants":
        """Remember one more, if the gradient rose along it, and forget the oldest."""
        rises = dot(step, change) > 0

        def append(stack, new):
            return jnp.where(rises, jnp.concatenate([stack[1:], new[None]]), stack)

        return Secants(*(jax.tree.map(append, *pair) for pair in zip(self, (step, change), strict=True)))

    def before(self, gradient: PyTree) -> tuple[PyTree, Array]:
        """Turn a gradient into the right-hand side for the matrix that secants correct; also return what `after` needs.

        Source:
            Nocedal and Wright, Numerical Optimization, algorithm 7.4 (two-loop recursion).
        """

        def one(q, secant):
            along = secant._weight() * dot(secant.step, q)
            return plus(q, secant.change, -along), along

        return jax.lax.scan(one, gradient, self, reverse=True)

    def after(self, x: PyTree, along: Array) -> PyTree:
        """Turn the solution with that matrix into the direction."""

        def one(x, each):
            secant, along = each
            return plus(x, secant.step, along - secant._weight() * dot(secant.change, x)), None

        return jax.lax.scan(one, x, (self, along))[0]

    def corrected(self, inverse: Callable[[PyTree], PyTree], gradient: PyTree) -> PyTree:
        """Multiply with an approximate inverse, corrected by what the steps changed."""
        rest, along = self.before(gradient)
        return self.after(inverse(rest), along)

    def _weight(self) -> Array:
        curvature = dot(self.step, self.change)
        return jnp.where(curvature > 0, 1.0 / jnp.where(curvature > 0, curvature, 1.0), 0.0)


class Learnt(eqx.Module):
    """An approximate inverse, corrected by what iterations have found of the matrix."""

    inverse: Callable[[PyTree], PyTree]
    secants: Secants

    def __call__(self, gradient: PyTree) -> PyTree:
        """Multiply with it."""
        return self.secants.corrected(self.inverse, gradient)


class _Direction(eqx.Module):
    newton: Any
    change: Array  # that it makes to the residuals, over their norm
    iterations: Array  # of all systems so far
    point: Any
    gradient: Any
    secants: Secants
    iterated: Secants  # with the Gauss–Newton matrix
    result: optx.RESULTS


def _known(y: PyTree, state: _Direction, tries: Array, gradient: PyTree) -> Secants:
    """Add the last step to what is known of the curvature; nothing is, once it is forgotten."""
    known = state.secants.followed_by(plus(y, state.point, -1.0), plus(gradient, state.gradient, -1.0))
    return jax.tree.map(lambda v: jnp.where(tries == 0, v, 0.0), known)


def _curved(y: PyTree, state: _Direction, tries: Array, gradient: PyTree) -> PyTree:
    """Compute what the curvature adds to the right-hand side of the linear system."""
    return plus(_known(y, state, tries, gradient).before(gradient)[0], gradient, -1.0)


@eqx.filter_jit
def _direction(
    y: PyTree, state: _Direction, tries: Array, residual: PyTree, solved: LeastSquares, iterations: Array
) -> _Direction:
    """Make the direction from the solution of the linear system."""
    gradient = solved.gradient
    known = _known(y, state, tries, gradient)
    newton = known.after(solved.x, known.before(gradient)[1])
    change = jnp.sqrt(jnp.maximum(dot(gradient, newton), 0.0) / dot(residual, residual))
    iterations = iterations + solved.iterations
    return _Direction(newton, change, iterations, y, gradient, known, solved.secants, optx.RESULTS.successful)


class PreconditionedDescent(optx.AbstractDescent):
    """The Gauss–Newton direction.

    Attributes:
        precondition: Makes, from J, an approximate inverse of JᵀJ.
        rtol: Relative tolerance of linear systems near the optimum; far from it they are solved less closely.
        most: Most iterations of each.
        negligible: What is left to go, over the posterior's standard deviation along it, below which a direction is
            not refined [-].
        hopeless: Half sum of squares from which on no direction is looked for.
    """

    precondition: Callable[[Any], Callable[[PyTree], PyTree]]
    rtol: Array
    most: Array
    negligible: Array
    hopeless: Array

    def init(self, y, f_info_struct):
        """Start without a direction."""
        del f_info_struct
        secants, iterated = (Secants.none(y, memory) for memory in (_MEMORY, _MEMORY_OF_ITERATIONS))
        infinite, none = jnp.full((), jnp.inf, float), jnp.zeros((), int)
        return _Direction(y, infinite, none, y, y, secants, iterated, optx.RESULTS.successful)

    def query(self, y, f_info, state):
        """Solve for the direction at an accepted point."""
        J, residual = f_info.jac, f_info.residual
        most = jnp.where(0.5 * dot(residual, residual) < self.hopeless, self.most, 0)
        rtol = jnp.clip(state.change, self.rtol, _ROUGHEST)
        precondition = self.precondition(J)

        # Where what was learnt of the curvature makes a direction promise too much, it is forgotten, and the system
        # solved again.
        def promises_too_much(carry):
            tries, direction = carry
            return (tries == 0) | ((tries == 1) & (direction.change > _MOST_PROMISED))

        def solve(carry):
            tries, last = carry
            further = eqx.Partial(_curved, y, state, tries)
            solved = least_squares(
                J.mv, J.T.mv, precondition, residual, rtol, most, self.negligible, further, last.iterated
            )
            return tries + 1, _direction(y, state, tries, residual, solved, last.iterations)

        carry = jnp.zeros((), int), state
        if is_traced((residual, state)):
            return jax.lax.while_loop(promises_too_much, solve, carry)[1]
        while promises_too_much(carry):
            carry = solve(carry)
        return carry[1]

    def step(self, step_size, state):
        """Go a part of the way."""
        return jax.tree.map(lambda v: -step_size * v, state.newton), state.result


class _Search(eqx.Module):
    step_size: Array
    change: Array  # `_Direction.change`


class Interpolating(optx.AbstractSearch):
    """Whole steps; where the sum of squares falls by much less than the Jacobian says, back to its least.

    The next direction is first looked along as far as the least of the last one lay. A direction costs tens of
    products, a look along it one solve. What the Jacobian says comes with the direction: unlike in
    `optimistix.BacktrackingArmijo`, it is not multiplied with once more.

    The sum of squares jumps where a forward solve cuts an increment back: friction remembers another path. A point that
    a jump put lower than its surroundings would never be left, so the shortest steps may rise a little.
    """

    def init(self, y, f_info_struct):
        """Start with whole steps."""
        del y, f_info_struct
        return _Search(jnp.ones(()), jnp.zeros(()))

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        """Accept a point that is no worse, and not far beyond the least of the parabola through it; or one close by."""
        del y, y_eval
        length, before, now = state.step_size, f_info.as_min(), f_eval_info.as_min()
        fall = state.change**2 * before  # that a whole step promises; the slope is twice it
        curvature = (now - before + 2.0 * fall * length) / length**2
        least = jnp.where(jnp.isfinite(now), fall / jnp.where(curvature > 0, curvature, fall), 0.0)
        lower = (now <= before) & (least >= _BEYOND * length)
        close = (length < _SHORT) & (now <= (1.0 + _RISE) * before)
        accept = first_step | lower | close
        shorter = jnp.clip(least, _SHORTEST * length, _LONGEST * length)
        length = jnp.where(accept, jnp.where(lower, jnp.minimum(least, 1.0), 1.0), shorter)
        return length, accept, optx.RESULTS.successful, _Search(length, state.change)


class Looking(NamedTuple):
    """How far Gauss–Newton has come; names as in the state of `optimistix.GaussNewton`."""

    first_step: Array
    y_eval: PyTree
    search_state: _Search
    f_info: optx.FunctionInfo | None
    aux: Any
    descent_state: _Direction
    num_accepted_steps: int


class GaussNewton(optx.AbstractGaussNewton):
    """Gauss–Newton for `optimistix.least_squares`, or driven from the host (`begin`, `look`).

    It ends where its next step would change the residuals by less than `rtol` of their norm: in a fit, about what is
    left to go over the posterior's standard deviations, root mean square. Their own change would be the wrong measure:
    directions that the data do not tell are never at rest.
    """

    rtol: Array
    atol: Array
    descent: PreconditionedDescent
    search: Interpolating = Interpolating()
    norm: Callable = eqx.field(static=True, default=optx.two_norm)
    verbose: Callable = eqx.field(static=True, default=lambda **_: None)

    def step(self, fn, y, args, options, state, tags):
        """Look at the next point, and go on from there if it is accepted."""
        state = eqx.tree_at(lambda s: s.search_state.change, state, state.descent_state.change)
        return super().step(fn, y, args, options, state, tags)

    def begin(self, y: PyTree) -> Looking:
        """Start to look for the least from the host: what `init` does."""
        return Looking(jnp.asarray(True), y, self.search.init(y, None), None, None, self.descent.init(y, None), 0)

    def look(self, evaluate: Callable, y: PyTree, state: Looking) -> tuple[PyTree, Looking]:
        """Do what `step` does, from the host: a solve or a product that takes long is then a program by itself.

        Args:
            evaluate: Computes, at a point, the residuals, what to keep with them, and how to make their Jacobian.
            y: The point accepted last.
            state: What came of the last look.
        """
        residual, aux, linearise = evaluate(state.y_eval)
        before = None if state.f_info is None else state.f_info.residual
        change = state.descent_state.change
        accept, search_state = _searched(self.search, state.first_step, before, residual, change, state.search_state)
        f_info, descent_state, accepted = state.f_info, state.descent_state, state.num_accepted_steps
        if accept:
            y, f_info, accepted = state.y_eval, optx.FunctionInfo.ResidualJac(residual, linearise()), accepted + 1
            descent_state = self.descent.query(y, f_info, descent_state)
        y_eval = _beside(self.descent, y, search_state.step_size, descent_state)
        aux = aux if accept else state.aux
        return y, Looking(jnp.asarray(False), y_eval, search_state, f_info, aux, descent_state, accepted)

    def terminate(self, fn, y, args, options, state, tags):
        """Tell whether the next step is small."""
        del fn, y, args, options, tags
        return state.descent_state.change <= self.rtol, optx.RESULTS.successful


@eqx.filter_jit
def _searched(
    search: Interpolating, first_step: Array, before: PyTree, now: PyTree, change: Array, state: _Search
) -> tuple[Array, _Search]:
    """Tell whether a point is accepted, and how far to go next."""
    infos = [optx.FunctionInfo.Residual(residual) for residual in (before, now)]
    _, accept, _, state = search.step(first_step, None, None, *infos, eqx.tree_at(lambda s: s.change, state, change))
    return accept, state


@eqx.filter_jit
def _beside(descent: PreconditionedDescent, y: PyTree, step_size: Array, state: _Direction) -> PyTree:
    return plus(y, descent.step(step_size, state)[0])
