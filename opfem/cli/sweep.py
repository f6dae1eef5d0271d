"""`opfem sweep CONFIG.toml`: a sweep of solves stated in a file.

The file states the options of `opfem palpate`, which of its numbers vary, and what to keep.
"""

import dataclasses
import shutil
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import numpy as np
from rich.console import Console
from scipy.stats import qmc

from ..datasets import coin_file
from ..io import finish, take_place, write_whole
from ..model import Imprint, Palpation
from ..results.dataset import STATS
from ..solvers import Newton, Solution, solve
from ..solvers.discretise import check_compatible
from ..solvers.progress import Progress
from ..sweeps import Batch, sample, sweep as compute, zip_
from ..sweeps.columns import SweepColumns, columns
from ..sweeps.design import Points, grid, known_name
from ..sweeps.outputs import FIELDS
from ..sweeps.store import FINISHED, PLAN, POINTS, TABLE
from .folder import prepare, refuse_links
from .messages import in_options, validators
from .options import ImprintOptions, LayerOptions, MapOptions, PictureOptions, RunOptions
from .output import pictures, with_drawings
from .statement import configure_jax, read_maps, state_experiment, state_palpation
from .toml_file import converted, read_toml

PICTURE = "sweep.png"
# All that a sweep writes, the mark of a finished one last.
RESULT = (POINTS, PLAN, TABLE, *with_drawings((PICTURE,)), FINISHED)
# Where a sweep is computed that is to take the place of the one in the folder around it.
_REPLACEMENT = ".opfem-replacement"


class _Axis(NamedTuple):
    """A number of the experiment that may vary; what its law or contact allows beside, is found where it is stated."""

    unit: str
    where: Callable[[Palpation], Any]
    least: float = 0.0
    least_too: bool = False

    @property
    def expected(self) -> str:
        """What its values must be."""
        return "finite" if self.least < 0.0 else "zero or positive" if self.least_too else "positive"

    def takes(self, values: np.ndarray) -> bool:
        """Tell whether all values are such."""
        enough = values >= self.least if self.least_too else values > self.least
        return bool(np.all(np.isfinite(values) & enough))


_AXES = {
    "c10": _Axis("MPa", lambda p: p.layer.material.c10, -np.inf),
    "c01": _Axis("MPa", lambda p: p.layer.material.c01, -np.inf),
    "bulk": _Axis("MPa", lambda p: p.layer.material.bulk),
    "l0": _Axis("mm", lambda p: p.layer.thickness),
    "window_friction": _Axis("1", lambda p: p.window.friction, least_too=True),
    "sample_friction": _Axis("1", lambda p: p.sample.friction, least_too=True),
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
_MOST_STATED = 200  # points that are checked one by one, a millisecond each
_MOST_FAILED = 5  # points that are named
_READ_IN = {"MPa": (1e3, "kPa"), "mm": (1e3, "µm")}
_DESIGNS = ("grid", "zip", "sobol", "latin_hypercube")


class _Inputs(NamedTuple):
    """What is the same at all points, as `opfem palpate` takes it."""

    map: str
    reading: MapOptions
    layer: LayerOptions
    contact: ImprintOptions
    increments: int | None


def sweep(config: Path, out: Path, resume: bool, run: RunOptions, files: PictureOptions = PictureOptions()) -> None:
    """Solve at all points that a file states, and write the table.

    Everything in the file is checked before the folder is touched or a program compiled.

    Args:
        config: The file.
        out: Folder of the results.
        resume: Whether to go on with what the folder holds.
        run: The run itself.
        files: Drawings to write too.
    """
    with Progress(True, at_once=True) as progress:
        progress.stage("reading")
        configure_jax(run.no_cache)
        stated = _read(config)
        points = _points(stated["axes"], stated.get("design", {}))
        keep = _keep(stated["outputs"]["keep"])
        execution = _execution(stated.get("execution", {}))
        function = _function(_inputs(stated["inputs"], points, config.parent), points)
        folder = _settle(out, resume, run.force)
        prepare(out)
        found = columns(compute(function, points, keep=keep, execution=execution, out=folder)).read_in(_READ_IN)
        progress.stage("pictures")
        for name, content in _pictures(found, files).items():
            write_whole(folder / name, content)
        if folder != out:
            take_place(out, folder, RESULT)
    _show(found, out)


def _pictures(found: SweepColumns, files: PictureOptions) -> dict[str, bytes]:
    """Draw what was kept as one number a point, by file name; nothing where that is nothing."""
    if not (found.outputs and found.axes and found.good.any()):
        return {}
    # Loaded here, so that a refused run does not wait for matplotlib.
    from ..plot import draw_sweep

    axes, outputs = (
        {found.title(name): values for name, values in numbers.items()} for numbers in (found.axes, found.outputs)
    )
    return pictures({PICTURE: draw_sweep(axes, outputs, found.good, found.shape)}, files)


def _show(found: SweepColumns, out: Path) -> None:
    """Print the points of the lowest and highest outputs, those that failed, and what was written."""
    failed = np.flatnonzero(~found.good)
    lines = []
    for name, values in found.outputs.items():
        if (ends := found.ends(name)) is not None:
            low, high = (f"{found.written(name, values[point])} at {found.at(point)}" for point in ends)
            lines.append(f"{name}: lowest {low}; highest {high}")
    lines += [
        f"Failed at {found.at(point)}: {found.status[point]} {found.message[point]}".rstrip()
        for point in failed[:_MOST_FAILED]
    ]
    written = [name for name in RESULT[2:] if (out / name).exists()]
    lines.append(f"{found.status.size} points, {failed.size} failed. Wrote {', '.join(written)} to {out}")
    console = Console(highlight=False)
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)


def _read(config: Path) -> dict[str, Any]:
    """Read a file and check the names of what it holds."""
    stated = read_toml(config)
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


def _settle(out: Path, resume: bool, force: bool) -> Path:
    """Find the folder to compute in: an old sweep that is to be replaced stays until the new one is complete."""
    finish(out, RESULT)
    begun, replacement = (out / PLAN).exists(), out / _REPLACEMENT
    if (out / FINISHED).exists() and not begun:
        raise FileExistsError(f"--out {out} holds the result of another command. Choose another --out.")
    if force and begun:
        refuse_links(out, RESULT)
        shutil.rmtree(replacement, ignore_errors=True)
        return replacement
    if resume and (replacement / PLAN).exists():
        return replacement
    if begun and not resume:
        raise FileExistsError(f"--out {out} holds a sweep. Pass --resume to go on with it, --force to replace it.")
    if resume and not begun:
        raise ValueError(f"--out {out} holds no sweep to go on with. Leave out --resume.")
    refuse_links(out, ())
    return out


def _keep(names: Any) -> list[str]:
    if not (isinstance(names, list) and names and all(isinstance(name, str) for name in names)):
        raise ValueError(f"[outputs] keep must be a list of names, got {names!r}.")
    for name in names:
        known_name("[outputs] keep", name, (*FIELDS, *STATS))
    if len(set(names)) < len(names):
        raise ValueError(f"[outputs] keep must name each output once, got {names!r}.")
    return names


def _execution(stated: Mapping[str, Any]) -> Batch:
    hints: dict[str, Any] = {"size": int, "mode": str, "threads": int}
    given = {name: converted(f"[execution] {name}", hints[name], value) for name, value in stated.items()}
    try:
        return Batch(**given)
    except ValueError as cause:
        raise ValueError(str(cause).replace("Batch.", "[execution] ")) from None


def _points(axes: Mapping[str, Any], design: Mapping[str, Any]) -> Points:
    """Read axes in their units; make the points."""
    kind = design.get("kind", "grid")
    known_name("[design] kind", kind, _DESIGNS)
    if not axes:
        raise ValueError("[axes] must name at least one number that varies, got none.")
    units = {name: _AXES[name].unit for name in axes}
    if kind in ("grid", "zip"):
        drawn = [name for name in ("points", "seed") if name in design]
        if drawn:
            raise ValueError(f"[design] {drawn[0]} is for kind sobol and latin_hypercube, got kind {kind!r}.")
        values = {name: _checked(name, _values(name, axis) * _factor(name, axis)) for name, axis in axes.items()}
        return (grid if kind == "grid" else zip_)(values).with_units(units)
    count, seed = (converted(f"[design] {name}", int, design.get(name, 0)) for name in ("points", "seed"))
    if count < 1:
        raise ValueError(f"[design] points must be a whole number of at least 1, got {count}.")
    if seed < 0:
        raise ValueError(f"[design] seed must be a whole number of at least 0, got {seed}.")
    sampler = {"sobol": qmc.Sobol, "latin_hypercube": qmc.LatinHypercube}[kind](d=len(axes), rng=seed)
    bounds, log = {}, []
    for name, axis in axes.items():
        if not isinstance(axis, dict) or not {"from", "to"} <= set(axis) <= {"from", "to", "log", "unit"}:
            raise ValueError(
                f"[axes] {name} of a {kind} design must be {{ from = , to = , log = , unit = }}, got {axis!r}."
            )
        ends = _checked(name, _numbers(name, [axis["from"], axis["to"]]) * _factor(name, axis))
        bounds[name] = (float(ends[0]), float(ends[1]))
        log += [name] if _is_log(name, axis) else []
    return sample(bounds, sampler.random(count), log).with_units(units)


def _values(name: str, axis: Any) -> np.ndarray:
    """Read one axis: a list, or a dict with values, or with from, to and points."""
    if isinstance(axis, list):
        return _numbers(name, axis)
    if isinstance(axis, dict) and "values" in axis and set(axis) <= {"values", "unit"}:
        return _numbers(name, axis["values"])
    if isinstance(axis, dict) and {"from", "to", "points"} <= set(axis) <= {"from", "to", "points", "log", "unit"}:
        low, high = _numbers(name, [axis["from"], axis["to"]])
        count = converted(f"[axes] {name} points", int, axis["points"])
        if count < 1:
            raise ValueError(f"[axes] {name} points must be a whole number of at least 1, got {count}.")
        log = _is_log(name, axis)
        if log and not (low > 0 and high > 0):
            raise ValueError(f"[axes] {name} must run between positive numbers for log = true, got {low} to {high}.")
        return (np.geomspace if log else np.linspace)(low, high, count)
    raise ValueError(
        f"[axes] {name} must be a list of numbers, {{ values = [...], unit = }} or "
        f"{{ from = , to = , points = , log = , unit = }}, got {axis!r}."
    )


def _is_log(name: str, axis: Mapping[str, Any]) -> bool:
    return converted(f"[axes] {name} log", bool, axis.get("log", False))


def _numbers(name: str, values: Any) -> np.ndarray:
    if not isinstance(values, list):
        raise ValueError(f"[axes] {name} must hold a list of numbers, got {values!r}.")
    array = np.array([converted(f"[axes] {name} [{_AXES[name].unit}]", float, value) for value in values])
    return array if np.isfinite(array).all() else _checked(name, array)  # before numbers are made of infinity


def _factor(name: str, axis: Any) -> float:
    known = _UNITS[_AXES[name].unit]
    unit = axis.get("unit", _AXES[name].unit) if isinstance(axis, dict) else _AXES[name].unit
    known_name(f"[axes] {name} unit", unit, tuple(known))
    return known[unit]


def _checked(name: str, values: np.ndarray) -> np.ndarray:
    axis = _AXES[name]
    if not axis.takes(values):
        raise ValueError(f"[axes] {name} [{axis.unit}] must be {axis.expected}, got {values.tolist()}.")
    return values


def _inputs(stated: Mapping[str, Any], points: Points, folder: Path) -> _Inputs:
    """Convert the inputs to the options of `opfem palpate`; an axis takes the place of its option."""
    groups = (MapOptions, LayerOptions, ImprintOptions)
    hints = {name: hint for group in groups for name, hint in typing.get_type_hints(group, include_extras=True).items()}
    hints |= {"map": str, "increments": int}
    given = {}
    for name, value in stated.items():
        known_name("[inputs]", name, tuple(hints))
        if name in points.columns:
            raise ValueError(f"[inputs] {name} is also one of the [axes]. Leave one out.")
        if name in ("l0", "missing") and isinstance(value, int | float) and not isinstance(value, bool):
            value = str(value)
        value = converted(f"[inputs] {name}", _plain(hints[name]), value)
        given[name] = _path(value, folder) if name in ("l0", "map", "mask") else value
        for check in getattr(hints[name], "__metadata__", ()):
            _check(f"[inputs] {name}", validators(check.validator), given[name])
    given |= {name: float(column[0]) for name, column in points.columns.items()}
    if "l0" in points.columns:
        given["l0"] = str(given["l0"])
    path = str(coin_file()) if given["map"] == "coin" else given["map"]
    reading, layer, contact = _group(MapOptions, given), _group(LayerOptions, given), _group(ImprintOptions, given)
    return _Inputs(path, reading, layer, contact, given.get("increments"))


def _check(what: str, checks: tuple[Any, ...], value: Any) -> None:
    for check in checks:
        try:
            check(None, value)
        except ValueError as cause:
            raise ValueError(f"{what} {cause}") from None


def _plain(hint: Any) -> Any:
    return hint.__origin__ if hasattr(hint, "__metadata__") else hint


def _group(kind: type[_Options], given: Mapping[str, Any]) -> _Options:
    """Make a group of options of those given that belong to it."""
    return kind(**{name: value for name, value in given.items() if name in typing.get_type_hints(kind)})


def _path(name: str, folder: Path) -> str:
    """Read paths as seen from the file that names them."""
    return str(folder / name) if (folder / name).is_file() else name


def _function(inputs: _Inputs, points: Points) -> Callable[..., Solution]:
    """State the experiment as a function of the numbers that vary, after checking them."""
    measured, unloaded = read_maps(inputs.map, inputs.reading)
    palpation, thickness = state_experiment(measured, unloaded, inputs.reading, inputs.layer, inputs.contact)
    _check_points(inputs, palpation, points)
    load = Imprint(thickness, correct_approach=inputs.contact.correct_approach)
    check_compatible(palpation, load, None)  # inside jit nothing can
    solver = Newton() if inputs.increments is None else Newton(increments=inputs.increments)
    names = tuple(points.columns)

    def solution(**numbers) -> Solution:
        varied = eqx.tree_at(
            lambda p: [_AXES[name].where(p) for name in names], palpation, [numbers[name] for name in names]
        )
        return solve(varied, load, solver, throw=False, progress=False)

    return solution


def _check_points(inputs: _Inputs, palpation: Palpation, points: Points) -> None:
    """State the experiment at the points, which checks their numbers; inside jit nothing can.

    Of very many points those at the ends of every axis are stated, where numbers go wrong first, and some between.
    """
    extent = (float(palpation.extent[0]), float(palpation.extent[1]))
    layers, contacts = (tuple(typing.get_type_hints(group)) for group in (LayerOptions, ImprintOptions))
    seen = set()
    chosen = set(np.linspace(0, len(points) - 1, min(len(points), _MOST_STATED)).astype(int).tolist())
    chosen |= {int(end) for column in points.columns.values() for end in (np.argmin(column), np.argmax(column))}
    for i in sorted(chosen):
        numbers = {name: float(column[i]) for name, column in points.columns.items()}
        unloaded = numbers.get("l0", palpation.layer.thickness)
        for group in ({"l0", *layers}, set(contacts)):  # independent of each other: each combination once
            own = {name: value for name, value in numbers.items() if name in group}
            if tuple(own.items()) in seen:
                continue
            seen.add(tuple(own.items()))
            layer = dataclasses.replace(inputs.layer, **{n: v for n, v in own.items() if n in layers})
            contact = dataclasses.replace(inputs.contact, **{n: v for n, v in own.items() if n in contacts})
            try:
                state_palpation(unloaded, extent, layer, contact)
            except ValueError as cause:
                at = ", ".join(f"{name} = {value:g}" for name, value in own.items())
                raise ValueError(f"[axes] at {at}: {in_options(str(cause))}") from None
