"""Explicit dynamics: the published method, as a solver for `solve`.

Between two outputs the increments run as one compiled loop; the host loop between them checks the energies, shows
progress and writes checkpoints. Inside a trace the same increments run as a differentiable scan.
"""

import dataclasses
import math
from typing import Any, Literal, Protocol, get_args, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from .._checks import check_non_negative, check_positive, concrete
from ..measurement import ThicknessMap
from ..mechanics.inertia import bulk_viscosity, lumped_mass, stable_increment
from ..mechanics.layer_force import LayerForce
from ..model import Contact, Load, Palpation
from .discretise import discretise
from .explicit_fields import recover_motion
from .explicit_history import History, begin_history
from .explicit_step import Dynamics, Motion, orthonormal_modes, run
from .progress import Progress
from .solution import LastConverged, Solution, is_failure

Amplitude = Literal["smooth_step", "ramp"]
ELEMENTS = ("mean_dilatation", "full", "reduced", "tet4")

_OUTPUTS = 20
# Compiling takes as long whatever the mesh.
_COMPILES = "the explicit solver, about 10 s the first time"


def _plain(value: Any) -> Any:
    """Convert a number of NumPy or JAX, which cannot be a static field, to Python's."""
    return float(value) if isinstance(value, np.generic | jax.Array) and not isinstance(value, Tracer) else value


@runtime_checkable
class Checkpoint(Protocol):
    """Storage of a run's state, for its restart; `opfem.Checkpoint` is one in a file."""

    def restore(self, inputs: Any, like: Any) -> Any:
        """Return the state stored for these inputs, or None."""
        ...

    def keep(self, inputs: Any, state: Any) -> None:
        """Replace the stored state."""
        ...


class Explicit(eqx.Module):
    """Explicit dynamics: central differences, lumped mass, kinematic contact.

    The method of the published maps. The load is applied over `duration` with a smooth amplitude; the layer is
    quasi-static where its kinetic energy is small: `stats` contains all energies at every output.

    Contact is pure master–slave at the nodes of the two faces; the rigid bodies are masters. (The weight 0.5 of the
    published decks' pairs has no effect against a rigid body.) Hard contact is exact, other laws are satisfied at the
    end of every increment by one scalar equation per node: neither reduces the stable increment. Friction sticks
    without elastic slip. The sides of the layer have no contact, as in the published decks.

    Args:
        duration: Time over which the load is applied [s].
        mass_scaling: Factor on the density [-], a number or one per element `(nz, ny, nx)`; or "variable": each
            element scaled to the mass that `increment` requires, at least its own.
        density: Density of the layer [t/mm³].
        amplitude: "smooth_step" (fifth-order, at rest at both ends) or "ramp".
        bulk_viscosity: (b1, b2) [-], linear and quadratic.
        damping: Damping proportional to mass [1/s].
        increment: Time increment [s]; "auto": `safety` times the estimated stable one, updated at every output. Inside
            jit, grad or vmap it must be a number, because the number of increments must be known.
        output_every: Time between outputs [s]; None: a twentieth of the duration.
        safety: Share of the estimated stable increment that "auto" takes [-].
        energy_limit: Error of the energy balance, over the largest energy, at which the solve stops [-].
        precision: "float32": compute in it, twice as fast, whatever precision the palpation has; None: the palpation's.
        checkpoint: Storage of the state at every output, such as `opfem.Checkpoint("run.npz")`; a solve with the same
            inputs continues from it. Untraced solves only.

    Raises:
        ValueError: If a number is out of range, or a name is unknown.
    """

    mass_scaling: Any = 25.0
    density: Any = 1e-9
    bulk_viscosity: tuple[Any, Any] = (0.06, 1.2)
    damping: Any = 0.0
    duration: float = eqx.field(static=True, converter=_plain, default=1.0)
    amplitude: Amplitude = eqx.field(static=True, default="smooth_step")
    increment: float | Literal["auto"] = eqx.field(static=True, converter=_plain, default="auto")
    output_every: float | None = eqx.field(static=True, converter=_plain, default=None)
    safety: float = eqx.field(static=True, converter=_plain, default=0.9)
    energy_limit: float = eqx.field(static=True, converter=_plain, default=0.05)
    precision: Literal["float32"] | None = eqx.field(static=True, default=None)
    checkpoint: Any = eqx.field(static=True, default=None)

    def __check_init__(self):
        for name, unit in (("duration", "s"), ("safety", "-"), ("energy_limit", "-")):
            value = getattr(self, name)
            if isinstance(value, Tracer):
                raise ValueError(f"Explicit.{name} [{unit}] must be a plain number, got a traced one.")
            check_positive(f"Explicit.{name}", unit, value)
        if self.increment != "auto":
            check_positive("Explicit.increment", "s", self.increment)
        if self.output_every is not None:
            check_positive("Explicit.output_every", "s", self.output_every)
        check_positive("Explicit.density", "t/mm³", self.density)
        if self.is_variable and self.increment == "auto":
            raise ValueError('Explicit.mass_scaling="variable" needs the increment [s] to scale for, got "auto".')
        if isinstance(self.mass_scaling, str) and not self.is_variable:
            raise ValueError(f'Explicit.mass_scaling must be a factor [-] or "variable", got {self.mass_scaling!r}.')
        if not self.is_variable:
            check_positive("Explicit.mass_scaling", "-", self.mass_scaling)
        if len(self.bulk_viscosity) != 2:
            raise ValueError(f"Explicit.bulk_viscosity must be two numbers (b1, b2), got {self.bulk_viscosity!r}.")
        for k, value in enumerate(self.bulk_viscosity, 1):
            check_non_negative(f"Explicit.bulk_viscosity b{k}", "-", value)
        check_non_negative("Explicit.damping", "1/s", self.damping)
        if self.amplitude not in get_args(Amplitude):
            raise ValueError(f"Explicit.amplitude must be one of {get_args(Amplitude)}, got {self.amplitude!r}.")
        if self.precision not in (None, "float32"):
            raise ValueError(f'Explicit.precision must be "float32" or None, got {self.precision!r}.')

    @property
    def is_variable(self) -> bool:
        """Whether the mass of every element is scaled to the increment."""
        return isinstance(self.mass_scaling, str) and self.mass_scaling == "variable"

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        every = self.duration / _OUTPUTS if self.output_every is None else self.output_every
        return max(1, math.ceil(self.duration / every - 1e-9))


def solve_explicit(
    palpation: Palpation, load: Load, solver: Explicit, start: Solution | None, progress: bool
) -> Solution:
    """Solve a palpation under a load by explicit dynamics; see `solve`."""
    if palpation.element not in ELEMENTS:
        raise ValueError(
            f"Explicit takes the elements {ELEMENTS}, got Palpation.element={palpation.element!r}. A mean stress that "
            'is an unknown, or nodes without mass, have no stable increment: use "mean_dilatation", or Newton().'
        )
    if getattr(load, "correct_approach", False):
        raise ValueError(
            "Explicit cannot shift out the approach of the contact law: it would need a second run. Pass "
            "Imprint(..., correct_approach=False), or solve with Newton()."
        )
    if getattr(load, "stiffness", None) is not None:
        raise ValueError(
            "Explicit takes dead loads: pass Traction(stiffness=None), or solve with Newton(), got Traction.stiffness "
            "[MPa/mm]."
        )
    first = None if start is None else start.last_converged.state
    if first is not None and not isinstance(first, Motion):
        raise ValueError(
            "Explicit continues what Explicit solved, but start comes from Newton. Use one solver for both."
        )
    load_start = None if start is None else start.load
    checkpoint, solver = solver.checkpoint, dataclasses.replace(solver, checkpoint=None)
    leaves = jax.tree.leaves((palpation, load, load_start, first, solver))
    traced = any(isinstance(leaf, Tracer) for leaf in leaves)
    if traced and solver.increment == "auto":
        raise ValueError(
            'Explicit.increment [s] must be a number inside jit, grad or vmap, got "auto": the number of increments '
            'must be known. Solve once outside and take 0.9 * solution.stats["increment"].'
        )
    with Progress(progress and not traced) as bar:
        bar.stage("explicit solver", compiles=_COMPILES)
        dynamics, motion = prepare(palpation, load, load_start, solver, first, _may_need_hold(palpation))
        if traced:
            motion, history = _run_traced(dynamics, motion, solver)
        else:
            keeper = None if checkpoint is None else (checkpoint, (palpation, load, load_start, first, solver))
            motion, history = _run_on_host(dynamics, motion, solver, keeper, bar)
        bar.stage("fields")
        return _finish(dynamics, motion, history, palpation, load, solver)


@eqx.filter_jit
def prepare(
    palpation: Palpation,
    load: Load,
    load_start: Load | None,
    solver: Explicit,
    first: Motion | None,
    may_need_hold: bool = True,
) -> tuple[Dynamics, Motion]:
    """Build the dynamic problem and its initial state.

    Args:
        palpation: The experiment.
        load: The load.
        load_start: Initial load; None: none.
        solver: Settings.
        first: Initial state; None: at rest.
        may_need_hold: False where friction constrains the layer, which saves work.
    """
    problem = discretise(palpation, load, load_start, "nodes")
    if solver.precision is not None:
        problem = _cast(problem, jnp.float32)
    dtype = problem.positions.dtype
    body = problem.body
    density = jnp.asarray(solver.density, dtype) * _mass_scaling(solver, body, problem.positions, dtype)
    contacts = [face for face in problem.contacts if face is not None]
    problem = eqx.tree_at(
        lambda p: p.contacts,
        problem,
        problem.contacts.map(lambda _, face: eqx.tree_at(lambda f: (f.sides,), face, (None,), is_leaf=_is_none)),
        is_leaf=_is_none,
    )
    mass = lumped_mass(body.cells, density)
    uniform = not isinstance(palpation.layer.thickness, ThicknessMap)
    friction = sum((face.contact.friction for face in contacts), start=jnp.zeros((), dtype))
    is_damped = isinstance(solver.damping, jax.Array) or solver.damping != 0.0
    dynamics = Dynamics(
        problem=problem,
        force=LayerForce(body, uniform),
        mass=mass,
        density=density,
        viscosity=bulk_viscosity(body, tuple(jnp.asarray(b, dtype) for b in solver.bulk_viscosity), density, uniform),
        damping=jnp.asarray(solver.damping, dtype) if is_damped else None,
        duration=jnp.asarray(solver.duration, float),
        hold_active=jnp.where(friction > 0, 0.0, 1.0).astype(dtype),
        modes=orthonormal_modes(problem, mass[0]) if may_need_hold else None,
        smooth=solver.amplitude == "smooth_step",
    )
    if first is None:
        return dynamics, dynamics.at_rest()
    begun: Motion = _cast(first, dtype)
    rest = dynamics.at_rest()
    damped = None if rest.damped is None else (rest.damped if begun.damped is None else begun.damped)
    return dynamics, dataclasses.replace(begun, time=rest.time, damped=damped)


def _may_need_hold(palpation: Palpation) -> bool:
    """Return whether friction is zero on both sides, or traced."""
    sides = [side for side in (palpation.window, palpation.sample) if isinstance(side, Contact)]
    frictions = [concrete(side.friction) for side in sides]
    return all(friction is None or not np.any(friction > 0) for friction in frictions)


def _is_none(leaf: Any) -> bool:
    return leaf is None


def _cast(tree: Any, dtype: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf, tree)


def _mass_scaling(solver: Explicit, body, X: Array, dtype) -> Array:
    if not solver.is_variable:
        scaling = jnp.asarray(solver.mass_scaling, dtype)
        elements = body.cells.slope_x.shape[1:]
        if scaling.ndim and scaling.shape != elements:
            raise ValueError(
                f"Explicit.mass_scaling [-] must be a number or one per element (nz, ny, nx) = {elements}, got shape "
                f"{scaling.shape}."
            )
        return scaling
    assert not isinstance(solver.increment, str)
    needed = solver.increment / (solver.safety * _viscous_share(solver))
    own = stable_increment(body, jnp.zeros_like(X), jnp.asarray(solver.density, dtype))
    return jnp.maximum(1.0, (needed / own) ** 2)


def _viscous_share(solver: Explicit) -> Array:
    """Compute the reduction factor of the stable increment by linear bulk viscosity."""
    b1 = jnp.asarray(solver.bulk_viscosity[0])
    return jnp.sqrt(1.0 + b1**2) - b1


@eqx.filter_jit
def _stable(dynamics: Dynamics, m: Motion, solver: Explicit) -> Array:
    return solver.safety * _viscous_share(solver) * dynamics.stable_increment(m.u)


_run = eqx.filter_jit(run)
_energies = eqx.filter_jit(Dynamics.energies)
_begin_history = eqx.filter_jit(begin_history)


def _run_on_host(
    dynamics: Dynamics, motion: Motion, solver: Explicit, keeper: tuple[Checkpoint, Any] | None, bar: Progress
) -> tuple[Motion, History]:
    """Run output by output; `keeper` is the storage of the state, and the inputs that identify it."""
    count = solver.outputs
    history, done = _begin_history(dynamics, motion, count), jnp.zeros((), int)
    if keeper is not None:
        kept = keeper[0].restore(keeper[1], (motion, history, done))
        motion, history, done = (motion, history, done) if kept is None else kept
    for k in range(int(done), count):
        if is_failure(history.status(solver.energy_limit)):
            break
        end = solver.duration * (k + 1) / count
        interval = end - float(motion.time)
        longest = float(_stable(dynamics, motion, solver)) if solver.increment == "auto" else solver.increment
        steps = max(1, math.ceil(interval / longest * (1.0 - 1e-9)))
        motion = _run(dynamics, motion, jnp.asarray(interval / steps), jnp.asarray(steps))
        motion = eqx.tree_at(lambda m: m.time, motion, jnp.asarray(end, float))
        history = history.at(k + 1, motion, _energies(dynamics, motion), interval / steps, steps)
        if keeper is not None:
            keeper[0].keep(keeper[1], (motion, history, jnp.asarray(k + 1)))
        bar.show(f"time {100 * (k + 1) / count:.0f} %, {int(history.steps)} increments", (k + 1) / count, estimate=True)
    return motion, history


def _run_traced(dynamics: Dynamics, motion: Motion, solver: Explicit) -> tuple[Motion, History]:
    """Run a fixed number of increments, about √N of them between the states stored for a reverse derivative."""
    assert not isinstance(solver.increment, str)
    outputs = solver.outputs
    steps = math.ceil(solver.duration / solver.increment / outputs * (1.0 - 1e-9))  # to each output
    groups = max(1, round(math.sqrt(steps / outputs)))
    inner = math.ceil(steps / groups)
    dt = solver.duration / (outputs * groups * inner)

    @jax.checkpoint
    def group(m, _):
        under = dynamics.under(m)
        one = jax.checkpoint(lambda m, _: (dynamics.step(m, jnp.asarray(dt), under), None))
        return jax.lax.scan(one, m, None, length=inner)[0], None

    def to_output(carry, k):
        m, history = carry
        m = jax.lax.scan(group, m, None, length=groups)[0]
        return (m, history.at(k, m, dynamics.energies(m), dt, groups * inner)), None

    start = motion, begin_history(dynamics, motion, outputs)
    return jax.lax.scan(to_output, start, jnp.arange(1, outputs + 1))[0]


@eqx.filter_jit
def _finish(
    dynamics: Dynamics, m: Motion, history: History, palpation: Palpation, load: Load, solver: Explicit
) -> Solution:
    fields = recover_motion(dynamics, m, load)
    result = history.status(solver.energy_limit)
    ok = ~is_failure(result)
    none = jnp.zeros((), int)
    stats = {
        "newton_steps": none,
        "krylov_steps": none,
        "increments": history.steps,
        "attempts": history.steps,
        "load_fraction": dynamics.fraction(m.time),
        "increment": jnp.nanmin(history.increment),
        "kinetic_ratio": history.kinetic_ratio,
        "energy_drift": history.drift,
        **fields.stretches,
        "output_time": history.time,
        "output_increment": history.increment,
        **{f"energy_{name}": values for name, values in history.energies.items()},
    }

    def kept(field):
        if not jnp.issubdtype(field.dtype, jnp.inexact):
            return field
        return jnp.where(ok, field.astype(palpation.extent.dtype), jnp.nan)

    positions = dynamics.problem.positions.astype(palpation.extent.dtype)
    public = jax.tree.map(kept, (m.u, fields.sample, fields.window, fields.stress_zz, fields.stats))
    displacement, sample, window, stress_zz, more = public
    thickness = eqx.tree_at(lambda t: t.values, fields.thickness, kept(fields.thickness.values))
    return Solution(
        displacement=displacement,
        positions=positions,
        sample=sample,
        window=window,
        thickness=thickness,
        stress_zz=stress_zz,
        stats={**stats, **more},
        result=result,
        last_converged=LastConverged(m.u.astype(positions.dtype), dynamics.fraction(m.time), m),
        palpation=palpation,
        load=load,
    )
