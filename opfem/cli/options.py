"""Options of the command line, in the groups that its help shows; loads nothing that takes time."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Group, Parameter

from .quantities import NewFile, NumberOrFile, OldFile, Quantity, count, not_negative, positive, whole

# The layer of the published decks; bulk is what Abaqus/Explicit makes of their D=0, K/µ = 20.
PUBLISHED_C10, PUBLISHED_C01, PUBLISHED_BULK = 2.23e-3, 7.03e-4, 0.11732
_ELEMENTS = (40, 40, 4)

Hexahedron = Literal["mean_dilatation", "full", "reduced", "hybrid"]
# As in `model.palpation`, which would load JAX.
Element = Literal["mean_dilatation", "full", "reduced", "hybrid", "tet4", "tet10"]


@Parameter(name="*", group=Group("Map", sort_key=1))
@dataclass(frozen=True)
class MapOptions:
    """How to read the loaded and the unloaded thickness."""

    l0: Annotated[
        str | None,
        Parameter(
            help="Unloaded thickness: a number in mm, or the path of a map.", validator=NumberOrFile("mm", "a map")
        ),
    ] = None
    extent: Annotated[
        tuple[float, float] | None,
        Parameter(
            help="LX LY from the first to the last sample in mm; this or --spacing.",
            validator=positive("mm", "two positive numbers"),
        ),
    ] = None
    spacing: Annotated[
        tuple[float, ...] | None,
        Parameter(
            help="DX DY between samples in mm, or one number for both; this or --extent.",
            consume_multiple=True,
            validator=positive("mm", "one positive number, or two"),
        ),
    ] = None
    unit: Annotated[Literal["mm", "um", "µm", "m"], Parameter(help="Unit of the file's numbers.")] = "mm"
    scale: Annotated[
        float | None,
        Parameter(
            help="Thickness of one count in µm, for files of counts; instead of --unit.", validator=positive("µm")
        ),
    ] = None
    missing: Annotated[
        str | None,
        Parameter(
            help="Numbers that mark missing pixels in the files, as in 0,65535; none if odd numbers are thickness.",
            allow_leading_hyphen=True,
        ),
    ] = None
    mask: Annotated[
        str | None,
        Parameter(
            help="Image or array of the pixels of MAP that are no data: 0 is data, all else is not.",
            validator=OldFile("an image or array"),
        ),
    ] = None
    max_missing: Annotated[
        float,
        Parameter(
            help="Largest fraction of missing pixels to accept.",
            validator=Quantity("1", "a number from 0 to 1", 0.0, 1.0),
        ),
    ] = 0.5
    std: Annotated[
        float | None,
        Parameter(help="Standard deviation of the thickness noise in mm.", validator=positive("mm")),
    ] = None
    variable: Annotated[
        str | None, Parameter(help="Name of the array, where MAP holds several; as in scan.thickness.")
    ] = None
    l0_variable: Annotated[str | None, Parameter(help="The same in the file of --l0.")] = None
    max_bytes: Annotated[
        int | None,
        Parameter(
            help="Largest array to load; a compressed one may be far larger than its file. Default: 512 MiB.",
            validator=Quantity("bytes", "a whole number of at least 1", 1.0),
            converter=whole,
        ),
    ] = None
    smooth: Annotated[
        float | None,
        Parameter(
            help="FWHM in mm of the Gaussian that smooths the maps; 0 is none. Default: half an element.",
            validator=not_negative("mm"),
        ),
    ] = None


@Parameter(name="*", group=Group("Volume", sort_key=1))
@dataclass(frozen=True)
class VolumeOptions:
    """How to read OCT volumes; those of Thorlabs and of opfem need none of it."""

    spacing: Annotated[
        tuple[float, float] | None,
        Parameter(help="DX DY between A-lines in mm.", validator=positive("mm", "two positive numbers")),
    ] = None
    depth_spacing: Annotated[
        float | None, Parameter(help="Distance between samples in depth in mm, as in air.", validator=positive("mm"))
    ] = None
    index_applied: Annotated[
        float | None,
        Parameter(
            help="Index that depths of the file were divided by. Default: the file's own, or 1.",
            validator=positive("-"),
        ),
    ] = None
    shape: Annotated[tuple[int, int, int] | None, Parameter(help="NY NX NZ of a file of nothing but numbers.")] = None
    order: Annotated[str | None, Parameter(help='Axes as stored, the fastest first, such as "zxy".')] = None
    dtype: Annotated[str | None, Parameter(help="Type of those numbers. Default: <f4.")] = None
    scale: Annotated[Literal["db", "linear", "complex"] | None, Parameter(help="What the file's numbers are.")] = None
    variable: Annotated[str | None, Parameter(help="Name of the array, where a file holds several.")] = None
    quantity: Annotated[
        Literal["auto", "intensity", "complex", "spectra"], Parameter(help="What to take of a file that holds several.")
    ] = "auto"


@Parameter(name="*", group=Group("Microscope", sort_key=2))
@dataclass(frozen=True)
class MicroscopeOptions:
    """The microscope; the defaults are that of the published maps."""

    wavelength: Annotated[float, Parameter(help="Central wavelength in mm.", validator=positive("mm"))] = 845e-6
    axial_fwhm: Annotated[
        float, Parameter(help="FWHM of a point's intensity along depth, in the layer, in mm.", validator=positive("mm"))
    ] = 7.8e-3
    lateral_fwhm: Annotated[float, Parameter(help="The same across in mm.", validator=positive("mm"))] = 11e-3
    index: Annotated[float, Parameter(help="Group index of the layer.", validator=positive("-"))] = 1.4


@Parameter(name="*", group=Group("Interface", sort_key=3))
@dataclass(frozen=True)
class InterfaceOptions:
    """What to look for."""

    edge: Annotated[
        Literal["auto", "brighter", "darker", "peak"],
        Parameter(help="The sample is brighter or darker than the layer, or reflects; auto chooses."),
    ] = "auto"
    search: Annotated[
        tuple[float, float] | None,
        Parameter(help="FROM TO in depth in mm. Default: 0.03 to the end.", validator=not_negative("mm")),
    ] = None
    max_slope: Annotated[float, Parameter(help="Largest slope of the interface.", validator=positive("-"))] = 0.6
    average: Annotated[float, Parameter(help="FWHM of the lateral average in mm.", validator=positive("mm"))] = 0.06
    confidence: Annotated[
        float,
        Parameter(help="Pixels of less are masked.", validator=Quantity("1", "a number from 0 to 1", 0.0, 1.0)),
    ] = 0.5
    mask: Annotated[
        str | None,
        Parameter(
            help="Image or array of the A-lines that are no data: 0 is data, all else is not.",
            validator=OldFile("an image or array"),
        ),
    ] = None
    window: Annotated[
        Literal["first_pixel", "find"],
        Parameter(help="The layer begins at the zero delay (common path), or at a reflection to be found."),
    ] = "first_pixel"
    tilt: Annotated[Literal["none", "plane"], Parameter(help="Correct for the tilt of a window that is found.")] = (
        "none"
    )


@Parameter(name="*", group=Group("Layer", sort_key=2))
@dataclass(frozen=True)
class LayerOptions:
    """The layer and its mesh."""

    c10: Annotated[
        float | None,
        Parameter(
            help=f"Mooney–Rivlin C10 in MPa. Default: the published {PUBLISHED_C10}.",
            validator=Quantity("MPa", "a number"),
        ),
    ] = None
    c01: Annotated[
        float | None,
        Parameter(
            help=f"Mooney–Rivlin C01 in MPa. Default: the published {PUBLISHED_C01}.",
            validator=Quantity("MPa", "a number"),
        ),
    ] = None
    bulk: Annotated[
        float | None,
        Parameter(
            help="Bulk modulus in MPa, or inf (incompressible: with --element hybrid); required with --c10 or --c01. "
            f"Default: {PUBLISHED_BULK}, K/µ = 20.",
            validator=positive("MPa", "a positive number, or inf", infinite=True),
        ),
    ] = None
    layer_extent: Annotated[
        tuple[float, float] | None,
        Parameter(
            help="LX LY of the layer in mm, where it is not the map's.",
            validator=positive("mm", "two positive numbers"),
        ),
    ] = None
    elements: Annotated[
        tuple[int, int, int],
        Parameter(
            help="Elements along x, y and through the thickness.",
            validator=count("three whole numbers of at least 1"),
            converter=whole,
        ),
    ] = _ELEMENTS
    element: Annotated[Element, Parameter(help="Element: see Palpation; hybrid for a nearly incompressible layer.")] = (
        "mean_dilatation"
    )
    sides: Annotated[Literal["free", "roller"], Parameter(help="What the layer's sides meet.")] = "free"


@Parameter(name="*", group=Group("Layer", sort_key=2))
@dataclass(frozen=True)
class FitLayerOptions(LayerOptions):
    """The layer and its mesh, of what a fit can differentiate."""

    element: Annotated[
        Hexahedron, Parameter(help="Element: see Palpation; hybrid for a nearly incompressible layer.")
    ] = "mean_dilatation"


@Parameter(name="*", group=Group("Contact", sort_key=3))
@dataclass(frozen=True)
class ContactOptions:
    """Contact with window and sample."""

    window_friction: Annotated[
        float, Parameter(help="Coulomb friction at the window.", validator=not_negative("1"))
    ] = 0.15
    sample_friction: Annotated[
        float, Parameter(help="Coulomb friction at the sample.", validator=not_negative("1"))
    ] = 0.05
    p0: Annotated[
        float, Parameter(help="Sample contact: pressure at zero clearance in MPa.", validator=positive("MPa"))
    ] = 2.0
    c0: Annotated[
        float, Parameter(help="Sample contact: clearance where pressure starts in mm.", validator=positive("mm"))
    ] = 0.01


@Parameter(name="*", group=Group("Contact", sort_key=3))
@dataclass(frozen=True)
class ImprintOptions(ContactOptions):
    """Contact with window and sample, where the measured surface is pressed in."""

    correct_approach: Annotated[
        bool, Parameter(help="Also shift out the approach of sample and layer that the contact law causes.")
    ] = False


@Parameter(name="*", group=Group("Fit", sort_key=4))
@dataclass(frozen=True)
class FitOptions:
    """What is known of the pressure before the map, and what is asked of the fit."""

    prior_length: Annotated[
        float | None,
        Parameter(
            help="Correlation length of the pressure in mm. Default: three elements.",
            validator=positive("mm", "a positive number, at least an element"),
        ),
    ] = None
    prior_std: Annotated[
        float | None,
        Parameter(
            help="Standard deviation of the pressure in MPa. Default: that of the uniaxial estimate.",
            validator=positive("MPa"),
        ),
    ] = None
    prior_mean: Annotated[
        float | None,
        Parameter(
            help="Mean of the pressure in MPa. Default: that of the uniaxial estimate.",
            validator=Quantity("MPa", "a number"),
        ),
    ] = None
    hyperparameters: Annotated[
        Literal["given", "discrepancy", "evidence"],
        Parameter(help="Take length and std as given, std by the discrepancy principle, or both as most likely."),
    ] = "given"
    nonnegative: Annotated[bool, Parameter(help="Keep the pressure above zero.")] = False
    model_std: Annotated[
        float | None,
        Parameter(
            help="Standard deviation of the computed thickness in mm, added to the map's noise. Default: what splines "
            "of the mesh cannot follow; and the pressure's includes the mesh error, from a solve on half the mesh.",
            validator=not_negative("mm"),
        ),
    ] = None
    friction_spread: Annotated[
        float | None,
        Parameter(
            help="Relative uncertainty of both frictions, fitted as well and allowed for. Default: none.",
            validator=positive("1"),
        ),
    ] = None
    modulus_spread: Annotated[
        float | None,
        Parameter(
            help="Relative uncertainty of C10, fitted as well and allowed for. Default: none.", validator=positive("1")
        ),
    ] = None
    draws: Annotated[
        int,
        Parameter(
            help="Draws of the posterior that standard deviations come from.", validator=count(), converter=whole
        ),
    ] = 16


@Parameter(name="*", group=Group("Solver", sort_key=5))
@dataclass(frozen=True)
class StepOptions:
    """How a fit applies its load."""

    increments: Annotated[
        int | None, Parameter(help="Load increments. Default: the solver's own.", validator=count(), converter=whole)
    ] = None


@Parameter(name="*", group=Group("Solver", sort_key=5))
@dataclass(frozen=True)
class SolverOptions:
    """Which solver computes, and how."""

    solver: Annotated[
        Literal["newton", "explicit"], Parameter(help="Implicit statics, or explicit dynamics as published.")
    ] = "newton"
    increments: Annotated[
        int | None,
        Parameter(help="Load increments of newton. Default: the solver's own.", validator=count(), converter=whole),
    ] = None
    duration: Annotated[
        float | None, Parameter(help="Duration of explicit in s. Default: the published 1 s.", validator=positive("s"))
    ] = None
    mass_scaling: Annotated[
        float | None,
        Parameter(help="Mass scaling of explicit. Default: the published 25.", validator=positive("1")),
    ] = None
    precision: Annotated[
        Literal["float32", "float64"], Parameter(help="Precision of explicit; float32 takes half the time.")
    ] = "float64"
    checkpoint: Annotated[
        Path | None,
        Parameter(
            help="File (.npz) that keeps the state of explicit, from which a killed run goes on.",
            validator=NewFile(".npz"),
        ),
    ] = None


@Parameter(name="*", group=Group("Files", sort_key=6))
@dataclass(frozen=True)
class PictureOptions:
    """Pictures as drawings, for print."""

    pdf: Annotated[bool, Parameter(help="Write every picture as .pdf, too.")] = False
    svg: Annotated[bool, Parameter(help="Write every picture as .svg, too.")] = False


@Parameter(name="*", group=Group("Files", sort_key=6))
@dataclass(frozen=True)
class ResultOptions(PictureOptions):
    """Files of a result, for browsers and for other programs."""

    also: Annotated[
        tuple[Literal["csv", "tiff", "mat"], ...],
        Parameter(
            help="Write the maps, too, on the pixels of the measured one: result.csv, result.tif (ImageJ), result.mat.",
            consume_multiple=True,
        ),
    ] = ()
    report: Annotated[
        bool, Parameter(help="Write report.html, 5 to 8 MB, which any browser opens.", negative="--no-report")
    ] = True


@Parameter(name="*", group=Group("Run", sort_key=7))
@dataclass(frozen=True)
class RunOptions:
    """The run itself."""

    force: Annotated[
        bool, Parameter(help="Replace a finished result in --out, which stays as it is until the new one is complete.")
    ] = False
    no_cache: Annotated[
        bool, Parameter(help="Compile anew and keep nothing, as with OPFEM_NO_CACHE=1 in the environment.")
    ] = False
    debug: Annotated[bool, Parameter(help="Show where an error came from.")] = False
