"""`write_inp`: a palpation or an experiment with its loads as a deck of Abaqus or CalculiX, exact or refused.

One flat mesh, which both codes read: soft blocks, and rigid bodies whose nodes are all constrained or moved.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, get_args

import jax.numpy as jnp
import numpy as np

from .._checks import concrete
from ..io import write_whole
from ..mechanics.face import tributary_area
from ..model import (
    Bonded,
    Compression,
    Contact,
    Displacement,
    Experiment,
    Imprint,
    Palpation,
    Roller,
    Side,
    Traction,
)
from ..model.palpation import SIDES
from ..solvers import Explicit, Newton
from ..solvers.discretise import check_compatible
from ..solvers.supports import Supports
from .deck import Code
from .writing_bodies import Bodies, Written, listed, show
from .writing_laws import element_name, interaction_lines, material_lines, rigid_lines

_KINDS = {Bonded: "bonded", Roller: "roller", Contact: "contact"}
# How far a map's grid may be from the mesh's to count as the same, of an element.
_ALIGNED = 1e-6
# Springs to ground [N/mm] beside the pins of CalculiX' decks, as in the stored runs, which converged with both; in all
# 0.06 % of the layer's own stiffness in shear.
_HELP = 1e-7

Load = Imprint | Displacement | Traction | Compression


def write_inp(
    path: str | os.PathLike,
    problem: Palpation | Experiment,
    load: Load | Sequence[Load],
    solver: Newton | Explicit = Newton(),
    *,
    code: Code = "abaqus",
) -> None:
    """Write a palpation or an experiment as an input file of Abaqus or CalculiX, which `read_inp` reads back.

    What the code cannot say is refused: CalculiX has no hard or exponential contact as opfem does, and its C3D8 is
    `element="full"`, Abaqus' `"mean_dilatation"`. The surface of an `Imprint` becomes facets between its nodes, at the
    map's own pixels where these lie on the mesh's grid, else at the nodes that opfem itself puts it through.

    Args:
        path: The file; replaced as a whole.
        problem: What is pressed.
        load: One load, or one for each step.
        solver: `Newton` writes static steps of equal increments, `Explicit` those of Abaqus/Explicit.
        code: Whose deck.

    Raises:
        ValueError: If the code cannot say something exactly, with what to take instead.

    Example:
        >>> import opfem as op
        >>> def to_abaqus(palpation, thickness):
        ...     op.write_inp("layer.inp", palpation, op.Imprint(thickness))
    """
    if code not in get_args(Code):
        raise ValueError(f'write_inp: code must be "abaqus" or "calculix", got {code!r}.')
    loads = tuple(load) if isinstance(load, Sequence) else (load,)
    if not loads:
        raise ValueError("write_inp needs a load, or one for each step; got none.")
    for before, one in zip((None, *loads[:-1]), loads, strict=True):
        check_compatible(problem, one, before)
    if isinstance(solver, Explicit) and (code == "calculix" or isinstance(problem, Experiment)):
        raise ValueError("write_inp: Explicit is written for Abaqus, and of a Palpation; take Newton().")
    write_whole(path, _Deck(problem, loads, solver, code).text().encode())


@dataclass
class _Deck:
    """A deck in the making."""

    problem: Palpation | Experiment
    loads: tuple[Load, ...]
    solver: Newton | Explicit
    code: Code
    numbers: Bodies = field(default_factory=Bodies)
    mesh: list[str] = field(default_factory=list)
    constrained: list[str] = field(default_factory=list)
    interactions: list[str] = field(default_factory=list)
    pairs: list[str] = field(default_factory=list)
    rigid: list[Written] = field(default_factory=list)

    @property
    def is_explicit(self) -> bool:
        """Whether dynamics solve it."""
        return isinstance(self.solver, Explicit)

    @property
    def extent(self) -> tuple[float, float]:
        """Lx, Ly [mm]."""
        lx, ly = np.asarray(self.problem.extent).tolist()
        return lx, ly

    @property
    def density(self) -> float | None:
        """Density of all materials [t/mm³]; None in statics."""
        return float(self.solver.density) if isinstance(self.solver, Explicit) else None

    def text(self) -> str:
        """Write all of it."""
        moved = self._palpation() if isinstance(self.problem, Palpation) else self._experiment()
        head = ["*HEADING", f"written by opfem for {self.code}; mm, N, MPa, s, t"]
        if any(isinstance(load, Imprint) for load in self.loads):
            head.append("** The surface PRESS has facets; opfem's runs smoothly through the same nodes.")
        model = [*head, *self.mesh, *rigid_lines(self.rigid, self.density), *self.interactions]
        boundary = ["*BOUNDARY", *self.constrained] if self.constrained else []
        pairs = [] if self.is_explicit else self.pairs
        return "\n".join([*model, *boundary, *pairs, *self._steps(moved), ""])

    def _body(self, name: str, law: Any, element: str, X: np.ndarray) -> Written:
        """Write a soft block with its material."""
        body, lines = self.numbers.block(name, element_name(element, self.code), X)
        damping = float(self.solver.damping) if isinstance(self.solver, Explicit) else 0.0
        self.mesh += [*lines, *material_lines(body, law, element, self.density, damping)]
        return body

    def _rigid(self, body: Written, lines: list[str], constrained: str) -> Written:
        self.mesh += lines
        self.rigid.append(body)
        self.constrained.append(f"{body.name}, {constrained}")
        return body

    @property
    def _rigid_kind(self) -> str:
        return "C3D8R" if self.is_explicit else "C3D8"

    def _touch(self, name: str, contact: Contact, slave: str, master: str) -> None:
        """Write a contact."""
        self.interactions += interaction_lines(name, contact, self.code, self.is_explicit)
        how = "MECHANICAL CONSTRAINT=KINEMATIC" if self.is_explicit else "TYPE=SURFACE TO SURFACE"
        self.pairs += [f"*CONTACT PAIR, INTERACTION={name}, {how}", f"S_{slave}, S_{master}"]

    def _palpation(self) -> Written:
        """Write a palpation; returns the body that is moved."""
        palpation = self.problem
        assert isinstance(palpation, Palpation)
        X = np.asarray(palpation.mesh().positions())
        layer = self._body("LAYER", palpation.layer.material, palpation.element, X)
        self._window(palpation.window, 0.0)
        load = self.loads[0]
        interface = "traction"
        moved = layer
        if isinstance(load, Imprint):
            interface = "contact"
            moved = self._press(palpation, X)
        elif isinstance(load, Displacement):
            interface = "bonded" if load.lateral == "fixed" else "uz"
            if load.lateral == "fixed":
                self.constrained.append("LAYER_HIGH, 1, 2")
        self._sides(layer, palpation.sides)
        share = np.asarray(tributary_area(jnp.asarray(X[:, 0])))
        self._hold(layer, 0, interface, palpation.window, share / share.sum())
        return moved

    def _window(self, window: Side, z: float) -> None:
        if isinstance(window, Contact):
            self._rigid(*self.numbers.plate("WINDOW", self._rigid_kind, self.extent, z, above=False), "1, 3")
            self._touch("I_WINDOW", window, "LAYER_LOW", "WINDOW_HIGH")
        else:
            self.constrained.append("LAYER_LOW, 1, 3" if isinstance(window, Bonded) else "LAYER_LOW, 3, 3")

    def _press(self, palpation: Palpation, X: np.ndarray) -> Written:
        """Write the rigid surface of an imprint, where its law has no pressure on the unloaded layer."""
        first = self.loads[0]
        contact = palpation.sample
        assert isinstance(first, Imprint)
        assert isinstance(contact, Contact)
        if any(isinstance(load, Imprint) and load.correct_approach for load in self.loads):
            raise ValueError("write_inp: correct_approach depends on the solution; a deck cannot say it. Leave it out.")
        x, y = self._grid(first)
        across, along = jnp.meshgrid(jnp.asarray(x), jnp.asarray(y))
        start = np.asarray(palpation.layer.thickness_at(across, along) + contact.law.zero_pressure_clearance)
        body = self._rigid(*self.numbers.surface("PRESS", self._rigid_kind, x, y, start), "1, 2")
        self._touch("I_SAMPLE", contact, "LAYER_HIGH", "PRESS_LOW")
        return body

    def _grid(self, load: Imprint) -> tuple[np.ndarray, np.ndarray]:
        """Choose the nodes of a rigid surface along x and y [mm]: the map's pixels, or those that opfem samples."""
        palpation = self.problem
        assert isinstance(palpation, Palpation)
        counts = palpation.elements[:2]
        axes = []
        for length, n, own in zip(self.extent, counts, (load.thickness.x, load.thickness.y), strict=True):
            size, pixels = length / n, np.asarray(own)
            off = pixels / size - np.rint(pixels / size)
            aligned = np.abs(off).max() < _ALIGNED and np.allclose(np.diff(pixels), size, rtol=_ALIGNED)
            aligned = aligned and pixels[0] < -0.5 * size and pixels[-1] > length + 0.5 * size
            beyond = n // 2 + 1
            axes.append(pixels if aligned else size * np.arange(-beyond, n + beyond + 1))
        return axes[0], axes[1]

    def _experiment(self) -> Written:
        """Write an experiment; returns the body that is moved."""
        experiment = self.problem
        assert isinstance(experiment, Experiment)
        interface = experiment.interface
        assert isinstance(interface, Contact)
        layer = self._body("LAYER", experiment.layer.material, experiment.element[0], _X(experiment.layer_mesh()))
        below, between, above = (_gap(side) for side in (experiment.window, interface, experiment.plate))
        self._window(experiment.window, 0.0 - below)
        X = _X(experiment.sample_mesh())
        X[2] += between
        sample = self._body("SAMPLE", experiment.sample_material(), experiment.element[1], X)
        self._touch("I_SAMPLE", interface, "LAYER_HIGH", "SAMPLE_LOW")
        plate, moved = experiment.plate, sample
        if isinstance(plate, Contact):
            z = float(experiment.plate_height) + between + above
            moved = self._rigid(*self.numbers.plate("PLATE", self._rigid_kind, self.extent, z, above=True), "1, 2")
            self._touch("I_PLATE", plate, "SAMPLE_HIGH", "PLATE_LOW")
        elif isinstance(plate, Bonded):
            self.constrained.append("SAMPLE_HIGH, 1, 2")
        for body in (layer, sample):
            self._sides(body, experiment.sides)
        for body, low, top in ((layer, experiment.window, "contact"), (sample, interface, _PLATES[type(plate)])):
            nodes = body.numbers[0].size
            self._hold(body, 0 if body is layer else -1, top, low, np.full(body.numbers.shape[1:], 1.0 / nodes))
        return moved

    def _sides(self, body: Written, sides: tuple[str, ...]) -> None:
        for side, kind in zip(SIDES, sides, strict=True):
            if kind == "roller":
                at = 0 if side[1] == "0" else -1
                nodes = body.numbers[..., at] if side[0] == "x" else body.numbers[:, at]
                self.mesh += listed("NSET", f"{body.name}_{side.upper()}", nodes.ravel().tolist())
                self.constrained.append(f"{body.name}_{side.upper()}, {'xy'.index(side[0]) + 1}")

    def _hold(self, body: Written, level: int, interface: str, low: Side, share: np.ndarray) -> None:
        """Write springs for a stated hold; where none is, pin what nothing but friction keeps in place."""
        hold = self.problem.hold
        if hold is not None:
            if self.is_explicit:
                raise ValueError("write_inp: Abaqus/Explicit has no springs to ground; leave out hold=.")
            self._springs(body, float(hold) * share)
            return
        drifts = Supports(_KINDS[type(low)], interface, self.problem.sides, spring=False).drifts
        if self.is_explicit or not any(drifts):
            return
        contacts = [side for side in _sides_of(self.problem) if isinstance(side, Contact)]
        if not any(float(side.friction) > 0 for side in contacts):
            raise ValueError(
                "write_inp: nothing holds the layer in the plane: no friction, and a deck cannot hold its mean motion "
                "as hold=None does. State hold= [N/mm], such as 1e-4, or sides."
            )
        _, my, mx = body.numbers.shape
        middle = body.numbers[level, my // 2]
        first, other = middle[mx // 2], middle[mx // 2 - max(mx // 20, 1)]
        self.constrained += [f"{first}, {k + 1}" for k in range(2) if drifts[k]] + (
            [f"{other}, 2"] if drifts[2] else []
        )
        if self.code == "calculix":
            self._springs(body, np.full(share.shape, _HELP))

    def _springs(self, body: Written, stiffness: np.ndarray) -> None:
        """Write springs to ground on the lower face, one set for each stiffness."""
        nodes = body.numbers[0]
        values, which = np.unique(np.round(stiffness / stiffness.max(), 12), return_inverse=True)
        for direction in (1, 2):
            for number, value in enumerate(values):
                own = nodes.ravel()[which.ravel() == number]
                name = f"{body.name}_SPRING{direction}_{number}"
                first, self.numbers.elements = self.numbers.elements, self.numbers.elements + own.size
                self.mesh.append(f"*ELEMENT, TYPE=SPRING1, ELSET={name}")
                self.mesh += [f"{first + k}, {node}" for k, node in enumerate(own.tolist())]
                self.mesh += [f"*SPRING, ELSET={name}", str(direction), show(value * stiffness.max())]

    def _steps(self, moved: Written) -> list[str]:
        lines: list[str] = []
        if isinstance(self.solver, Explicit):
            kind = ", DEFINITION=SMOOTH STEP" if self.solver.amplitude == "smooth_step" else ""
            lines += [f"*AMPLITUDE, NAME=LOADING{kind}", f"0., 0., {show(self.solver.duration)}, 1."]
        before: Load | None = None
        for number, load in enumerate(self.loads, start=1):
            lines += self._step(number, load, before, moved)
            before = load
        return lines

    def _step(self, number: int, load: Load, before: Load | None, moved: Written) -> list[str]:
        inc = ", INC=400" if self.code == "calculix" else f", NAME=STEP-{number}"
        lines = [f"*STEP{inc}, NLGEOM" if self.code == "calculix" else f"*STEP{inc}, NLGEOM=YES", *self._procedure()]
        if self.is_explicit and number == 1:
            lines += self.pairs
        if isinstance(load, Traction):
            lines += ["*CLOAD", *self._forces(load, moved)]
        else:
            values = self._moves(load, moved)
            if self.is_explicit and before is not None:
                values = values - self._moves(before, moved)
            amplitude = ", AMPLITUDE=LOADING" if self.is_explicit else ""
            lines += [f"*BOUNDARY{amplitude}", *_rows(moved, load, values)]
        return [*lines, *self._outputs(moved), "*END STEP"]

    def _procedure(self) -> list[str]:
        solver = self.solver
        if isinstance(solver, Newton):
            first = show(1.0 / float(solver.increments))
            return ["*STATIC", f"{first}, 1., 1e-05, {first}"]
        scaling = concrete(solver.mass_scaling) if not isinstance(solver.mass_scaling, str) else None
        if scaling is None or scaling.ndim:
            raise ValueError("write_inp: mass_scaling must be one factor [-] for a deck of Abaqus/Explicit.")
        linear, quadratic = (show(value) for value in solver.bulk_viscosity)
        lines = ["*DYNAMIC, EXPLICIT", f", {show(solver.duration)}", "*BULK VISCOSITY", f"{linear}, {quadratic}"]
        return [*lines, f"*FIXED MASS SCALING, FACTOR={show(float(scaling))}"]

    def _moves(self, load: Load, moved: Written) -> np.ndarray:
        """Compute the displacement along z at the end of a load [mm], of the nodes of the moved face `(my, mx)`."""
        shape = moved.numbers.shape[1:]
        if isinstance(load, Compression):
            return np.full(shape, -float(load.approach))
        if isinstance(load, Displacement):
            return np.broadcast_to(np.asarray(load.uz), shape)
        assert isinstance(load, Imprint)
        assert isinstance(self.problem, Palpation)
        first = self.loads[0]
        assert isinstance(first, Imprint)
        across, along = jnp.meshgrid(*(jnp.asarray(axis) for axis in self._grid(first)))
        return np.asarray(load.thickness.sample(across, along) - self.problem.layer.thickness_at(across, along))

    def _forces(self, load: Traction, moved: Written) -> list[str]:
        assert isinstance(self.problem, Palpation)
        if load.lateral is None or load.stiffness is not None:
            raise ValueError(
                "write_inp: a Traction is written as forces; that needs lateral= [MPa] and no stiffness=. A lateral "
                "part that follows friction depends on the solution."
            )
        X = _X(self.problem.mesh())[:, -1]
        area = np.asarray(tributary_area(jnp.asarray(X)))
        normal = np.broadcast_to(np.asarray(load.normal), area.shape)
        force = np.stack([*np.asarray(load.lateral), -normal]) * area
        numbers = moved.numbers[-1].ravel().tolist()
        return [
            f"{node}, {k + 1}, {show(value)}"
            for k in range(3)
            for node, value in zip(numbers, force[k].ravel(), strict=True)
        ]

    def _outputs(self, moved: Written) -> list[str]:
        if self.code == "abaqus":
            frames = f", NUMBER INTERVAL={self.solver.outputs}" if isinstance(self.solver, Explicit) else ""
            lines = [
                f"*OUTPUT, FIELD{frames}",
                "*NODE OUTPUT",
                "U, RF, COORD",
                "*ELEMENT OUTPUT, DIRECTIONS=YES",
                "LE, S",
            ]
            return [
                *lines,
                *(["*CONTACT OUTPUT", "CSTRESS,"] if self.pairs else []),
                "*OUTPUT, HISTORY, VARIABLE=PRESELECT",
            ]
        often = "FREQUENCY=100000"  # the end of the step
        lines = [f"*NODE FILE, OUTPUT=3D, {often}", "U, RF", f"*EL FILE, {often}", "S"]
        lines += [f"*CONTACT FILE, {often}", "CDIS, CSTR"] if self.pairs else []
        faces = ["LAYER_LOW", "LAYER_HIGH", *([f"{moved.name}_HIGH"] if moved.name == "SAMPLE" else [])]
        for name in [*(body.name for body in self.rigid), *faces]:
            lines += [f"*NODE PRINT, NSET={name}, TOTALS=ONLY, {often}", "RF"]
        return [*lines, f"*EL PRINT, ELSET=LAYER_HIGH, {often}", "S"]


_PLATES = {Bonded: "bonded", Roller: "uz", Contact: "contact"}


def _X(mesh: Any) -> np.ndarray:
    return np.array(mesh.positions())


def _gap(side: Side) -> float:
    """Clearance [mm] at which a side starts."""
    return float(side.law.zero_pressure_clearance) if isinstance(side, Contact) else 0.0


def _sides_of(problem: Palpation | Experiment) -> tuple[Side, ...]:
    if isinstance(problem, Palpation):
        return problem.window, problem.sample
    return problem.window, problem.interface, problem.plate


def _rows(moved: Written, load: Load, values: np.ndarray) -> list[str]:
    """Write displacements along z: of a rigid body all nodes, of a soft one those of its upper face."""
    if isinstance(load, Compression):
        where = moved.name if moved.name == "PLATE" else f"{moved.name}_HIGH"
        return [f"{where}, 3, 3, {show(values.flat[0])}"]
    numbers = moved.numbers if isinstance(load, Imprint) else moved.numbers[-1:]
    return [
        f"{node}, 3, 3, {show(value)}"
        for level in numbers
        for node, value in zip(level.ravel().tolist(), values.ravel(), strict=True)
    ]
