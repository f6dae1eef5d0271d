"""Pictures: what is drawn, where, in which unit, and that no label is cut off."""

import subprocess
import sys
from io import BytesIO

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

import opfem as op
from opfem.plot import draw_pictures, plot_pressure, plot_residual, plot_status, plot_thickness
from opfem.plot.maps import STATUS_COLOURS
from tests import tolerances as tol


@pytest.fixture(scope="module")
def dataset(solution):
    return op.to_xarray(solution)


def colour_bar(ax):
    return next(other for other in ax.figure.axes if other is not ax)


def render(figure) -> np.ndarray:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=100)
    return np.asarray(Image.open(buffer).convert("L"))


@pytest.fixture
def pictures(dataset, loaded):
    return {
        "pressure": plot_pressure(dataset),
        "window": plot_pressure(dataset, window=True),
        "status": plot_status(dataset),
        "thickness": plot_thickness(loaded),
        "residual": plot_residual(dataset, loaded),
    }


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


NAMES = ["pressure", "window", "status", "thickness", "residual"]


@pytest.mark.parametrize("name", NAMES)
def test_axes(pictures, name):
    ax = pictures[name]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [mm]", "y [mm]")
    assert ax.get_aspect() == 1
    # Row 0 at the top, as imagesc shows a matrix.
    assert ax.get_ylim()[0] > ax.get_ylim()[1]
    assert ax.get_xlim()[0] < ax.get_xlim()[1]


@pytest.mark.parametrize("name", NAMES)
def test_nothing_is_cut_off(pictures, name):
    figure = pictures[name].figure
    picture = render(figure)
    used, page = figure.get_tightbbox(figure.canvas.get_renderer()), figure.bbox_inches
    assert used.x0 >= 0
    assert used.y0 >= 0
    assert used.x1 <= page.x1
    assert used.y1 <= page.y1
    # Drawn, and blank along the rim of the page.
    assert picture.std() > 20
    assert np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]]).min() == 255


def test_pressure_in_kpa_where_it_acts(pictures, dataset):
    ax = pictures["pressure"]
    assert "kPa" in colour_bar(ax).get_ylabel()
    mesh = ax.collections[0]
    np.testing.assert_allclose(mesh.get_array(), 1e3 * dataset.pressure, rtol=tol.ROUNDOFF)
    drawn = mesh.get_coordinates()
    np.testing.assert_array_equal(drawn[..., 0], dataset.x_current)
    np.testing.assert_array_equal(drawn[..., 1], dataset.y_current)


def test_solution_or_dataset(solution, dataset):
    ax = plot_pressure(dataset).figure.subplots()
    assert plot_pressure(solution, ax) is ax
    np.testing.assert_array_equal(ax.collections[0].get_array(), plot_pressure(dataset).collections[0].get_array())


def test_largest_pressure_can_be_set(dataset):
    ax = plot_pressure(dataset, vmax=1.0)
    assert ax.collections[0].get_clim() == (0.0, 1.0)


def test_pressure_reads_in_grey(dataset):
    """Higher pressure is lighter on a grey print."""
    ax = plot_pressure(dataset)
    shades = ax.collections[0].cmap(np.linspace(0, 1, 32))[:, :3] @ [0.299, 0.587, 0.114]
    assert (np.diff(shades) > 0).all()


def test_status_colours_differ_in_grey():
    shades = sorted(np.dot(to_rgb(colour), [0.299, 0.587, 0.114]) for colour in STATUS_COLOURS.values())
    assert np.diff(shades).min() > 0.2


def test_status_key(pictures, dataset):
    labels = [label.get_text() for label in colour_bar(pictures["status"]).get_yticklabels()]
    shares = [float((dataset.contact_status == code).mean()) for code in range(3)]
    assert labels == [f"{name}\n{share:.0%}" for name, share in zip(("open", "stick", "slip"), shares, strict=True)]


def test_thickness_in_um_and_missing_pixels(pictures, loaded):
    ax = pictures["thickness"]
    assert "µm" in colour_bar(ax).get_ylabel()
    image = ax.images[0].get_array()
    assert np.array_equal(np.argwhere(image.mask), [[3, 4]])
    assert image[0, 0] == pytest.approx(1e3 * float(loaded.values[0, 0]), rel=tol.ROUNDOFF)
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["no data"]
    # Pixels are centred on their samples.
    assert ax.images[0].get_extent() == pytest.approx((-0.05, 2.05, 2.0625, -0.0625))


def test_residual_is_measured_less_computed(pictures, dataset, loaded):
    expected = 1e3 * (np.asarray(loaded.values) - dataset.thickness.values)
    shown = pictures["residual"].images[0].get_array()
    np.testing.assert_allclose(shown.compressed(), expected[~np.asarray(loaded.mask)], rtol=tol.ROUNDOFF)
    low, high = pictures["residual"].images[0].get_clim()
    assert low == -high


def test_residual_needs_the_same_grid(dataset):
    other = op.ThicknessMap(np.full((17, 21), 0.4), extent=(3.0, 2.0))
    with pytest.raises(ValueError, match="must lie on the grid"):
        plot_residual(dataset, other)


def test_report(dataset, loaded):
    drawn = draw_pictures(dataset, loaded)
    assert list(drawn) == ["pressure.png", "report.png"]
    figure = drawn["report.png"]
    titles = [ax.get_title() for ax in figure.axes if ax.get_title()]
    force = -float(dataset.force_sample[2])
    assert titles[:3] == ["Measured thickness", f"Pressure at the sample, {force:.3g} N", "Contact at the sample"]
    assert titles[3].endswith("µm rms")
    picture = render(figure)
    # Not blank, and nothing touches the rim of the page.
    assert picture.std() > 20
    rim = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
    assert rim.min() == 255


def test_failed_solution_is_not_drawn(failed_solution):
    with pytest.raises(ValueError, match="did not converge"):
        plot_pressure(failed_solution)


def test_notebooks_show_pictures_and_files_need_no_display(dataset, loaded):
    draw_pictures(dataset, loaded)
    assert plt.get_fignums() == []
    ax = plot_pressure(dataset)
    assert plt.gcf() is ax.figure


def test_no_pyplot():
    code = "import sys, opfem.plot; print('matplotlib.pyplot' in sys.modules)"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "False"
