"""The 3-D scene renders without a display, in the colours of the numbers it shows."""

import numpy as np
import pytest
import pyvista

import opfem as op


@pytest.fixture
def plotter():
    plotter = pyvista.Plotter(off_screen=True, window_size=(600, 400))
    yield plotter
    plotter.close()


@pytest.mark.parametrize(("colour", "title"), [("pressure", "Contact pressure [kPa]"), ("stress_zz", "-S33")])
def test_scene_renders_and_returns_its_plotter(solution, plotter, colour, title):
    assert op.plot_layer(solution, plotter, colour=colour) is plotter
    assert next(iter(plotter.scalar_bars.keys())).startswith(title)
    picture = plotter.screenshot(return_img=True)
    assert picture.shape[:2] == (400, 600)
    # The layer covers a good part of the picture, and its top is coloured (viridis is never grey).
    coloured = np.ptp(picture.astype(int), axis=2) > 40
    assert 0.05 < coloured.mean() < 0.6
    assert (picture == 255).all(axis=2).mean() > 0.2


def test_colours_span_the_pressure_in_kpa(solution, plotter):
    op.plot_layer(op.to_xarray(solution), plotter)
    low, high = plotter.mapper.scalar_range
    assert low == 0.0
    assert high == pytest.approx(1e3 * float(solution.pressure.max()))
    bounds = plotter.actors and plotter.mesh.bounds
    assert bounds.z_max - bounds.z_min < 0.55  # the mesh itself is not stretched


def display(plotter, x: float, y: float, z: float) -> tuple[float, float]:
    """Where a point of the layer is seen: pixels to the right and up."""
    plotter.render()
    plotter.renderer.SetWorldPoint(*(plotter.scale * np.array([x, y, z])), 1.0)
    plotter.renderer.WorldToDisplay()
    return plotter.renderer.GetDisplayPoint()[:2]


def test_the_layer_lies_as_on_the_maps(solution, plotter):
    op.plot_layer(solution, plotter)
    middle, right, lower, sample = (
        display(plotter, *point) for point in ((1.0, 1.0, 0.0), (2.0, 1.0, 0.0), (1.0, 2.0, 0.0), (1.0, 1.0, 0.5))
    )
    assert right[0] > middle[0] + 50
    assert lower[1] < middle[1] - 50
    assert sample[1] > middle[1] + 20


def test_ticks_are_at_round_numbers(solution, plotter, monkeypatch):
    said = []
    monkeypatch.setattr(plotter, "add_point_labels", lambda at, labels, **_: said.append((at, labels)))
    op.plot_layer(solution, plotter, stretch_z=2.0)
    assert [labels for _, labels in said] == [
        ["0", "0.5", "1", "1.5", "2", "x [mm]"],
        ["0", "0.5", "1", "1.5", "2", "y [mm]"],
        ["0", "0.2", "0.4", "z [mm]"],
    ]
    for axis, (at, labels) in enumerate(said):
        np.testing.assert_allclose(at[:-1, axis] / [1.0, -1.0, 2.0][axis], [float(label) for label in labels[:-1]])


def test_a_scene_off_screen_needs_no_display_and_does_not_complain(solution, monkeypatch, capfd):
    monkeypatch.delenv("DISPLAY", raising=False)
    scene = op.plot_layer(solution, off_screen=True)
    assert scene.screenshot(return_img=True).ndim == 3
    scene.close()
    assert capfd.readouterr().err == ""


def test_errors(solution, failed_solution, plotter):
    with pytest.raises(ValueError, match="needs a converged solution"):
        op.plot_layer(failed_solution, plotter)
    with pytest.raises(ValueError, match=r'"pressure" or "stress_zz", got \'red\''):
        op.plot_layer(solution, plotter, colour="red")
