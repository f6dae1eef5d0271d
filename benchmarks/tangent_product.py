"""The product of the tangent with a field: share of the memory bandwidth, and against scipy's BSR matrix.

Run `python -m benchmarks.tangent_product [--elements 40 80 160]` for meshes of n × n × n/10 elements. Prints one
JSON line per mesh and precision: elements per second, bytes per element, the share of the bandwidth that the same
run measures, and the same of `scipy.sparse.bsr_array` with the same 3 × 3 blocks (which uses one core).
"""

import argparse
import itertools
import json
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse

from benchmarks.stream import best_seconds, read_bandwidth
from opfem.solvers.stencil import apply_stencil


def neighbours(shape: tuple[int, ...]) -> Iterator[tuple[tuple[int, int], tuple[slice, ...], tuple[slice, ...]]]:
    """Go through the blocks of a stencil: its place, the nodes that have such a neighbour, and the neighbours."""
    for dz, dy, dx in itertools.product(range(3), repeat=3):
        here = tuple(slice(max(0, 1 - d), n - max(0, d - 1)) for d, n in zip((dz, dy, dx), shape, strict=True))
        there = tuple(slice(max(0, d - 1), n - max(0, 1 - d)) for d, n in zip((dz, dy, dx), shape, strict=True))
        yield (dz, 3 * dy + dx), here, there


def without_outside(S: np.ndarray) -> np.ndarray:
    """Zero the blocks of neighbours that lie beyond the borders, as assembled stencils have them."""
    inside = np.zeros_like(S)
    for place, here, _ in neighbours(S.shape[4:]):
        inside[(*place, ..., *here)] = S[(*place, ..., *here)]
    return inside


def block_matrix(S: np.ndarray) -> scipy.sparse.bsr_array:
    """Build the sparse matrix of a stencil; its unknowns are ordered (node, component)."""
    shape = S.shape[4:]
    node = np.arange(np.prod(shape)).reshape(shape)
    rows, columns, blocks = [], [], []
    for place, here, there in neighbours(shape):
        rows.append(node[here].ravel())
        columns.append(node[there].ravel())
        blocks.append(np.moveaxis(S[(*place, ..., *here)].reshape(3, 3, -1), 2, 0))
    rows, columns, blocks = np.concatenate(rows), np.concatenate(columns), np.concatenate(blocks)
    order = np.lexsort((columns, rows))
    starts = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=node.size))])
    return scipy.sparse.bsr_array((blocks[order], columns[order], starts), shape=(3 * node.size, 3 * node.size))


def measure(n: int, dtype: type) -> dict:
    """Time both products on one mesh."""
    shape = (n // 10 + 1, n + 1, n + 1)
    rng = np.random.default_rng(0)
    S = without_outside(rng.standard_normal((3, 9, 3, 3, *shape), np.float32).astype(dtype))
    u = rng.standard_normal((3, *shape)).astype(dtype)
    bandwidth = read_bandwidth(dtype)
    product, stencil, field = jax.jit(apply_stencil), jnp.asarray(S), jnp.asarray(u)
    result = np.asarray(product(stencil, field))
    seconds = best_seconds(lambda: product(stencil, field).block_until_ready())
    matrix, vector = block_matrix(S), np.moveaxis(u, 0, -1).ravel()
    np.testing.assert_allclose(
        np.moveaxis((matrix @ vector).reshape(*shape, 3), -1, 0), result, atol=1e-4 * np.abs(result).max()
    )
    peer_seconds = best_seconds(lambda: matrix @ vector)
    elements = n * n * (n // 10)
    moved = S.nbytes + 2 * u.nbytes
    return {
        "elements": [n, n, n // 10],
        "dtype": np.dtype(dtype).name,
        "bytes_per_element": round(moved / elements),
        "Melements_per_s": elements / seconds / 1e6,
        "read_bandwidth_GB_per_s": bandwidth / 1e9,
        "share_of_bandwidth": moved / seconds / bandwidth,
        "bsr_Melements_per_s": elements / peer_seconds / 1e6,
        "times_bsr": peer_seconds / seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--elements", type=int, nargs="+", default=[40, 80, 160])
    jax.config.update("jax_enable_x64", True)
    for n, dtype in itertools.product(parser.parse_args().elements, (np.float64, np.float32)):
        print(json.dumps(measure(n, dtype)), flush=True)


if __name__ == "__main__":
    main()
