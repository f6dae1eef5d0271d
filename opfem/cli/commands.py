"""The commands: what each takes and does, as its help says it; each computes in its own module.

Those modules load JAX, so they are imported when a command runs.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import App, CycloptsError, Parameter

from .command_line import remember
from .curve_options import CurveOptions, LawOptions
from .deck_options import DeckOptions, WriteOptions
from .messages import say
from .options import (
    ContactOptions,
    FitLayerOptions,
    FitOptions,
    ImprintOptions,
    InterfaceOptions,
    LayerOptions,
    MapOptions,
    MicroscopeOptions,
    PictureOptions,
    ResultOptions,
    RunOptions,
    SolverOptions,
    StepOptions,
    VolumeOptions,
)
from .quantities import positive
from .running import complain, reporting

MISUSED = 2


def _version() -> str:
    from .. import __version__

    return f"opfem {__version__}"


app = App(
    name="opfem",
    help="Stress on tissue from the measured thickness of a soft layer.",
    default_parameter=Parameter(negative=()),
    version=_version,
)
app.register_install_completion_command(help="Let the shell complete opfem's commands and options.")
app["--version"].help = "Show the version of opfem."
app["--help"].help = "Show this."

_Map = Annotated[
    str,
    Parameter(
        name="MAP",
        help="Loaded thickness (.mat, .npy, .npz, .tif, .csv), an OCT volume (.oct), or the word example.",
    ),
]
_Out = Annotated[Path, Parameter(help="Folder of the results.")]


def run(tokens: Sequence[str] | None) -> None:
    """Run a command and exit.

    Args:
        tokens: Arguments; None takes those of the process.
    """
    remember(tokens)
    try:
        app(tokens, exit_on_error=False, print_error=False)
    except CycloptsError as error:
        complain(say(error))
        raise SystemExit(MISUSED) from None


@app.command
def palpate(
    map: _Map,
    /,
    *,
    out: _Out,
    reading: MapOptions = MapOptions(),
    layer: LayerOptions = LayerOptions(),
    contact: ImprintOptions = ImprintOptions(),
    solver: SolverOptions = SolverOptions(),
    deck: WriteOptions = WriteOptions(),
    files: ResultOptions = ResultOptions(),
    run: RunOptions = RunOptions(),
) -> None:
    """Compute the stress map of a measured thickness map.

    Writes result.nc, result.vtu, summary.json, report.html, the first thing to look at, pressure.png and report.png;
    with --also files for other programs.
    """
    from .palpate import palpate

    with reporting(run.debug):
        palpate(map, out, reading, layer, contact, solver, deck, run, files)


@app.command
def fit(
    map: _Map,
    /,
    *,
    out: _Out,
    reading: MapOptions = MapOptions(),
    layer: FitLayerOptions = FitLayerOptions(),
    contact: ContactOptions = ContactOptions(),
    options: FitOptions = FitOptions(),
    steps: StepOptions = StepOptions(),
    files: ResultOptions = ResultOptions(),
    run: RunOptions = RunOptions(),
) -> None:
    """Fit the traction on the sample to a measured thickness map, with its uncertainty.

    Needs the noise of the map, --std; the map itself is neither filled nor smoothed. Writes result.nc, result.vtu,
    summary.json, report.html, the first thing to look at, pressure.png and fit.png.
    """
    from .fit import fit

    with reporting(run.debug):
        fit(map, out, reading, layer, contact, options, steps, run, files)


@app.command
def fit_parameters(
    config: Annotated[
        Path,
        Parameter(
            name="CONFIG",
            help="A .toml file with [layer], [experiment], [window], [sample], [[state]], [[increment]], [[bulge]], "
            "[parameters] and [fit]; see the documentation.",
        ),
    ],
    /,
    *,
    out: _Out,
    files: PictureOptions = PictureOptions(),
    run: RunOptions = RunOptions(),
) -> None:
    """Fit frictions, moduli and offsets to forces, maps and displacements of loaded states, as CONFIG says.

    Writes summary.json, parameters.png, the first thing to look at, and result.nc.
    """
    from .fit_parameters import run_fit

    with reporting(run.debug):
        run_fit(config, out, run, files)


@app.command
def sweep(
    config: Annotated[
        Path, Parameter(name="CONFIG", help="A .toml file with [inputs], [axes] and [outputs]; see the documentation.")
    ],
    /,
    *,
    out: _Out,
    resume: Annotated[bool, Parameter(help="Go on with the sweep that --out holds.")] = False,
    files: PictureOptions = PictureOptions(),
    run: RunOptions = RunOptions(),
) -> None:
    """Solve for many values of materials, frictions and thickness, as CONFIG says.

    Writes result.nc, labelled by the axes, its numbers as table.csv and sweep.png, and every finished point on the way.
    """
    from .sweep import sweep

    with reporting(run.debug):
        sweep(config, out, resume, run, files)


@app.command
def simulate(
    scene: Annotated[
        Path,
        Parameter(
            name="SCENE",
            help="A .toml file with [layer], [sample], [[inclusion]], [experiment], [window], [interface], [plate], "
            "[compression] and [measurement]; see the documentation.",
        ),
    ],
    /,
    *,
    out: _Out,
    deck: WriteOptions = WriteOptions(),
    files: ResultOptions = ResultOptions(),
    run: RunOptions = RunOptions(),
) -> None:
    """Solve a virtual experiment, whose true stress is known: layer and deformable sample between window and plate.

    Writes map.npz, which palpate and fit take with its noise, result.nc and result.vtu (the truth), summary.json,
    report.html, section.png and report.png; l0.npz where the layer's thickness is a map.
    """
    from .simulate import simulate

    with reporting(run.debug):
        simulate(scene, out, deck, run, files)


@app.command
def deck(
    file: Annotated[Path, Parameter(name="FILE", help="Abaqus or CalculiX input file (.inp, .inp.gz).")],
    /,
    *,
    out: Annotated[Path | None, Parameter(help="Folder of the results; needed unless --info.")] = None,
    info: Annotated[
        bool, Parameter(help="Solve nothing: say what the deck states, and draw it as deck.png in --out, where given.")
    ] = False,
    options: DeckOptions = DeckOptions(),
    files: ResultOptions = ResultOptions(),
    run: RunOptions = RunOptions(),
) -> None:
    """Solve an Abaqus or CalculiX deck: a soft layer between rigid bodies, or under a soft sample; step by step.

    Writes result.nc, result.vtu, summary.json, report.html and pictures of the last step, those of earlier ones in
    step_1 and so on.
    From the second step on, result.nc holds axial_increment, what a phase-sensitive OCT sees between two steps.
    """
    from .deck import solve_deck, state_deck

    with reporting(run.debug):
        if info:
            state_deck(file, out, options, run)
        elif out is None:
            raise ValueError("--out is needed: folder of the results; or --info, which solves nothing.")
        else:
            solve_deck(file, out, options, run, files)


@app.command
def oct(
    loaded: Annotated[
        str | None, Parameter(name="LOADED", help="OCT volume of the loaded layer: .oct, .h5, .mat, .npy, .tif, raw.")
    ] = None,
    /,
    *,
    out: _Out,
    phase: Annotated[
        tuple[str, str] | None,
        Parameter(help="BEFORE AFTER: two complex volumes, whose phase tells the axial displacement between them."),
    ] = None,
    unloaded: Annotated[str | None, Parameter(help="OCT volume of the unloaded layer.")] = None,
    l0: Annotated[
        float | None, Parameter(help="Unloaded thickness in mm, instead of a volume.", validator=positive("mm"))
    ] = None,
    reading: VolumeOptions = VolumeOptions(),
    microscope: MicroscopeOptions = MicroscopeOptions(),
    options: InterfaceOptions = InterfaceOptions(),
    files: PictureOptions = PictureOptions(),
    run: RunOptions = RunOptions(),
) -> None:
    """Measure the thickness of the layer in an OCT volume, or the displacement between two.

    Writes thickness.npz, which palpate and fit take with its noise and mask, unloaded.npz with --unloaded,
    interface.npz, summary.json and two pictures: bscans.png, the first thing to look at, and maps.png. With --phase
    displacement.npz, displacement.png and summary.json.
    """
    from .oct import measure
    from .phase import measure_phase

    with reporting(run.debug):
        if (loaded is None) == (phase is None):
            raise ValueError("opfem oct takes either LOADED or --phase BEFORE AFTER.")
        if phase is not None:
            return measure_phase(phase, out, reading, microscope, run, files)
        assert loaded is not None
        measure(loaded, out, unloaded, l0, reading, microscope, options, run, files)


@app.command
def calibrate(
    *curves: Annotated[
        str, Parameter(name="CURVE", help="Stress–strain curves (.csv, .txt, .mat, .npz, .npy, .h5), of one material.")
    ],
    out: _Out,
    reading: CurveOptions = CurveOptions(),
    options: LawOptions = LawOptions(),
    files: PictureOptions = PictureOptions(),
    run: RunOptions = RunOptions(),
) -> None:
    """Fit a material law to stress–strain curves, and say what they can and cannot tell.

    Writes summary.json, calibration.png, the first thing to look at, and result.nc.
    """
    from .calibrate import run_calibration

    with reporting(run.debug):
        run_calibration(list(curves), out, reading, options, run, files)


@app.command
def demo(
    *,
    out: _Out = Path("opfem_demo"),
    coin: Annotated[bool, Parameter(help="Take the published map of a 5-cent coin (downloaded once, GPL-3).")] = False,
    solver: SolverOptions = SolverOptions(),
    files: ResultOptions = ResultOptions(),
    run: RunOptions = RunOptions(),
) -> None:
    """Show what opfem does: the stress map of a built-in measurement, or of the published coin."""
    from .palpate import demo

    with reporting(run.debug):
        demo(out, coin, solver, run, files)
