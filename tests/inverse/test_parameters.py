"""Fitted numbers: their priors, how they enter the experiment, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import opfem as op
from opfem.inverse.parameters import check_parameters, with_numbers


def palpation(thickness=0.5):
    return op.Palpation(
        op.Layer(thickness, op.MooneyRivlin(c10=2.23e-3, c01=7.03e-4, bulk=0.11732)),
        extent=(2.0, 2.0),
        elements=(4, 4, 2),
        window=op.Contact(op.HardOverclosure(), 0.15),
        sample=op.Contact(op.ExponentialOverclosure(pressure=2.0, clearance=0.01), 0.05),
    )


def test_standard_normal_numbers_become_those_of_the_prior():
    white = jax.random.normal(jax.random.key(0), (20000,))
    normal, lognormal = op.Normal(3.0, 0.5).number(white), op.LogNormal(2.0, 0.3).number(white)
    assert normal.mean() == pytest.approx(3.0, abs=0.02)
    assert normal.std() == pytest.approx(0.5, rel=0.03)
    assert jnp.median(lognormal) == pytest.approx(2.0, rel=0.01)
    assert jnp.log(lognormal).std() == pytest.approx(0.3, rel=0.03)
    assert lognormal.min() > 0


def test_numbers_enter_the_experiment_by_their_path():
    changed = with_numbers(palpation(), {"window.friction": 0.3, "layer.material.c10": 1e-3})
    assert changed.window.friction == 0.3
    assert changed.layer.material.c10 == 1e-3
    assert changed.sample.friction == 0.05
    assert changed.layer.thickness == 0.5


@pytest.mark.parametrize("unloaded", [0.5, op.ThicknessMap(np.full((5, 5), 0.5), extent=(2.0, 2.0))])
def test_index_and_offset_change_the_unloaded_thickness(unloaded):
    changed = with_numbers(palpation(unloaded), {"refractive_index": 1.25, "l0_offset": 0.01})
    assert np.asarray(changed.mesh().thickness) == pytest.approx((0.5 + 0.01) / 1.25)


def test_derivative_by_a_number():
    def heights(c10):
        return jnp.sum(with_numbers(palpation(), {"layer.material.c10": c10}).layer.material.shear)

    assert jax.grad(heights)(2e-3) == pytest.approx(2.0)


@pytest.mark.parametrize("name", ["window.fraction", "elements", "layer", "layer.material", "c10"])
def test_unknown_names_are_refused(name):
    with pytest.raises(ValueError, match=rf"such as 'layer\.material\.c10'.*got '{name}'"):
        check_parameters("fit_traction", palpation(), {name: op.Normal(1.0, 0.1)})


def test_a_bare_number_is_no_prior():
    with pytest.raises(ValueError, match=r"parameters\['window\.friction'\] must be Normal\(mean, std\)"):
        check_parameters("fit_traction", palpation(), {"window.friction": 0.1})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: op.Normal(0.0, 0.0), r"Normal\.std .* must be positive, got 0"),
        (lambda: op.LogNormal(-1.0, 0.1), r"LogNormal\.median .* must be positive, got -1"),
        (lambda: op.ForceReading(1.0, -0.1), r"ForceReading\.std \[N\] must be positive, got -0\.1"),
        (
            lambda: op.AxialDisplacement(np.zeros((3, 5, 5)), np.ones((2, 5))),
            "AxialDisplacement.std must have",
        ),
        (
            lambda: op.AxialDisplacement(np.full((3, 5, 5), np.nan), 1e-4),
            "AxialDisplacement.values .* must be finite",
        ),
    ],
)
def test_data_and_priors_check_their_numbers(make, message):
    with pytest.raises(ValueError, match=message):
        make()
