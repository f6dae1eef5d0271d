"""Elastic foundation that stabilises the forward solves of a fit; it does not change the optimum.

Under a dead load a layer that slips and opens snaps through, and the map becomes a strongly nonlinear function of the
traction. A foundation between load and layer limits the displacement of every node, so that most fits converge in half
of the steps or fewer. The fit determines the traction transmitted to the layer, with the foundation's part included.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..measurement import ThicknessMap
from ..mechanics.face import tributary_area
from ..model import Imprint, Palpation
from ..solvers import Newton
from ..solvers.compiling import QuickJit
from ..solvers.solution import is_failure
from ..solvers.solve import prepare
from ..solvers.stepping import outcome
from .forward import resume
from .measured_surface import MeasuredSurface
from .preconditioner import fit_normal, indentation
from .prior import AbstractPrior

# Share of the pixels around a node that must be data; below it the surface is filled in from its surroundings.
_MEASURED_SHARE = 0.3
# Least height of an imprint over the layer's thickness: splines extrapolated over masked corners fall below zero.
_LEAST_HEIGHT = 0.05
# Load increments of an imprint before the fit falls back to a dead load: it bounds the time spent on an imprint.
_MAX_INCREMENTS = 200


class ElasticFoundation(eqx.Module):
    """Springs of stiffness k between the applied normal traction T and the layer.

    They are stress-free at the displacement û(T) that small-strain elasticity predicts near a solved state. The layer
    receives T + k (u_z - û): to first order T, and exactly T without stiffness.

    Attributes:
        stiffness: Per reference area [MPa/mm].
        normal: Normal traction of this state, under each map, per reference area [MPa].
        uz: Displacement of the interface under it [mm].
        gain: Indentation per pressure of every cosine mode [mm/MPa].
        softness: Local indentation over that of the mean thickness [-].
    """

    stiffness: Array
    normal: Float[Array, "maps my mx"]
    uz: Float[Array, "maps my mx"]
    gain: Float[Array, "maps my mx"]
    softness: Float[Array, "maps my mx"]

    def dead_load(self, applied: Float[Array, "maps my mx"]) -> Float[Array, "maps my mx"]:
        """Compute the part of the load that does not depend on displacement, T - k û [MPa]."""
        change = jax.vmap(indentation)(self.gain, self.softness, applied - self.normal)
        return applied - self.stiffness * (self.uz - change)

    def transmitted(
        self, dead: Float[Array, "maps my mx"], uz: Float[Array, "maps my mx"]
    ) -> Float[Array, "maps my mx"]:
        """Compute the normal traction transmitted to the layer at displacements uz [MPa]."""
        return dead + self.stiffness * uz


def zero_foundation(palpation: Palpation, surfaces: MeasuredSurface, prior: AbstractPrior) -> ElasticFoundation:
    """Make a foundation of zero stiffness: a dead load, with the structure, and so the programs, of a stiff one."""
    layer, zeros = fit_normal(palpation, surfaces, prior).maps, jnp.zeros_like(surfaces.surface)
    return ElasticFoundation(jnp.zeros_like(zeros, shape=()), zeros, zeros, layer.gain, layer.softness)


class Imprinted(NamedTuple):
    """Imprints of the maps.

    Attributes:
        traction: Force on the layer per reference area [MPa].
        uz: Displacement of the interface [mm].
    """

    traction: Float[Array, "maps 3 my mx"]
    uz: Float[Array, "maps my mx"]


def solve_imprints(palpation: Palpation, surfaces: MeasuredSurface, solver: Newton) -> Imprinted | None:
    """Press the maps in; None where one cannot be solved.

    Args:
        palpation: The experiment.
        surfaces: Measured surface of every map, stacked.
        solver: Settings of the solves.
    """
    limited = dataclasses.replace(solver, max_increments=min(solver.max_increments, _MAX_INCREMENTS)).as_leaves()
    ends = []
    for i in range(surfaces.surface.shape[0]):
        load = _imprint(palpation, jax.tree.map(lambda leaf, i=i: leaf[i], surfaces))
        problem, start = prepare(palpation, load, None, limited, None, False)
        ends.append(resume(problem, start, limited))
    if any(bool(is_failure(outcome(s))) for s in ends):
        return None
    area = tributary_area(palpation.mesh().positions()[:, -1])
    traction = jnp.stack([s.state.applied.sample.face for s in ends]) / area
    return Imprinted(traction, jnp.stack([s.state.u[2, -1] for s in ends]))


@QuickJit
def _imprint(palpation: Palpation, measured: MeasuredSurface) -> Imprint:
    # Splines oscillate where few pixels are data: fill these nodes in from their surroundings.
    rows, columns = jnp.abs(measured.to_rows).T, jnp.abs(measured.to_columns)
    counted = rows @ (measured.certainty > 0) @ columns
    is_data = counted >= _MEASURED_SHARE * (jnp.sum(rows, axis=1)[:, None] * jnp.sum(columns, axis=0))
    least = _LEAST_HEIGHT * jnp.mean(palpation.mesh().thickness)
    surface = ThicknessMap(jnp.maximum(measured.surface, least), extent=palpation.extent, mask=~is_data)
    return Imprint(surface.filled())
