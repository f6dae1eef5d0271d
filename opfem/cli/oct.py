"""`opfem oct LOADED --out DIR`: from OCT volumes to the thickness maps that the other commands take.

`opfem palpate VOLUME.oct` reads its map by the same functions.
"""

import dataclasses
import io
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ..io import read_oct, write_thickness, write_together
from ..io.entry import MAX_BYTES
from ..io.masks import read_mask
from ..measurement import MeasurementError, ThicknessMap
from ..measurement.oct import EDGES, Interface, OctSystem, OctVolume, find_interface
from ..solvers.progress import Progress
from .folder import prepare, refuse_finished, refuse_links
from .options import InterfaceOptions, MicroscopeOptions, PictureOptions, RunOptions, VolumeOptions
from .output import pictures, with_drawings
from .statement import configure_jax

FILES = ("interface.npz", "unloaded.npz", "bscans.png", "maps.png", "summary.json", "thickness.npz")
"""What the command writes; the last marks a finished result."""

_WINDOW_REACH = 0.03  # mm below the window's interface where the sample's is looked for from


def measure(
    loaded: str,
    out: Path,
    unloaded: str | None,
    l0: float | None,
    reading: VolumeOptions,
    microscope: MicroscopeOptions,
    options: InterfaceOptions,
    run: RunOptions,
    files: PictureOptions = PictureOptions(),
) -> None:
    """Measure the thickness of the layer and write it.

    Args:
        loaded: File of the loaded volume.
        out: Folder of the results.
        unloaded: File of the unloaded volume.
        l0: Unloaded thickness [mm].
        reading: How to read the volumes.
        microscope: The microscope.
        options: What to look for.
        run: The run itself.
        files: Drawings to write, too.
    """
    if unloaded is not None and l0 is not None:
        raise ValueError("--l0 and --unloaded both state the unloaded layer; leave one out.")
    with Progress(True, at_once=True) as progress:
        progress.stage("reading")
        configure_jax(run.no_cache)
        refuse_links(out, with_drawings(FILES))
        refuse_finished(out, FILES[-1], run.force)
        volume = read_volume(loaded, reading)
        before = None if unloaded is None else read_volume(unloaded, reading)
        prepare(out)
        progress.stage("interface")
        interface, thickness = find_thickness(volume, loaded, microscope, options)
        first = None if before is None else find_thickness(before, str(unloaded), microscope, options)[1]
        if first is not None and first.shape != thickness.shape:
            raise ValueError(f"--unloaded has (ny, nx) = {first.shape} A-lines, LOADED {thickness.shape}.")
        numbers = _numbers(loaded, volume, interface, thickness, first if first is not None else l0)
        stated = {**dataclasses.asdict(reading), **dataclasses.asdict(microscope), **dataclasses.asdict(options)}
        numbers["settings"] = {name: value for name, value in stated.items() if value is not None}
        progress.stage("pictures")
        from ..plot import draw_interface

        contents = {"interface.npz": _interface_bytes(interface)}
        if first is not None:
            contents["unloaded.npz"] = _map_bytes(first)
        contents |= pictures(draw_interface(volume, interface, thickness), files)
        contents["summary.json"] = (json.dumps(numbers, indent=2, ensure_ascii=False) + "\n").encode()
        contents["thickness.npz"] = _map_bytes(thickness)
        write_together(out, contents, with_drawings(FILES))
    _show(numbers, list(contents), out)


def is_volume(path: str) -> bool:
    """Tell whether a path is that of an OCT volume."""
    return path.lower().endswith(".oct") or (Path(path) / "Header.xml").is_file()


def read_volume(path: str, reading: VolumeOptions = VolumeOptions()) -> OctVolume:
    """Read a volume by the options of the command line."""
    return read_oct(path, **dataclasses.asdict(reading))


def find_thickness(
    volume: OctVolume,
    path: str,
    microscope: MicroscopeOptions = MicroscopeOptions(),
    options: InterfaceOptions = InterfaceOptions(),
) -> tuple[Interface, ThicknessMap]:
    """Find the interface and the thickness by the options of the command line.

    Args:
        volume: The volume.
        path: Its file, for messages.
        microscope: The microscope.
        options: What to look for.

    Raises:
        MeasurementError: Where there is no interface; names the file.
    """
    system = OctSystem(**dataclasses.asdict(microscope))
    mask = None if options.mask is None else read_mask(Path(path), options.mask, volume.shape[:2], MAX_BYTES)
    find: dict[str, Any] = {
        "edge": options.edge,
        "max_slope": options.max_slope,
        "average": options.average,
        "confidence": options.confidence,
        "mask": mask,
    }
    low, high = options.search or (0.03, None)
    try:
        if options.window == "first_pixel":
            interface = find_interface(volume, system, search=(low, high), **find)
            return interface, interface.thickness(tilt=options.tilt)
        window = find_interface(volume, system, edge="peak", search=(0.0, high), mask=mask)
        below = (np.asarray(window.depth) + max(low, _WINDOW_REACH), high)
        interface = find_interface(volume, system, search=below, **find)
        return interface, interface.thickness(window, options.tilt)
    except MeasurementError as cause:
        raise MeasurementError(f"{path}: {cause}") from cause


def _numbers(path: str, volume: OctVolume, interface: Interface, thickness: ThicknessMap, unloaded) -> dict[str, Any]:
    kept = ~np.asarray(thickness.mask)
    values, std = 1e3 * np.asarray(thickness.values)[kept], 1e3 * np.asarray(thickness.std)[kept]
    edges = np.bincount(np.asarray(interface.edge)[kept], minlength=len(EDGES)) / kept.sum()
    numbers: dict[str, Any] = {
        "volume": path,
        "pixels": list(volume.shape),
        "masked_share": float(1.0 - kept.mean()),
        "thickness_min_um": float(values.min()),
        "thickness_median_um": float(np.median(values)),
        "thickness_max_um": float(values.max()),
        "std_median_um": float(np.median(std)),
        "contrast_median_dB": float(np.median(np.asarray(interface.contrast_db)[kept])),
        "confidence_median": float(np.median(np.asarray(interface.confidence)[kept])),
        "edge_shares": {name: float(share) for name, share in zip(EDGES, edges, strict=True) if share > 0},
        "steps": [step.name for step in thickness.steps],
    }
    if isinstance(unloaded, ThicknessMap):
        both = kept & ~np.asarray(unloaded.mask)
        before = 1e3 * np.asarray(unloaded.values)
        numbers["unloaded_median_um"] = float(np.median(before[both]))
        numbers["strain_median"] = float(np.median(1e3 * np.asarray(thickness.values)[both] / before[both] - 1.0))
    elif unloaded is not None:
        numbers["unloaded_median_um"] = 1e3 * float(unloaded)
        numbers["strain_median"] = float(np.median(values / (1e3 * unloaded) - 1.0))
    return numbers


def _show(numbers: dict[str, Any], files: list[str], out: Path) -> None:
    console = Console(highlight=False)
    low, middle, high = (numbers[f"thickness_{name}_um"] for name in ("min", "median", "max"))
    console.print(
        f"thickness {middle:.1f} µm ({low:.1f} to {high:.1f}), standard deviation {numbers['std_median_um']:.2g} µm, "
        f"contrast {numbers['contrast_median_dB']:.1f} dB, {numbers['masked_share']:.1%} masked",
        markup=False,
        soft_wrap=True,
    )
    if "strain_median" in numbers:
        console.print(f"strain {numbers['strain_median']:.1%} (median)", markup=False)
    console.print(
        f"Look at {out / 'bscans.png'} first. Wrote {', '.join(files)} to {out}", markup=False, soft_wrap=True
    )


def _interface_bytes(interface: Interface) -> bytes:
    buffer = io.BytesIO()
    fields = {
        name: np.asarray(getattr(interface, name)) for name in ("depth", "std", "confidence", "contrast_db", "edge")
    }
    np.savez_compressed(buffer, edges=np.array(EDGES), mask=np.asarray(interface.mask), **fields)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def _map_bytes(thickness: ThicknessMap) -> bytes:
    with tempfile.TemporaryDirectory() as scratch:
        write_thickness(thickness, Path(scratch) / "map.npz")
        return (Path(scratch) / "map.npz").read_bytes()
