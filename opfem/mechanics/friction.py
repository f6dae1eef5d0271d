"""Coulomb friction at face points: elastic slip, return map, and their stiffness.

The slip of a point is measured along the surface, in (x, y) of the surface; its history is that of the last increment.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .contact_state import FacePoints, PointVector, SlipHistory

# Share of the elastic limit from which on the status of a point is "slip".
_AT_LIMIT = 0.9


class Friction(NamedTuple):
    """Friction at face points: traction [MPa], and the quantities that its derivatives need."""

    traction: Array
    stiffness: Array  # tangential stiffness [MPa/mm], of stick or slip
    reach: Array  # trial elastic slip, in space [mm]
    length: Array  # of it [mm]
    elastic: Array
    slid: Array
    conjugate: Array
    limited: Array  # whether friction, if any, is at its limit
    sliding: Array
    slips: Array


def return_map(
    pressure: Array, stiffness: Array, limit: Array, points: FacePoints, history: SlipHistory, sticks: Array | None
) -> Friction:
    """Compute friction by a return map: trial slip, radially reduced to the elastic limit where a point slides.

    Args:
        pressure: Contact pressure [MPa].
        stiffness: Sticking stiffness [MPa/mm].
        limit: Elastic slip at which a point starts to slide [mm].
        points: The points.
        history: Their history.
        sticks: Mask of points that stick in any case; None: none.
    """
    trial, (slope_x, slope_y) = trial_slip(points, history), points.slope
    rise = slope_x * trial[0] + slope_y * trial[1]
    squared = trial[0] ** 2 + trial[1] ** 2 + rise**2
    length = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    length = jnp.where(squared > 0, length, 0.0)
    sliding = length > limit if sticks is None else (length > limit) & ~sticks
    ratio = jnp.where(sliding, limit / jnp.where(sliding, length, 1.0), 1.0)
    closed = pressure > 0
    elastic = jnp.where(closed, ratio * trial, 0.0)
    climb = slope_x * elastic[0] + slope_y * elastic[1]
    tangent = jnp.concatenate([elastic, climb[None]])
    return Friction(
        traction=-stiffness * tangent,
        stiffness=stiffness * ratio,
        reach=jnp.concatenate([trial, rise[None]]),
        length=length,
        elastic=elastic,
        slid=jnp.where(closed, trial - elastic, 0.0),
        conjugate=-stiffness * (elastic + points.slope * climb),
        limited=sliding,
        sliding=closed & sliding,
        slips=closed & (length > _AT_LIMIT * limit),
    )


def positive_part(
    normal: PointVector, pushing: Array, sticking: Array, friction: Friction
) -> Float[Array, "3 3 points *faces"]:
    """Compute the symmetric positive part of contact's stiffness [MPa/mm]: without curvature and frictional coupling.

    Args:
        normal: Normal of the surface.
        pushing: Normal stiffness.
        sticking: Tangential stiffness, of sliding points across their slip only.
        friction: Friction at the points.
    """
    along, eye = normal[:, None] * normal, np.eye(3).reshape(3, 3, *[1] * (normal.ndim - 1))
    length = jnp.where(friction.limited, friction.length, 1.0)
    direction = jnp.where(friction.limited, friction.reach / length, 0.0)
    return pushing * along + sticking * (eye - along - direction[:, None] * direction)


def trial_slip(points: FacePoints, history: SlipHistory) -> Float[Array, "2 points *faces"]:
    """Compute the trial elastic slip [mm], for stick at all points."""
    anchor = history.position if points.anchor is None else points.anchor
    return history.elastic + points.position[:2] - anchor
