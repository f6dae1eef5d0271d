"""The picture of a sweep: which points are joined, and which are marked."""

import numpy as np

from opfem.plot import draw_sweep

AXES = {"c10 [kPa]": np.repeat([1.0, 10.0, 100.0], 2), "friction": np.tile([0.0, 0.3], 3)}
OUTPUTS = {"pressure [kPa]": np.array([1.0, 2.0, 3.0, 4.0, 5.0, 0.5]), "force [N]": np.arange(6.0)}
GOOD = np.array([True, True, True, True, True, False])


def drawn(ax, label: str) -> np.ndarray:
    (line,) = [line for line in ax.get_lines() if line.get_label() == label]
    return np.array(line.get_data())


def test_points_of_a_grid_are_joined_along_each_axis():
    figure = draw_sweep(AXES, OUTPUTS, GOOD, (3, 2))
    first, second, third, fourth = figure.axes
    np.testing.assert_array_equal(drawn(first, "friction 0"), [[1, 10, 100], [1, 3, 5]])
    np.testing.assert_array_equal(drawn(first, "friction 0.3"), [[1, 10], [2, 4]])  # the last point failed
    np.testing.assert_array_equal(drawn(second, "c10 [kPa] 1"), [[0, 0.3], [1, 2]])
    assert (first.get_ylabel(), third.get_ylabel()) == ("pressure [kPa]", "force [N]")
    assert (third.get_xlabel(), fourth.get_xlabel()) == ("c10 [kPa]", "friction")
    assert (first.get_xscale(), second.get_xscale()) == ("log", "linear")


def test_lowest_highest_and_failed_points_are_marked():
    ax = draw_sweep(AXES, OUTPUTS, GOOD, (3, 2)).axes[0]
    rings = [np.array(line.get_data())[:, 0].tolist() for line in ax.get_lines() if line.get_fillstyle() == "none"]
    assert rings == [[1.0, 1.0], [100.0, 5.0]]
    assert drawn(ax, "failed")[0].tolist() == [100.0]


def test_points_that_form_no_grid_are_not_joined():
    ax = draw_sweep({"c10": np.array([2.0, 1.0, 2.0])}, {"p": np.arange(3.0)}, np.ones(3, bool), None).axes[0]
    assert ax.get_lines()[0].get_linestyle() == "None"
    ax = draw_sweep({"c10": np.array([2.0, 1.0, 3.0])}, {"p": np.arange(3.0)}, np.ones(3, bool), None).axes[0]
    np.testing.assert_array_equal(ax.get_lines()[0].get_data(), [[1, 2, 3], [1, 0, 2]])


def test_words_on_an_axis():
    ax = draw_sweep({"element": np.array(["full", "tet4"])}, {"p": np.arange(2.0)}, np.ones(2, bool), (2,)).axes[0]
    assert [label.get_text() for label in ax.get_xticklabels()] == ["full", "tet4"]
