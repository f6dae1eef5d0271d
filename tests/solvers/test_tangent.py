"""The tangent of the discrete problem against the derivative of its residual, for everything a palpation can have."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.solvers.discretise import discretise
from opfem.solvers.tangent import Unknowns
from tests.tolerances import ROUNDOFF_FLOAT32

ELEMENTS = (6, 4, 2)
MATERIAL = op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=0.11732)
SOFT = op.Contact(op.ExponentialOverclosure(pressure=2.0, clearance=0.01), friction=0.2)
PRESSED = op.Imprint(op.ThicknessMap(np.full((5, 7), 0.44), extent=(2.0, 1.4)))


def problem_of(load=PRESSED, window=SOFT, sample=SOFT, material=MATERIAL, **options):
    palpation = op.Palpation(op.Layer(0.5, material), (2.0, 1.4), ELEMENTS, window, sample, **options)
    return discretise(palpation, load, None, "gauss2")


CASES = {
    "contact on both sides": lambda: problem_of(),
    "held by a spring": lambda: problem_of(hold=0.3),
    "rollers and bonded": lambda: problem_of(
        op.Displacement(-0.05), op.Bonded(), op.Roller(), sides={"x0": "roller", "y1": "roller"}
    ),
    "bed of springs": lambda: problem_of(op.Traction(0.002, stiffness=0.05)),
    "hybrid": lambda: problem_of(element="hybrid", material=op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=jnp.inf)),
    "tet10": lambda: problem_of(element="tet10", hold=0.3),
    "reduced": lambda: problem_of(op.Traction(0.002), op.Bonded(), element="reduced"),
}
QUICK = ("contact on both sides", "hybrid")


@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in CASES])
def test_product_is_the_derivative_of_the_residual(name):
    problem = eqx.tree_at(lambda p: p.viscosity, CASES[name](), jnp.asarray(0.2))
    rng = np.random.default_rng(0)
    state = problem.initial_state()
    shape = problem.positions.shape
    free = problem.free
    squeezed = -0.1 * np.asarray(problem.positions) * np.array([0.0, 0.0, 1.0])[:, None, None, None]
    stress = None if state.mean_stress is None else jnp.asarray(1e-3 * rng.standard_normal(state.mean_stress.shape))
    x = Unknowns(jnp.asarray(squeezed + 2e-3 * rng.standard_normal(shape)) * free, stress)
    along, across = (jax.tree.map(lambda v: jnp.asarray(rng.standard_normal(v.shape)), x) for _ in range(2))
    along, across = (v._replace(u=v.u * free) for v in (along, across))

    @eqx.filter_jit
    def products(problem, x):
        fraction, held, scale = jnp.asarray(0.8), jnp.asarray(False), problem.stress_scale

        def residual(x):
            return problem.residual(problem.forces(x, fraction, state), held)

        _, expected = jax.jvp(residual, (x,), (along.scaled(scale),))
        tangents = [problem.tangent(x, fraction, state, None, transposed) for transposed in (False, True)]
        forward, back = (t.apply(v) for t, v in zip(tangents, (along, across), strict=True))
        return expected.scaled(scale), forward, back

    expected, got, back = products(problem, x)
    np.testing.assert_array_less(0.0, np.abs(expected.u).max())
    for part, right in zip(jax.tree.leaves(got._replace(u=got.u * free)), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(part, right, rtol=0, atol=30 * ROUNDOFF_FLOAT32 * np.abs(right).max())

    def dot(a, b):
        return sum(
            np.vdot(np.asarray(v, float), w) for v, w in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
        )

    size = np.sqrt(dot(got, got) * dot(across, across))
    np.testing.assert_allclose(dot(across, got), dot(along, back), rtol=0, atol=30 * ROUNDOFF_FLOAT32 * size)
