"""`value_and_sensitivities` on closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from tests.tolerances import ROUNDOFF


def energy(mass, speed=2.0):
    return 0.5 * mass * speed**2


def test_one_number():
    value, derivatives = op.value_and_sensitivities(energy)(3.0, speed=4.0)
    assert float(value) == 24.0
    assert {name: float(d) for name, d in derivatives.items()} == {"mass": 8.0, "speed": 12.0}
    # What is not given is no variable.
    assert set(op.value_and_sensitivities(energy)(3.0).derivatives) == {"mass"}


@pytest.mark.parametrize("mode", ["map", "vmap", "call"])
def test_swept_with_units(mode):
    data = op.sweep(
        op.value_and_sensitivities(energy),
        {"mass": [1, 2], "speed": [3.0, 5.0]},
        units={"energy": "N mm", "mass": "tonne"},
        execution=op.Batch(2 if mode != "call" else 1, mode),
    )
    mass, speed = np.meshgrid([1, 2], [3.0, 5.0], indexing="ij")
    np.testing.assert_allclose(data.energy, 0.5 * mass * speed**2, rtol=ROUNDOFF)
    np.testing.assert_allclose(data.d_energy_d_mass, 0.5 * speed**2, rtol=ROUNDOFF)
    np.testing.assert_allclose(data.d_energy_d_speed, mass * speed, rtol=ROUNDOFF)
    assert data.d_energy_d_mass.attrs == {"units": "N mm / (tonne)", "long_name": "derivative of energy by mass"}
    assert "units" not in data.d_energy_d_speed.attrs


def test_maps_and_dicts():
    def fields(a, b):
        return {"map": a * jnp.arange(3.0) + b, "sum": a + b}

    value, derivatives = jax.jit(op.value_and_sensitivities(fields))(2.0, 3.0)
    np.testing.assert_allclose(value["map"], [3.0, 5.0, 7.0], rtol=ROUNDOFF)
    np.testing.assert_allclose(derivatives["a"]["map"], [0.0, 1.0, 2.0], rtol=ROUNDOFF)
    np.testing.assert_allclose(derivatives["b"]["map"], 1.0, rtol=ROUNDOFF)
    assert float(derivatives["b"]["sum"]) == 1.0


def test_any_arguments():
    value, derivatives = op.value_and_sensitivities(lambda **numbers: numbers["a"] * numbers["b"])(a=2.0, b=3.0)
    assert (float(value), float(derivatives["a"]), float(derivatives["b"])) == (6.0, 3.0, 2.0)


def test_what_has_no_derivative(solution):
    with pytest.raises(ValueError, match=r"differentiates by numbers, got 'hybrid' for 'mass'"):
        op.value_and_sensitivities(energy)("hybrid")
    with pytest.raises(ValueError, match=r"got array.* for 'mass'"):
        op.value_and_sensitivities(energy)(np.ones(3))
    with pytest.raises(ValueError, match=r"numbers, arrays or a dict of these, got Solution"):
        op.value_and_sensitivities(lambda a: solution)(1.0)
