"""Terms of dynamics: lumped mass, stable time increment and bulk viscosity of a layer.

Used by the explicit solver; forces stay in `internal` and `layer_force`.
"""

import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..model.deformation import kinematics
from .internal import LayerBody
from .kinematics import CellKind, LayerCells, contract

Cells = Float[Array, "nz ny nx"]

# Σ |∇N|² over the nodes of each of a box's six tetrahedra is twice Σ 1/L²: an upper bound of frequencies.
_TETRAHEDRA = 2.0


def lumped_mass(cells: LayerCells, density: Array) -> Float[Array, "mz my mx"]:
    """Compute the row-sum lumped mass of the nodes [t].

    Args:
        cells: Cells of the layer.
        density: Density, scaled or not [t/mm³]: one number or `(nz, ny, nx)`.
    """
    mass = cells.weight * density * jnp.ones_like(cells.slope_x)
    return cells.assemble(contract(_shape_values(cells.kind), mass)[:, None])[0]


def _shape_values(kind: CellKind) -> np.ndarray:
    """Compute N_a at the points of a cell, `(nodes, points)`."""
    if len(kind.points) == 8:
        ends = np.stack([1.0 - kind.points, kind.points])  # end, point, axis
        return np.array([np.prod([ends[node[axis], :, axis] for axis in range(3)], axis=0) for node in kind.nodes])
    own = np.any(kind.gradients != 0.0, axis=1)  # a tetrahedron's nodes are those that its gradients see
    return (own / own.sum(axis=1, keepdims=True)).T


def wave_modulus(body: LayerBody) -> Array:
    """Compute the modulus of dilatational waves [MPa] of the unloaded layer."""
    return body.material.bulk + 4.0 / 3.0 * body.material.shear


def stable_increment(body: LayerBody, u: Float[Array, "3 mz my mx"], density: Array) -> Cells:
    """Estimate the largest stable time increment of every element [s], at its current shape and wave speed.

    1/sqrt(Σ_J (c_J/L_J)²): c_J is the fastest wave along the element's axis J at its mean deformation gradient,
    measured like the length L_J in the unloaded layer. It includes the shortening and the stiffening of a compressed
    element. For a cube it is 0.577 L/c; one free cube allows 0.596, a mesh of them about 0.85.

    Args:
        body: The layer.
        u: Displacement [mm].
        density: Density, scaled or not [t/mm³]: one number or `(nz, ny, nx)`.

    Source:
        Flanagan & Belytschko, J. Appl. Mech. 51 (1984) 35: the bound by the element's mean gradients.
    """
    cells = body.cells
    H = cells.mean(cells.displacement_gradient(u), 2)
    moduli = [jnp.max(jnp.sum(jnp.abs(A), axis=1), axis=0)[0] for A in _acoustic_tensors(body, H)]
    hx, hy = cells.spacing
    depth, slope_x, slope_y = (jnp.min(cells.depth, 0), *(jnp.max(jnp.abs(s), 0) for s in _slopes(cells)))
    largest = jnp.maximum(jnp.maximum(moduli[0], moduli[1]), moduli[2])
    squares = moduli[0] / hx**2 + moduli[1] / hy**2 + moduli[2] / depth**2 + largest * (slope_x**2 + slope_y**2)
    return jnp.sqrt(density / (squares * (_TETRAHEDRA if cells.name == "tet4" else 1.0)))


def _slopes(cells: LayerCells) -> tuple[Array, Array]:
    hx, hy = cells.spacing
    return cells.slope_x / hx, cells.slope_y / hy


def _acoustic_tensors(body: LayerBody, H: Float[Array, "3 3 1 nz ny nx"]) -> list[Array]:
    """Compute dP[i, J]/dF[k, J] (J not summed) for J = x, y, z, each `(3, 3, 1, nz, ny, nx)` [MPa]."""
    tangent = body.full_tangent(kinematics(H))
    blocks = {(i, k): tangent.block(i, k) for i, k in itertools.product(range(3), repeat=2)}
    return [jnp.stack([jnp.stack([blocks[i, k][J, J] for k in range(3)]) for i in range(3)]) for J in range(3)]


class BulkViscosity(eqx.Module):
    """Viscous mean stress that damps volume waves: linear, and quadratic in compression.

    q = b1 ρ c L ε' + ρ (b2 L)² |ε'| min(ε', 0), with ε' the rate of the element's volume strain, L its shortest
    edge, ρ c = sqrt(ρ M).

    Attributes:
        linear: b1 ρ c L [MPa s], one number or per element.
        quadratic: ρ (b2 L)² [MPa s²].

    Source:
        Abaqus Analysis User's Guide, Explicit dynamic analysis: bulk viscosity.
    """

    linear: Array
    quadratic: Array

    def __call__(self, change: Cells, before: Cells, dt: Array) -> Cells:
        """Compute the stress [MPa] from mean J - 1 now and one increment dt [s] before."""
        rate = (change - before) / (dt * (1.0 + change))
        return (self.linear - self.quadratic * jnp.minimum(rate, 0.0)) * rate


def bulk_viscosity(body: LayerBody, coefficients: tuple, density: Array, uniform: bool) -> BulkViscosity:
    """Build the bulk viscosity of a layer.

    Args:
        body: The layer.
        coefficients: (b1, b2) [-].
        density: Density, scaled or not [t/mm³].
        uniform: Whether all elements are the same brick.
    """
    b1, b2 = coefficients
    depth = body.cells.depth[0, 0, 0, 0] if uniform else jnp.min(body.cells.depth, 0)
    length = jnp.minimum(jnp.min(body.cells.element_spacing), depth)
    linear, quadratic = b1 * length * jnp.sqrt(density * wave_modulus(body)), density * (b2 * length) ** 2
    if linear.ndim:  # one for each element, where they are not all alike
        linear, quadratic = (v * jnp.ones(body.cells.slope_x.shape[1:], v.dtype) for v in (linear, quadratic))
    return BulkViscosity(linear, quadratic)
