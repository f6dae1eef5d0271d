"""The deformed layer in three dimensions, as a pyvista scene."""

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.ticker import MaxNLocator

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

    It lies as on the maps, x to the right and y towards the viewer, its face at the sample up: the mirror image of the
    layer itself, as a map is seen from the sample. The scene is returned, not shown: call `.show()` on it,
    or `.screenshot(path)` on one that is off screen.

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
    scene.set_scale(yscale=-1.0, zscale=stretch_z)
    _draw_axes(scene, grid.bounds, np.array([1.0, -1.0, stretch_z]))
    if stretch_z != 1.0:
        scene.add_text(f"z stretched {stretch_z:g} times", font_size=_FONT // 2, color="black")
    scene.set_background("white")
    scene.camera_position = [(-0.3, -1.3, 1.15), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)]
    scene.reset_camera()
    scene.camera.zoom(1.05)
    return scene


_FONT = 16
_TICK, _TICKS = 0.02, {"x": 5, "y": 5, "z": 2}  # length over the longest side, and most intervals
_BAR: Any = {
    "title_font_size": _FONT,
    "label_font_size": _FONT,
    "fmt": "%.3g",
    "vertical": False,
    "color": "black",
    "n_labels": 4,  # none in the middle, where the title is
    "position_x": 0.28,
    "position_y": 0.87,
    "width": 0.68,
    "height": 0.1,
}


def _draw_axes(scene: Any, bounds: Any, scale: Float[np.ndarray, "3"]) -> None:
    """Draw the axes along the edges nearest to the viewer, with ticks at round numbers."""
    low, high = np.array(bounds).reshape(3, 2).T
    left, right = np.array([low[0], high[1], low[2]]), np.array([high[0], high[1], low[2]])
    tick = _TICK * float(np.max(high - low))
    places = {"x": (left, (0.0, tick, 0.0)), "y": (left, (-tick, 0.0, 0.0)), "z": (right, (tick, 0.0, 0.0))}
    for axis, (name, (corner, outward)) in enumerate(places.items()):
        ticks = MaxNLocator(_TICKS[name], steps=[1, 2, 5, 10]).tick_values(low[axis], high[axis])
        ticks = ticks[(ticks >= low[axis] - 1e-9) & (ticks <= high[axis] + 1e-9)]
        at = np.repeat(corner[None], ticks.size, axis=0)
        at[:, axis] = ticks
        ends = np.repeat(corner[None], 2, axis=0)
        ends[:, axis] = low[axis], high[axis]
        out = np.array(outward)
        scene.add_lines(np.concatenate([ends, np.stack([at, at + out], axis=1).reshape(-1, 3)]), color="black", width=2)
        middle = ends.mean(axis=0) + 5.0 * out
        # Labels, unlike all else, are not scaled with the scene.
        labels = [*(f"{tick:g}" for tick in ticks), f"{name} [mm]"]
        scene.add_point_labels(
            scale * np.concatenate([at + 2.2 * out, middle[None]]),
            labels,
            font_size=_FONT,
            text_color="black",
            bold=False,
            shape=None,
            show_points=False,
            always_visible=True,
            justification_horizontal="center",
            justification_vertical="center",
        )


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
