"""One increment of explicit dynamics: central differences with velocities half an increment behind.

A pure function of its state: displacement, velocity, mean J of the elements, and the contact states of both faces. The
host loop and the differentiable scan in `explicit` run the same increment.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..mechanics.contact_body import RigidPatches
from ..mechanics.contact_face import ContactFace
from ..mechanics.face import area_vector, assemble_face, gather_face, size, surface_tangents
from ..mechanics.inertia import BulkViscosity, stable_increment
from ..mechanics.layer_force import LayerForce
from .equilibrium import Problem
from .explicit_contact import FaceMotion, Travel, still, touch
from .stencil import Nodal

# Increments that share the surface patches around the nodes; a node moves by a thousandth of a cell in them.
_REUSED = 16


class Motion(eqx.Module):
    """A state of the layer in motion.

    Attributes:
        u: Displacement at the time reached [mm].
        v: Velocity half an increment before [mm/s].
        change: Mean J - 1 of the elements one increment before [-].
        bulk: Viscous mean stress of the elements one increment before [MPa].
        window: Contact of the window face; None: none.
        sample: Contact of the interface; None: none.
        hold: Force of the in-plane hold in each rigid motion [N].
        viscous: Energy dissipated by bulk viscosity since the start [N mm].
        damped: Energy dissipated by damping since the start [N mm].
        loaded: Work of dead loads and imposed displacements since the start, by node of the interface [N mm].
        time: Since the start of the load [s].
        last: Previous increment [s]; zero at rest, so that the first is a half step.
    """

    u: Nodal
    v: Nodal
    change: Float[Array, "nz ny nx"]
    bulk: Float[Array, "nz ny nx"]
    window: FaceMotion | None
    sample: FaceMotion | None
    hold: Float[Array, "3"]
    viscous: Float[Array, "nz ny nx"]
    damped: Float[Array, "mz my mx"] | None
    loaded: Float[Array, "my mx"] | None
    time: Float[Array, ""]
    last: Float[Array, ""]

    @property
    def mean_stress(self) -> None:
        """Mean stress is no unknown."""
        return None


class Dynamics(eqx.Module):
    """The layer in motion under a load.

    Attributes:
        problem: The discrete problem.
        force: Internal force.
        mass: Lumped mass of the nodes [t].
        density: Scaled density of the elements [t/mm³].
        viscosity: Bulk viscosity.
        damping: Damping proportional to mass [1/s]; None: none.
        duration: Of the load [s].
        hold_active: 1 where the in-plane hold constrains rigid motion, without friction; else 0.
        modes: Rigid in-plane motions of the window face that it constrains, orthonormal in 1/mass.
        smooth: Whether the load follows a smooth step, or grows evenly.
    """

    problem: Problem
    force: LayerForce
    mass: Float[Array, "mz my mx"]
    density: Array
    viscosity: BulkViscosity
    damping: Array | None
    duration: Array
    hold_active: Array
    modes: Float[Array, "modes 2 my mx"] | None
    smooth: bool = eqx.field(static=True)

    def at_rest(self) -> Motion:
        """Build the undeformed layer at rest."""
        u = jnp.zeros_like(self.problem.positions)
        no_element = jnp.zeros(self.problem.elements, u.dtype)
        faces = self.problem.contacts.map(lambda body, face: still(face, u[:, 0]))
        zero = jnp.zeros((), u.dtype)
        return Motion(
            u,
            u,
            no_element,
            no_element,
            *faces,
            jnp.zeros(3, u.dtype),
            no_element,
            None if self.damping is None else u[0],
            u[0, -1] if self._is_loaded else None,
            jnp.zeros((), float),
            zero,
        )

    def fraction(self, time: Array) -> Array:
        """Compute the load fraction at a time."""
        t = jnp.clip(time / self.duration, 0.0, 1.0)
        return (t**3 * (10.0 + t * (6.0 * t - 15.0)) if self.smooth else t).astype(self.mass.dtype)

    def stable_increment(self, u: Nodal) -> Array:
        """Estimate the stable increment [s] of the layer, without bulk viscosity."""
        return jnp.min(stable_increment(self.force.body, u, self.density))

    def under(self, m: Motion) -> RigidPatches | None:
        """Gather patches of the sample's surface around the nodes of the interface."""
        face = self.problem.contacts.sample
        x, y, _ = self.problem.positions[:, -1] + m.u[:, -1]
        return None if face is None else face.surface.around(x, y)

    def step(self, m: Motion, dt: Array, under: RigidPatches | None) -> Motion:
        """Advance by one increment dt [s], with surface patches around current or recent positions of the nodes."""
        problem, dtype = self.problem, m.u.dtype
        dt = jnp.asarray(dt, dtype)
        mean = 0.5 * (m.last + dt)  # between the middles of the last and of this increment
        end_time = m.time + dt
        earlier, now = self.fraction(m.time - m.last), self.fraction(m.time)
        travel = Travel(earlier, now, self.fraction(end_time), dt, mean / dt)
        before = jnp.where(m.last > 0, m.last, 1.0)  # nothing has moved before the first increment

        internal, change = self.force(
            m.u, lambda now, viscosity, change: viscosity(now, change, before), self.viscosity, m.change
        )
        drag = 0.0 if self.damping is None else 0.5 * self.damping * mean
        free = self._free()
        v = ((1.0 - drag) * m.v - (mean / self.mass) * internal) / (1.0 + drag)
        v = v if free is None else v * free
        v, hold = self._held(self._pulled(m, v, mean, dt), mean)

        mobility = dt * mean / self.mass
        window, sample, loaded = m.window, m.sample, m.loaded
        below, above = dt * v[:, 0], dt * v[:, -1]
        if problem.dead is not None:
            start, end = problem.dead
            dead = (1.0 - travel.end) * start + travel.end * end
            above = above + mobility[-1] * dead
        if problem.contacts.window is not None:
            below, window = self._touch("window", m, None, below, mobility, travel)
        if problem.contacts.sample is not None:
            above, sample = self._touch("sample", m, under, above, mobility, travel)
        if problem.dead is not None and loaded is not None:
            loaded = loaded + 0.5 * mean * jnp.sum(dead * (m.v[:, -1] + above / dt), axis=0)
        if problem.imposed is not None and loaded is not None:
            low, high = problem.imposed
            needed = (1.0 - travel.end) * low + travel.end * high - m.u[2, -1]
            pushed = (needed - above[2]) / mobility[-1]
            above = above.at[2].set(needed)
            loaded = loaded + 0.5 * mean * pushed * (m.v[2, -1] + needed / dt)
        v = v.at[:, 0].set(below / dt).at[:, -1].set(above / dt)
        u = m.u + dt * v

        bulk = self.viscosity(change, m.change, before)
        viscous = m.viscous + 0.5 * (m.bulk + bulk) * (change - m.change) * self.force.body.cells.volume[0]
        damped = m.damped
        if self.damping is not None and damped is not None:
            damped = damped + 0.25 * mean * self.damping * self.mass * jnp.sum((v + m.v) ** 2, axis=0)
        return Motion(u, v, change, bulk, window, sample, hold, viscous, damped, loaded, end_time, dt)

    @property
    def _is_loaded(self) -> bool:
        return self.problem.dead is not None or self.problem.imposed is not None

    def energies(self, m: Motion) -> dict[str, Array]:
        """Compute all energies [N mm] in the middle of the last increment, and their balance.

        Velocities are known there, and work is summed up to there.
        """
        works = [face.work for face in (m.window, m.sample) if face is not None]

        def total(*parts):
            return sum((jnp.sum(part) for part in parts if part is not None), start=jnp.zeros((), self.mass.dtype))

        spent = {
            "strain": _widest(self.force.body).energy(_widest(m.u) - 0.5 * _widest(m.last) * _widest(m.v)),
            "kinetic": 0.5 * jnp.sum(self.mass * m.v**2),
            "contact": total(*(work.contact for work in works)),
            "friction": total(*(work.friction for work in works)),
            "viscous": total(m.viscous),
            "damping": total(m.damped),
        }
        external = total(m.loaded, *(work.external for work in works))
        return {**spent, "external": external, "total": sum(spent.values()) - external}

    def _free(self) -> Array | None:
        free = self.problem.supports.free(self.problem.positions.shape[1:])
        if self.problem.imposed is not None:
            free[2, -1] = 1.0  # displacement of these nodes is imposed, and its work is summed
        return None if free.all() else jnp.asarray(free, self.mass.dtype)

    def _pulled(self, m: Motion, v: Nodal, mean: Array, dt: Array) -> Nodal:
        if self.problem.spring is None:
            return v
        rate = self.problem.spring / self.mass[0]
        pulled = (v[:2, 0] - mean * rate * m.u[:2, 0]) / (1.0 + mean * dt * rate)
        return v.at[:2, 0].set(pulled)

    def _held(self, v: Nodal, mean: Array) -> tuple[Nodal, Array]:
        """Project rigid in-plane motion of the window face out of the velocity; also return its force [N]."""
        none = jnp.zeros(3, v.dtype)
        if self.modes is None:
            return v, none
        along = self.hold_active * jnp.tensordot(self.modes, v[:2, 0], 3)
        constrained = v.at[:2, 0].add(-jnp.tensordot(along, self.modes, 1) / self.mass[0])
        return constrained, none.at[: len(along)].set(-along / mean)

    def _touch(self, body: str, m: Motion, under: RigidPatches | None, move: Array, mobility: Array, travel: Travel):
        """Return the displacement of a face in the increment, and its new contact state."""
        face: ContactFace = getattr(self.problem.contacts, body)
        level = 0 if body == "window" else -1
        here = self.problem.positions[:, level] + m.u[:, level]
        area = nodal_area(here, face) if face.imposed is None else jnp.zeros_like(here[0])
        last, mobility = m.v[:, level] * travel.increment, mobility[level]
        added, motion = touch(face, getattr(m, body), under, here + move, move, last, mobility, area, travel)
        return move + added, motion


def nodal_area(x: Float[Array, "3 my mx"], face: ContactFace) -> Float[Array, "my mx"]:
    """Compute each node's share of the current area [mm²]."""
    corners = gather_face(x)
    _, xi, eta = surface_tangents(corners, "nodes")
    area = size(area_vector(xi, eta))
    if face.shares is not None:
        area = area * face.shares[:, : area[0].size].reshape(area.shape)
    return assemble_face(0.25 * area)


def _widest(tree: Any) -> Any:
    """Convert numbers to the widest precision in use: an energy density is a small difference of large numbers."""
    return jax.tree.map(lambda leaf: leaf.astype(float) if eqx.is_inexact_array(leaf) else leaf, tree)


def orthonormal_modes(problem: Problem, mass: Float[Array, "my mx"]) -> Float[Array, "modes 2 my mx"] | None:
    """Build the rigid motions that only friction resists, orthonormal when weighted by 1/mass."""
    modes = problem.drift_modes
    if modes is None:
        return None
    ready: list[Array] = []
    for mode in modes:
        for other in ready:
            mode = mode - jnp.sum(mode * other / mass) * other
        ready.append(mode / jnp.sqrt(jnp.sum(mode**2 / mass)))
    return jnp.stack(ready)


def run(dynamics: Dynamics, m: Motion, dt: Array, steps: Array) -> Motion:
    """Advance by equal increments."""

    def group(k, m):
        return several(dynamics, m, dt, jnp.minimum(_REUSED, steps - k * _REUSED))

    return jax.lax.fori_loop(0, (steps + _REUSED - 1) // _REUSED, group, m)


def several(dynamics: Dynamics, m: Motion, dt: Array, steps: Array) -> Motion:
    """Advance by a few equal increments over the same surface patches: gathering them is slow."""
    under = dynamics.under(m)
    return jax.lax.fori_loop(0, steps, lambda _, m: dynamics.step(m, dt, under), m)
