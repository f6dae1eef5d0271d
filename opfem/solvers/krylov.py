"""Flexible GMRES: the linear solver of one Newton step.

Frictional contact makes the tangent non-symmetric, and its curvature can make it indefinite;
the preconditioner is a symmetric positive V-cycle in float32. Restarted, with a fixed basis
size, so that it runs under jit and vmap.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree


class KrylovResult(NamedTuple):
    """Solution, relative residual estimate, and applications of the preconditioner."""

    x: PyTree
    relative_residual: Float[Array, ""]
    iterations: Array


class _Basis(NamedTuple):
    V: Array  # (m + 1, n) orthonormal directions
    Z: Array  # (m, n) preconditioned directions
    R: Array  # (m, m) triangular factor, columns filled one by one
    rotations: Array  # (2, m) Givens cosines and sines
    g: Array  # (m + 1,) rotated right-hand side
    j: Array


def fgmres(
    operator: Callable[[PyTree], PyTree],
    preconditioner: Callable[[PyTree], PyTree],
    b: PyTree,
    rtol: float | int | Array,
    basis: int,
    max_iterations: float | int | Array,
) -> KrylovResult:
    """Solve operator(x) = b to a residual of rtol × |b|.

    Args:
        operator: Linear map of a PyTree of the structure of b.
        preconditioner: Approximate inverse, in any precision.
        b: Right-hand side: a PyTree of arrays.
        rtol: Relative tolerance on the residual norm.
        basis: Directions kept before a restart.
        max_iterations: Limit of applications of the preconditioner; checked at restarts.

    Source:
        Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 9.6.
    """
    like, b = b, _flat(b)
    n = b.size
    target = jnp.asarray(rtol, b.dtype) * _norm(b)

    def restart(carry):
        x, r, iterations, _ = carry
        beta = _norm(r)
        start = _Basis(
            V=jnp.zeros((basis + 1, n), b.dtype).at[0].set(r / jnp.where(beta > 0, beta, 1.0)),
            Z=jnp.zeros((basis, n), jnp.float32),
            R=jnp.eye(basis, dtype=b.dtype),
            rotations=jnp.zeros((2, basis), b.dtype),
            g=jnp.zeros(basis + 1, b.dtype).at[0].set(beta),
            j=jnp.zeros((), int),
        )
        end = jax.lax.while_loop(
            lambda s: (s.j < basis) & (jnp.abs(s.g[s.j]) > target),
            lambda s: _extend(s, operator, preconditioner, like),
            start,
        )
        # Columns not reached keep the identity and a zero right-hand side.
        right = jnp.where(jnp.arange(basis) < end.j, end.g[:-1], 0.0)
        x = x + _back_substitute(end.R, right) @ end.Z
        r = _rotate_back(end) @ end.V
        return x, r, iterations + end.j, _norm(r)

    def unfinished(carry):
        _, _, iterations, size = carry
        return (size > target) & (iterations < max_iterations)

    x, _, iterations, size = jax.lax.while_loop(
        unfinished, restart, (jnp.zeros_like(b), b, jnp.zeros((), int), _norm(b) + target)
    )
    norm = _norm(b)
    return KrylovResult(_unflat(x, like), size / jnp.where(norm > 0, norm, 1.0), iterations)


def _extend(s: _Basis, operator, preconditioner, like: PyTree) -> _Basis:
    j = s.j
    z = _flat(preconditioner(_unflat(s.V[j], like))).astype(jnp.float32)
    w = _flat(operator(_unflat(z, like))).astype(s.V.dtype)

    def orthogonalise(k, carry):
        w, h = carry
        along = jnp.vdot(s.V[k], w)
        return w - along * s.V[k], h.at[k].set(along)

    w, h = jax.lax.fori_loop(0, j + 1, orthogonalise, (w, jnp.zeros_like(s.g)))
    size = _norm(w)

    def rotate(k, h):
        c, sn = s.rotations[0, k], s.rotations[1, k]
        turned = jnp.stack([c * h[k] + sn * h[k + 1], -sn * h[k] + c * h[k + 1]])
        return jax.lax.dynamic_update_slice(h, turned, (k,))

    h = jax.lax.fori_loop(0, j, rotate, h.at[j + 1].set(size))
    radius = jnp.sqrt(h[j] ** 2 + h[j + 1] ** 2)
    radius = jnp.where(radius > 0, radius, 1.0)
    c, sn = h[j] / radius, h[j + 1] / radius
    column = jnp.where(jnp.arange(s.R.shape[0]) < j, h[:-1], 0.0).at[j].set(radius)
    return _Basis(
        V=s.V.at[j + 1].set(w / jnp.where(size > 0, size, 1.0)),
        Z=s.Z.at[j].set(z),
        R=s.R.at[:, j].set(column),
        rotations=s.rotations.at[:, j].set(jnp.stack([c, sn])),
        g=s.g.at[j + 1].set(-sn * s.g[j]).at[j].set(c * s.g[j]),
        j=j + 1,
    )


def _back_substitute(R: Array, g: Array) -> Array:
    def row(k, y):
        i = R.shape[0] - 1 - k
        return y.at[i].set((g[i] - R[i] @ y) / R[i, i])

    return jax.lax.fori_loop(0, R.shape[0], row, jnp.zeros_like(g))


def _rotate_back(s: _Basis) -> Array:
    """Compute the residual from the basis, so that the operator is compiled once."""

    def rotate(i, r):
        k = s.j - 1 - i
        c, sn = s.rotations[0, k], s.rotations[1, k]
        return jax.lax.dynamic_update_slice(r, jnp.stack([-sn * r[k + 1], c * r[k + 1]]), (k,))

    return jax.lax.fori_loop(0, s.j, rotate, jnp.zeros_like(s.g).at[s.j].set(s.g[s.j]))


def _norm(v: Array) -> Array:
    return jnp.sqrt(jnp.vdot(v, v))


def _flat(tree: PyTree) -> Array:
    return jnp.concatenate([leaf.reshape(-1) for leaf in jax.tree.leaves(tree)])


def _unflat(v: Array, like: PyTree) -> PyTree:
    leaves, structure = jax.tree.flatten(like)
    parts = jnp.split(v, np.cumsum([leaf.size for leaf in leaves])[:-1])
    return jax.tree.unflatten(structure, [p.reshape(leaf.shape) for p, leaf in zip(parts, leaves, strict=True)])
