"""From the converged state of a layer and a sample to what users read."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..measurement import ThicknessMap
from ..mechanics.boundary import take, to_touching
from ..mechanics.face import to_corners
from ..model import Compression, extreme_stretches
from .equations import State
from .equilibrium import Problem
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


def recover_experiment(problem: Stack, before: State, state: State, load: Compression) -> ExperimentFields:
    """Recover the fields of a state, given the one its last increment started from."""
    forces = problem.forces(state.unknowns, state.fraction, before)
    lower, upper = (body.reactions(f) for body, f in zip(problem.bodies, forces.bodies, strict=True))
    layer, sample = problem.bodies
    (low_before, up_before), (low, up) = parts(before), parts(state)
    window, window_stats = face_result(
        layer, "window", layer.supports.window, low_before, low, lower.applied.window.face
    )
    plate, plate_stats = face_result(
        sample, "sample", sample.supports.interface, up_before, up, upper.applied.sample.face
    )
    interface, pair_stats = _interface(problem, before, state, lower.applied.sample.face)
    histories = [h for body in state.histories[:2] for h in body if h is not None] + [state.histories[2]]
    hold = [body.hold_force(f, state.held) for body, f in zip(problem.bodies, (lower, upper), strict=True)]
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
        "min_volume_ratio": forces.smallest_J,
    }
    # The layer's own thickness: contact with the window may leave a gap.
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
