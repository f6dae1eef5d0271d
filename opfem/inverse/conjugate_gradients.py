"""Linear least squares by preconditioned conjugate gradients, driven from the host or traced.

Nothing is materialised: one iteration multiplies once with the Jacobian and once with its transpose. What iterations
find out of the normal matrix corrects the preconditioner of the next system (BFGS on top of it).
"""

import functools
import operator
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ..solvers.compiling import QuickJit, is_traced


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
        limits = (jnp.asarray(limit, zero.dtype) for limit in (rtol, most, negligible))
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


@QuickJit
def _unfinished(it: _Iteration) -> Array:
    enough = jnp.maximum(it.rtol**2 * it.first, it.negligible**2)
    return (it.count == 0) | ((it.size > enough) & (it.count <= it.most))


@QuickJit
def _along(it: _Iteration, q: PyTree) -> _Iteration:
    """Go along p, whose product with J is q, as far as residuals fall."""
    squared = dot(q, q)
    step = jnp.where(squared > 0, it.size / jnp.where(squared > 0, squared, 1.0), 0.0)
    moved = jax.tree.map(lambda v: step * v, it.p)
    return it._replace(x=plus(it.x, moved), rest=plus(it.rest, q, -step), moved=moved)


@QuickJit
def _with_added(it: _Iteration, gradient: PyTree, further: Callable) -> _Iteration:
    """Find in the first pass what is to be added to the right-hand side."""
    return it._replace(added=jax.lax.cond(it.count == 0, lambda: further(gradient), lambda: it.added))


@QuickJit
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


@QuickJit
def _learnt(found: "Secants", it: _Iteration, turned: _Iteration) -> "Secants":
    """Learn of JᵀJ from the last step; in the first pass there was none."""
    return found.followed_by(it.moved, plus(it.before, turned.before, -1.0))


def dot(a: PyTree, b: PyTree) -> Array:
    """Sum the products of all numbers."""
    products = (jnp.vdot(v, w) for v, w in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
    return functools.reduce(operator.add, products)


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
