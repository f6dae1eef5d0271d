"""The tangent of the discrete problem: the linear operator of one Newton step, and its preconditioner's block.

Displacement alone, or displacement and the elements' mean stress: a saddle point
[[A, Bᵀ], [B, -M/bulk]], which stays well-posed when the bulk modulus is infinite.
"""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics.kinematics import LayerCells
from .multigrid import apply_multigrid, build_multigrid
from .stencil import ElementMatrices, Nodal, Stencil, apply_stencil, assemble_stencil, held, with_unit_diagonal


class Unknowns(NamedTuple):
    """What Newton's method solves for, and residuals of the same shape.

    Attributes:
        u: Displacement [mm]; as a residual, force [N].
        mean_stress: Mean stress of the elements [MPa]; as a residual, the volume they miss [mm³]. None where
            it is no unknown.
    """

    u: Nodal
    mean_stress: Float[Array, "nz ny nx"] | None = None

    def scaled(self, scale: Array) -> "Unknowns":
        """Multiply mean stress by a scale: over a linear system's scale it is in mm, its residual in N."""
        return self._replace(mean_stress=None if self.mean_stress is None else scale * self.mean_stress)


class VolumeCoupling(NamedTuple):
    """How mean stress and displacement couple, both in mm (`Unknowns.scaled`).

    Attributes:
        vectors: Derivative of each element's volume by its free nodes, times the scale [N/mm].
        mass: Volume of each element times the scale squared.
        compliance: One over the bulk modulus [1/MPa].
        guard: Bulk modulus of the preconditioner [MPa].
        shear: Shear modulus [MPa].
    """

    vectors: Float[Array, "a 3 nz ny nx"]
    mass: Float[Array, "nz ny nx"]
    compliance: Array
    guard: Array
    shear: Array

    def force(self, cells: LayerCells, stress: Array) -> Nodal:
        """Compute Bᵀ stress: the nodal force of mean stresses."""
        return cells.assemble(self.vectors * stress)

    def change(self, cells: LayerCells, u: Nodal) -> Array:
        """Compute B u: the volume change of the elements."""
        return jnp.sum(self.vectors * cells.gather(u), axis=(0, 1))

    @property
    def schur_inverse(self) -> Array:
        """Invert what is left for the mean stress when displacement with the guard's stiffness is eliminated."""
        left = 1.0 - self.guard * self.compliance
        return 1.0 / (self.mass * (self.compliance + left / (self.guard + 2.0 * self.shear)))


class Tangent(NamedTuple):
    """The tangent in float32, and the element matrices its preconditioner is built from."""

    stencil: Stencil
    guarded: ElementMatrices
    free: Nodal
    cells: LayerCells
    points: Array | None  # dP/dF times volume, where the body is not in the stencil
    volume: VolumeCoupling | None

    def apply(self, x: Unknowns) -> Unknowns:
        """Multiply with unknowns."""
        f = apply_stencil(self.stencil, x.u)
        if self.points is not None:
            H = self.cells.displacement_gradient((self.free * x.u).astype(jnp.float32))
            stress = jnp.zeros_like(H)
            for k, L in itertools.product(range(3), repeat=2):
                stress = stress + self.points[:, :, k, L] * H[k, L]
            f = f + self.free * self.cells.assemble(self.cells.nodal_vectors(stress))
        if self.volume is None or x.mean_stress is None:
            return Unknowns(f)
        f = f + self.volume.force(self.cells, x.mean_stress)
        change = self.volume.change(self.cells, x.u)
        return Unknowns(f, change - self.volume.compliance * self.volume.mass * x.mean_stress)


def assemble_tangent(
    K: ElementMatrices,
    guarded: ElementMatrices,
    free: np.ndarray,
    scale: Array,
    transposed: bool,
    cells: LayerCells,
    points: Array | None,
    volume: VolumeCoupling | None,
) -> Tangent:
    """Assemble the tangent; rows of unknowns that are not free get `scale` [N/mm] on the diagonal."""
    if not free.all():
        K = held(K, jnp.asarray(free))
    if transposed:
        K = jnp.transpose(K, (0, 2, 1, 4, 3, 5, 6))
        points = None if points is None else jnp.transpose(points, (2, 3, 0, 1, *range(4, points.ndim)))
    S = assemble_stencil(K)
    if points is None:
        S = with_unit_diagonal(S, scale)
    return Tangent(S, guarded, jnp.asarray(free, jnp.float32), cells, points, volume)


def preconditioner(tangent: Tangent, free: np.ndarray, scale: Array):
    """Build the preconditioner: one V-cycle; with mean stress, a block-triangular step around it.

    The displacement block carries the guard's stiffness of volume (an augmented Lagrangian), so that the
    iterations do not grow with the bulk modulus.

    Source:
        Benzi, Golub & Liesen, Acta Numerica 14 (2005), sections 8 and 10.
    """
    multigrid = build_multigrid(tangent.guarded, None if free.all() else free, scale)
    volume, cells = tangent.volume, tangent.cells

    def apply(r: Unknowns) -> Unknowns:
        if volume is None or r.mean_stress is None:
            return Unknowns(apply_multigrid(multigrid, r.u))
        rest = r.mean_stress.astype(jnp.float32)
        push = volume.force(cells, volume.guard / volume.mass * rest)
        u = apply_multigrid(multigrid, r.u + push)
        return Unknowns(u, volume.schur_inverse * (volume.change(cells, u) - rest))

    return apply
