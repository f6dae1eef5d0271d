"""Multigrid for a thin layer: the preconditioner of the tangent system.

Semi-coarsening in x and y: a Chebyshev smoother solves each column exactly, with the strong coupling through the
thickness and the contact stiffness. Coarse operators are Galerkin products, stencils like the finest one; all is
float32 inside float64 iterations. The prolongation to the finest grid is enriched by rigid sliding modes along a tilted
contact (`_sliding_rise`). An odd number of elements is padded with an empty one, so that any mesh coarsens.
"""

from functools import partial, reduce
from operator import add
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics.hex8 import pad_axis
from ..mechanics.unfused import unfused
from .stencil import (
    ElementMatrices,
    Nodal,
    PartNodal,
    Stencil,
    apply_stencil,
    assemble_stencil,
    coarsen_stencil,
    column_blocks,
    dense_matrix,
    mask_stencil,
    neighbours,
    with_unit_diagonal,
)

# Interval of eigenvalues that the smoother damps. 4 is an upper bound: an element has nodes in four columns, so that
# xᵀ K x ≤ 4 xᵀ D x for the part D of K within columns (element by element, by the triangle inequality).
_SMOOTHED = (0.5, 4.0)
# Smoothing steps before and after the coarse correction.
_SMOOTHING_STEPS = 2
# Chebyshev steps for the sliding modes.
_RISE_STEPS = 4
# The coarsest grid is solved by one dense inverse of at most about this many unknowns. 540 would save the coin on
# 40×40×4 elements a grid, 700 of 13 800 instructions to compile, and cost 12 % of run time: the inverse, and 4 steps
# of 78 more.
_DENSE_UNKNOWNS = 450


def _chebyshev(steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute the factors of the last step and of the preconditioned residual in every step.

    Source:
        Saad, Iterative Methods for Sparse Linear Systems, 2nd ed., algorithm 12.1.
    """
    low, high = _SMOOTHED
    centre, half_width = 0.5 * (high + low), 0.5 * (high - low)
    rho = half_width / centre
    of_step, of_residual = [0.0], [1.0 / centre]
    for _ in range(steps - 1):
        next_rho = 1.0 / (2.0 * centre / half_width - rho)
        of_step.append(next_rho * rho)
        of_residual.append(2.0 * next_rho / half_width)
        rho = next_rho
    return np.array(of_step), np.array(of_residual)


class Level(NamedTuple):
    """One grid: its operator, column inverses and free unknowns."""

    stencil: Stencil
    columns: Float[Array, "m m my mx"]
    free: Nodal | None


class Multigrid(NamedTuple):
    """The operator of the finest grid, the levels, finest first, and the inverse of the coarsest operator.

    `sliding_rise` is the energy-minimising u_z of the finest grid for unit translations along x and y; zeros without
    coarse grids.
    """

    finest: Stencil
    sliding_rise: Float[Array, "2 mz my mx"]
    levels: tuple[Level, ...]
    coarsest: Float[Array, "n n"]
    coarsest_free: Nodal | None


def build_multigrid(K: ElementMatrices, free: np.ndarray | None, scale: Array) -> Multigrid:
    """Set up the preconditioner.

    Args:
        K: Element matrices [N/mm], contact included, symmetric positive definite on free unknowns.
        free: Static mask of free unknowns; None: all are free.
        scale: Typical stiffness [N/mm], for the rows of fixed unknowns.
    """
    S = assemble_stencil(K.astype(jnp.float32))
    scale = scale.astype(jnp.float32)
    levels = []
    while True:
        mask = None if free is None else jnp.asarray(free, jnp.float32)
        S = S if free is None else S * jnp.asarray(mask_stencil(free), S.dtype)
        # A coarse grid may have ghost nodes.
        whole = S if free is None and not levels else unfused(with_unit_diagonal, S, scale)
        nodes = S.shape[-3:]
        if not levels:
            finest, sliding_rise = whole, jnp.zeros((2, *nodes), S.dtype)
        if 3 * int(np.prod(nodes)) <= _DENSE_UNKNOWNS or max(nodes[1:]) <= 3:
            return Multigrid(
                finest, sliding_rise, tuple(levels), _invert(dense_matrix(whole), int(np.prod(nodes[1:]))), mask
            )
        levels.append(Level(whole, _invert_columns(column_blocks(whole)), mask))
        if len(levels) == 1:
            sliding_rise = _sliding_rise(whole) if mask is None else mask[:2] * _sliding_rise(whole)
            S = unfused(_enriched, S, sliding_rise)
        for axis in _coarsened_axes(S.shape):
            S = unfused(partial(coarsen_stencil, axis=axis), S)
        free = None if free is None else _coarsen_mask(free)


def apply_multigrid(multigrid: Multigrid, r: Nodal) -> Nodal:
    """Apply one V-cycle, in float32."""
    return _v_cycle(multigrid, 0, r.astype(jnp.float32))


def _v_cycle(multigrid: Multigrid, depth: int, r: Nodal) -> Nodal:
    if depth == len(multigrid.levels):
        return (multigrid.coarsest @ r.reshape(-1)).reshape(r.shape)
    level = multigrid.levels[depth]

    def correction(r):
        if depth == 0:
            r = jnp.concatenate([r[:2] + multigrid.sliding_rise * r[2], r[2:]])
        coarse = _v_cycle(multigrid, depth + 1, _free(multigrid, depth + 1, _restrict(r)))
        fine = _prolong(coarse, r.shape)
        if depth == 0:
            fine = jnp.concatenate(
                [fine[:2], fine[2:] + jnp.sum(multigrid.sliding_rise * fine[:2], axis=0, keepdims=True)]
            )
        return fine if level.free is None else fine * level.free

    half, factors = _SMOOTHING_STEPS, _chebyshev(_SMOOTHING_STEPS)
    of_step, of_residual = (jnp.asarray(np.concatenate([f, [0.0], f]), r.dtype) for f in factors)

    # Pre-smoothing, coarse correction and post-smoothing in one loop, so that each part is compiled once. The last
    # residual is not used, but its product costs less than a second copy of the smoother.
    def move(k, carry):
        x, r, step = carry
        step = jax.lax.cond(
            k == half,
            lambda: correction(r),
            lambda: of_step[k] * step + of_residual[k] * _solve_columns(level.columns, r),
        )
        return x + step, r - apply_stencil(level.stencil, step), step

    none = jnp.zeros_like(r)
    return jax.lax.fori_loop(0, 2 * half + 1, move, (none, r, none))[0]


def _sliding_rise(S: Stencil) -> Float[Array, "2 mz my mx"]:
    """Compute the energy-minimising u_z response to unit translations along x and y; it enriches the prolongation.

    A layer that slides along an uneven sample rises and falls with it. Without these modes, interpolated sliding would
    compress the stiff contact, and coarse grids would overestimate the stiffness of a soft motion.
    """
    zz = S[:, :, 2:, 2:]
    columns = _invert_columns(column_blocks(zz))
    of_step, of_residual = (jnp.asarray(factors, S.dtype) for factors in _chebyshev(_RISE_STEPS))

    def settle(push):
        def move(k, carry):
            z, r, step = carry
            step = of_step[k] * step + of_residual[k] * _solve_columns(columns, r)
            return z + step, r - apply_stencil(zz, step), step

        none = jnp.zeros_like(push)
        return jax.lax.fori_loop(0, _RISE_STEPS, move, (none, push, none))[0]

    push = reduce(add, (-S[dz, d, 2, :2] for dz in range(3) for d in range(9)))
    return jax.vmap(settle)(push[:, None])[:, 0]


def _enriched(S: Stencil, sliding_rise: Float[Array, "2 mz my mx"]) -> Stencil:
    """Change the basis of the third component to u_z minus the response to sliding."""
    S = jnp.concatenate(
        [S[:, :, :, :2] + neighbours(sliding_rise)[:, :, None] * S[:, :, :, 2:], S[:, :, :, 2:]], axis=3
    )
    return jnp.concatenate([S[:, :, :2] + sliding_rise[:, None] * S[:, :, 2:], S[:, :, 2:]], axis=2)


def _free(multigrid: Multigrid, depth: int, r: Nodal) -> Nodal:
    mask = multigrid.levels[depth].free if depth < len(multigrid.levels) else multigrid.coarsest_free
    return r if mask is None else r * mask


def _solve_columns(inverses: Array, r: PartNodal) -> PartNodal:
    return unfused(_times_columns, inverses, r)


def _times_columns(inverses: Array, r: PartNodal) -> PartNodal:
    components, layers = r.shape[:2]
    # Row j of a symmetric inverse times unknown j, summed over layers for all components at once.
    rows = inverses.reshape(components, layers, components * layers, *r.shape[2:])
    products = [rows[:, z] * r[:, z, None] for z in range(layers)]
    by_component = sum(products[1:], start=products[0])
    return sum((by_component[c] for c in range(1, components)), start=by_component[0]).reshape(r.shape)


def _invert_columns(blocks: Array) -> Array:
    """Invert every column's matrix by Gauss–Jordan elimination, vectorised over columns.

    No pivoting: the blocks are symmetric positive definite. No batched LAPACK: two concurrent calls deadlock on two
    cores (jaxlib 0.10.2).
    """
    rows = jnp.arange(blocks.shape[0])

    def eliminate(k, B):
        is_k = (rows == k)[:, None, None]
        column = B[:, k]
        row = jnp.where(is_k, 1.0, B[k]) / B[k, k]
        B = jnp.where(is_k[None], 0.0, B) - column[:, None] * row[None]
        return jnp.where(is_k[:, None], row[None], B)

    return jax.lax.fori_loop(0, blocks.shape[0], eliminate, blocks)


def _invert(A: Float[Array, "n n"], m: int) -> Float[Array, "n n"]:
    """Invert a symmetric positive matrix by Gauss–Jordan elimination of m unknowns at once; m divides n.

    On two cores LAPACK takes up to five times longer here, because its threads wait for those of XLA.
    """
    n = A.shape[0]

    def eliminate(k, B):
        at = k * m
        rows, columns = jax.lax.dynamic_slice(B, (at, 0), (m, n)), jax.lax.dynamic_slice(B, (0, at), (n, m))
        pivot = jax.lax.dynamic_slice(rows, (0, at), (m, m))
        pivot = _invert_columns(pivot[..., None, None])[..., 0, 0]
        rows = pivot @ jax.lax.dynamic_update_slice(rows, jnp.eye(m, dtype=B.dtype), (0, at))
        columns = jax.lax.dynamic_update_slice(columns, jnp.zeros((m, m), B.dtype), (at, 0))
        B = jax.lax.dynamic_update_slice(B, jnp.zeros((n, m), B.dtype), (0, at)) - columns @ rows
        return jax.lax.dynamic_update_slice(B, rows, (at, 0))

    return jax.lax.fori_loop(0, n // m, eliminate, A)


def _coarsened_axes(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the lateral axes of more than two elements, which coarsen."""
    return tuple(axis for axis in (-1, -2) if shape[axis] > 3)


def _coarsen_mask(free: np.ndarray) -> np.ndarray:
    for axis in _coarsened_axes(free.shape):
        if free.shape[axis] % 2 == 0:  # odd number of elements: the ghost node is free
            widths = np.zeros((free.ndim, 2), int)
            widths[axis, 1] = 1
            free = np.pad(free, widths, constant_values=1)
        free = free[..., ::2] if axis == -1 else free[..., ::2, :]
    return free


def _prolong(v: Array, shape: tuple[int, ...]) -> Array:
    for axis in _coarsened_axes(shape):
        low, high = _without_end(v, axis, 0), _without_end(v, axis, 1)
        pairs = jnp.stack([low, 0.5 * (low + high)], axis=v.ndim + axis + 1)
        doubled = list(v.shape)
        doubled[axis] = 2 * (v.shape[axis] - 1)
        last = jax.lax.slice_in_dim(v, v.shape[axis] - 1, None, axis=v.ndim + axis)
        v = jnp.concatenate([pairs.reshape(doubled), last], axis=axis)
    return v[..., : shape[-2], : shape[-1]]


def _restrict(r: Array) -> Array:
    for axis in _coarsened_axes(r.shape):
        reach = r.shape[axis] // 2 * 2 + 1  # of the coarse nodes; the last may be a ghost
        r = pad_axis(r, axis, (1, reach + 1 - r.shape[axis]))
        before, at, after = (jax.lax.slice_in_dim(r, k, k + reach, 2, r.ndim + axis) for k in range(3))
        r = at + 0.5 * (before + after)
    return r


def _without_end(v: Array, axis: int, start: int) -> Array:
    return jax.lax.slice_in_dim(v, start, start + v.shape[axis] - 1, axis=v.ndim + axis)
