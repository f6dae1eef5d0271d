"""The thin-layer multigrid: Galerkin products, transfers, column inverses, and how well it preconditions."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.mechanics.internal import layer_body
from opfem.model import LayerMesh
from opfem.solvers.krylov import fgmres
from opfem.solvers.multigrid import (
    _coarsen_mask,
    _coarsened_axes,
    _enriched,
    _invert,
    _invert_columns,
    _prolong,
    _restrict,
    _sliding_rise,
    apply_multigrid,
    build_multigrid,
)
from opfem.solvers.stencil import (
    apply_stencil,
    assemble_stencil,
    coarsen_stencil,
    column_blocks,
    mask_stencil,
    with_unit_diagonal,
)
from tests.oracles import assemble_dense, linear_interpolation, nodal_index
from tests.tolerances import ROUNDOFF, ROUNDOFF_FLOAT32, SOLVER

MATERIAL = op.MooneyRivlin(2.2e-3, 7.03e-4, 0.11612)
# Counts of elements (nx, ny, nz): even, odd, odd again after halving, and an axis that is too short to coarsen.
MESHES = pytest.mark.parametrize("elements", [(4, 4, 1), (5, 3, 2), (6, 2, 1), (3, 5, 1)])


def interpolation(elements):
    """Dense matrix from coarse to fine nodal fields: linear in x and y, nothing along z."""
    nx, ny, nz = elements
    along = [linear_interpolation(n + 1) if n + 1 > 3 else np.eye(n + 1) for n in (ny, nx)]
    return np.kron(np.eye(3 * (nz + 1)), np.kron(*along))


def leaning_matrix(lean):
    """Dense matrix from nodal fields whose third component exceeds the lean to nodal fields."""
    shape = lean.shape[1:]
    T = np.eye(3 * int(np.prod(shape))).reshape(3, *shape, 3, *shape)
    for z, y, x in np.ndindex(*shape):
        T[2, z, y, x, :2, z, y, x] = lean[:, z, y, x]
    return T.reshape((3 * int(np.prod(shape)),) * 2)


def coarse_counts(elements):
    nx, ny, nz = elements
    return (*((n + 1) // 2 if n + 1 > 3 else n for n in (nx, ny)), nz)


def node_shape(elements):
    nx, ny, nz = elements
    return nz + 1, ny + 1, nx + 1


def element_matrices(elements, seed=0):
    nx, ny, nz = elements
    return np.random.default_rng(seed).standard_normal((nz, 8, 8, 3, 3, ny, nx))


def bottom_and_side_held(elements):
    free = np.ones((3, *node_shape(elements)))
    free[:, 0] = free[0, ..., 0] = free[0, ..., -1] = free[1, ..., 0, :] = 0
    return free


@MESHES
def test_prolongation_is_linear_interpolation(elements):
    coarse = np.random.default_rng(1).standard_normal((3, *node_shape(coarse_counts(elements))))
    fine = (3, *node_shape(elements))
    expected = (interpolation(elements) @ coarse.ravel()).reshape(fine)
    np.testing.assert_allclose(_prolong(jnp.array(coarse), fine), expected, ROUNDOFF, ROUNDOFF)


@MESHES
def test_restriction_is_the_transpose_of_prolongation(elements):
    rng = np.random.default_rng(2)
    v, w = (
        rng.standard_normal((3, *node_shape(coarse_counts(elements)))),
        rng.standard_normal((3, *node_shape(elements))),
    )
    left = np.sum(np.asarray(_prolong(jnp.array(v), w.shape)) * w)
    np.testing.assert_allclose(left, np.sum(v * np.asarray(_restrict(jnp.array(w)))), 10 * ROUNDOFF)


@MESHES
def test_coarse_stencil_is_the_galerkin_product(elements):
    K = element_matrices(elements)
    coarse = assemble_stencil(jnp.array(K))
    for axis in _coarsened_axes((1, *node_shape(elements))):
        coarse = coarsen_stencil(coarse, axis)
    shape = node_shape(coarse_counts(elements))
    assert coarse.shape[-3:] == shape
    P = interpolation(elements)
    expected = P.T @ assemble_dense(K) @ P
    columns = np.eye(len(expected)).reshape(-1, 3, *shape)
    product = np.asarray(jax.vmap(lambda u: apply_stencil(coarse, u))(jnp.array(columns))).reshape(expected.shape).T
    np.testing.assert_allclose(product, expected, ROUNDOFF, 10 * ROUNDOFF * np.abs(expected).max())


def test_coarse_level_is_the_galerkin_product_of_free_unknowns():
    """The level that is built, in float32: held unknowns neither give nor take; their rows hold the scale."""
    elements = (27, 15, 1)
    K = layer_stiffness(elements)
    free = bottom_and_side_held(elements)
    multigrid = eqx.filter_jit(lambda E: build_multigrid(E, free, jnp.asarray(1e-3)))(jnp.array(K))
    built = multigrid.levels[1].stencil
    P = leaning_matrix(np.asarray(multigrid.sliding_rise, float)) @ interpolation(elements)
    coarse_free = _coarsen_mask(free).ravel()
    fine = free.ravel()[:, None] * assemble_dense(K) * free.ravel()
    expected = coarse_free[:, None] * (P.T @ fine @ P) * coarse_free
    expected[np.diag(expected) == 0, np.diag(expected) == 0] = 1e-3
    for seed in (3, 4):
        u = np.random.default_rng(seed).standard_normal((3, *built.shape[-3:]))
        product = (expected @ u.ravel()).reshape(u.shape)
        got = apply_stencil(built, jnp.array(u, jnp.float32))
        np.testing.assert_allclose(got, product, ROUNDOFF_FLOAT32, ROUNDOFF_FLOAT32 * np.abs(product).max())


def test_coarse_mask_takes_every_second_node_and_frees_ghosts():
    free = bottom_and_side_held((5, 4, 1))
    coarse = _coarsen_mask(free)
    assert coarse.shape == (3, 2, 3, 4)
    np.testing.assert_array_equal(coarse[..., :3], free[..., ::2, ::2])
    np.testing.assert_array_equal(coarse[..., 3], 1.0)


def test_column_inverses_equal_numpy():
    elements = (3, 2, 3)
    nx, ny, nz = elements
    free = bottom_and_side_held(elements)
    K = layer_stiffness(elements)
    S = with_unit_diagonal(assemble_stencil(jnp.array(K)) * mask_stencil(free), jnp.asarray(1e-3))
    inverses = np.asarray(_invert_columns(column_blocks(S)))
    dense = free.ravel()[:, None] * assemble_dense(K) * free.ravel() + 1e-3 * np.diag(1 - free.ravel())
    for y in range(ny + 1):
        for x in range(nx + 1):
            places = [nodal_index((nz + 1, ny + 1, nx + 1), c, z, y, x) for c in range(3) for z in range(nz + 1)]
            expected = np.linalg.inv(dense[np.ix_(places, places)])
            np.testing.assert_allclose(inverses[:, :, y, x], expected, atol=10 * ROUNDOFF * np.abs(expected).max())


@pytest.mark.parametrize("m", [3, 12])
def test_inverse_by_blocks_equals_numpy(m):
    root = np.random.default_rng(3).standard_normal((24, 24))
    A = root @ root.T + 24 * np.eye(24)
    np.testing.assert_allclose(_invert(jnp.array(A), m), np.linalg.inv(A), atol=10 * ROUNDOFF)


@MESHES
def test_leaning_turns_heights_into_what_exceeds_the_lean(elements):
    shape = node_shape(elements)
    lean = np.random.default_rng(4).standard_normal((2, *shape))
    K = element_matrices(elements)
    expected = leaning_matrix(lean).T @ assemble_dense(K) @ leaning_matrix(lean)
    leaning = _enriched(assemble_stencil(jnp.array(K)), jnp.array(lean))
    columns = jnp.eye(3 * lean[0].size).reshape(-1, 3, *lean.shape[1:])
    found = np.asarray(jax.vmap(lambda u: apply_stencil(leaning, u))(columns)).reshape(len(columns), -1).T
    np.testing.assert_allclose(found, expected, atol=100 * ROUNDOFF * np.abs(expected).max())


# A bonded layer, ten to four times as wide as thick.


def layer_stiffness(elements, extent=(5.0, 4.0), thickness=0.5):
    nx, ny, nz = elements
    y, x = np.meshgrid(np.linspace(0, 1, ny + 1), np.linspace(0, 1, nx + 1), indexing="ij")
    L0 = thickness * (1 + 0.1 * np.sin(3 * x) * np.cos(2 * y))
    body = layer_body(LayerMesh(jnp.array(L0), jnp.array(extent), nz), MATERIAL, "mean_dilatation")
    return np.asarray(_stiffness_at_rest(body, jnp.zeros((3, *node_shape(elements)))))


_stiffness_at_rest = eqx.filter_jit(lambda body, u: body.cell_stiffness(u))


@pytest.mark.parametrize("elements", [(6, 4, 2), (3, 2, 5)])
def test_columns_bound_the_spectrum(elements):
    """An element touches four columns: no eigenvalue is above 4, what the smoother is built for."""
    K, shape = layer_stiffness(elements), node_shape(elements)
    free = bottom_and_side_held(elements).ravel() == 1
    column = np.broadcast_to(np.arange(shape[1] * shape[2]).reshape(shape[1:]), (3, *shape)).ravel()[free]
    dense = assemble_dense(K)[np.ix_(free, free)]
    within = np.where(column[:, None] == column, dense, 0.0)
    assert 2.0 < np.linalg.eigvals(np.linalg.solve(within, dense)).real.max() < 4.0


def rollers(elements, bonded):
    free = np.ones((3, *node_shape(elements)))
    if bonded:
        free[:, 0] = 0
    else:
        free[2, 0] = 0
    free[0, ..., 0] = free[0, ..., -1] = free[1, ..., 0, :] = free[1, ..., -1, :] = 0
    return free


@partial(jax.jit, static_argnums=(2,))
def _solve(K, b, mask):
    free = np.frombuffer(mask).reshape(b.shape)
    scale = jnp.asarray(1e-3)
    S = with_unit_diagonal(assemble_stencil(K) * mask_stencil(free), scale)
    multigrid = build_multigrid(K, free, scale)
    solution = fgmres(
        lambda v: apply_stencil(S, v),
        lambda v: apply_multigrid(multigrid, v),
        b,
        jnp.asarray(SOLVER / 10),
        basis=30,
        max_iterations=60,
    )
    return solution, b - apply_stencil(S, solution.x)


@pytest.mark.parametrize(
    ("elements", "extent", "bonded"),
    [((13, 7, 3), (5.0, 2.7), True), ((20, 2, 16), (2.5, 0.25), False)],
    ids=["13x7x3", "20x2x16 on a roller"],
)
def test_a_thin_layer_converges_in_few_iterations(elements, extent, bonded):
    """A random load, so that every frequency is in it, to 1e-8: 32 to 37 when this was written."""
    free = rollers(elements, bonded)
    b = free * np.random.default_rng(5).standard_normal(free.shape)
    solution, residual = _solve(jnp.array(layer_stiffness(elements, extent)), jnp.array(b), free.tobytes())
    assert solution.iterations < 40
    assert np.linalg.norm(residual) <= 2 * SOLVER / 10 * np.linalg.norm(b)
    np.testing.assert_array_equal(np.asarray(solution.x)[free == 0], 0.0)


def on_an_uneven_sample(elements, slope=0.3, wave=4.0, times_the_layer=200.0):
    """Stiffness of a layer whose interface is held stiffly, without friction, along the normals of an egg box.

    `wave` is its length in elements.
    """
    nx, ny, nz = elements
    K = np.array(layer_stiffness(elements, (5.0, 5.0)))
    spring = times_the_layer * MATERIAL.shear * nz / 0.5 * (5.0 / nx) * (5.0 / ny) / 4
    for a, (right, up) in enumerate([(0, 0), (1, 0), (0, 1), (1, 1)], start=4):
        x, y = 2 * np.pi / wave * np.stack(np.meshgrid(np.arange(nx) + right, np.arange(ny) + up))
        normal = np.stack([slope * np.sin(x) * np.cos(y), slope * np.cos(x + 1) * np.sin(y), np.ones((ny, nx))])
        K[-1, a, a] += spring * normal[:, None] * normal
    return K


def test_a_layer_that_slides_on_an_uneven_sample_converges_as_fast():
    """Coarse grids need heights that follow lateral motion: 21 iterations when this was written, 36 without."""
    elements = (16, 16, 2)
    free = np.ones((3, *node_shape(elements)))
    free[2, 0] = free[0, ..., 0] = free[1, ..., 0, :] = 0
    b = free * np.random.default_rng(5).standard_normal(free.shape)
    solution, residual = _solve(jnp.array(on_an_uneven_sample(elements)), jnp.array(b), free.tobytes())
    assert solution.iterations < 26
    assert np.linalg.norm(residual) <= 2 * SOLVER / 10 * np.linalg.norm(b)


def test_heights_that_follow_lateral_motion_need_little_energy():
    """Four steps leave less than a fifth of the vertical force that lateral motion alone makes."""
    elements = (6, 6, 1)
    K = on_an_uneven_sample(elements)
    dense, n = assemble_dense(K), int(np.prod(node_shape(elements)))
    zz, zx = dense[2 * n :, 2 * n :], dense[2 * n :, :n]
    lean = np.asarray(_sliding_rise(assemble_stencil(jnp.array(K))))[0].ravel()
    left = zx.sum(axis=1) + zz @ lean
    assert np.linalg.norm(left) < 0.2 * np.linalg.norm(zx.sum(axis=1))


def test_v_cycle_is_symmetric_and_positive():
    """What conjugate directions and the inverse's covariance rely on; to the rounding of float32."""
    elements = (8, 8, 2)
    free = rollers(elements, bonded=True)
    K = jnp.array(layer_stiffness(elements, (5.0, 5.0)))
    apply = jax.jit(lambda v: apply_multigrid(build_multigrid(K, free, jnp.asarray(1e-3)), v))
    rng = np.random.default_rng(6)
    u, v = (free * rng.standard_normal(free.shape) for _ in range(2))
    Mu, Mv = (np.asarray(apply(jnp.array(w)), float) for w in (u, v))
    size = np.sqrt(np.sum(u * Mu) * np.sum(v * Mv))
    assert np.sum(u * Mu) > 0
    np.testing.assert_allclose(np.sum(v * Mu), np.sum(u * Mv), atol=10 * ROUNDOFF_FLOAT32 * size)


def test_a_small_mesh_is_solved_at_once():
    """Below the size of the dense solve there is no level and one application is the answer."""
    elements = (2, 2, 2)
    free = rollers(elements, bonded=True)
    K = layer_stiffness(elements, (0.5, 0.5))
    multigrid = jax.jit(lambda E: build_multigrid(E, free, jnp.asarray(1e-3)))(jnp.array(K))
    assert not multigrid.levels
    inner = free.ravel() == 1
    b = np.random.default_rng(7).standard_normal(free.shape) * free
    expected = np.linalg.solve(assemble_dense(K)[np.ix_(inner, inner)], b.ravel()[inner])
    got = np.asarray(apply_multigrid(multigrid, jnp.array(b))).ravel()
    np.testing.assert_allclose(got[inner], expected, atol=1e2 * ROUNDOFF_FLOAT32 * np.abs(expected).max())


@pytest.mark.timeout(120, method="thread")
def test_two_multigrids_in_one_program_do_not_block_each_other():
    """Two batched LAPACK calls at once wait for ever on two cores (jaxlib 0.10.2); there must be none."""
    elements = (12, 12, 2)
    free = rollers(elements, bonded=True)
    K = jnp.array(layer_stiffness(elements, (5.0, 5.0)))
    r = jnp.array(free * np.random.default_rng(8).standard_normal(free.shape))

    @jax.jit
    def both(first, second):
        return [apply_multigrid(build_multigrid(E, free, jnp.asarray(1e-3)), r) for E in (first, second)]

    for _ in range(5):
        one, two = both(K, 2.0 * K)
    np.testing.assert_allclose(one, 2.0 * np.asarray(two), rtol=0, atol=1e2 * ROUNDOFF_FLOAT32 * np.abs(one).max())
