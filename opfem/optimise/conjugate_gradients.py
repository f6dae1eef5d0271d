"""Linear least squares by preconditioned conjugate gradients, driven from the host or traced.

The method is matrix-free: one iteration takes one product with the Jacobian and one with its transpose. Secant pairs
of the iterations improve the preconditioner of the next system by BFGS updates.
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
        residual: b - J x.
        gradient: Jᵀb.
        relative_gradient: Residual of the normal equations over their right-hand side, in the preconditioner's norm.
        iterations: Number of iterations.
        secants: Secant pairs of JᵀJ, those of these iterations included.
    """

    x: PyTree
    residual: PyTree
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
    added: Callable[[PyTree], PyTree] | None = None,
    secants: "Secants | None" = None,
) -> LeastSquares:
    """Minimise |J x - b|² / 2 - added(Jᵀb) · x by conjugate gradients on the normal equations (CGLS).

    The iteration runs on the host, one call per product, unless b is traced.

    Args:
        jacobian: Product with J.
        transpose: Product with Jᵀ.
        precondition: Approximate inverse of JᵀJ, symmetric positive definite; nearly linear suffices.
        b: Right-hand side.
        rtol: Relative tolerance of the gradient Jᵀ(b - J x) + added(Jᵀb), in the preconditioner's norm.
        most: Limit of iterations.
        negligible: Absolute tolerance of the same norm: the error of J x.
        added: Computes, from Jᵀb, the term added to this right-hand side; None: none.
        secants: Secant pairs of JᵀJ that correct the preconditioner; None: no correction, and no pair is recorded.

    Source:
        Björck, Numerical Methods for Least Squares Problems, algorithm 7.4.1 (CGLS), preconditioned;
        Notay, SIAM J. Sci. Comput. 22 (2000) 1444 (flexible CG for a nearly linear preconditioner);
        Morales and Nocedal, SIAM J. Optim. 10 (2000) 1079 (BFGS preconditioning by earlier iterations).
    """

    def iterate(carry: tuple["_Iteration", "Secants | None"]) -> tuple["_Iteration", "Secants | None"]:
        it, pairs = carry
        it = _line_minimum(it, jacobian(it.p))
        return turn(it, transpose(it.residual), pairs)

    def turn(it: "_Iteration", gradient: PyTree, pairs: "Secants | None") -> tuple["_Iteration", "Secants | None"]:
        if added is not None:
            it = _with_added(it, gradient, added)
        turned = _conjugate(it, gradient, precondition if pairs is None else QuasiNewtonInverse(precondition, pairs))
        return turned, None if pairs is None else _recorded(pairs, it, turned)

    def begin(like: PyTree) -> "_Iteration":
        zeros = jax.tree.map(lambda v: jnp.zeros(v.shape, v.dtype), like)
        zero = jnp.zeros((), jnp.result_type(*jax.tree.leaves(like)))
        limits = (jnp.asarray(limit, zero.dtype) for limit in (rtol, most, negligible))
        return _Iteration(zeros, b, zeros, zeros, zeros, zeros, zeros, zero, zero, jnp.zeros((), int), *limits)

    if is_traced(b):
        # The first pass computes the gradient only, so that each product is compiled once.
        start = begin(jax.eval_shape(transpose, b)), secants
        end, pairs = jax.lax.while_loop(lambda carry: _unfinished(carry[0]), iterate, start)
    else:
        gradient = transpose(b)
        end, pairs = turn(begin(gradient), gradient, secants)
        while _unfinished(end):
            end, pairs = iterate((end, pairs))
    relative_gradient = jnp.sqrt(end.size / jnp.where(end.first > 0, end.first, 1.0))
    return LeastSquares(end.x, end.residual, end.start, relative_gradient, end.count - 1, pairs)


class _Iteration(NamedTuple):
    x: PyTree
    residual: PyTree  # b - J x
    start: PyTree  # Jᵀb
    added: PyTree  # term added to Jᵀb
    before: PyTree  # gradient of the last iteration
    p: PyTree
    moved: PyTree  # last step along p
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
def _line_minimum(it: _Iteration, q: PyTree) -> _Iteration:
    """Step to the minimum along p, with q = J p."""
    squared = dot(q, q)
    step = jnp.where(squared > 0, it.size / jnp.where(squared > 0, squared, 1.0), 0.0)
    moved = jax.tree.map(lambda v: step * v, it.p)
    return it._replace(x=plus(it.x, moved), residual=plus(it.residual, q, -step), moved=moved)


@QuickJit
def _with_added(it: _Iteration, gradient: PyTree, added: Callable) -> _Iteration:
    """Compute in the first pass the term added to the right-hand side."""
    return it._replace(added=jax.lax.cond(it.count == 0, lambda: added(gradient), lambda: it.added))


@QuickJit
def _conjugate(it: _Iteration, gradient: PyTree, precondition: Callable) -> _Iteration:
    """Compute the next conjugate direction (Polak–Ribière form, for a nearly linear preconditioner)."""
    now = plus(gradient, it.added)
    z = precondition(now)
    new = dot(now, z)
    change = new - dot(it.before, z)
    return it._replace(
        start=jax.tree.map(lambda new, old: jnp.where(it.count == 0, new, old), gradient, it.start),
        before=now,
        p=plus(z, it.p, jnp.where(it.size > 0, change / jnp.where(it.size > 0, it.size, 1.0), 0.0)),
        size=new,
        first=jnp.where(it.count == 0, new, it.first),
        count=it.count + 1,
    )


@QuickJit
def _recorded(pairs: "Secants", it: _Iteration, turned: _Iteration) -> "Secants":
    """Record the secant pair of the last step; the first pass has none."""
    return pairs.appended(it.moved, plus(it.before, turned.before, -1.0))


def dot(a: PyTree, b: PyTree) -> Array:
    """Compute the inner product."""
    products = (jnp.vdot(v, w) for v, w in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
    return functools.reduce(operator.add, products)


def plus(a: PyTree, b: PyTree, factor: Array | float = 1.0) -> PyTree:
    """Compute a + factor b."""
    return jax.tree.map(lambda v, w: v + factor * w, a, b)


class Secants(NamedTuple):
    """BFGS pairs: steps and the changes of the gradient along them, newest last; unused pairs are zero."""

    step: PyTree
    change: PyTree

    @classmethod
    def none(cls, like: PyTree, memory: int) -> "Secants":
        """Make a memory without pairs."""
        zeros = jax.tree.map(lambda v: jnp.zeros((memory, *v.shape), v.dtype), like)
        return cls(zeros, zeros)

    def appended(self, step: PyTree, change: PyTree) -> "Secants":
        """Append a pair of positive curvature and drop the oldest one; other pairs are skipped."""
        positive = dot(step, change) > 0

        def append(stack, new):
            return jnp.where(positive, jnp.concatenate([stack[1:], new[None]]), stack)

        return Secants(*(jax.tree.map(append, *pair) for pair in zip(self, (step, change), strict=True)))

    def before(self, gradient: PyTree) -> tuple[PyTree, Array]:
        """Run the first loop of the two-loop recursion: right-hand side for the uncorrected matrix, and coefficients.

        Source:
            Nocedal and Wright, Numerical Optimization, algorithm 7.4 (two-loop recursion).
        """

        def one(q, secant):
            along = secant._weight() * dot(secant.step, q)
            return plus(q, secant.change, -along), along

        return jax.lax.scan(one, gradient, self, reverse=True)

    def after(self, x: PyTree, along: Array) -> PyTree:
        """Run the second loop: from the solution with the uncorrected matrix to the direction."""

        def one(x, each):
            secant, along = each
            return plus(x, secant.step, along - secant._weight() * dot(secant.change, x)), None

        return jax.lax.scan(one, x, (self, along))[0]

    def corrected(self, inverse: Callable[[PyTree], PyTree], gradient: PyTree) -> PyTree:
        """Compute the product with the BFGS update of an approximate inverse."""
        right, along = self.before(gradient)
        return self.after(inverse(right), along)

    def _weight(self) -> Array:
        curvature = dot(self.step, self.change)
        return jnp.where(curvature > 0, 1.0 / jnp.where(curvature > 0, curvature, 1.0), 0.0)


class QuasiNewtonInverse(eqx.Module):
    """BFGS update of an approximate inverse by secant pairs of the matrix."""

    inverse: Callable[[PyTree], PyTree]
    secants: Secants

    def __call__(self, gradient: PyTree) -> PyTree:
        """Compute its product with a gradient."""
        return self.secants.corrected(self.inverse, gradient)
