"""The deformed layer in three dimensions, as a pyvista scene."""

from typing import TYPE_CHECKING, Any

import xarray as xr

from ..io import layer_grid
from ..results import ExperimentSolution, Solution, to_xarray

if TYPE_CHECKING:
    import pyvista

_KPA = 1e3


def plot_layer(
    data: Solution | ExperimentSolution | xr.Dataset,
    plotter: "pyvista.Plotter | None" = None,
    *,
    colour: str = "pressure",
    stretch_z: float = 3.0,
    vmax: float | None = None,
    cmap: str = "viridis",
    off_screen: bool = False,
) -> "pyvista.Plotter":
    """Put the deformed layer into a 3-D scene, coloured on its top by what the sample does to it [kPa].

    The scene is returned, not shown: call `.show()` on it, or `.screenshot(path)` on one that is off screen.

    Args:
        data: A solution, or its dataset.
        plotter: Scene to add to; None makes one.
        colour: "pressure" (contact pressure at the sample) or "stress_zz" (−σ_zz, mean of the top element).
        stretch_z: How much the picture is stretched along the thickness; the scene says so.
        vmax: Upper end of the colours [kPa]; None takes the largest value.
        cmap: Name of the colour map; the default brightens with pressure and so reads in grey.
        off_screen: Make a scene that needs no display.

    Raises:
        ValueError: For a failed solution, or an unknown colour.
    """
    if colour not in ("pressure", "stress_zz"):
        raise ValueError(f'colour must be "pressure" or "stress_zz", got {colour!r}.')
    grid = layer_grid(data if isinstance(data, xr.Dataset) else to_xarray(data))
    if colour == "pressure":
        title = "Contact pressure [kPa]"
        grid.point_data[title] = _KPA * grid.point_data["pressure_MPa"]
    else:
        title = "-S33, top element [kPa]"
        grid.cell_data[title] = -_KPA * grid.cell_data["stress_zz_MPa"]
    values = grid[title]
    limits = (min(0.0, float(_finite(values).min())), float(_finite(values).max()) if vmax is None else vmax)
    # pyvista wraps its methods so that pyright no longer knows them.
    scene: Any = _new_scene(off_screen) if plotter is None else plotter
    scene.add_mesh(
        grid.extract_surface(algorithm="dataset_surface"),
        scalars=title,
        cmap=cmap,
        clim=limits,
        nan_color="lightgrey",
        show_edges=True,
        edge_opacity=0.2,
        scalar_bar_args=_BAR,
    )
    scene.set_scale(zscale=stretch_z)
    # The ranges are given because the scene would label its stretched ones.
    titles = {"xtitle": "x [mm]", "ytitle": "y [mm]", "ztitle": "z [mm]"}
    scene.show_bounds(**titles, axes_ranges=list(grid.bounds), location="outer", color="black", **_LABELS)
    if stretch_z != 1.0:
        scene.add_text(f"z stretched {stretch_z:g} times", font_size=9, color="black")
    scene.set_background("white")
    scene.camera_position = [(-0.9, -1.25, 1.1), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)]
    scene.reset_camera()
    scene.camera.zoom(0.9)
    return scene


_LABELS: Any = {"n_xlabels": 4, "n_ylabels": 4, "n_zlabels": 2, "fmt": "%.1f", "font_size": 14, "padding": 0.03}
_BAR: Any = {
    "title_font_size": 16,
    "label_font_size": 16,
    "fmt": "%.3g",
    "vertical": True,
    "color": "black",
    "position_x": 0.85,
    "position_y": 0.15,
    "height": 0.7,
}


def _new_scene(off_screen: bool) -> "pyvista.Plotter":
    """Make a scene, without VTK's warning where it finds no X server and takes other means."""
    # Loaded here, so that other pictures do not wait for them.
    import pyvista
    from vtkmodules.vtkCommonCore import vtkLogger

    verbosity = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    try:
        return pyvista.Plotter(off_screen=off_screen)
    finally:
        vtkLogger.SetStderrVerbosity(verbosity)


def _finite(values):
    return values[values == values]
