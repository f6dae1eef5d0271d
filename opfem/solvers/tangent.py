"""The tangent of the discrete problem: linear operator of one Newton step, and its block preconditioner.

Displacement alone, or displacement and the elements' mean stress: a saddle point
[[A, Bᵀ], [B, -M/bulk]], which stays well-posed when the bulk modulus is infinite.
"""

import itertools
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ..mechanics.boundary import Bodies, put, take, to_touching
from ..mechanics.internal import LayerBody
from ..mechanics.kinematics import LayerCells
from .multigrid import Multigrid, apply_multigrid
from .stencil import Nodal, apply_stencil

# Bulk over shear modulus in the preconditioner of `hybrid`: moderate, as multigrid iterations grow with its square
# root.
VOLUME_GUARD = 20.0


class Unknowns(NamedTuple):
    """Unknowns of Newton's method, and residuals of the same structure; in a stack, tuples over bodies.

    Attributes:
        u: Displacement [mm]; as a residual, force [N].
        mean_stress: Mean stress of the elements [MPa]; as a residual, volume [mm³]. None where it is
            no unknown.
    """

    u: PyTree
    mean_stress: PyTree = None

    def scaled(self, scale: Array) -> "Unknowns":
        """Scale mean stress: divided by a linear system's scale it is in mm, its residual in N."""
        return self._replace(mean_stress=jax.tree.map(lambda stress: scale * stress, self.mean_stress))


@runtime_checkable
class AbstractTangent(Protocol):
    """The linear operator of one Newton step, in float32."""

    def apply(self, x: Unknowns) -> Unknowns:
        """Compute the product with unknowns."""
        ...


class VolumeCoupling(NamedTuple):
    """Coupling of mean stress and displacement, both in mm (`Unknowns.scaled`).

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
        """Apply the inverse of the approximate Schur complement for mean stress, displacement eliminated."""
        left = 1.0 - self.guard * self.compliance
        return 1.0 / (self.mass * (self.compliance + left / (self.guard + 2.0 * self.shear)))


def couple_volume(
    body: LayerBody, free: np.ndarray, u: Nodal, scale: Array
) -> tuple[VolumeCoupling, Float[Array, "nz 8 8 3 3 ny nx"]]:
    """Build the coupling of mean stress and displacement, and the volumetric stiffness of the preconditioner [N/mm].

    Args:
        body: The layer.
        free: Mask of the unknowns, 1 where free.
        u: Displacement [mm].
        scale: Scale of mean stress over displacement [MPa/mm].
    """
    by_node = body.volume_vectors(u)
    volume = body.cells.volume[0]
    guard = VOLUME_GUARD * body.material.shear
    vectors = jnp.moveaxis(by_node, 2, 0)  # layers first
    pairs = vectors[:, :, None, :, None] * vectors[:, None, :, None, :]
    stiffness = (guard / volume)[:, None, None, None, None] * pairs
    coupling = VolumeCoupling(
        vectors=scale * by_node * body.cells.gather(jnp.asarray(free, by_node.dtype)),
        mass=scale**2 * volume,
        compliance=1.0 / body.material.bulk,
        guard=guard,
        shear=body.material.shear,
    )
    return coupling, stiffness


class Tangent(NamedTuple):
    """The linear operator of one Newton step, in float32, and its preconditioner.

    The preconditioner is a V-cycle for the guarded stiffness, which is symmetric and positive definite. The operator is
    its finest stencil plus the terms that the guarded stiffness omits.

    Attributes:
        multigrid: Preconditioner of the guarded stiffness.
        faces: Omitted terms of contact, or all of contact where the body is omitted: face matrices
            `(4, 4, 3, 3, faces)`.
        diagonal: Omitted terms of springs and viscosity at the nodes [N/mm]; broadcasts to a nodal field.
        free: 1 for free unknowns; None: all are free.
        cells: Cells of the layer.
        points: dP/dF times volume, where the stiffness is of other elements than the body.
        volume: Coupling of mean stress and displacement, where mean stress is an unknown.
    """

    multigrid: Multigrid
    faces: Bodies
    diagonal: Array
    free: Nodal | None
    cells: LayerCells
    points: Array | None
    volume: VolumeCoupling | None

    def apply(self, x: Unknowns) -> Unknowns:
        """Compute the product with unknowns."""
        u = x.u.astype(jnp.float32)
        inside = u if self.free is None else self.free * u
        more = self._of_faces(inside) + self.diagonal * inside
        if self.points is not None:
            more = more + self._of_points(self.points, inside)
        if self.free is not None:
            more = self.free * more
        f = more if self.points is not None else apply_stencil(self.multigrid.finest, u) + more
        if self.volume is None or x.mean_stress is None:
            return Unknowns(f)
        change = self.volume.change(self.cells, u)
        guard = self.volume.guard / self.volume.mass * change
        f = f + self.volume.force(self.cells, x.mean_stress - guard)
        return Unknowns(f, change - self.volume.compliance * self.volume.mass * x.mean_stress)

    def precondition(self, r: Unknowns) -> Unknowns:
        """Apply one V-cycle; with mean stress, a block-triangular step around it.

        The displacement block includes a volumetric stiffness (augmented Lagrangian), so that the number of iterations
        does not grow with the bulk modulus.

        Source:
            Benzi, Golub & Liesen, Acta Numerica 14 (2005), sections 8 and 10.
        """
        if self.volume is None or r.mean_stress is None:
            return Unknowns(apply_multigrid(self.multigrid, r.u))
        rest = r.mean_stress.astype(jnp.float32)
        push = self.volume.force(self.cells, self.volume.guard / self.volume.mass * rest)
        u = apply_multigrid(self.multigrid, r.u + push)
        return Unknowns(u, self.volume.schur_inverse * (self.volume.change(self.cells, u) - rest))

    def transposed(self) -> "Tangent":
        """Transpose the operator; the guarded stiffness is symmetric."""
        faces = jax.tree.map(lambda K: jnp.transpose(K, (1, 0, 3, 2, 4)), self.faces)
        points = self.points
        points = None if points is None else jnp.transpose(points, (2, 3, 0, 1, *range(4, points.ndim)))
        return self._replace(faces=faces, points=points)

    def _of_faces(self, u: Nodal) -> Nodal:
        _, nz, ny, nx = (n - 1 for n in u.shape)
        f = jnp.zeros_like(u)
        for body, K in zip(Bodies._fields, self.faces, strict=True):
            if K is not None:
                corners = take(u, body, with_sides=K.shape[-1] > ny * nx)
                forces = jnp.sum(K * corners[None, :, None], axis=(1, 3))
                f = f + put(to_touching(forces, (nz, ny, nx)), body, u.shape)
        return f

    def _of_points(self, points: Array, u: Nodal) -> Nodal:
        H = self.cells.displacement_gradient(u)
        stress = jnp.zeros_like(H)
        for k, L in itertools.product(range(3), repeat=2):
            stress = stress + points[:, :, k, L] * H[k, L]
        return self.cells.assemble(self.cells.nodal_vectors(stress))
