"""Pictures: what is drawn, where, in which unit, and that no label is cut off."""

import subprocess
import sys
from io import BytesIO

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.contour import ContourSet
from PIL import Image

import opfem as op
from opfem.plot import draw_pictures, plot_compression, plot_pressure, plot_residual, plot_status, plot_thickness
from opfem.plot.drawing import DIVERGING, STATUS_COLOURS
from opfem.plot.layout import page
from tests import tolerances as tol


@pytest.fixture(scope="module")
def dataset(solution):
    return op.to_xarray(solution)


def colour_bar(ax):
    (bar,) = ax.child_axes
    return bar


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
        "compression": plot_compression(dataset),
        "residual": plot_residual(dataset, loaded),
    }


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


NAMES = ["pressure", "window", "status", "thickness", "compression", "residual"]


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
    areas = [float(dataset.node_area.where(dataset.contact_status == code, 0.0).sum()) for code in range(3)]
    assert labels == [f"{name}\n{area:.3g}" for name, area in zip(("open", "stick", "slip"), areas, strict=True)]
    assert colour_bar(pictures["status"]).get_ylabel() == "Contact status, area [mm²]"


def test_thickness_in_um_and_missing_pixels(pictures, loaded):
    ax = pictures["thickness"]
    assert "µm" in colour_bar(ax).get_ylabel()
    image = ax.images[0].get_array()
    assert np.array_equal(np.argwhere(image.mask), [[3, 4]])
    assert image[0, 0] == pytest.approx(1e3 * float(loaded.values[0, 0]), rel=tol.ROUNDOFF)
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["no data"]
    # Pixels are centred on their samples.
    assert ax.images[0].get_extent() == pytest.approx((-0.05, 2.05, 2.0625, -0.0625))


def test_compression_in_percent(pictures, dataset):
    ax = pictures["compression"]
    shown = ax.images[0].get_array()
    np.testing.assert_allclose(shown, 100.0 * (1.0 - dataset.thickness / 0.5), rtol=tol.ROUNDOFF, atol=1e-12)
    assert colour_bar(ax).get_ylabel() == "Compression [%]"


def test_missing_pixels_are_hatched_on_every_map(pictures):
    for name in NAMES:
        assert [text.get_text() for text in pictures[name].get_legend().get_texts()] == ["no data"]


@pytest.fixture
def lifted(dataset):
    """Contact lost where x is above 1 mm."""
    changed = dataset.copy(deep=True)
    changed["contact_status"] = dataset.contact_status.where(dataset.x < 1.1, 0)
    return changed


def test_open_area_is_hatched_and_contact_outlined(lifted, loaded):
    for ax in (plot_pressure(lifted), plot_status(lifted), plot_compression(lifted), plot_residual(lifted, loaded)):
        filled, *lines = [part for part in ax.collections if isinstance(part, ContourSet)][-3:]
        assert filled.hatches == [".."]
        # The outline runs midway between the last node that touches and the first that does not.
        (outline,) = lines[-1].get_paths()
        moved = lifted.x_current.values[:, 3:5].mean(axis=1)
        assert moved.min() - 1e-9 <= outline.vertices[:, 0].min() <= outline.vertices[:, 0].max() <= moved.max() + 1e-9
        assert "open" in [text.get_text() for text in ax.get_legend().get_texts()]


def test_an_air_gap_is_no_residual(lifted, loaded):
    shown = plot_residual(lifted, loaded).images[0].get_array()
    x = np.asarray(loaded.x)
    assert shown.mask[:, x > 1.3].all()
    assert not shown.mask[5:, x < 1.0].any()


def test_residual_is_measured_less_computed(pictures, dataset, loaded):
    expected = 1e3 * (np.asarray(loaded.values) - dataset.thickness.values)
    shown = pictures["residual"].images[0].get_array()
    np.testing.assert_allclose(shown.compressed(), expected[~np.asarray(loaded.mask)], rtol=tol.ROUNDOFF)
    low, high = pictures["residual"].images[0].get_clim()
    assert low == -high


def test_residual_is_diverging_about_zero():
    shades = plt.get_cmap(DIVERGING)(np.linspace(0, 1, 65))[:, :3] @ [0.299, 0.587, 0.114]
    assert np.argmax(shades) == 32
    assert (np.diff(shades)[:31] > 0).all()
    assert (np.diff(shades)[33:] < 0).all()


def test_residual_of_a_map_on_other_pixels(dataset, loaded):
    """Every fourth pixel of the map, so that the finer one has the same residual there."""
    coarse = op.ThicknessMap(loaded.values[::4, ::4], extent=loaded.extent, mask=loaded.mask[::4, ::4])
    shown = plot_residual(dataset, coarse).images[0].get_array()
    fine = plot_residual(dataset, loaded).images[0].get_array()
    np.testing.assert_allclose(shown, fine[::4, ::4], rtol=1e-9, atol=1e-9)


def test_residual_needs_a_map(truth):
    with pytest.raises(ValueError, match=r"no thickness map to compare with; pass measured=\."):
        plot_residual(truth)


@pytest.mark.parametrize("count", [1, 3, 5, 6, 8])
@pytest.mark.parametrize("aspect", [0.4, 1.0, 7 / 4, 4.0])
def test_a_page_holds_all_its_maps(count, aspect):
    (rows, columns), (width, height) = page(count, (0.0, aspect, 0.0, 1.0))
    assert 0 <= rows * columns - count < columns
    assert width > columns * 1.5
    assert height > rows * 1.5


@pytest.mark.parametrize("height", [2.0, 1.0])
def test_maps_of_a_page_align_and_fill_it(dataset, loaded, height):
    """Also those of a layer that is not square."""
    scaled = {name: (dataset[name].dims, dataset[name].values * height / 2.0) for name in ("y", "y_image", "y_current")}
    narrow = dataset.assign_coords(scaled)
    measured = op.ThicknessMap(loaded.values, extent=(2.0, height), mask=loaded.mask)
    figure = draw_pictures(narrow, measured)["report.png"]
    picture = render(figure)
    maps = [ax for ax in figure.axes if ax.get_title()]
    assert len(maps) == 6
    places = np.array([ax.get_position().bounds for ax in maps])
    for column, different in zip(places.T, (3, 2, 1, 1) if height == 2.0 else (2, 3, 1, 1), strict=True):
        assert len(np.unique(column.round(6))) == different
    assert len({(ax.get_xlim(), ax.get_ylim()) for ax in maps}) == 1
    # Half an inch of white at most above, below and beside.
    used = np.argwhere(picture < 250)
    assert (used.min(axis=0) < 50).all()
    assert (picture.shape - used.max(axis=0) < 50).all()


def test_report(dataset, loaded, solution):
    drawn = draw_pictures(dataset, loaded)
    assert list(drawn) == ["pressure.png", "report.png"]
    figure = drawn["report.png"]
    titles = [ax.get_title() for ax in figure.axes if ax.get_title()]
    force = -float(dataset.force_sample[2])
    rms = op.summary(solution, loaded)["residual_rms_um"]
    assert titles == [
        "Measured thickness",
        "Compression",
        f"Pressure at the sample, {force:.3g} N",
        f"Residual, {rms:.2g} µm rms",
        "Contact at the sample",
        "Contact at the window",
    ]
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
