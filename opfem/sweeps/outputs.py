"""Outputs of a point of a sweep: named and labelled arrays, and the status of the point.

A solution is reduced to the requested fields inside the compiled program.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..inverse import FitStatus, TractionFit
from ..results.dataset import EXPERIMENT_STATS, FIT_STATS, IMAGE, NODES, STATS
from ..results.fields import pressure_image
from ..solvers import CONVERGED, RESULTS, ExperimentSolution, Solution
from .design import RESERVED, known_name

_Solved = Solution | ExperimentSolution
Keep = Sequence[str] | Callable[[Any], dict[str, Any]] | None

STATUS = " ended"
"""How solutions ended, among the arrays of a point."""
ERROR, NONFINITE, SUCCESSFUL = "error", "nonfinite", "successful"
GOOD = CONVERGED
"""Statuses of points that have a result."""
_ENDS = {"solve": RESULTS, "fit": FitStatus}
# Equinox has no public mapping from names to items.
_NAMES = {kind: enumeration._name_to_item for kind, enumeration in _ENDS.items()}
_ELEMENTS = ("y_element", "x_element")
FIELDS: dict[str, tuple[tuple[str, ...], str, str, Callable[[Any], Any]]] = {
    "max_pressure": ((), "MPa", "largest contact pressure at the sample", lambda s: jnp.max(s.pressure)),
    "pressure": (NODES, "MPa", "contact pressure at the sample on the current area", lambda s: s.pressure),
    "pressure_image": (IMAGE, "MPa", "contact pressure at the sample under each pixel", pressure_image),
    "traction": (("component", *NODES), "MPa", "force on the layer per reference area", lambda s: s.traction),
    "slip": (("lateral", *NODES), "mm", "tangential slip at the sample", lambda s: s.slip),
    "contact_status": (NODES, "1", "contact status: 0 open, 1 stick, 2 slip", lambda s: s.contact_status),
    "displacement": (("component", "z", *NODES), "mm", "displacement", lambda s: s.displacement),
    "stress_zz": (_ELEMENTS, "MPa", "Cauchy stress zz, mean over the top element", lambda s: s.stress_zz),
    "thickness": (
        IMAGE,
        "mm",
        "computed thickness of the loaded layer",
        lambda s: jnp.where(s.thickness.mask, jnp.nan, s.thickness.values),
    ),
}
_FIT_FIELDS: dict[str, tuple[tuple[str, ...], str, str, Callable[[Any], Any]]] = {
    "pressure_std": (NODES, "MPa", "posterior standard deviation of the pressure", lambda f: f.pressure_std),
    "residual": (NODES, "mm", "interface minus measured surface", lambda f: f.residual),
    "chi2": ((), "1", "sum of squared misfits over their noise", lambda f: f.chi2),
    "effective_dof": ((), "1", "degrees of freedom that the map determines", lambda f: f.effective_dof),
}


class Sensitivities(NamedTuple):
    """A function's value and its derivatives.

    Attributes:
        value: Result of the function: a number, an array, or a dict of these.
        derivatives: By argument: the same, differentiated by it.
    """

    value: Any
    derivatives: dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Label:
    """How an output is labelled.

    Attributes:
        dims: Its dimensions; None: unnamed.
        units: Its units; None: unknown.
        long_name: Description.
        per: Argument that it is differentiated by.
    """

    dims: tuple[str, ...] | None = None
    units: str | None = None
    long_name: str = ""
    per: str | None = None


class OutputError(ValueError):
    """The results of a sweep's function cannot be stored as requested, at any point."""


@dataclasses.dataclass(frozen=True)
class Outputs:
    """Converts the results of a function to named arrays. Works inside jit; labels do not depend on numbers.

    Args:
        name: Name of an output that has none.
        keep: Fields of a solution to store, or a function that reduces a result to a dict of arrays.
        units: Units of axes, and of outputs without a known unit.
        axes: Names of the axes.
    """

    name: str
    keep: tuple[str, ...] | Callable[[Any], dict[str, Any]] | None
    units: dict[str, str]
    axes: tuple[str, ...]

    def arrays(self, returned: Any) -> tuple[dict[str, Array], dict[str, Label]]:
        """Name and label the arrays of a result.

        Raises:
            OutputError: If it contains anything but numbers, arrays, solutions and dicts of them, or `keep` names
                an unknown field.
        """
        values, labels = {}, {}
        if callable(self.keep):
            returned = self.keep(returned)
        for name, value, label in self._named(self.name, returned):
            if name in values or name in (*self.axes, *RESERVED):
                raise OutputError(f"An output of the sweep cannot be called {name!r}: that name is taken.")
            if name in self.units and label.units not in (None, self.units[name]):
                raise OutputError(
                    f"Output {name!r} of the sweep is in {label.units}, got units {self.units[name]!r}. Leave them "
                    "out, or convert it in the function."
                )
            values[name] = jnp.asarray(value)
            labels[name] = dataclasses.replace(label, units=self.units.get(name, label.units))
        for name in self.units:
            _known("Units of the sweep: axis or output", name, (*self.axes, *(n for n in values if n != STATUS)))
        return values, labels

    def _named(self, name: str, part: Any):
        if isinstance(part, _Solved | TractionFit):
            yield from self._kept(part)
        elif isinstance(part, Sensitivities):
            yield from self._named(name, part.value)
            for argument, derivative in part.derivatives.items():
                for of, value, label in self._named(name, derivative):
                    about = f"derivative of {of} by {argument}"
                    label = dataclasses.replace(label, units=self.units.get(of), long_name=about, per=argument)
                    yield f"d_{of}_d_{argument}", value, label
        elif isinstance(part, Mapping):
            for key, value in part.items():
                yield from self._named(str(key), value)
        elif isinstance(part, np.ndarray | np.generic | Array | bool | int | float):
            yield name, part, Label()
        else:
            raise OutputError(
                "The function of a sweep must return a number, an array, a Solution, a TractionFit or a dict of "
                f"these, got {type(part).__name__} for {name!r}."
            )

    def _kept(self, part: _Solved | TractionFit):
        solution = _solution(part)
        own = _FIT_FIELDS if isinstance(part, TractionFit) else {}
        known = STATS | FIT_STATS | (EXPERIMENT_STATS if isinstance(part, ExperimentSolution) else {})
        stats = dict.fromkeys(solution.stats, solution.stats)
        if isinstance(part, TractionFit):
            stats |= dict.fromkeys(part.stats, part.stats)
        keep = self.keep if isinstance(self.keep, tuple) else ("pressure", *own, *stats)
        dims: set[str] = set()
        for name in keep:
            _known("sweep.keep", name, (*FIELDS, *own, *stats))
            if name in stats:
                value = jnp.asarray(stats[name][name])
                unit, about = known.get(name, (None, name.replace("_", " ")))
                label = Label(("component",) if value.shape == (3,) else None, unit, about)
            else:
                its, unit, about, of = (own | FIELDS)[name]
                value, label = of(part if name in own else solution), Label(its, unit, about)
            dims |= set(label.dims or ())
            yield name, value, label
        yield from ((name, value, label) for name, value, label in _grid(solution) if name in dims)
        yield STATUS, _end_codes(part), Label()


def _solution(part: _Solved | TractionFit) -> _Solved:
    return part.solution if isinstance(part, TractionFit) else part


def _grid(solution: _Solved):
    """Yield the positions along each dimension; they are coordinates unless they are swept."""
    X, image = solution.positions[:2, -1], solution.thickness
    x, y = X[0, 0], X[1, :, 0]
    yield "x", x, Label(("x",), "mm", "reference position along image columns")
    yield "y", y, Label(("y",), "mm", "reference position along image rows")
    yield "x_element", 0.5 * (x[1:] + x[:-1]), Label(("x_element",), "mm", "reference element centres along x")
    yield "y_element", 0.5 * (y[1:] + y[:-1]), Label(("y_element",), "mm", "reference element centres along y")
    yield "x_image", image.x, Label(("x_image",), "mm", "position of image columns")
    yield "y_image", image.y, Label(("y_image",), "mm", "position of image rows")


def _known(what: str, name: str, known: Any) -> None:
    try:
        known_name(what, name, known)
    except ValueError as cause:
        raise OutputError(str(cause)) from None


def _end_codes(part: _Solved | TractionFit) -> Array:
    """Write down how a solve, and a fit, ended as places in `_NAMES`; -1: there was no fit."""
    ends = {"solve": _solution(part).result} | ({"fit": part.result} if isinstance(part, TractionFit) else {})
    codes = [
        sum((place * (ends[kind] == item) for place, item in enumerate(names.values())), jnp.zeros((), int))
        if kind in ends
        else jnp.asarray(-1)
        for kind, names in _NAMES.items()
    ]
    return jnp.stack(codes)


def ending(values: dict[str, np.ndarray]) -> tuple[str, str]:
    """Return the status of a point and a message, empty if it succeeded.

    A number, or a map that has no finite number at all, is taken for a failure.
    """
    if STATUS in values:
        for (kind, names), code in zip(_NAMES.items(), values[STATUS].tolist(), strict=True):
            if code > 0:
                name = list(names)[code]
                return name, _ENDS[kind][names[name]]
    for name, value in values.items():
        if value.dtype.kind == "f" and value.size and not np.isfinite(value).any():
            return NONFINITE, f"{name} is not finite."
    return SUCCESSFUL, ""
