"""Recovery of results from the converged state of a layer and a sample."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..measurement import ThicknessMap
from ..mechanics.boundary import Bodies, take, to_touching
from ..mechanics.face import to_corners
from ..model import Compression, Experiment, extreme_stretches
from .equations import State
from .equilibrium import Forces, Problem
from .experiment import single_bodies
from .recover import at_nodes, deformed_thickness, face_result, per_area
from .solution import BodyResult, FaceResult
from .stack import Stack, parts


class ExperimentFields(eqx.Module):
    """Everything recovered from one converged state."""

    layer: BodyResult
    sample: BodyResult
    window: FaceResult
    interface: FaceResult
    plate: FaceResult
    thickness: ThicknessMap
    stats: dict[str, Array]


class _Single(NamedTuple):
    """One body: its problem, initial and final state of its last increment, and its forces at the end."""

    problem: Problem
    before: State
    state: State
    forces: Forces


def recover_experiment(
    problem: Stack | Problem, before: State, state: State, experiment: Experiment, load: Compression
) -> ExperimentFields:
    """Recover the fields of a state, given the one its last increment started from."""
    if isinstance(problem, Stack):
        bodies, hold = _of_stack(problem, before, state)
    else:
        bodies, hold = _of_block(problem, before, state, experiment, load)
    (layer, low_before, low, lower), (sample, up_before, up, upper) = bodies
    window, window_stats = face_result(
        layer, "window", layer.supports.window, low_before, low, lower.applied.window.face
    )
    plate, plate_stats = face_result(
        sample, "sample", sample.supports.interface, up_before, up, upper.applied.sample.face
    )
    histories = [h for h in (*low.histories, *up.histories) if h is not None]
    if isinstance(problem, Stack):
        interface, pair_stats = _interface(problem, before, state, lower.applied.sample.face)
        histories.append(state.histories[2])
    else:
        interface, pair_stats = face_result(layer, "sample", "bonded", low_before, low, lower.applied.sample.face)
    u = low.u
    stats = {
        "force_sample": lower.applied.sample.total,
        "force_window": lower.applied.window.total,
        "force_plate": upper.applied.sample.total,
        "force_hold": sum(jnp.concatenate([jnp.sum(h, axis=(1, 2)), jnp.zeros(1, h.dtype)]) for h in hold),
        "work_plate": up.work.sample,
        "work_window": low.work.window,
        "strain_energy": layer.body.energy(low.u, low.mean_stress) + sample.body.energy(up.u, up.mean_stress),
        "friction_dissipation": sum((h.dissipated for h in histories), start=jnp.zeros((), u.dtype)),
        "approach": pair_stats["approach"],
        "max_penetration": jnp.stack([s["max_penetration"] for s in (window_stats, pair_stats, plate_stats)]).max(),
        "min_volume_ratio": jnp.minimum(lower.smallest_J, upper.smallest_J),
    }
    # The thickness of the layer itself: there may be a gap at the window.
    own = u[:, -1] - jnp.concatenate([jnp.zeros_like(u[:2, 0]), u[2:, 0]])
    return ExperimentFields(
        layer=_result(layer, low),
        sample=_result(sample, up),
        window=window,
        interface=interface,
        plate=plate,
        thickness=deformed_thickness(layer.positions[:, -1], own, load),
        stats=stats,
    )


def _of_stack(problem: Stack, before: State, state: State) -> tuple[list[_Single], list[Array]]:
    """Split a stack into its bodies, with the hold force on each."""
    of_bodies = problem.forces(state.unknowns, state.fraction, before).bodies
    forces = [body.reactions(f) for body, f in zip(problem.bodies, of_bodies, strict=True)]
    holds = zip(problem.bodies, forces, problem.holds(state.hold_active), strict=True)
    singles = zip(problem.bodies, parts(before), parts(state), forces, strict=True)
    return [_Single(*single) for single in singles], [body.hold_force(f, hold_active) for body, f, hold_active in holds]


def _of_block(
    block: Problem, before: State, state: State, experiment: Experiment, load: Compression
) -> tuple[list[_Single], list[Array]]:
    """Split a block at its interface into bodies, each with the interface force of the other."""
    hold = block.hold_force(block.reactions(block.forces(state.unknowns, state.fraction, before)), state.hold_active)
    contacts = Bodies(block.contacts.window, None), Bodies(None, block.contacts.sample)
    nz = experiment.layer_elements[2]
    singles = []
    # Quadrature and start are irrelevant: contacts are those of the block.
    for own, body, nodes, elements in zip(
        contacts,
        single_bodies(experiment, load, None, "gauss2"),
        (slice(None, nz + 1), slice(nz, None)),
        (slice(None, nz), slice(nz, None)),
        strict=True,
    ):
        single = dataclasses.replace(body, contacts=own, viscosity=block.viscosity, spring=None)
        at, last = (_cut(s, own, nodes, elements) for s in (before, state))
        singles.append(_Single(single, at, last, single.reactions(single.forces(last.unknowns, last.fraction, at))))
    return singles, [hold]


def _cut(state: State, contacts: Bodies, nodes: slice, elements: slice) -> State:
    """Extract one body's part of the state of a block."""
    stress = None if state.mean_stress is None else state.mean_stress[elements]
    histories = contacts.map(lambda _, __, history: history, state.histories)
    return dataclasses.replace(state, u=state.u[:, nodes], mean_stress=stress, histories=histories)


def _result(problem: Problem, state: State) -> BodyResult:
    body = problem.body
    _, stress, _ = body.fields(state.u, state.mean_stress)
    smallest, largest = extreme_stretches(body.kinematics(state.u))
    return BodyResult(
        displacement=state.u,
        positions=problem.positions,
        mean_stress=state.mean_stress,
        stress=body.cells.element_mean(stress, body.field_volume()),
        min_stretch=smallest,
        max_stretch=largest,
    )


def _interface(
    problem: Stack, before: State, state: State, force: Float[Array, "3 my mx"]
) -> tuple[FaceResult, dict[str, Array]]:
    layer, pair = problem.lower, problem.pair
    pressure, traction = per_area(layer, "sample", state.u[0][:, -1], force)
    corners = take(layer.positions + state.u[0], "sample", with_sides=False)
    upper = (problem.upper.positions + state.u[1])[:, 0]
    points = pair.locate(state.fraction, corners, upper, before.histories[2])

    def on_nodes(values):
        return to_touching(to_corners(values, pair.face.rule), layer.elements).face

    point = pair.at_points(points, before.histories[2])
    slip, status, stats = at_nodes(pair.face, point, state.histories[2].slip, pair.area(points), on_nodes)
    return FaceResult(pressure, traction, slip, status), stats
