"""Element updates per second of the explicit solver, against a gather/scatter peer and the machine's arithmetic.

Run `python -m benchmarks.explicit_throughput [--elements 40 80 160] [--precision float32 float64] [--seconds 4]`.
Prints one JSON line per mesh and precision. All figures of a line come from one run: the machine is shared.

The peer is the same increment (contact, friction, bulk viscosity, mean dilatation) with the usual internal force:
nodal values gathered to an array of elements, einsum to the displacement gradient, the energy differentiated, its
gradient scattered. The arithmetic limit is the internal force's operations, as XLA counts them in its compiled
code, over the rate of a chain of multiply-adds in the cache.
"""

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import opfem as op
from opfem.mechanics.internal import LayerBody
from opfem.mechanics.layer_force import LayerForce
from opfem.solvers.explicit import prepare
from opfem.solvers.explicit_step import Dynamics, Motion, run


class GatherScatterForce(eqx.Module):
    """The peer: energy over element arrays, differentiated."""

    body: LayerBody
    connectivity: np.ndarray

    def __call__(self, u: jax.Array, extra_stress: Callable, *fields: Any) -> tuple[jax.Array, jax.Array]:
        cells, material = self.body.cells, self.body.material
        gradients = jnp.asarray(cells.kind.gradients, u.dtype)
        sizes = jnp.stack([cells.spacing[0], cells.spacing[1], cells.depth[0, 0, 0, 0]])
        dN_dX = jnp.moveaxis(gradients, 1, 2) / sizes
        weight = cells.weight[0, 0, 0, 0]

        def volume_ratio(u):
            nodal = u.reshape(3, -1).T[self.connectivity]
            F = jnp.einsum("eai,qaj->eqij", nodal, dN_dX) + jnp.eye(3, dtype=u.dtype)
            return F, jnp.linalg.det(F)

        shape = tuple(n - 1 for n in u.shape[1:])
        change = jnp.mean(volume_ratio(u)[1], axis=1) - 1.0
        extra = jax.lax.stop_gradient(extra_stress(change.reshape(shape), *fields).reshape(-1))

        def energy(u):
            F, J = volume_ratio(u)
            C = jnp.einsum("eqki,eqkj->eqij", F, F)
            I1 = jnp.trace(C, axis1=-2, axis2=-1)
            I2 = 0.5 * (I1**2 - jnp.einsum("eqij,eqij->eq", C, C))
            j = J ** (-2.0 / 3.0)
            mean = jnp.mean(J, axis=1) - 1.0
            isochoric = material.c10 * (j * I1 - 3.0) + material.c01 * (j * j * I2 - 3.0)
            return weight * (jnp.sum(isochoric) + 8.0 * jnp.sum(0.5 * material.bulk * mean**2 + extra * mean))

        return jax.grad(energy)(u), change.reshape(shape)


def connectivity(elements: tuple[int, int, int]) -> np.ndarray:
    """List the nodes of every element, `(elements, 8)`."""
    nz, ny, nx = elements
    nodes = np.arange((nz + 1) * (ny + 1) * (nx + 1)).reshape(nz + 1, ny + 1, nx + 1)
    corners = [(z, y, x) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    return np.stack([nodes[z : z + nz, y : y + ny, x : x + nx].ravel() for z, y, x in corners], axis=1)


def experiment(n: int, precision: str) -> tuple[Dynamics, Motion]:
    """State the layer under a smooth bump, n × n × n/10 elements."""
    y, x = np.meshgrid(np.linspace(0, 5, 61), np.linspace(0, 5, 61), indexing="ij")
    loaded = 0.5 - 0.04 - 0.06 * np.exp(-((x - 2.2) ** 2 + (y - 2.7) ** 2) / 1.5)
    palpation = op.Palpation(
        op.Layer(0.5, op.MooneyRivlin(2.23e-3, 7.03e-4, bulk=0.11732)),
        (5.0, 5.0),
        (n, n, n // 10),
        window=op.Contact(op.HardOverclosure(), 0.15),
        sample=op.Contact(op.ExponentialOverclosure(2.0, 0.01), 0.05),
    )
    solver = op.Explicit(precision="float32" if precision == "float32" else None)
    return prepare(palpation, op.Imprint(op.ThicknessMap(loaded, extent=(5.0, 5.0))), None, solver, None)


def rate(advance: Callable[[int], Any], seconds: float, elements: int) -> float:
    """Measure element updates per second: median of five runs of equal length."""
    advance(2)
    begin = time.perf_counter()
    advance(4)
    steps = max(4, int(4 * seconds / 5 / (time.perf_counter() - begin)))
    spent = []
    for _ in range(5):
        begin = time.perf_counter()
        advance(steps)
        spent.append(time.perf_counter() - begin)
    return elements * steps / float(np.median(spent))


def flop_rate(dtype) -> float:
    """Measure multiply-adds of the machine [flop/s]: a long chain on vectors that stay in the cache."""
    n, depth = 1 << 17, 512

    @jax.jit
    def chain(x):
        return jax.lax.fori_loop(0, depth // 32, lambda _, x: _thirty_two(x), x)

    x = jnp.linspace(0.0, 1.0, n, dtype=dtype)
    jax.block_until_ready(chain(x))
    spent = []
    for _ in range(5):
        begin = time.perf_counter()
        jax.block_until_ready(chain(x))
        spent.append(time.perf_counter() - begin)
    return 2.0 * n * depth / min(spent)


def _thirty_two(x):
    for _ in range(32):
        x = x * x.dtype.type(0.9999) + x.dtype.type(1e-4)
    return x


def operations(force: LayerForce, u: jax.Array) -> float:
    """Count the operations of one internal force per element, as XLA's cost analysis does.

    On a part that is not computed in blocks: the analysis counts one pass of a loop.
    """
    part = u[:, :5, :41, :41]
    compiled = jax.jit(lambda u: force(u, jnp.zeros_like)[0]).lower(part).compile()
    return float(compiled.cost_analysis()["flops"]) / (4 * 40 * 40)


def loop_rate(dynamics: Dynamics, start: Motion, seconds: float) -> float:
    """Measure whole increments."""
    dt = 0.5 * dynamics.stable_increment(start.u)
    loop = jax.jit(lambda m, steps: run(dynamics, m, dt, steps))
    return rate(lambda steps: jax.block_until_ready(loop(start, steps)), seconds, start.change.size)


def force_rate(force: LayerForce, u: jax.Array, seconds: float, elements: int) -> float:
    """Measure the internal force alone."""
    alone = jax.jit(lambda u: force(u, jnp.zeros_like)[0])

    def again(steps):
        for _ in range(steps):
            jax.block_until_ready(alone(u))

    return rate(again, seconds, elements)


def measure(n: int, precision: str, seconds: float) -> dict:
    """Measure one mesh in one precision."""
    made, start = experiment(n, precision)
    count = start.change.size
    peer = eqx.tree_at(lambda d: d.force, made, GatherScatterForce(made.force.body, connectivity((n // 10, n, n))))
    u = jnp.asarray(1e-3 * np.random.default_rng(0).standard_normal(start.u.shape), start.u.dtype)
    whole, other = loop_rate(made, start, seconds), loop_rate(peer, start, seconds)
    force = force_rate(made.force, u, seconds, count)
    work, machine = operations(made.force, u), flop_rate(start.u.dtype)
    return {
        "elements": (n, n, n // 10),
        "precision": precision,
        "updates_per_s": round(whole),
        "peer_updates_per_s": round(other),
        "ratio": round(whole / other, 2),
        "force_alone_per_s": round(force),
        "flop_per_element": round(work),
        "machine_Gflops": round(machine / 1e9, 1),
        "arithmetic_limit_per_s": round(machine / work),
        "fraction_of_limit": round(whole * work / machine, 3),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--elements", type=int, nargs="+", default=[40, 80, 160])
    parser.add_argument("--precision", nargs="+", default=["float32", "float64"])
    parser.add_argument("--seconds", type=float, default=4.0)
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for n in chosen.elements:
        for precision in chosen.precision:
            print(json.dumps(measure(n, precision, chosen.seconds)), flush=True)


if __name__ == "__main__":
    main()
