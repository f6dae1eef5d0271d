"""Missing values in every format: numbers that stand for them, masks, counts, and what looks like them."""

import numpy as np
import PIL.Image
import pytest
import scipy.io

from opfem.io import read_thickness
from opfem.measurement import MeasurementError, MeasurementWarning
from tests.io.test_thickness import FILES, save
from tests.tolerances import ROUNDOFF

SHAPE, EXTENT = (6, 11), (5.0, 2.5)
HOLES = [(0, 0), (2, 3), (2, 4), (5, 10)]


@pytest.fixture
def counts():
    """Thickness in whole µm, as 16-bit detectors give it."""
    return np.random.default_rng(0).integers(400, 470, SHAPE).astype("u2")


def with_holes(array, number):
    array = array.copy()
    for pixel in HOLES:
        array[pixel] = number
    return array


def holes(got):
    return [tuple(pixel) for pixel in np.argwhere(got.mask).tolist()]


class TestNumbers:
    @pytest.mark.parametrize("name", FILES)
    @pytest.mark.parametrize(("number", "dtype"), [(0, "u2"), (65535, "u2"), (9999, "f4"), (-1, "i2"), (0.5, "f2")])
    def test_stand_for_missing_pixels(self, tmp_path, counts, name, number, dtype):
        save(tmp_path / name, with_holes(counts.astype(dtype), number))
        got = read_thickness(tmp_path / name, extent=EXTENT, unit="um", missing=number)
        assert holes(got) == HOLES
        assert got.steps[0].numbers["missing_pixels"] == 4
        np.testing.assert_allclose(got.values[~got.mask], 1e-3 * counts[~np.asarray(got.mask)], ROUNDOFF)

    @pytest.mark.parametrize("dtype", ["f4", ">f4", "f2"])
    def test_that_the_file_holds_rounded(self, tmp_path, counts, dtype):
        np.save(tmp_path / "a.npy", with_holes(counts.astype(dtype), 0.1))
        assert holes(read_thickness(tmp_path / "a.npy", extent=EXTENT, unit="um", missing=0.1)) == HOLES

    def test_several(self, tmp_path, counts):
        marked = with_holes(counts.astype("f8"), 9999)
        marked[3, 3:5] = 0
        marked[4, 4] = np.nan
        np.save(tmp_path / "a.npy", marked)
        got = read_thickness(tmp_path / "a.npy", extent=EXTENT, unit="um", missing=(0, 9999))
        assert holes(got) == sorted([*HOLES, (3, 3), (3, 4), (4, 4)])

    @pytest.mark.parametrize("wrong", ["x", ["0"], True, {"a": 1}])
    def test_refuses_what_is_no_number(self, tmp_path, counts, wrong):
        np.save(tmp_path / "a.npy", counts)
        with pytest.raises(MeasurementError, match="missing= must be a number or numbers of the file"):
            read_thickness(tmp_path / "a.npy", extent=EXTENT, unit="um", missing=wrong)

    @pytest.mark.parametrize("number", [0, -1])
    def test_are_named_where_they_are_no_thickness(self, tmp_path, counts, number):
        np.save(tmp_path / "a.npy", with_holes(counts.astype("i2"), number))
        with pytest.raises(
            MeasurementError, match=rf"4 of 66 pixels hold exactly {number}, .*pass missing={number} if"
        ):
            read_thickness(tmp_path / "a.npy", extent=EXTENT, unit="um")

    def test_too_many_are_told_apart(self, tmp_path, counts):
        counts[:4] = 0
        np.save(tmp_path / "a.npy", counts)
        with pytest.raises(MeasurementError, match=r"44 of 66 pixels \(67%\) are missing \(44 hold missing=\), above"):
            read_thickness(tmp_path / "a.npy", extent=EXTENT, unit="um", missing=0)


class TestPiles:
    """Numbers that several pixels at the edge of the range share."""

    def read(self, folder, numbers, **how):
        np.save(folder / "a.npy", numbers)
        return read_thickness(folder / "a.npy", extent=EXTENT, **({"unit": "um"} | how))

    @pytest.mark.parametrize("number", [9999, 2000, 65535, 30])
    def test_far_outside_are_refused(self, tmp_path, counts, number):
        marked = with_holes(counts, number)
        message = (
            rf"4 of 66 pixels hold exactly {number}, far from the others \(4\d\d to 4\d\d\): pass missing={number} if"
        )
        with pytest.raises(MeasurementError, match=message):
            self.read(tmp_path, marked)
        assert holes(self.read(tmp_path, marked, missing=number)) == HOLES
        if number < 5e4:  # 65.5 mm is no thickness in any case
            assert not self.read(tmp_path, marked, missing="none").mask.any()

    @pytest.mark.parametrize(("number", "suspicion"), [(500, "apart from"), (365, "apart from"), (512, "apart from")])
    def test_apart_are_warned_of(self, tmp_path, counts, number, suspicion):
        with pytest.warns(MeasurementWarning, match=rf"4 of 66 pixels hold exactly {number}, {suspicion} the others"):
            self.read(tmp_path, with_holes(counts, number))

    def test_clipped_numbers_are_warned_of(self, tmp_path):
        numbers = np.minimum(np.random.default_rng(0).uniform(0.3, 0.5, (51, 101)), 0.48)
        with pytest.warns(
            MeasurementWarning, match=r"pixels hold exactly 0\.48, far more often than any of the others"
        ):
            self.read(tmp_path, numbers, unit="mm")

    def test_full_scale_is_warned_of(self, tmp_path):
        numbers = np.random.default_rng(0).integers(200, 255, SHAPE)
        numbers[2, 3:5] = 255
        with pytest.warns(MeasurementWarning, match="2 of 66 pixels hold exactly 255, a full scale beyond the others"):
            self.read(tmp_path, numbers.astype("u1"), unit="mm", scale=1.5)

    def test_one_outlier_is_warned_of(self, tmp_path, counts):
        counts[2, 2] = 4000
        with pytest.warns(MeasurementWarning, match="1 of 66 pixels hold exactly 4000, far from"):
            self.read(tmp_path, counts)

    @pytest.mark.parametrize("kind", ["whole µm", "flat", "steps", "untouched"])
    def test_good_maps_are_taken_without_a_word(self, tmp_path, kind, counts):
        x, y = np.meshgrid(np.linspace(-2, 2, 11), np.linspace(-1, 1, 6))
        dent = 470 - 70 * np.exp(-(x**2 + y**2))
        good = {"whole µm": np.rint(dent), "flat": np.full(SHAPE, 450), "untouched": np.where(dent > 460, 470, dent)}
        good["steps"] = np.where(dent > 430, 470, 400)
        assert self.read(tmp_path, good[kind]).shape == SHAPE


class TestScale:
    @pytest.mark.parametrize("name", FILES)
    def test_counts_become_thickness(self, tmp_path, counts, name):
        save(tmp_path / name, counts // 3)
        got = read_thickness(tmp_path / name, extent=EXTENT, scale=2.93)
        np.testing.assert_allclose(got.values, 2.93e-3 * (counts // 3), ROUNDOFF)
        np.testing.assert_allclose(got.steps[0].numbers["unit_mm"], 2.93e-3, ROUNDOFF)

    @pytest.mark.parametrize(
        ("how", "message"),
        [
            ({"scale": 2.0, "unit": "um"}, "pass either unit= or scale="),
            ({"scale": 0.0}, r"scale \[µm per count\] must be positive, got 0"),
            ({"scale": 2e3}, r"spans 8\d\d to 9\d\d mm"),
        ],
    )
    def test_refuses(self, tmp_path, counts, how, message):
        np.save(tmp_path / "a.npy", counts)
        with pytest.raises(MeasurementError, match=message):
            read_thickness(tmp_path / "a.npy", extent=EXTENT, **how)


class TestMask:
    def read(self, folder, mask, counts, **how):
        np.save(folder / "a.npy", counts)
        return read_thickness(folder / "a.npy", extent=EXTENT, unit="um", mask=mask, **how)

    @pytest.mark.parametrize("name", ["m.png", "m.bmp", "m.tif", "m.npy", "m.npz", "m.csv", "v5.mat", "v73.mat"])
    def test_files(self, tmp_path, counts, name):
        mask = with_holes(np.zeros(SHAPE, "u1"), 255)
        if name.endswith(("png", "bmp")):
            PIL.Image.fromarray(mask).save(tmp_path / name)
        else:
            save(tmp_path / name, mask.astype(float) if name.endswith("73.mat") else mask)
        assert holes(self.read(tmp_path, tmp_path / name, counts)) == HOLES

    def test_true_and_false_of_matlab(self, tmp_path, counts):
        scipy.io.savemat(tmp_path / "m.mat", {"note": "bubbles", "bad": with_holes(np.zeros(SHAPE, bool), True)})
        assert holes(self.read(tmp_path, str(tmp_path / "m.mat"), counts)) == HOLES

    @pytest.mark.parametrize("dtype", [bool, int, float])
    def test_arrays(self, tmp_path, counts, dtype):
        assert holes(self.read(tmp_path, with_holes(np.zeros(SHAPE, dtype), 1), counts)) == HOLES

    def test_adds_to_missing_numbers(self, tmp_path, counts):
        counts[1, 1] = 0
        got = self.read(tmp_path, with_holes(np.zeros(SHAPE), 1), counts, missing=0)
        assert holes(got) == sorted([*HOLES, (1, 1)])

    def test_hides_what_is_no_thickness(self, tmp_path, counts):
        assert holes(self.read(tmp_path, with_holes(np.zeros(SHAPE), 1), with_holes(counts, 9999))) == HOLES

    def test_inverted_is_refused(self, tmp_path, counts):
        with pytest.raises(MeasurementError, match=r"62 are masked.*0 is data and all else is not: is it inverted\?"):
            self.read(tmp_path, with_holes(np.ones(SHAPE), 0), counts)

    @pytest.mark.parametrize(
        ("mask", "message"),
        [
            (np.zeros((6, 10), bool), r"mask must have the map's shape \(6, 11\) \(ny, nx\), got \(6, 10\)"),
            (np.arange(66).reshape(SHAPE), "must be black and white: .* got 66 values from 0 to 65"),
            (np.full(SHAPE, np.nan), "mask must be black and white"),
            ("nowhere.png", r"nowhere\.png: no such file"),
            ("mask.jp2", r"mask\.jp2: cannot read \.jp2 as a mask"),
        ],
    )
    def test_refuses(self, tmp_path, counts, mask, message):
        with pytest.raises(MeasurementError, match=message):
            self.read(tmp_path, mask, counts)

    def test_refuses_colours(self, tmp_path, counts):
        PIL.Image.fromarray(np.full((*SHAPE, 3), (0, 9, 200), "u1")).save(tmp_path / "m.png")
        with pytest.raises(MeasurementError, match="is a colour image; a mask is black and white"):
            self.read(tmp_path, tmp_path / "m.png", counts)
