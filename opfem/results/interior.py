"""Stress, strain and energy inside the layer: at Gauss points, as element means, recovered at nodes."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics.internal import LayerBody, layer_body
from ..mechanics.kinematics import CellKind, LayerCells, contract
from ..model.deformation import identity_like, product, transpose
from ..solvers import ExperimentSolution, Solution


class LayerFields(eqx.Module):
    """Fields at the points where the elements of the deformed layer measure strain.

    Eight Gauss points, x fastest; one for "reduced", six for "tet4". A cell is an element, but for "tet10"
    2 × 2 × 2 of them with 24 points.

    Attributes:
        deformation_gradient: F [-].
        stress: Cauchy stress [MPa], tension positive.
        energy_density: Strain energy per reference volume [MPa].
        volume: Reference volume of each point [mm³].
        cells: The cells and their points.
    """

    deformation_gradient: Float[Array, "3 3 points cz cy cx"]
    stress: Float[Array, "3 3 points cz cy cx"]
    energy_density: Float[Array, "points cz cy cx"]
    volume: Float[Array, "points _ cy cx"]
    cells: LayerCells

    @property
    def green_strain(self) -> Float[Array, "3 3 points cz cy cx"]:
        """Green–Lagrange strain (FᵀF - I)/2 [-]."""
        F = self.deformation_gradient
        return 0.5 * (product(transpose(F), F) - identity_like(F))

    def element_mean(self, values: Float[Array, "*components points cz cy cx"]) -> Float[Array, "*components nz ny nx"]:
        """Average a field over the reference volume of each element.

        Args:
            values: One of the fields, or any like it.
        """
        return self.cells.element_mean(values, self.volume)

    def at_nodes(self, values: Float[Array, "*components points cz cy cx"]) -> Float[Array, "*components mz my mx"]:
        """Recover a field at the nodes: extrapolated in each cell, then averaged by reference volume.

        It is exact for a field that is linear in the reference position, and reaches the surfaces, where an
        element mean lies half an element below. Not so "reduced" and "tet4", whose points do not fix all
        slopes in a cell: exact for a constant, at the surfaces near the mean.

        Args:
            values: One of the fields, or any like it.
        """
        components = values.shape[:-4]
        flat = values.reshape(-1, *values.shape[-4:])
        share = jnp.broadcast_to(jnp.sum(self.volume, axis=0), flat.shape[-3:])
        nodal = contract(_extrapolation(self.cells.kind, flat.shape[1]), jnp.moveaxis(flat, 1, 0)) * share
        total = self.cells.assemble(jnp.broadcast_to(share, (len(nodal), 1, *share.shape)))
        return (self.cells.assemble(nodal) / total).reshape(*components, *total.shape[1:])


def _extrapolation(kind: CellKind, points: int) -> np.ndarray:
    """Build what turns values at the points of a cell into values at its nodes `(nodes, points)`.

    Through eight points goes a trilinear field; through those of tetrahedra a linear one, by least squares.
    """

    def terms(at: np.ndarray) -> np.ndarray:
        x, y, z = at.T - 0.5  # from the middle, so that a constant stays one where the points do not fix every slope
        one = np.ones_like(x)
        if points == 1:
            return one[:, None]
        linear = [one, x, y, z]
        return np.stack(linear if points != 8 else [*linear, x * y, y * z, z * x, x * y * z], axis=1)

    own = kind.points if points > 1 else np.full((1, 3), 0.5)
    return terms(kind.nodes / kind.span) @ np.linalg.pinv(terms(own))


def layer_fields(solution: Solution | ExperimentSolution) -> LayerFields:
    """Compute stress, strain and energy inside the layer of a solution; NaN where the solve failed.

    In "mean_dilatation" and "hybrid" elements the mean stress is the element's.

    Args:
        solution: What `solve` returned; works under jit, vmap and grad.
    """
    if isinstance(solution, ExperimentSolution):
        experiment = solution.experiment
        body = layer_body(experiment.layer_mesh(), experiment.layer.material, experiment.element[0])
        return _fields(body, solution.layer.displacement, solution.layer.mean_stress)
    palpation = solution.palpation
    body = layer_body(palpation.mesh(), palpation.layer.material, palpation.element)
    return _fields(body, solution.displacement, solution.last_converged.state.mean_stress)


def sample_fields(solution: ExperimentSolution) -> LayerFields:
    """Compute stress, strain and energy inside the sample of an experiment, as `layer_fields` does in the layer.

    Args:
        solution: What `solve` returned; works under jit, vmap and grad.
    """
    experiment = solution.experiment
    body = layer_body(experiment.sample_mesh(), experiment.sample_material(), experiment.element[1])
    return _fields(body, solution.sample.displacement, solution.sample.mean_stress)


def _fields(body: LayerBody, displacement: Array, mean_stress: Array | None) -> LayerFields:
    return LayerFields(*body.fields(displacement, mean_stress), body.field_volume(), body.cells)
