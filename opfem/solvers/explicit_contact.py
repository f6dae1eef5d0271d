"""Kinematic contact of explicit dynamics between a rigid body and the nodes of a face.

Pure master–slave: nodes move from their predicted position without contact to the one that satisfies the law at the end
of the increment. The contact force follows from this correction; without a penalty, contact does not reduce the stable
increment. The weight of a balanced pair (0.5 in the published decks) has no effect against a rigid body.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..mechanics.contact_body import RigidPatches
from ..mechanics.contact_face import ContactFace
from ..mechanics.face import to_nodes
from ..model import HardOverclosure

Face = Float[Array, "my mx"]
FaceVector = Float[Array, "3 my mx"]

# Newton steps of the pressure equation, from the last increment's clearance; convergence is quadratic.
_PRESSURE_STEPS = 4
# A node slips from this share of the friction limit on, as in the implicit solver.
_AT_LIMIT = 0.9


class Work(NamedTuple):
    """Energy [N mm] of one node since the start: contact, friction, and work of the body's motion."""

    contact: Face
    friction: Face
    external: Face


class FaceMotion(eqx.Module):
    """State of the contact of one face between increments.

    Attributes:
        clearance: Initial guess of the pressure equation [mm].
        normal: Force of the body on the layer along the surface's normal [N].
        friction: The tangential rest [N].
        slip: Slip along x and y since the start [mm].
        slips: 1 where friction is at its limit, or within a tenth of it, else 0.
        work: Energies of every node since the start.
    """

    clearance: Face
    normal: FaceVector
    friction: FaceVector
    slip: Float[Array, "2 my mx"]
    slips: Face
    work: Work

    @property
    def force(self) -> FaceVector:
        """Force of the body on the layer [N]."""
        return self.normal + self.friction


class Travel(NamedTuple):
    """The current increment.

    Attributes:
        before: Load fraction at the start of the previous increment.
        start: Load fraction at the start of this one.
        end: Load fraction at its end.
        increment: Length of the increment [s].
        share: The time in which its forces act, from the middle of the increment before to its own, over its length.
    """

    before: Array
    start: Array
    end: Array
    increment: Array
    share: Array


def still(face: ContactFace, x: FaceVector) -> FaceMotion:
    """Initialise a face without contact."""
    zero = jnp.zeros_like(x)
    # The law is open there, so that the first pressure equation starts at the predicted position.
    clearance = jnp.full_like(x[0], 1.0) * face.own_contact.law.zero_pressure_clearance
    return FaceMotion(clearance, zero, zero, zero[:2], zero[0], Work(*zero))


def touch(
    face: ContactFace,
    motion: FaceMotion,
    under: RigidPatches | None,
    trial: FaceVector,
    move: FaceVector,
    last_move: FaceVector,
    mobility: Face,
    area: Face,
    travel: Travel,
) -> tuple[FaceVector, FaceMotion]:
    """Move the nodes of a face to where the contact law is satisfied at the end of the increment.

    Args:
        face: The contact.
        motion: Its state.
        under: The body's surface around the nodes; None for the plane z = 0.
        trial: Position at the end of the increment without contact [mm].
        move: Displacement in the increment without contact [mm].
        last_move: Displacement in the increment at the previous velocity [mm].
        mobility: Displacement per force within the increment [mm/N].
        area: Current area of each node [mm²].
        travel: Travel of the body.

    Returns:
        Correction of the displacement by contact, and the new state.
    """
    side = 1.0 if face.above else -1.0
    zero = jnp.zeros_like(area)
    height, slope_x, slope_y, lift = (zero,) * 4 if under is None else under.at(travel.end, trial[0], trial[1])
    stretch = jnp.sqrt(1.0 + slope_x**2 + slope_y**2)
    normal = jnp.stack([-slope_x, -slope_y, jnp.ones_like(slope_x)]) / stretch
    if face.imposed is not None:  # a dead load is applied elsewhere; here it bounds friction
        clearance, push = motion.clearance, imposed_force(face, travel.end, area.shape)
        added = jnp.zeros_like(move)
    else:
        free = (side * (height - trial[2]) + face.offset) / stretch
        clearance, push = _push(face, motion.clearance, free, mobility, area)
        added = -side * (push * mobility) * normal
    d = (move + added)[:2]
    along = jnp.stack([d[0], d[1], slope_x * d[0] + slope_y * d[1]])
    squared = jnp.sum(along**2, axis=0)
    length = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    limit = face.own_contact.friction * push * mobility  # as a displacement
    share = jnp.where(squared > 0, jnp.minimum(limit / length, 1.0), 0.0)
    added = added - share * along
    normal_force = jnp.zeros_like(move) if face.imposed is not None else -side * push * normal
    friction = -share * along / mobility
    closed = push > 0
    slips = (closed & (squared > 0) & (length > _AT_LIMIT * limit)).astype(push.dtype)
    slip = motion.slip + jnp.where(closed, (1.0 - share) * d, 0.0)
    moved = 0.5 * travel.share * (last_move + move + added)
    lifted = 0.5 * lift * (travel.end - travel.before)
    relative = jnp.stack([moved[0], moved[1], moved[2] - lifted])
    work = Work(
        contact=motion.work.contact - jnp.sum(normal_force * relative, axis=0),
        friction=motion.work.friction - jnp.sum(friction * relative, axis=0),
        external=motion.work.external + (normal_force[2] + friction[2]) * lifted,
    )
    return added, FaceMotion(clearance, normal_force, friction, slip, slips, work)


def imposed_force(face: ContactFace, fraction: Array, shape: tuple[int, ...]) -> Face:
    """Compute the dead normal force of a node [N] that bounds its friction."""
    assert face.imposed is not None
    ny, nx = shape[0] - 1, shape[1] - 1
    pressure = face.imposed.bounding(fraction, face.rule, 0.0) * face.imposed.area
    return to_nodes(pressure.reshape(-1, ny, nx), face.rule)


def _push(face: ContactFace, guess: Face, free: Face, mobility: Face, area: Face) -> tuple[Face, Face]:
    """Solve clearance = free + mobility · area · p(clearance) for the clearance and the normal force [N].

    The right side decreases and the left side increases, so that there is one root. The last step is linear in
    everything except its initial clearance, so that its derivative is that of the root.
    """
    law = face.own_contact.law
    if isinstance(law, HardOverclosure):
        return free, jnp.maximum(-free, 0.0) / mobility
    give = mobility * area

    def newton(clearance):
        one = jnp.ones_like(clearance)
        pressure, slope = jax.jvp(lambda c: law.pressure_at(c, face.stiffness), (clearance,), (one,))
        slope = jax.lax.stop_gradient(slope)
        after = clearance - (clearance - free - give * pressure) / (1.0 - jax.lax.stop_gradient(give) * slope)
        return after, pressure + slope * (after - clearance)

    clearance = jax.lax.stop_gradient(guess)
    for _ in range(_PRESSURE_STEPS - 1):
        clearance = jax.lax.stop_gradient(newton(clearance)[0])
    clearance, pressure = newton(clearance)
    return clearance, jnp.maximum(pressure, 0.0) * area
