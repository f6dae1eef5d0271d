"""Points of a sweep: which there are, in which order, and what is refused."""

import itertools

import numpy as np
import pytest
import xarray as xr
from scipy.stats import qmc

import opfem as op
from opfem.sweeps.design import check_arguments, grid


def test_a_grid_holds_every_combination_last_axis_fastest():
    points = grid({"a": [1.0, 2.0], "b": [3.0, 4.0, 5.0]})
    expected = list(itertools.product([1.0, 2.0], [3.0, 4.0, 5.0]))
    assert list(zip(points.columns["a"], points.columns["b"], strict=True)) == expected
    assert (points.dims, points.shape) == (("a", "b"), (2, 3))


def test_whole_numbers_stay_whole():
    assert grid({"n": [1, 2]}).columns["n"].dtype.kind == "i"


def test_units_come_with_a_data_array():
    axis = xr.DataArray([1.0, 2.0], dims="c10", attrs={"units": "MPa"})
    assert grid({"c10": axis}).with_units({"friction": "1"}).units == {"c10": "MPa"}
    with pytest.raises(ValueError, match=r"'c10' of the sweep comes in 'MPa', got units 'kPa'"):
        grid({"c10": axis}).with_units({"c10": "kPa"})


def test_a_sample_is_stretched_over_its_bounds():
    cube = qmc.Sobol(d=2, rng=0).random(8)
    points = op.sample({"c10": (1e-3, 1e-1), "friction": (0.1, 0.3)}, cube, log=["c10"])
    assert points.dims == ("point",)
    np.testing.assert_allclose(np.log10(points.columns["c10"]), -3 + 2 * cube[:, 0], rtol=1e-12)
    np.testing.assert_allclose(points.columns["friction"], 0.1 + 0.2 * cube[:, 1], rtol=1e-12)


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({}, "must be a dict of argument names and values"),
        ({"a": []}, "Axis 'a' of the sweep is empty"),
        ({"a": 1.0}, r"Axis 'a' of the sweep must be a list of numbers, got shape \(\)"),
        ({"a": np.zeros((2, 3))}, r"got shape \(2, 3\).*sweep an index"),
        ({"a": [1.0, np.nan]}, "must not contain NaN"),
        ({"a": [1.0, 1.0]}, "must contain each value once"),
        ({"a": [object()]}, "must contain numbers or words"),
        ({"status": [1.0]}, "cannot be called 'status'"),
    ],
)
def test_wrong_axes(axes, message):
    with pytest.raises(ValueError, match=message):
        grid(axes)


def test_wrong_points():
    with pytest.raises(ValueError, match=r"one length, got \{'a': 1, 'b': 2\}"):
        op.zip_({"a": [1.0], "b": [1.0, 2.0]})
    with pytest.raises(ValueError, match="1 of 2 twice"):
        op.zip_({"a": [1.0, 1.0], "b": [2.0, 2.0]})
    with pytest.raises(ValueError, match=r"\(points, 2\) between 0 and 1, got shape \(4, 1\)"):
        op.sample({"a": (0.0, 1.0), "b": (0.0, 1.0)}, np.zeros((4, 1)))
    with pytest.raises(ValueError, match=r"bounds\['a'\] must be two positive numbers"):
        op.sample({"a": (0.0, 1.0)}, np.zeros((4, 1)), log=["a"])
    with pytest.raises(ValueError, match="Did you mean 'friction'"):
        op.sample({"friction": (0.1, 1.0)}, np.zeros((4, 1)), log=["frictoin"])


def test_axes_are_arguments():
    def peak(c10, friction=0.1):
        return c10

    with pytest.raises(ValueError, match=r"of peak must be one of c10, friction, got 'c1'. Did you mean 'c10'\?"):
        check_arguments(peak, grid({"c1": [1.0]}))
    with pytest.raises(ValueError, match="peak needs c10, which no axis gives"):
        check_arguments(peak, grid({"friction": [1.0]}))
    check_arguments(lambda **numbers: 0.0, grid({"anything": [1.0]}))
