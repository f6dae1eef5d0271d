"""What is evaluated apart is evaluated all the same: values, batches, derivatives, and the border itself."""

import jax
import jax.numpy as jnp
import numpy as np

import opfem as op
from opfem import _device
from opfem.mechanics.internal import layer_body
from opfem.mechanics.layer_force import LayerForce
from opfem.mechanics.unfused import mapped, unfused
from opfem.solvers.multigrid import apply_multigrid, build_multigrid
from tests.tolerances import ROUNDOFF


def _pair(x, scale):
    return {"sine": scale * jnp.sin(x), "count": jnp.arange(3)}


def test_values_are_the_function_s_under_jit_and_vmap():
    x = jnp.linspace(0.0, 1.0, 5)
    expected = _pair(x, 2.0)
    for got in (unfused(_pair, x, 2.0), jax.jit(lambda x: unfused(_pair, x, 2.0))(x)):
        np.testing.assert_allclose(got["sine"], expected["sine"], ROUNDOFF)
        np.testing.assert_array_equal(got["count"], expected["count"])
    lanes = jax.vmap(lambda scale: unfused(_pair, x, scale)["sine"])(jnp.array([1.0, 3.0]))
    np.testing.assert_allclose(lanes, [jnp.sin(x), 3.0 * jnp.sin(x)], ROUNDOFF)


def test_derivatives_go_through():
    x = jnp.linspace(0.0, 1.0, 5)
    gradient = jax.jit(jax.grad(lambda x: jnp.sum(unfused(_pair, x, 2.0)["sine"])))(x)
    np.testing.assert_allclose(gradient, 2.0 * jnp.cos(x), ROUNDOFF)
    _, change = jax.jvp(lambda x: unfused(_pair, x, 2.0)["sine"], (x,), (jnp.ones_like(x),))
    np.testing.assert_allclose(change, 2.0 * jnp.cos(x), ROUNDOFF)


def test_the_compiler_keeps_the_border_on_cpu():
    """Should it learn to resolve the condition, solves become several times slower without any other sign."""
    compiled = jax.jit(lambda x: unfused(jnp.sin, x + 1.0) + 1.0).lower(jnp.ones(1000)).compile()
    assert "conditional(" in compiled.as_text()
    batched = jax.jit(jax.vmap(lambda x: unfused(jnp.sin, x + 1.0) + 1.0)).lower(jnp.ones((4, 1000))).compile()
    assert "conditional(" in batched.as_text()


def test_an_accelerator_s_program_gives_what_the_cpu_s_does(monkeypatch):
    palpation = op.Palpation(op.Layer(0.5, op.NeoHooke(2.9e-3, 0.1)), (1.0, 0.8), (7, 5, 2), op.Bonded(), op.Bonded())
    mesh = palpation.mesh()
    body = layer_body(mesh, palpation.layer.material, palpation.element)
    u = 0.01 * jnp.asarray(np.random.default_rng(0).standard_normal(mesh.positions().shape))

    def evaluate(u):
        force, _ = LayerForce(body, True)(u, jnp.zeros_like)
        K = body.cell_stiffness(u, more=1e-3 * jnp.eye(24).reshape(8, 3, 8, 3).swapaxes(1, 2))
        return force, K, apply_multigrid(build_multigrid(K, None, jnp.asarray(0.01)), u), mapped(jnp.sum, u)

    on_cpu = jax.jit(evaluate)(u)
    monkeypatch.setattr(_device, "CPU", _device.ACCELERATOR)
    as_on_gpu = jax.jit(lambda u: evaluate(u))
    for ours, theirs, scale in zip(as_on_gpu(u), on_cpu, (ROUNDOFF, ROUNDOFF, 1e-3, ROUNDOFF), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=scale * float(jnp.abs(theirs).max()))
