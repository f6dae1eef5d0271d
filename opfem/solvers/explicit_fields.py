"""Recovery of results from explicit dynamics: the same fields as those of the implicit solver."""

import jax.numpy as jnp
from jaxtyping import Array

from ..mechanics.boundary import Bodies, Body, Touching
from ..model import Load
from .equilibrium import Forces
from .explicit_contact import FaceMotion
from .explicit_step import Dynamics, Motion
from .recover import Fields, deformed_thickness, per_area, reached_stretches
from .solution import OPEN, SLIP, STICK, FaceResult


def recover_motion(dynamics: Dynamics, m: Motion, load: Load) -> Fields:
    """Recover the fields of a state; contact forces are those of its last increment."""
    problem, u = dynamics.problem, m.u
    internal, smallest_J = dynamics.force.body.internal_force(u)
    nothing = jnp.zeros_like(u[:, 0])
    window, sample = (nothing if face is None else face.force for face in (m.window, m.sample))
    fraction = dynamics.fraction(m.time)
    if problem.dead is not None:
        start, end = problem.dead
        sample = sample + (1.0 - fraction) * start + fraction * end
    applied = Bodies(Touching(window, None), Touching(sample, None))
    forces = problem.reactions(Forces(internal, None, applied, None, smallest_J))
    window, sample = (touching.face for touching in forces.applied)
    hold = nothing if dynamics.modes is None else _hold(dynamics, m)
    if problem.spring is not None:
        hold = hold.at[:2].add(-problem.spring * u[:2, 0])
    x = problem.positions + u
    acting = {"sample": (sample, x[:, -1]), "window": (window, x[:, 0]), "hold": (hold, x[:, 0])}
    energies = dynamics.energies(m)
    stats = {
        **{f"force_{name}": jnp.sum(force, axis=(1, 2)) for name, (force, _) in acting.items()},
        **{f"moment_{name}": jnp.sum(jnp.cross(at, f, axis=0), axis=(1, 2)) for name, (f, at) in acting.items()},
        "work_sample": energies["external"] - energies["contact"] - energies["friction"],
        "work_window": jnp.zeros_like(energies["external"]),
        "strain_energy": dynamics.force.body.energy(u),
        "friction_dissipation": energies["friction"],
        "approach": _approach(dynamics, m),
        "max_penetration": _penetration(dynamics, m),
        "min_volume_ratio": smallest_J,
        "residual": _residual(dynamics, forces, hold),
    }
    _, stress, _ = dynamics.force.body.fields(u)
    top = problem.body.cells.element_mean(stress[2, 2], problem.body.field_volume())[-1]
    return Fields(
        _face(dynamics, "sample", m.sample, u, sample),
        _face(dynamics, "window", m.window, u, window),
        deformed_thickness(problem.positions[:, -1], u[:, -1], load),
        top,
        reached_stretches(problem, u),
        stats,
    )


def _face(dynamics: Dynamics, body: Body, motion: FaceMotion | None, u: Array, force: Array) -> FaceResult:
    problem, level = dynamics.problem, 0 if body == "window" else -1
    pressure, traction = per_area(problem, body, u[:, level], force)
    if motion is None:
        supports = problem.supports
        sticks = (supports.window if body == "window" else supports.interface) == "bonded"
        slip = jnp.zeros_like(u[:2, level]) if sticks else u[:2, level]
        return FaceResult(pressure, traction, slip, jnp.full(pressure.shape, STICK if sticks else SLIP))
    closed = jnp.any(motion.force != 0, axis=0)
    status = jnp.where(closed, jnp.where(motion.slips > 0, SLIP, STICK), OPEN)
    return FaceResult(pressure, traction, motion.slip, status)


def _hold(dynamics: Dynamics, m: Motion) -> Array:
    modes = dynamics.modes
    assert modes is not None
    lateral = jnp.tensordot(m.hold[: len(modes)], modes, 1)
    return jnp.concatenate([lateral, jnp.zeros_like(lateral[:1])])


def _approach(dynamics: Dynamics, m: Motion) -> Array:
    """Average over the load how far the sample's law lets the bodies approach [mm]."""
    face = dynamics.problem.contacts.sample
    zero = jnp.zeros((), m.u.dtype)
    if face is None or m.sample is None or face.imposed is not None:
        return zero
    load = jnp.sqrt(jnp.sum(m.sample.normal**2, axis=0))
    towards = face.contact.law.zero_pressure_clearance - _clearance(dynamics, m, "sample")
    total = jnp.sum(load)
    return jnp.where(total > 0, jnp.sum(load * towards) / jnp.where(total > 0, total, 1.0), zero)


def _penetration(dynamics: Dynamics, m: Motion) -> Array:
    """Find the largest penetration of a node [mm]."""
    depths = [jnp.zeros((), m.u.dtype)]
    for body in Bodies._fields:
        face = getattr(dynamics.problem.contacts, body)
        if face is not None and face.imposed is None:
            depths.append(jnp.max(-_clearance(dynamics, m, body)))
    return jnp.max(jnp.stack(depths))


def _clearance(dynamics: Dynamics, m: Motion, body: str) -> Array:
    face = getattr(dynamics.problem.contacts, body)
    x = (dynamics.problem.positions + m.u)[:, 0 if body == "window" else -1]
    height, slope_x, slope_y = face.surface.at(dynamics.fraction(m.time), x[0], x[1])
    side = 1.0 if face.above else -1.0
    return (side * (height - x[2]) + face.offset) / jnp.sqrt(1.0 + slope_x**2 + slope_y**2)


def _residual(dynamics: Dynamics, forces: Forces, hold: Array) -> Array:
    """Compute the inertial force over the contact force, a measure of quasi-static equilibrium [-]."""
    problem = dynamics.problem
    unbalanced = problem.unbalanced(forces) * problem.free
    unbalanced = unbalanced.at[:, 0].add(-hold)
    return jnp.sqrt(jnp.sum(unbalanced**2)) / problem.force_scale(forces)
