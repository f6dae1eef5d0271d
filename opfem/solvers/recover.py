"""Recovery of results from a converged state: pressures, tractions, slip, thickness, forces."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..measurement import ThicknessMap
from ..mechanics.boundary import Bodies, Body, Touching, put, take, to_touching
from ..mechanics.contact_face import ContactFace
from ..mechanics.contact_state import PointContact
from ..mechanics.face import (
    area_vector,
    filled_vertices,
    nodal_area_vector,
    size,
    to_corners,
    tributary_area,
)
from ..mechanics.interface_point import NodalField, locate
from ..model import Compression, Imprint, Load, extreme_stretches
from .equilibrium import Problem, State
from .solution import OPEN, SLIP, STICK, FaceResult


class Fields(eqx.Module):
    """Everything recovered from one converged state."""

    sample: FaceResult
    window: FaceResult
    thickness: ThicknessMap
    stress_zz: Float[Array, "ny nx"]
    stretches: dict[str, Array]
    stats: dict[str, Array]


def recover(problem: Problem, before: State, state: State, load: Load) -> Fields:
    """Recover the fields of a state, given the one its last increment started from."""
    u = state.u
    forces = problem.reactions(problem.forces(state.unknowns, state.fraction, before))
    hold = problem.hold_force(forces, state.hold_active)
    _, stress, _ = problem.body.fields(u, state.mean_stress)
    applied = forces.applied
    sample, sample_stats = face_result(
        problem, "sample", problem.supports.interface, before, state, applied.sample.face
    )
    window, window_stats = face_result(problem, "window", problem.supports.window, before, state, applied.window.face)
    dissipated = [history.dissipated for history in state.histories if history is not None]
    x = problem.positions + u
    hold = jnp.concatenate([hold, jnp.zeros_like(hold[:1])])
    on_layer = {
        "sample": put(applied.sample, "sample", x.shape),
        "window": put(applied.window, "window", x.shape),
        "hold": put(Touching(hold, None), "window", x.shape),
    }
    stats = {
        **{f"force_{name}": jnp.sum(force, axis=(1, 2, 3)) for name, force in on_layer.items()},
        **{f"moment_{name}": jnp.sum(jnp.cross(x, force, axis=0), axis=(1, 2, 3)) for name, force in on_layer.items()},
        "work_sample": state.work.sample,
        "work_window": state.work.window,
        "strain_energy": problem.body.energy(u, state.mean_stress),
        "friction_dissipation": sum(dissipated, start=jnp.zeros((), u.dtype)),
        "approach": sample_stats["approach"],
        "max_penetration": jnp.maximum(sample_stats["max_penetration"], window_stats["max_penetration"]),
        "side_overlap": side_overlap(problem, state),
        "min_volume_ratio": forces.smallest_J,
    }
    top = problem.body.cells.element_mean(stress[2, 2], problem.body.field_volume())[-1]
    return Fields(
        sample,
        window,
        deformed_thickness(problem.positions[:, -1], u[:, -1], load),
        top,
        reached_stretches(problem, u),
        stats,
    )


def side_overlap(problem: Problem, state: State) -> Array:
    """Compute the largest overlap of the layer's sides with window or sample [mm]."""
    deepest = jnp.zeros((), state.u.dtype)
    for body, face in zip(Bodies._fields, problem.contacts, strict=True):
        if face is not None and face.imposed is None:
            corners = take(problem.positions + state.u, body, with_sides=True)
            sides = corners[..., int(np.prod(problem.elements[1:])) :]
            deepest = jnp.maximum(deepest, -jnp.min(face.clearance(face.locate(state.fraction, sides))))
    return deepest


def reached_stretches(problem: Problem, u: Array) -> dict[str, Array]:
    """Find the smallest and the largest principal stretch in the layer."""
    smallest, largest = extreme_stretches(problem.body.kinematics(u))
    return {"min_stretch": smallest, "max_stretch": largest}


def face_result(
    problem: Problem, body: Body, support: str, before: State, state: State, force: Array
) -> tuple[FaceResult, dict[str, Array]]:
    """Recover the contact fields of one face of a body, and its least clearance."""
    face, old, new = (getattr(bodies, body) for bodies in (problem.contacts, before.histories, state.histories))
    level = 0 if body == "window" else -1
    X, u = problem.positions[:, level], state.u[:, level]
    x = X + u
    cells = problem.body.cells.name

    def filled(values):
        return filled_vertices(values, cells)

    pressure, traction = per_area(problem, body, u, force)
    zero = jnp.zeros((), x.dtype)
    if face is None:
        sticks = support == "bonded"
        status = jnp.full(pressure.shape, STICK if sticks else SLIP)
        slip = jnp.zeros_like(x[:2]) if sticks else u[:2]
        return FaceResult(pressure, traction, slip, status), {"approach": zero, "max_penetration": zero}
    corners = take(problem.positions + state.u, body, with_sides=False)
    old, new = (jax.tree.map(lambda v: v[..., : corners.shape[-1]] if v.ndim else v, history) for history in (old, new))
    points = face.locate(state.fraction, corners)

    def on_nodes(values):
        return filled(to_touching(to_corners(values, face.rule), problem.elements).face)

    weight = size(area_vector(*points.tangents))
    weight = weight if face.shares is None else weight * face.shares[:, : weight.shape[1]]
    slip, status, stats = at_nodes(face, face.at_points(points, old), new.slip, weight, on_nodes)
    return FaceResult(pressure, traction, slip, status), stats


def at_nodes(
    face: ContactFace, point: PointContact, slip: Array, weight: Array, on_nodes: Callable[[Array], Array]
) -> tuple[Array, Array, dict[str, Array]]:
    """Average contact at the points of a face over its nodes: slip [mm] and status; and compute the approach [mm].

    Args:
        face: The face.
        point: Contact at its points.
        slip: Slip since the start at its points [mm].
        weight: Quadrature weight of the points [mm²].
        on_nodes: Integrates values at the points, per unit of (ξ, η), with the shape functions of the nodes.
    """
    load = jnp.where(point.pressure > 0, point.pressure * weight, 0.0)
    share = on_nodes(jnp.stack([weight, load, load * point.slips], axis=1))
    status = jnp.where(share[1] > 0, jnp.where(share[2] > 0.5 * share[1], SLIP, STICK), OPEN)
    slip = on_nodes(jnp.moveaxis(slip * weight, 1, 0)) / jnp.where(share[0] > 0, share[0], 1.0)
    if face.imposed is not None:
        zero = jnp.zeros((), weight.dtype)
        return slip, status, {"approach": zero, "max_penetration": zero}
    total = jnp.sum(load)
    towards = face.own_contact.law.zero_pressure_clearance - point.clearance
    closed = jnp.where(point.pressure > 0, -point.clearance, 0.0)
    return (
        slip,
        status,
        {
            "approach": jnp.sum(load * towards) / jnp.where(total > 0, total, 1.0),
            "max_penetration": jnp.maximum(jnp.max(closed), 0.0),
        },
    )


def per_area(problem: Problem, body: Body, u: Array, force: Array) -> tuple[Array, Array]:
    """Convert nodal forces [N] of a body to pressure on the current area and traction per reference area [MPa].

    Args:
        problem: The discrete problem.
        body: Name of the face.
        u: Displacement of that face [mm], `(3, ny+1, nx+1)`.
        force: Nodal force on the layer, same shape.
    """
    cells, X = problem.body.cells.name, problem.positions[:, 0 if body == "window" else -1]
    force, area = (filled_vertices(values, cells) for values in (force, nodal_area_vector(X + u, cells)))
    outward = area if body == "sample" else -area
    pressure = -jnp.sum(force * outward, axis=0) / jnp.sum(outward**2, axis=0)
    return pressure, force / filled_vertices(tributary_area(X, cells), cells)


def deformed_thickness(
    X: Float[Array, "3 my mx"], u: Float[Array, "3 my mx"], load: Load | Compression
) -> ThicknessMap:
    """Sample the deformed interface at the load's grid points, or at the mesh's; masked where there is none.

    Args:
        X: Reference positions of the interface's nodes [mm].
        u: Their displacement [mm].
        load: The load.
    """
    far = X[:2, -1, -1]
    size = far / jnp.array([X.shape[2] - 1, X.shape[1] - 1])
    if isinstance(load, Imprint):
        grid = load.thickness
        extent, origin = grid.extent, grid.origin
        y, x = jnp.meshgrid(grid.y, grid.x, indexing="ij")
    else:
        extent, origin = far, jnp.zeros(2, u.dtype)
        x, y = X[0], X[1]
    below = locate(NodalField(u[:2], size), jnp.stack([x, y]), far, size)
    height, _, _ = NodalField((X + u)[2:], size)(*below.at)
    return ThicknessMap(height[0], extent=extent, origin=origin, mask=~jnp.all(below.found, axis=0), is_filled=True)
