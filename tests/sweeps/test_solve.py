"""Sweeps of solves and fits: labels, statuses, derivatives, against one solve at a time."""

import equinox as eqx
import jax
import numpy as np
import pytest

import opfem as op
from tests.experiments import MATERIAL, published_palpation
from tests.tolerances import FINITE_DIFFERENCE, SOLVER

C10, FRICTION = (-1e-3, 2e-3, 4e-3), (0.0, 0.2)  # a negative modulus cannot be solved
KEEP = ("max_pressure", "pressure", "pressure_image", "slip", "stress_zz", "contact_status", "thickness")
KEEP += ("force_sample", "newton_steps")
ACCURATE = op.Newton(rtol=SOLVER / 10)


def palpation(c10, friction):
    return published_palpation(friction, material=op.MooneyRivlin(c10, MATERIAL.c01, MATERIAL.bulk))


@pytest.fixture(scope="module")
def data(loaded):
    def pressed(c10, friction):
        return op.solve(palpation(c10, friction), op.Imprint(loaded), ACCURATE, throw=False)

    return op.sweep(pressed, {"c10": C10, "friction": FRICTION}, keep=KEEP, units={"c10": "MPa", "friction": "1"})


def test_each_point_is_what_one_solve_gives(data, loaded):
    for c10 in C10[1:]:
        for friction in FRICTION:
            alone = op.to_xarray(op.solve(palpation(c10, friction), op.Imprint(loaded), ACCURATE))
            point = data.sel(c10=c10, friction=friction)
            assert point.status.item() == alone.attrs["status"]
            for name in ("pressure", "pressure_image", "slip", "stress_zz", "thickness", "force_sample"):
                scale = float(np.abs(alone[name]).max())
                assert point[name].dims == alone[name].dims
                np.testing.assert_allclose(point[name], alone[name], rtol=0, atol=SOLVER * scale, err_msg=name)
                assert point[name].attrs["units"] == alone[name].attrs["units"]
            assert float(point.max_pressure) == float(point.pressure.max())
            for name in ("x", "y", "x_element", "y_element", "x_image", "y_image"):
                np.testing.assert_allclose(data[name], alone[name], rtol=1e-12, atol=1e-15)


def test_what_cannot_be_solved_says_why(data):
    impossible = data.sel(c10=-1e-3)
    assert not set(impossible.status.values) & {"successful", "slides_off", "error"}
    assert set(impossible.status.values) <= set(op.RESULTS._name_to_item)
    assert np.isnan(impossible.pressure).all()
    assert np.isnan(impossible.max_pressure).all()
    assert all(impossible.message.values)


def test_solutions_of_experiments_are_kept_as_those_of_palpations(truth):
    def scaled(factor):
        return eqx.tree_at(lambda s: s.interface.pressure, truth, factor * truth.interface.pressure)

    keep = ("pressure", "pressure_image", "thickness", "force_plate", "strain_energy")
    data = op.sweep(scaled, {"factor": [1.0, 2.0]}, keep=keep, execution=op.Batch(mode="call"))
    alone = op.to_xarray(truth)
    for name in keep[1:]:
        np.testing.assert_allclose(data[name].sel(factor=1.0), alone[name], rtol=1e-12)
        assert data[name].attrs["long_name"] == alone[name].attrs["long_name"]
    np.testing.assert_array_equal(data.pressure.sel(factor=2.0), 2 * alone.pressure)
    assert set(data.status.values) == {"successful"}


def test_a_swept_extent_is_no_coordinate(solution):
    def wide(length):
        return eqx.tree_at(lambda s: s.positions, solution, length * solution.positions)

    data = op.sweep(wide, {"length": [1.0, 2.0]}, keep=("pressure",), execution=op.Batch(mode="call"))
    assert data.pressure.dims == ("length", "y", "x")
    np.testing.assert_array_equal(data.x_position.sel(length=2.0), 2 * data.x_position.sel(length=1.0))
    assert "x" not in data.coords


def test_wrong_keep_and_wrong_unit(solution):
    def known(a):
        return solution

    with pytest.raises(ValueError, match=r"sweep.keep must be one of .*got 'presure'. Did you mean 'pressure'"):
        op.sweep(known, {"a": [1.0]}, keep=("presure",), execution=op.Batch(mode="call"))
    with pytest.raises(ValueError, match="Output 'pressure' of the sweep is in MPa, got units 'kPa'"):
        op.sweep(known, {"a": [1.0]}, units={"pressure": "kPa"}, execution=op.Batch(mode="call"))


def test_all_that_a_solution_may_keep(solution):
    everything = op.sweep(lambda a: solution, {"a": [1.0]}, execution=op.Batch(mode="call"))
    assert {"pressure", *solution.stats} <= set(everything.data_vars)
    assert everything.force_sample.dims == ("a", "component")
    assert everything.component.values.tolist() == ["x", "y", "z"]


@pytest.mark.slow
def test_sensitivities_of_a_solve(loaded):
    def peak(c10, friction):
        accurate = op.Newton(rtol=1e-11)
        return op.solve(palpation(c10, friction), op.Imprint(loaded), accurate, throw=False).pressure.max()

    both = op.value_and_sensitivities(peak)
    data = op.sweep(both, {"c10": [2e-3, 4e-3], "friction": [0.2]}, units={"c10": "MPa", "peak": "MPa"})
    solved = jax.jit(peak)
    for c10 in (2e-3, 4e-3):
        point = data.sel(c10=c10, friction=0.2)
        step = 1e-5
        by_c10 = (solved(c10 * (1 + step), 0.2) - solved(c10 * (1 - step), 0.2)) / (2 * c10 * step)
        by_friction = (solved(c10, 0.2 + step) - solved(c10, 0.2 - step)) / (2 * step)
        np.testing.assert_allclose(point.d_peak_d_c10, by_c10, rtol=FINITE_DIFFERENCE)
        np.testing.assert_allclose(point.d_peak_d_friction, by_friction, rtol=FINITE_DIFFERENCE)
    assert data.d_peak_d_c10.attrs["units"] == "MPa / (MPa)"


@pytest.mark.slow
def test_a_sweep_of_fits(loaded):
    def fitted(std):
        return op.fit_traction(palpation(2e-3, 0.2), loaded, op.Matern(length=0.5, std=std), draws=2, throw=False)

    data = op.sweep(fitted, {"std": [2e-3, 4e-3]}, keep=("pressure", "pressure_std", "chi2", "forward_solves"))
    alone = fitted(4e-3)
    np.testing.assert_allclose(data.pressure.sel(std=4e-3), alone.pressure, rtol=1e-9)
    np.testing.assert_allclose(data.chi2.sel(std=4e-3), alone.chi2, rtol=1e-9)
    assert (data.status == "successful").all()
    assert (data.pressure_std > 0).all()
