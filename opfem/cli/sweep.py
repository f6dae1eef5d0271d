"""`opfem sweep CONFIG.toml`: a sweep of solves stated in a file.

The file says what `opfem palpate` would be told, which of its numbers vary, and what to keep.
"""

import shutil
import tomllib
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import equinox as eqx
import numpy as np
from cyclopts import Parameter
from rich.console import Console
from scipy.stats import qmc

from .. import sweep as computation
from ..datasets import coin_file
from ..model import Palpation
from ..solvers import Newton, Solution, solve
from ..solvers.discretise import check_compatible
from ..solvers.progress import Progress
from ..sweep import Batch, sample, zip_
from ..sweep.design import Points, grid, known_name
from ..sweep.outputs import GOOD
from ..sweep.store import FINISHED, PLAN, POINTS
from .options import ContactOptions, LayerOptions, MapOptions, NoCache
from .running import configure_jax, reporting
from .statement import read_maps, state_experiment


class _Axis(NamedTuple):
    """A number of the experiment that may vary."""

    unit: str
    where: Callable[[Palpation], Any]
    may_be_zero: bool = False


_AXES = {
    "c10": _Axis("MPa", lambda p: p.layer.material.c10),
    "c01": _Axis("MPa", lambda p: p.layer.material.c01, True),
    "bulk": _Axis("MPa", lambda p: p.layer.material.bulk),
    "l0": _Axis("mm", lambda p: p.layer.thickness),
    "window_friction": _Axis("1", lambda p: p.window.friction, True),
    "sample_friction": _Axis("1", lambda p: p.sample.friction, True),
    "p0": _Axis("MPa", lambda p: p.sample.law.pressure),
    "c0": _Axis("mm", lambda p: p.sample.law.clearance),
}
_UNITS = {
    "MPa": {"MPa": 1.0, "kPa": 1e-3, "Pa": 1e-6},
    "mm": {"mm": 1.0, "um": 1e-3, "µm": 1e-3, "m": 1e3},
    "1": {"1": 1.0},
}
_Options = TypeVar("_Options")
_SECTIONS = ("inputs", "axes", "design", "outputs", "execution")
_DESIGNS = ("grid", "zip", "sobol", "latin_hypercube")


class _Inputs(NamedTuple):
    """What is the same at all points, as `opfem palpate` takes it."""

    map: str
    reading: MapOptions
    layer: LayerOptions
    contact: ContactOptions
    increments: int | None


def sweep(
    config: Annotated[Path, Parameter(name="CONFIG")],
    /,
    *,
    out: Path,
    resume: Annotated[bool, Parameter(help="Go on with the sweep that --out holds.")] = False,
    force: Annotated[bool, Parameter(help="Remove the sweep that --out holds, and begin anew.")] = False,
    no_cache: NoCache = False,
    debug: Annotated[bool, Parameter(help="Show where an error came from.")] = False,
) -> None:
    """Solve for many values of materials, frictions and thickness, as CONFIG says.

    Writes result.nc, labelled by the axes, and every finished point on the way.

    Args:
        config: A .toml file with [inputs], [axes] and [outputs]; the README shows one.
        out: Folder of the results.
        resume: Whether to go on.
        force: Whether to begin anew.
        no_cache: Whether to do without compiled programs on disk.
        debug: Whether to show tracebacks.
    """
    with reporting(debug):
        with Progress(True, at_once=True) as progress:
            progress.stage("reading")
            configure_jax(no_cache)
            stated = _read(config)
            _settle_folder(out, resume, force)
            points = _points(stated["axes"], stated.get("design", {}))
            keep = stated["outputs"]["keep"]
            if not (isinstance(keep, list) and keep and all(isinstance(name, str) for name in keep)):
                raise ValueError(f"[outputs] keep must be a list of names, got {keep!r}.")
            function = _function(_inputs(stated["inputs"], points, config.parent), tuple(points.columns))
            execution = Batch(**stated.get("execution", {}))
            data = computation(function, points, keep=keep, execution=execution, out=out)
        failed = int(np.sum(~np.isin(data.status, GOOD)))
        console = Console(highlight=False)
        console.print(f"{len(points)} points, {failed} failed. Wrote {FINISHED} to {out}", markup=False, soft_wrap=True)


def _read(config: Path) -> dict[str, Any]:
    """Read a file and check the names of what it holds."""
    try:
        stated = tomllib.loads(config.read_text(encoding="utf-8"))
    except OSError as cause:
        raise ValueError(f"Cannot read {config}: {cause.strerror}.") from cause
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as cause:
        raise ValueError(f"{config} is not TOML: {cause}.") from cause
    for section, entries in stated.items():
        known_name(f"{config}: section", section, _SECTIONS)
        if not isinstance(entries, dict):
            raise ValueError(f"{config}: {section} must be a section, [{section}], got {entries!r}.")
    for section, entry in (("inputs", "map"), ("axes", None), ("outputs", "keep")):
        if section not in stated or (entry is not None and entry not in stated[section]):
            raise ValueError(f"{config} needs [{section}]" + (f" with {entry} = ..." if entry else "") + ".")
    for section, known in (
        ("axes", tuple(_AXES)),
        ("design", ("kind", "points", "seed")),
        ("outputs", ("keep",)),
        ("execution", ("size", "mode", "threads")),
    ):
        for name in stated.get(section, {}):
            known_name(f"{config}: [{section}]", name, known)
    return stated


def _settle_folder(out: Path, resume: bool, force: bool) -> None:
    begun = (out / PLAN).exists()
    if force and begun:
        (out / FINISHED).unlink(missing_ok=True)
        shutil.rmtree(out / POINTS, ignore_errors=True)
        (out / PLAN).unlink()
    elif begun and not resume:
        raise FileExistsError(f"{out} holds a sweep. Pass --resume to go on with it, --force to replace it.")
    elif resume and not begun:
        raise ValueError(f"{out} holds no sweep to go on with. Leave out --resume.")


def _points(axes: Mapping[str, Any], design: Mapping[str, Any]) -> Points:
    """Read axes in their units; make the points."""
    kind = design.get("kind", "grid")
    known_name("[design] kind", kind, _DESIGNS)
    units = {name: _AXES[name].unit for name in axes}
    if kind in ("grid", "zip"):
        values = {name: _checked(name, _values(name, axis) * _factor(name, axis)) for name, axis in axes.items()}
        return (grid if kind == "grid" else zip_)(values).with_units(units)
    count, seed = (_converted(f"[design] {name}", int, design.get(name, 0)) for name in ("points", "seed"))
    if count < 1:
        raise ValueError(f"[design] points must be a whole number of at least 1, got {count}.")
    sampler = {"sobol": qmc.Sobol, "latin_hypercube": qmc.LatinHypercube}[kind](d=len(axes), rng=seed)
    bounds, log = {}, []
    for name, axis in axes.items():
        if not isinstance(axis, dict) or not {"from", "to"} <= set(axis) <= {"from", "to", "log", "unit"}:
            raise ValueError(f"[axes] {name} of a {kind} design must be {{ from = , to = , log = , unit = }}.")
        ends = _checked(name, _numbers(name, [axis["from"], axis["to"]]) * _factor(name, axis))
        bounds[name] = (float(ends[0]), float(ends[1]))
        log += [name] if axis.get("log") else []
    return sample(bounds, sampler.random(count), log).with_units(units)


def _values(name: str, axis: Any) -> np.ndarray:
    """Read one axis: a list, or a dict with values, or with from, to and points."""
    if isinstance(axis, list):
        return _numbers(name, axis)
    if isinstance(axis, dict) and "values" in axis and set(axis) <= {"values", "unit"}:
        return _numbers(name, axis["values"])
    if isinstance(axis, dict) and {"from", "to", "points"} <= set(axis) <= {"from", "to", "points", "log", "unit"}:
        low, high = _numbers(name, [axis["from"], axis["to"]])
        count = _converted(f"[axes] {name} points", int, axis["points"])
        if axis.get("log") and not (low > 0 and high > 0):
            raise ValueError(f"[axes] {name} must run between positive numbers for log = true, got {low} to {high}.")
        return (np.geomspace if axis.get("log") else np.linspace)(low, high, max(count, 0))
    raise ValueError(
        f"[axes] {name} must be a list of numbers, {{ values = [...], unit = }} or "
        f"{{ from = , to = , points = , log = , unit = }}, got {axis!r}."
    )


def _numbers(name: str, values: Any) -> np.ndarray:
    array = np.asarray(values)
    if array.ndim != 1 or (array.size and array.dtype.kind not in "fi"):
        raise ValueError(f"[axes] {name} must hold numbers, got {values!r}.")
    return array.astype(float)


def _factor(name: str, axis: Any) -> float:
    known = _UNITS[_AXES[name].unit]
    unit = axis.get("unit", _AXES[name].unit) if isinstance(axis, dict) else _AXES[name].unit
    if unit not in known:
        raise ValueError(f"[axes] {name} unit must be one of {', '.join(known)}, got {unit!r}.")
    return known[unit]


def _checked(name: str, values: np.ndarray) -> np.ndarray:
    unit, zero = _AXES[name].unit, _AXES[name].may_be_zero
    if values.size and not (np.isfinite(values).all() and (values.min() >= 0 if zero else values.min() > 0)):
        wanted = "zero or positive" if zero else "positive"
        raise ValueError(f"[axes] {name} [{unit}] must be {wanted}, got {values.tolist()}.")
    return values


def _inputs(stated: Mapping[str, Any], points: Points, folder: Path) -> _Inputs:
    """Convert the inputs to the options of `opfem palpate`; an axis takes the place of its option."""
    groups = (MapOptions, LayerOptions, ContactOptions)
    hints = {name: hint for group in groups for name, hint in typing.get_type_hints(group).items()}
    given = {}
    for name, value in stated.items():
        known_name("[inputs]", name, ("map", "increments", *hints))
        if name in points.columns:
            raise ValueError(f"[inputs] {name} is also one of the [axes]. Leave one out.")
        given[name] = _converted(f"[inputs] {name}", {"map": str, "increments": int, **hints}[name], value)
    given |= {name: float(column[0]) for name, column in points.columns.items()}
    if "l0" in given:
        given["l0"] = _path(str(given["l0"]), folder)
    path = str(coin_file()) if given["map"] == "coin" else _path(given["map"], folder)
    reading, layer, contact = _group(MapOptions, given), _group(LayerOptions, given), _group(ContactOptions, given)
    return _Inputs(path, reading, layer, contact, given.get("increments"))


def _group(kind: type[_Options], given: Mapping[str, Any]) -> _Options:
    """Make a group of options of those given that belong to it."""
    return kind(**{name: value for name, value in given.items() if name in typing.get_type_hints(kind)})


def _path(name: str, folder: Path) -> str:
    """Read paths as seen from the file that names them."""
    return str(folder / name) if (folder / name).is_file() else name


def _converted(what: str, hint: Any, value: Any) -> Any:
    """Convert a value of TOML to the type of an option."""
    choices = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    for choice in choices:
        parts = typing.get_args(choice)
        if typing.get_origin(choice) is Literal:
            if value in parts:
                return value
        elif typing.get_origin(choice) is tuple:
            if isinstance(value, list) and len(value) == len(parts):
                return tuple(_converted(what, part, item) for part, item in zip(parts, value, strict=True))
        elif choice is float and isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
        elif choice is str and isinstance(value, str | int | float) and not isinstance(value, bool):
            return str(value)
        elif choice is not float and type(value) is choice:
            return value
    expected = " or ".join(getattr(c, "__name__", str(c)) if not typing.get_args(c) else str(c) for c in choices)
    raise ValueError(f"{what} must be {expected.replace(' or NoneType', '')}, got {value!r}.")


def _function(inputs: _Inputs, names: tuple[str, ...]) -> Callable[..., Solution]:
    """State the experiment as a function of the numbers that vary."""
    measured, unloaded = read_maps(inputs.map, inputs.reading)
    palpation, load = state_experiment(measured, unloaded, inputs.reading, inputs.layer, inputs.contact)
    check_compatible(palpation, load, None)  # inside jit nothing can
    solver = Newton() if inputs.increments is None else Newton(increments=inputs.increments)

    def solution(**numbers) -> Solution:
        varied = eqx.tree_at(
            lambda p: [_AXES[name].where(p) for name in names], palpation, [numbers[name] for name in names]
        )
        return solve(varied, load, solver, throw=False, progress=False)

    return solution
