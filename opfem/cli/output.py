"""Optional files of a command beside its result: vector drawings of the pictures, and maps for other programs."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import xarray as xr
from rich.console import Console

from ..io import MAP_FILES, encoded
from ..measurement import ThicknessMap
from .messages import in_options
from .options import PictureOptions, ResultOptions

_DPI = 200
_DRAWINGS = (".pdf", ".svg")
REPORT = "report.html"


def with_drawings(names: Sequence[str]) -> tuple[str, ...]:
    """Name the files that a result may have where its pictures may be drawings, too."""
    drawings = [name.removesuffix(".png") + suffix for name in names if name.endswith(".png") for suffix in _DRAWINGS]
    return (*drawings, *names)


def pictures(figures: Mapping[str, Any], options: PictureOptions) -> dict[str, bytes]:
    """Encode pictures, optionally as vector drawings too.

    Args:
        figures: Matplotlib figures by file name, which ends in .png.
        options: Which drawings.
    """
    wanted = [".png", *(suffix for suffix in _DRAWINGS if getattr(options, suffix[1:]))]
    contents = {}
    for name, figure in figures.items():
        for suffix in wanted:
            picture = io.BytesIO()
            figure.savefig(picture, format=suffix[1:], dpi=_DPI)
            contents[name.removesuffix(".png") + suffix] = picture.getvalue()
    return contents


def exports(dataset: xr.Dataset, measured: ThicknessMap | None, options: ResultOptions) -> dict[str, bytes]:
    """Encode a result for browsers and the maps for other programs, by file name.

    Args:
        dataset: What was solved or fitted.
        measured: Measured map, whose pixels are taken; None takes those of the load.
        options: Which of them.
    """
    files = {f"result{MAP_FILES[kind][0]}": encoded(dataset, kind, measured) for kind in dict.fromkeys(options.also)}
    if not options.report:
        return files
    # Loaded here, so that what needs no report does not wait for plotly.
    from ..report import report_bytes

    return {REPORT: report_bytes(dataset, measured), **files}


def show_warnings(numbers: dict[str, Any]) -> None:
    """Print what a reader should know before relying on a result.

    Args:
        numbers: Its summary.
    """
    console = Console(highlight=False)
    said = [f"{numbers['status']}: {numbers['status_message']}"] if numbers["status_message"] else []
    for warning in [*said, *numbers["warnings"]]:
        console.print(in_options(warning), style="yellow", markup=False, soft_wrap=True)
