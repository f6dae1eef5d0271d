"""Numbers in another unit, and maps that do not fit their layer: refused or warned of, with both ranges."""

import sys
import warnings

import numpy as np
import pytest

import opfem as op
from opfem.results.summary import summary_rows
from tests.experiments import EXTENT, L0, MATERIAL, PIXELS, bumpy_map, flat_map, published_palpation


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: op.MooneyRivlin(2230.0, 703.0, 117320.0),
            r"MooneyRivlin shear modulus \[MPa\].*got 5866; is it in Pa\?",
        ),
        (lambda: op.NeoHooke(2230.0, 1e5), r"NeoHooke shear modulus .*got 4460; is it in Pa\?"),
        (lambda: op.Yeoh(2230.0, -300.0, 200.0, 1e5), r"Yeoh shear modulus .*is it in Pa\?"),
        (lambda: op.Ogden([4000.0, 500.0], [2.0, -2.0], 1e5), r"Ogden shear modulus .*got 4500; is it in Pa\?"),
        (lambda: op.Hencky(5866.0, 1e5), r"Hencky shear modulus .*is it in Pa\?"),
        (lambda: op.Hencky(5e-9, 1e-7), r"between 1e-06 and 1000 \(1 Pa to 1 GPa\), got 5e-09; 1 kPa is 1e-3 MPa"),
        (lambda: op.ExponentialOverclosure(2e6, 0.01), r"pressure \(p0\) \[MPa\].*got 2e\+06; is it in Pa\?"),
        (
            lambda: op.ExponentialOverclosure(2.0, 10.0),
            r"clearance \(c0\) \[mm\] must be at most 1, got 10; is it in µm\?",
        ),
        (lambda: op.TabularOverclosure([0.0, 2e6], [0.01, 0.0]), r"TabularOverclosure\.pressure .*is it in Pa\?"),
        (lambda: op.TabularOverclosure([0.0, 2.0], [10.0, 0.0]), r"TabularOverclosure\.clearance .*is it in µm\?"),
        (lambda: op.Layer(500.0, MATERIAL), r"Layer\.thickness \[mm\] .*between 0\.02 and 20, got 500; is it in µm\?"),
        (lambda: op.Layer(5e-4, MATERIAL), r"Layer\.thickness \[mm\] .*got 0\.0005; is it in m\? Multiply by 1e3"),
        (lambda: op.Layer(flat_map(45.0), MATERIAL), r"Layer\.thickness \[mm\] .*got 45; is it in µm\?"),
        (lambda: op.Layer(flat_map(5e-3), MATERIAL), r"Layer\.thickness \[mm\] .*got 0\.005; is it in m\?"),
    ],
)
def test_another_unit_is_refused_where_it_is_stated(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    "make",
    [
        lambda: op.MooneyRivlin(0.5, 0.1, np.inf),  # a hard rubber, incompressible
        lambda: op.NeoHooke(1e-5, 2e3),  # a gel of 20 Pa that is as compressible as water
        lambda: op.ExponentialOverclosure(20.0, 1e-4),
        lambda: op.Layer(0.05, MATERIAL),
        lambda: op.Layer(10.0, MATERIAL),
    ],
)
def test_what_people_use_is_taken(make):
    make()


def pressed(thickness, unloaded=L0):
    return op.solve(published_palpation(thickness=unloaded), op.Imprint(thickness))


@pytest.mark.parametrize(
    ("loaded", "unloaded", "message"),
    [
        (bumpy_map(), 10.0, r"spans 0\.39\d* to 0\.47 mm on the layer, L0 10 mm: 100% .*below 0\.1 times L0"),
        (
            flat_map(0.45),
            0.05,
            r"L0 0\.05 mm: 100% of the pixels are above 5 times L0\. Are map and L0 in the same unit",
        ),
        (flat_map(0.45), flat_map(5.0), r"L0 5 mm: 100% .*below 0\.1"),
        (flat_map(0.04), flat_map(0.5), r"spans 0\.04 mm on the layer, L0 0\.5 mm"),
    ],
)
def test_a_map_in_another_unit_than_its_layer_is_refused_before_the_solve(loaded, unloaded, message, monkeypatch):
    monkeypatch.setattr(sys.modules["opfem.solvers.solve"], "prepare", lambda *_: pytest.fail("compiles"))
    with pytest.raises(ValueError, match=message):
        pressed(loaded, unloaded)
    noisy = op.ThicknessMap(loaded.values, extent=EXTENT, std=2e-3)
    prior = op.Matern(length=0.6, std=1e-3)
    for use, name in (
        (lambda p: op.fit_traction(p, noisy, prior), "fit_traction"),
        (lambda p: op.linear_estimate(p, noisy, prior), "linear_estimate"),
        (lambda p: op.uniaxial_estimate(p, noisy), "uniaxial_estimate"),
    ):
        with pytest.raises(ValueError, match=rf"{name}\.thickness .*{message}"):
            use(published_palpation(thickness=unloaded))


def lifted(share, by=0.2):
    """A map of which a share, from one side, lies above L0 by a part of it."""
    values = np.full(PIXELS, 0.9 * L0)
    values[:, : round(share * PIXELS[1])] = (1 + by) * L0
    return op.ThicknessMap(values, extent=EXTENT)


@pytest.mark.parametrize(
    ("loaded", "message"),
    [
        (
            flat_map(0.51),
            r"spans 0\.51 mm on the layer, L0 0\.5 mm: the map is thicker than L0 everywhere, so that the",
        ),
        (lifted(0.3, by=0.3), r"29% of the pixels are above 1\.2 times L0, more than a sample lifts off"),
    ],
)
def test_a_map_above_its_layer_is_warned_of(loaded, message):
    with pytest.warns(UserWarning, match=message):
        op.uniaxial_estimate(published_palpation(), loaded)


def masked(thickness):
    """The same map, of which what lies far from the layer is not data."""
    far = np.asarray(thickness.values) > 1.2 * L0
    return op.ThicknessMap(thickness.values, extent=EXTENT, mask=far)


@pytest.mark.parametrize(
    "loaded", [bumpy_map(), lifted(0.3, by=0.1), lifted(0.04, by=0.3), masked(lifted(0.3, by=0.3))]
)
def test_lift_off_and_missing_pixels_are_no_doubt(loaded):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        op.uniaxial_estimate(published_palpation(), loaded.filled())


def test_pixels_beyond_the_layer_do_not_count():
    values = np.full((11, 21), 0.45)
    values[:, 11:] = 4.0  # x above 2 mm
    wide = op.ThicknessMap(values, extent=(4.0, 2.0))
    assert np.isfinite(op.uniaxial_estimate(published_palpation(), wide)).all()


def test_a_solution_in_which_nothing_touches_says_so():
    with pytest.warns(UserWarning, match="touches nowhere"):
        solution = pressed(flat_map(0.52))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        numbers = op.summary(solution)
        rows = summary_rows(numbers)
    assert numbers["status"] == "successful"
    assert numbers["status_message"].startswith("Nothing touches: ")
    assert op.to_xarray(solution).attrs["status_message"].startswith("Nothing touches: ")
    assert numbers["contact_area_mm2"] == 0.0
    assert numbers["force_imbalance_percent"] is None
    assert ("force on the layer, normal", "0", "N") in rows
    assert not any(value.startswith("-") for _, value, _ in rows)
