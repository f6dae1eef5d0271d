"""Options of `opfem calibrate`: how to read the curves, and what to fit; loads nothing that takes time."""

from dataclasses import dataclass
from typing import Annotated, Literal

from cyclopts import Group, Parameter

from .quantities import count, positive, whole


@Parameter(name="*", group=Group("Curve", sort_key=1))
@dataclass(frozen=True)
class CurveOptions:
    """How to read stress–strain curves."""

    strain: Annotated[
        Literal["%", "1", "stretch", "log", "mm"],
        Parameter(help="Unit of the strain; 1 is a fraction, mm a displacement over --height."),
    ] = "%"
    stress: Annotated[
        Literal["Pa", "kPa", "MPa", "N"], Parameter(help="Unit of the stress; N is a force over --area.")
    ] = "kPa"
    columns: Annotated[
        tuple[str, ...],
        Parameter(
            help="Columns of strain, stress, and where there are, position, force, time: from 0, or by name.",
            consume_multiple=True,
        ),
    ] = ("0", "1")
    sign: Annotated[
        Literal["auto", "compression", "tension"], Parameter(help="Needed where strain and stress are both positive.")
    ] = "auto"
    kind: Annotated[Literal["nominal", "true"], Parameter(help="Stress over the initial or the current area.")] = (
        "nominal"
    )
    mode: Annotated[Literal["uniaxial", "equibiaxial", "planar"], Parameter(help="Kind of test.")] = "uniaxial"
    branch: Annotated[Literal["loading", "unloading", "mean"], Parameter(help="Part of the cycle.")] = "loading"
    area: Annotated[float | None, Parameter(help="Initial area of the specimen in mm².", validator=positive("mm²"))] = (
        None
    )
    height: Annotated[float | None, Parameter(help="Its initial height in mm.", validator=positive("mm"))] = None
    std: Annotated[
        float | None, Parameter(help="Standard deviation of the stress in MPa.", validator=positive("MPa"))
    ] = None
    variable: Annotated[str | None, Parameter(help="Name of the array or struct, where a file holds several.")] = None


@Parameter(name="*", group=Group("Law", sort_key=2))
@dataclass(frozen=True)
class LawOptions:
    """What to fit to the curves."""

    law: Annotated[
        Literal["neo_hooke", "mooney_rivlin", "yeoh", "ogden", "hencky"], Parameter(help="The material law.")
    ] = "mooney_rivlin"
    terms: Annotated[int, Parameter(help="Terms of ogden, 1 to 3.", validator=count(), converter=whole)] = 1
    bulk_ratio: Annotated[
        float | None,
        Parameter(help="Bulk over shear modulus. Default: incompressible.", validator=positive("-")),
    ] = None
    offset: Annotated[
        Literal["stress", "strain", "none"], Parameter(help="What of each curve is off at contact, and fitted.")
    ] = "stress"
    weights: Annotated[Literal["absolute", "relative"], Parameter(help="Points count alike, or by their stress.")] = (
        "absolute"
    )
    stretches: Annotated[
        tuple[float, float] | None,
        Parameter(help="LOW HIGH stretches to fit over.", validator=positive("-", "two positive numbers")),
    ] = None
    platens: Annotated[Literal["lubricated", "bonded"], Parameter(help="bonded needs --diameter and --height.")] = (
        "lubricated"
    )
    diameter: Annotated[float | None, Parameter(help="Of the specimen in mm.", validator=positive("mm"))] = None
