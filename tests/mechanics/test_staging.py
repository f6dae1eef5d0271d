"""What is evaluated apart is evaluated all the same: values, batches, derivatives, and the border itself."""

import jax
import jax.numpy as jnp
import numpy as np

from opfem.mechanics.staging import apart
from tests.tolerances import ROUNDOFF


def _pair(x, scale):
    return {"sine": scale * jnp.sin(x), "count": jnp.arange(3)}


def test_values_are_the_function_s_under_jit_and_vmap():
    x = jnp.linspace(0.0, 1.0, 5)
    expected = _pair(x, 2.0)
    for got in (apart(_pair, x, 2.0), jax.jit(lambda x: apart(_pair, x, 2.0))(x)):
        np.testing.assert_allclose(got["sine"], expected["sine"], ROUNDOFF)
        np.testing.assert_array_equal(got["count"], expected["count"])
    lanes = jax.vmap(lambda scale: apart(_pair, x, scale)["sine"])(jnp.array([1.0, 3.0]))
    np.testing.assert_allclose(lanes, [jnp.sin(x), 3.0 * jnp.sin(x)], ROUNDOFF)


def test_derivatives_go_through():
    x = jnp.linspace(0.0, 1.0, 5)
    gradient = jax.jit(jax.grad(lambda x: jnp.sum(apart(_pair, x, 2.0)["sine"])))(x)
    np.testing.assert_allclose(gradient, 2.0 * jnp.cos(x), ROUNDOFF)
    _, change = jax.jvp(lambda x: apart(_pair, x, 2.0)["sine"], (x,), (jnp.ones_like(x),))
    np.testing.assert_allclose(change, 2.0 * jnp.cos(x), ROUNDOFF)


def test_the_compiler_keeps_the_border_on_cpu():
    """Should it learn to resolve the condition, solves become several times slower without any other sign."""
    compiled = jax.jit(lambda x: apart(jnp.sin, x + 1.0) + 1.0).lower(jnp.ones(1000)).compile()
    assert "conditional(" in compiled.as_text()
    batched = jax.jit(jax.vmap(lambda x: apart(jnp.sin, x + 1.0) + 1.0)).lower(jnp.ones((4, 1000))).compile()
    assert "conditional(" in batched.as_text()
