"""`opfem oct --phase BEFORE AFTER --out DIR`: the axial displacement between two complex volumes."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from ..io import displacement_bytes, write_together
from ..measurement.oct import DisplacementVolume, OctSystem, axial_displacement
from ..solvers.progress import Progress
from .folder import prepare, refuse_finished, refuse_links
from .oct import read_volume
from .options import MicroscopeOptions, PictureOptions, RunOptions, VolumeOptions
from .output import pictures, with_drawings
from .statement import configure_jax

FILES = ("displacement.png", "summary.json", "displacement.npz")
"""What the command writes; the last marks a finished result."""


def measure_phase(
    paths: tuple[str, str],
    out: Path,
    reading: VolumeOptions,
    microscope: MicroscopeOptions,
    run: RunOptions,
    files: PictureOptions = PictureOptions(),
) -> None:
    """Measure the displacement and write it.

    Args:
        paths: Files of the volumes before and after.
        out: Folder of the results.
        reading: How to read the volumes.
        microscope: The microscope.
        run: The run itself.
        files: Drawings to write, too.
    """
    with Progress(True, at_once=True) as progress:
        progress.stage("reading")
        configure_jax(run.no_cache)
        refuse_links(out, with_drawings(FILES))
        refuse_finished(out, FILES[-1], run.force)
        before, after = (read_volume(path, reading) for path in paths)
        prepare(out)
        progress.stage("displacement")
        found = axial_displacement(before, after, OctSystem(**dataclasses.asdict(microscope)))
        progress.stage("pictures")
        from ..plot import draw_displacement

        numbers = {"before": paths[0], "after": paths[1], **_numbers(found)}
        contents = {
            **pictures({FILES[0]: draw_displacement(found)}, files),
            "summary.json": (json.dumps(numbers, indent=2, ensure_ascii=False) + "\n").encode(),
            "displacement.npz": displacement_bytes(found),
        }
        write_together(out, contents, with_drawings(FILES))
    console = Console(highlight=False)
    console.print(
        f"displacement {numbers['displacement_min_nm']:.0f} to {numbers['displacement_max_nm']:.0f} nm, standard "
        f"deviation {numbers['std_median_nm']:.2g} nm, strain {numbers['strain_median']:.3%}, coherence "
        f"{numbers['coherence_median']:.2f}, {numbers['masked_share']:.1%} masked",
        markup=False,
        soft_wrap=True,
    )
    console.print(f"Look at {out / FILES[0]} first. Wrote {', '.join(contents)} to {out}", markup=False, soft_wrap=True)


def _numbers(found: DisplacementVolume) -> dict[str, Any]:
    kept = ~found.mask
    strain = found.strain()
    known = ~strain.mask
    return {
        "masked_share": float(found.mask.mean()),
        "displacement_min_nm": 1e6 * float(found.values[kept].min()),
        "displacement_max_nm": 1e6 * float(found.values[kept].max()),
        "std_median_nm": 1e6 * float(np.median(found.std[kept])),
        "scale_std": float(found.scale_std),
        "coherence_median": float(np.median(found.coherence)),
        "strain_median": float(np.median(strain.values[known])) if known.any() else None,
    }
