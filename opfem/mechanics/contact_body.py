"""Counterpart of a contact face: a rigid surface that moves with the load, or an imposed pressure."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..model import HeightField
from ..model.surface import Patches
from .face import FaceRule, quadrature
from .kinematics import contract


class RigidSurface(eqx.Module):
    """A rigid body's surface: a height field that moves from `start` to `end` along z.

    None for both is the plane z = 0.
    """

    start: HeightField | None
    end: HeightField | None

    @property
    def is_plane(self) -> bool:
        """Whether it is the plane z = 0."""
        return self.end is None

    def at(self, fraction: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Evaluate height [mm] and slopes [-] at a fraction of the motion."""
        d = self.derivatives(fraction, x, y, 1)
        return d[0, 0], d[0, 1], d[1, 0]

    def derivatives(self, fraction: Array, x: Array, y: Array, order: int) -> Float[Array, "along_y along_x *points"]:
        """Evaluate height [mm] and its derivatives (`HeightField.derivatives`)."""
        if self.start is None or self.end is None:
            return jnp.zeros((order + 1, order + 1, *x.shape), x.dtype)
        low, high = self.start.coefficients, self.end.coefficients
        now = eqx.tree_at(lambda f: f.coefficients, self.end, (1.0 - fraction) * low + fraction * high)
        return now.derivatives(x, y, order)

    def around(self, x: Array, y: Array) -> "RigidPatches | None":
        """Gather the coefficients of the surface around points [mm]; None for the plane z = 0."""
        if self.start is None or self.end is None:
            return None
        return RigidPatches(self.start.around(x, y), self.end.around(x, y))


class RigidPlate(eqx.Module):
    """A rigid plane across z that moves along z from `start` to `end` [mm]."""

    start: Array
    end: Array

    @property
    def is_plane(self) -> bool:
        """Whether it is a plane."""
        return True

    def derivatives(self, fraction: Array, x: Array, y: Array, order: int) -> Float[Array, "along_y along_x *points"]:
        """Evaluate height [mm] and its derivatives, which are zero."""
        height = (1.0 - fraction) * self.start + fraction * self.end
        others = jnp.zeros((order + 1, order + 1, *x.shape), x.dtype)
        return jax.lax.dynamic_update_slice(others, jnp.broadcast_to(height, (1, 1, *x.shape)), (0,) * others.ndim)


class RigidPatches(eqx.Module):
    """A rigid surface around points, at the start and at the end of its motion."""

    start: Patches
    end: Patches

    def at(self, fraction: Array, x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Evaluate height [mm], slopes [-] and rise per load fraction [mm]."""
        low, high = self.start.powers, self.end.powers
        height, slope_x, slope_y = eqx.tree_at(lambda p: p.powers, self.end, low + fraction * (high - low))(x, y)
        return height, slope_x, slope_y, eqx.tree_at(lambda p: p.powers, self.end, high - low).height(x, y)


class ImposedPressure(eqx.Module):
    """Normal pressure per reference area that bounds friction: a dead load, applied elsewhere, and a foundation.

    Attributes:
        start: Dead pressure at the corners of the faces at load fraction 0 `(4, *faces)` [MPa].
        end: Dead pressure at load fraction 1.
        area: Reference area per unit of (ξ, η) at the points [mm²].
        height: Height of the points at which the foundation is at rest [mm]; None: no foundation.
        stiffness: Foundation stiffness at load fractions 0 and 1 [MPa/mm].
    """

    start: Float[Array, "4 *faces"]
    end: Float[Array, "4 *faces"]
    area: Float[Array, "points *faces"]
    height: Float[Array, "points *faces"] | None = None
    stiffness: tuple[Array, Array] | None = None

    def foundation_pressure(self, fraction: Array, z: Float[Array, "points *faces"]) -> Float[Array, "points *faces"]:
        """Compute the pressure of the foundation [MPa] at heights [mm]; negative in tension."""
        if self.height is None or self.stiffness is None:
            return jnp.zeros_like(z)
        start, end = self.stiffness
        return ((1.0 - fraction) * start + fraction * end) * (z - self.height)

    def bounding(self, fraction: Array, rule: FaceRule, foundation: Array | float) -> Float[Array, "points *faces"]:
        """Compute the pressure [MPa] at the points, the foundation's included; tension bounds friction by zero."""
        corners = (1.0 - fraction) * self.start + fraction * self.end
        return jnp.maximum(contract(quadrature(rule).N, corners) + foundation, 0.0)
