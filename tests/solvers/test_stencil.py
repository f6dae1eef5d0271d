"""The block stencil against dense matrices assembled entry by entry."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from opfem.solvers.stencil import apply_stencil, assemble_stencil, column_blocks, mask_stencil, with_unit_diagonal
from tests.oracles import assemble_dense, nodal_index
from tests.tolerances import ROUNDOFF

NX, NY, NZ = 4, 3, 2
SHAPE = (NZ + 1, NY + 1, NX + 1)
SIZE = 3 * int(np.prod(SHAPE))


@pytest.fixture(scope="module")
def K():
    """Element matrices without any symmetry."""
    return np.random.default_rng(0).standard_normal((NZ, 8, 8, 3, 3, NY, NX))


@pytest.fixture(scope="module")
def S(K):
    return jax.jit(assemble_stencil)(jnp.array(K))


@pytest.fixture(scope="module")
def free():
    """Bonded window, and a roller at x = 0."""
    free = np.ones((3, *SHAPE))
    free[:, 0] = free[0, ..., 0] = 0
    return free


_apply = jax.jit(apply_stencil)


def field(seed):
    return np.random.default_rng(seed).standard_normal((3, *SHAPE))


def test_product_equals_the_dense_matrix(K, S):
    dense, u = assemble_dense(K), field(1)
    expected = (dense @ u.ravel()).reshape(u.shape)
    np.testing.assert_allclose(_apply(S, jnp.array(u)), expected, ROUNDOFF, ROUNDOFF * np.abs(expected).max())


def test_entries_couple_a_node_with_its_neighbours(K, S):
    dense, stencil = assemble_dense(K), np.asarray(S)
    for dz, dy, dx in itertools.product(range(3), repeat=3):
        for z, y, x in itertools.product(*map(range, SHAPE)):
            other = (z + dz - 1, y + dy - 1, x + dx - 1)
            block = stencil[dz, 3 * dy + dx, :, :, z, y, x]
            if any(not 0 <= n < count for n, count in zip(other, SHAPE, strict=True)):
                np.testing.assert_array_equal(block, 0.0)
                continue
            rows, columns = ([nodal_index(SHAPE, c, *at) for c in range(3)] for at in ((z, y, x), other))
            np.testing.assert_allclose(block, dense[np.ix_(rows, columns)], ROUNDOFF, 10 * ROUNDOFF)


def test_product_is_linear_and_transposes_with_the_elements(K, S):
    """⟨K u, v⟩ = ⟨u, Kᵀ v⟩, the transpose taken element by element."""
    transposed = jax.jit(assemble_stencil)(jnp.array(np.transpose(K, (0, 2, 1, 4, 3, 5, 6))))
    u, v = field(2), field(3)
    left = np.sum(np.asarray(_apply(S, jnp.array(u))) * v)
    right = np.sum(u * np.asarray(_apply(transposed, jnp.array(v))))
    np.testing.assert_allclose(left, right, 10 * ROUNDOFF)


def test_held_unknowns_lose_rows_and_columns(K, S, free):
    u = field(9)
    expected = free.ravel() * (assemble_dense(K) @ (free * u).ravel())
    got = _apply(S * mask_stencil(free), jnp.array(u))
    np.testing.assert_allclose(got.ravel(), expected, ROUNDOFF, ROUNDOFF * np.abs(expected).max())


def test_unit_diagonal_is_put_only_where_a_row_is_empty(K, free):
    scale = 7.0
    S = jax.jit(lambda E: with_unit_diagonal(assemble_stencil(E) * mask_stencil(free), jnp.asarray(scale)))(
        jnp.array(K)
    )
    u = field(4)
    expected = free.ravel() * (assemble_dense(K) @ (free * u).ravel()) + scale * (1 - free.ravel()) * u.ravel()
    np.testing.assert_allclose(_apply(S, jnp.array(u)).ravel(), expected, ROUNDOFF, ROUNDOFF * np.abs(expected).max())


def test_column_blocks_are_the_columns_of_the_dense_matrix(K, S):
    dense, blocks = assemble_dense(K), np.asarray(column_blocks(S))
    for y, x in itertools.product(range(NY + 1), range(NX + 1)):
        places = [nodal_index(SHAPE, c, z, y, x) for c in range(3) for z in range(NZ + 1)]
        np.testing.assert_allclose(blocks[:, :, y, x], dense[np.ix_(places, places)], ROUNDOFF, 10 * ROUNDOFF)


def test_one_element_is_its_own_matrix():
    K = np.random.default_rng(5).standard_normal((1, 8, 8, 3, 3, 1, 1))
    u = np.random.default_rng(6).standard_normal((3, 2, 2, 2))
    expected = (assemble_dense(K) @ u.ravel()).reshape(u.shape)
    got = apply_stencil(assemble_stencil(jnp.array(K)), jnp.array(u))
    np.testing.assert_allclose(got, expected, ROUNDOFF, 10 * ROUNDOFF)


def test_jit_equals_eager_and_vmap_a_loop(S):
    fields = jnp.stack([field(7), field(8)])
    for lane, u in zip(jax.jit(jax.vmap(lambda v: apply_stencil(S, v)))(fields), fields, strict=True):
        eager = apply_stencil(S, u)
        np.testing.assert_allclose(lane, eager, ROUNDOFF, 10 * ROUNDOFF)
        np.testing.assert_allclose(_apply(S, u), eager, ROUNDOFF, 10 * ROUNDOFF)
