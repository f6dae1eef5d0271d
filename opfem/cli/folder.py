"""The folder of results, `--out`: what it may hold, and how a new result takes the place of an old one.

A link is followed where it is the folder, and refused where it is a file of a result.
"""

import json
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import xarray as xr

from ..io import MAP_FILES, finish, netcdf_bytes, vtu_bytes, whole_file, write_thickness, write_together
from ..measurement import ThicknessMap
from ..sweeps.store import PLAN
from .options import ResultOptions
from .output import REPORT, exports, pictures, with_drawings

# The mark of a finished result comes last: a folder that holds it holds a whole result.
FINISHED = "result.nc"
EXAMPLE = "example_map.npz"
SIMULATED, UNLOADED = "map.npz", "l0.npz"
DECK_PICTURE = "deck.png"
_PICTURES = ("pressure.png", "report.png", "fit.png", "section.png")
_EXPORTS = (REPORT, *(f"result{suffix}" for suffix, _ in MAP_FILES.values()))
# All that `palpate`, `fit` and `simulate` write.
RESULT = (
    *(EXAMPLE, SIMULATED, UNLOADED, "result.vtu", *_EXPORTS),
    *(*with_drawings(_PICTURES), DECK_PICTURE, "summary.json", FINISHED),
)


def settle(out: Path, force: bool) -> None:
    """Refuse a folder whose content may not be replaced; complete a result that a killed process left half in place.

    Raises:
        FileExistsError: Where it holds a sweep, or a finished result and no `force`.
        OSError: Where it, or a file of a result in it, is a link that leads nowhere good.
    """
    refuse_links(out, RESULT)
    finish(out, RESULT)
    if (out / PLAN).exists():
        raise FileExistsError(f"--out {out} holds a sweep ({PLAN}). Choose another --out, or remove that folder.")
    refuse_finished(out, FINISHED, force)


def refuse_finished(out: Path, last: str, force: bool) -> None:
    """Raise FileExistsError where the folder holds the file that is written last, and no `force`."""
    if (out / last).exists() and not force:
        raise FileExistsError(
            f"--out {out} holds a finished result ({last}). Pass --force to replace it, or another --out."
        )


def refuse_links(out: Path, names: Sequence[str]) -> None:
    """Raise OSError where the folder is a link to nothing, or a file of a result in it is a link."""
    if out.is_symlink() and not out.exists():
        raise OSError(f"--out {out} is a link to {out.readlink()}, which does not exist. Make that folder, or mend it.")
    links = [name for name in names if (out / name).is_symlink()]
    if links:
        raise OSError(
            f"--out {out} holds {links[0]} as a link to {(out / links[0]).readlink()}. A result is written beside and "
            "takes the place of the old one, which no link can follow. Remove it, link the folder itself, or choose "
            "another --out."
        )


def prepare(out: Path) -> None:
    """Find out before the long solve whether the results can be written."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as cause:
        raise OSError(f"Cannot write results to --out {out}: {cause.strerror}. Choose another --out.") from cause


def write_result(
    dataset: xr.Dataset,
    figures: dict[str, Any],
    numbers: dict[str, Any],
    out: Path,
    maps: Mapping[str, ThicknessMap] = MappingProxyType({}),
    *,
    measured: ThicknessMap | None = None,
    options: ResultOptions = ResultOptions(),
) -> list[str]:
    """Write every file of a result: all are complete before one of an old result is replaced.

    Args:
        dataset: What was solved or fitted.
        figures: Matplotlib figures by file name.
        numbers: For summary.json.
        out: Folder of the results.
        maps: Thickness maps by file name: the built-in one where that was measured, or those that were simulated.
        measured: Measured map, whose pixels exported maps have; None takes those of the load.
        options: Which files for other programs are written too.

    Returns:
        The names of the files.
    """
    contents: dict[str, Any] = {name: _thickness_bytes(thickness) for name, thickness in maps.items()}
    contents["result.vtu"] = vtu_bytes(dataset)
    contents |= exports(dataset, measured, options) | pictures(figures, options)
    contents["summary.json"] = _json(numbers)
    contents[FINISHED] = netcdf_bytes(dataset)
    write_together(out, contents, RESULT)
    return list(contents)


def record_failure(numbers: dict[str, Any], out: Path) -> None:
    """Write summary.json of a solve that failed, except beside a finished result, which stays as it is.

    Args:
        numbers: In types that JSON knows.
        out: Folder of the results.
    """
    if not (out / FINISHED).exists():
        with whole_file(out / "summary.json") as temporary:
            temporary.write_bytes(_json(numbers))


def _json(numbers: dict[str, Any]) -> bytes:
    # A file name that is no text becomes escapes, which JSON reads back.
    return (json.dumps(numbers, indent=2, ensure_ascii=False) + "\n").encode("utf-8", "backslashreplace")


def _thickness_bytes(thickness: ThicknessMap) -> bytes:
    with tempfile.TemporaryDirectory() as scratch:
        write_thickness(thickness, Path(scratch) / EXAMPLE)
        return (Path(scratch) / EXAMPLE).read_bytes()
