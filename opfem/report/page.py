"""`write_report`: a result as one page for a browser, which needs no network: maps, section, layer, numbers, sources.

Edge of the chain: made from the dataset of `to_xarray`, or from one that was read back.
"""

import json
import os
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np
import plotly.graph_objects as go
import xarray as xr
from plotly.offline import get_plotlyjs

from ..io import write_whole
from ..measurement import ThicknessMap
from ..results import ExperimentSolution, Solution, TractionFit, on_pixels, summary, to_xarray
from .checks import WARNINGS, checks, in_short
from .convergence import convergence_rows, energy_figure
from .figures import map_figure
from .inputs import NOT_RECORDED, assumptions, input_rows
from .layer3d import layer_figure, stretch
from .maps import ReportMap, report_maps, stride_of
from .numbers import number_rows
from .provenance import PAPERS, citation, provenance_rows
from .section import BAND, section_figure
from .tables import input_table, items, number_table, source_table

# Dark on light, so that the line is seen on every colour; the upper one is what the reader drags.
_LINE_STYLES: tuple[dict[str, Any], ...] = ({"color": "#ffffff", "width": 5}, {"color": "#111111", "width": 2})
_ORIENTATION = (
    "As the microscope sees it through the window: x along image columns, y along image rows and downwards. A value "
    "is where the face of the layer now lies."
)


def write_report(
    data: Solution | ExperimentSolution | TractionFit | xr.Dataset,
    path: str | os.PathLike,
    measured: ThicknessMap | None = None,
) -> None:
    """Write a result as one HTML file that opens in any browser, without a network; whole or not at all.

    Maps with their values under the cursor, a section along a line, the layer in three dimensions, the numbers in
    words, what was given and what assumed, convergence and energy, versions and what to cite; 5 to 8 MB.

    Args:
        data: A solution, a fit, or the dataset of one, such as `read_netcdf` returns.
        path: File to make or replace.
        measured: The map as it was measured. None draws the one that was pressed in, filled and smoothed, or where the
            result holds none, the computed thickness.

    Raises:
        ValueError: For a solve that did not converge.
        FileNotFoundError: When the folder does not exist.

    Example:
        >>> import opfem as op
        >>> def report_of(solution, loaded):
        ...     op.write_report(solution, "report.html", measured=loaded)
    """
    write_whole(path, report_bytes(data if isinstance(data, xr.Dataset) else _with_warnings(data, measured), measured))


def _with_warnings(data: Solution | ExperimentSolution | TractionFit, measured: ThicknessMap | None) -> xr.Dataset:
    fit, solution = (data, data.solution) if isinstance(data, TractionFit) else (None, data)
    warnings = summary(solution, measured)["warnings"]
    advice = "" if fit is None else fit.advice()
    return to_xarray(data).assign_attrs({WARNINGS: json.dumps([*warnings, advice] if advice else warnings)})


def report_bytes(dataset: xr.Dataset, measured: ThicknessMap | None = None) -> bytes:
    """Make the page of a report.

    Args:
        dataset: What `to_xarray` returned.
        measured: The map as it was measured, where it is known.

    Raises:
        ValueError: For a solve that did not converge.
    """
    if not np.isfinite(dataset["displacement"].values).all():
        status = dataset.attrs.get("status")
        raise ValueError(f"There is nothing to report: the solve did not converge (status {status!r}).")
    pixels = on_pixels(dataset, measured)
    maps = report_maps(dataset, pixels, measured is not None)
    inputs = input_rows(dataset)
    energy = energy_figure(dataset)
    x, y = _limits(pixels)
    figures = _figures(dataset, maps, pixels) | ({} if energy is None else {"energy": energy})
    page = Template(_packaged("page.html")).substitute(
        version=escape(str(dataset.attrs.get("opfem_version", ""))),
        title=escape(_heading(dataset)),
        css=_packaged("page.css"),
        heading=escape(_heading(dataset)),
        subtitle=escape(_subtitle(dataset, stride_of(pixels), measured is not None)),
        short=escape(in_short(dataset, pixels)),
        checks="".join(
            f'<li class="{"good" if check.good else "care"}">{escape(check.words)}</li>'
            for check in checks(dataset, pixels, inputs)
        ),
        orientation=escape(_ORIENTATION),
        aspect=f"{(y[1] - y[0]) / (x[1] - x[0]):.4f}",
        maps="".join(map(_card, maps)),
        legend=_legend(maps),
        section_words=escape(_section_words(dataset)),
        layer_words=escape(_layer_words(stretch(dataset))),
        numbers=number_table(number_rows(dataset, pixels)),
        inputs_words=escape(_inputs_words(any(row.mark == NOT_RECORDED for row in inputs))),
        inputs=input_table(inputs, assumptions(dataset)),
        convergence=number_table(convergence_rows(dataset)),
        energy="" if energy is None else '<div class="plot more energy" id="energy"></div>',
        provenance=source_table(provenance_rows(dataset)),
        papers=items([citation(dataset), *PAPERS]),
        # plotly writes < as an escape, so that no text of a figure ends the script element.
        plots=f"{{{','.join(f'{json.dumps(name)}:{figure.to_json()}' for name, figure in figures.items())}}}",
        line=json.dumps(_line(pixels)),
        plotly=_script(get_plotlyjs()),
        js=_script(_packaged("page.js")),
    )
    return page.encode("utf-8", "backslashreplace")


def _packaged(name: str) -> str:
    return files("opfem.report").joinpath(name).read_text(encoding="utf-8")


def _script(text: str) -> str:
    """Keep a program inside its script element, which no string of it may end."""
    return text.replace("</script", "<\\/script")


def _limits(pixels: xr.Dataset) -> tuple[tuple[float, float], tuple[float, float]]:
    """Find the ends of the maps along x and y [mm]."""
    x, y = ((float(axis[0]), float(axis[-1])) for axis in (pixels["x_image"].values, pixels["y_image"].values))
    return x, y


def _line(pixels: xr.Dataset) -> list[float]:
    """Choose where the line lies before the reader drags it: across the middle, from one eighth to seven [mm]."""
    (x0, x1), y = _limits(pixels)
    return [x0 + 0.125 * (x1 - x0), sum(y) / 2, x0 + 0.875 * (x1 - x0), sum(y) / 2]


def _figures(dataset: xr.Dataset, maps: Sequence[ReportMap], pixels: xr.Dataset) -> dict[str, go.Figure]:
    x0, y0, x1, y1 = _line(pixels)
    figures = {}
    for drawn in maps:
        figure = map_figure(drawn, _limits(pixels))
        for style in _LINE_STYLES:
            figure.add_shape(type="line", x0=x0, y0=y0, x1=x1, y1=y1, line=style)
        for name, x, y in (("A", x0, y0), ("B", x1, y1)):
            figure.add_annotation(
                text=name, x=x, y=y, showarrow=False, bgcolor="white", bordercolor="#333", borderpad=1
            )
        figures[f"map-{drawn.key}"] = figure
    return {**figures, "section": section_figure(list(maps)), "layer": layer_figure(dataset)}


def _heading(dataset: xr.Dataset) -> str:
    if "pressure_std" in dataset:
        return "Stress on the sample, fitted to the thickness of a soft layer"
    return str(dataset.attrs.get("title", "Stress on the sample"))


def _subtitle(dataset: xr.Dataset, stride: int, was_measured: bool) -> str:
    sides = " × ".join(f"{side:g}" for side in dataset.attrs["extent"])
    thinned = f" Every {_ordinal(stride)} pixel of the map is drawn." if stride > 1 else ""
    if "sample_displacement" in dataset:
        return f"A layer of {sides} mm pressed onto a sample of known stiffness: the computed truth.{thinned}"
    seen = ", its thickness measured by optical coherence tomography" if was_measured else ""
    return f"A layer of {sides} mm{seen}.{thinned}"


def _ordinal(number: int) -> str:
    return {2: "2nd", 3: "3rd"}.get(number, f"{number}th")


def _card(drawn: ReportMap) -> str:
    unit = f" [{escape(drawn.unit)}]" if drawn.unit else ""
    return (
        f'<figure class="map-card"><figcaption><h3>{escape(drawn.title)}{unit}</h3>{escape(drawn.words)}</figcaption>'
        f'<div class="frame"><div class="plot map" id="map-{escape(drawn.key)}"></div></div></figure>'
    )


def _legend(maps: Sequence[ReportMap]) -> str:
    marks = {
        "unmeasured": (
            "not measured; what is computed there rests on its surroundings",
            any(drawn.unmeasured is not None and drawn.unmeasured.any() for drawn in maps),
        ),
        "clear": (
            "the layer does not touch the sample",
            any(drawn.clear is not None and drawn.clear.any() for drawn in maps),
        ),
        "off": ("no layer", any(drawn.key == "pressure" and np.isnan(drawn.values).any() for drawn in maps)),
    }
    return "".join(
        f'<span><i class="swatch {name}"></i>{escape(words)}</span>' for name, (words, shown) in marks.items() if shown
    )


def _section_words(dataset: xr.Dataset) -> str:
    band = f" The band is ± {BAND:g} standard deviations." if "pressure_std" in dataset else ""
    return f"Thickness is drawn from the window downwards.{band}"


def _layer_words(stretched: float) -> str:
    return (
        "Seen through the clear window as the microscope sees it; what stands up is where the sample presses. Coloured "
        f"by the pressure on the sample [kPa], stretched {stretched:g} times along its thickness. Drag to turn it; "
        "roll the wheel to come nearer."
    )


def _inputs_words(unrecorded: bool) -> str:
    if unrecorded:
        return (
            "This result does not record which inputs were given and which assumed; results of the command line do. "
            "Compare each with your own."
        )
    return "Given by whoever computed this, or assumed by opfem because nothing was said: those may not be yours."
