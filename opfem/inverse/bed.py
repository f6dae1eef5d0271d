"""The bed of springs that a fit presses with.

Under a dead load a layer moves far where it slips and opens, and as sharp a load as a coin's makes it snap: maps are
far from linear in it. Springs between the load and the layer hold every node on its way: what is asked for then moves
the interface about as small-strain elasticity says, so that most fits settle in half of the steps or less. What springs
do is known: the traction which the layer carries in the end, and not the load behind them, is what is fitted.
"""

import dataclasses

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
from ..solvers.stepping import Stepping, outcome
from .forward import to_the_end
from .observation import Observation
from .preconditioner import fit_normal, indentation
from .prior import AbstractPrior

# Stiffness over shear modulus per thickness [-]. The published coin snaps at 2.5 and less, at 8 and more it does not. A
# fit on 40×40×4 elements of 5 × 5 mm takes 45 inner iterations in 5 solves at 7.5, 52 in 5 at 19, 68 in 6 at 75, and
# without springs 92 in 13. The coin, whose misfit jumps, takes 30 to 40 solves at 20 and at 75; at 7.5 inner
# iterations become too many.
_STIFFNESS = 20.0
# A node of the surface counts as measured where this part of its pixels does.
_TOLD = 0.3
# Least height of an imprint over the layer's thickness, and the increments tried before it is given up.
_LEAST, _MOST_ATTEMPTS = 0.05, 200


class Bed(eqx.Module):
    """Springs of stiffness k between the asked-for normal traction T and the layer.

    They are at rest where the interface is expected, û(T): near an imprint of the map, by small-strain elasticity.
    The layer carries T + k (u_z - û), which is T to first order; without stiffness it is T.

    Attributes:
        stiffness: Of the springs [MPa/mm].
        normal: Normal traction under imprints of the maps, per reference area [MPa].
        uz: Displacement of the interface there [mm].
        gain: Indentation per pressure of every cosine mode [mm/MPa].
        softness: Local indentation over that of the mean thickness [-].
    """

    stiffness: Array
    normal: Float[Array, "maps my mx"]
    uz: Float[Array, "maps my mx"]
    gain: Float[Array, "maps my mx"]
    softness: Float[Array, "maps my mx"]

    def load(self, asked: Float[Array, "maps my mx"]) -> Float[Array, "maps my mx"]:
        """Compute the dead part of the load, T - k û [MPa]."""
        further = jax.vmap(indentation)(self.gain, self.softness, asked - self.normal)
        return asked - self.stiffness * (self.uz - further)

    def carried(self, load: Float[Array, "maps my mx"], uz: Float[Array, "maps my mx"]) -> Float[Array, "maps my mx"]:
        """Compute the normal traction that the layer carries at displacements [MPa]."""
        return load + self.stiffness * uz


def no_bed(palpation: Palpation, observations: Observation, prior: AbstractPrior) -> Bed:
    """Make a bed without stiffness: a dead load. A stiff one has the same structure, and compiles nothing anew."""
    layer, nothing = fit_normal(palpation, observations, prior).maps, jnp.zeros_like(observations.surface)
    return Bed(jnp.zeros_like(nothing, shape=()), nothing, nothing, layer.gain, layer.softness)


def lay_bed(bed: Bed, palpation: Palpation, observations: Observation, solver: Newton) -> Bed | None:
    """Stiffen a bed, at rest about imprints of the maps; None where the layer does not take the imprint."""
    maps = observations.surface.shape[0]
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], observations) for i in range(maps)]
    few = dataclasses.replace(solver, max_increments=min(solver.max_increments, _MOST_ATTEMPTS)).as_leaves()
    ends = [_imprinted(palpation, _imprint(palpation, observation), few) for observation in each]
    if any(bool(is_failure(outcome(s))) for s in ends):
        return None
    stiffness = _STIFFNESS * palpation.layer.material.shear / jnp.mean(palpation.mesh().thickness)
    area = tributary_area(palpation.mesh().positions()[:, -1])
    normal = -jnp.stack([s.state.applied.sample.face[2] for s in ends]) / area
    uz = jnp.stack([s.state.u[2, -1] for s in ends])
    return Bed(stiffness, normal, uz, bed.gain, bed.softness)


def _imprinted(palpation: Palpation, load: Imprint, solver: Newton) -> Stepping:
    problem, start = prepare(palpation, load, None, solver, None, False)
    return to_the_end(problem, start, solver)


@QuickJit
def _imprint(palpation: Palpation, observation: Observation) -> Imprint:
    # Where few pixels count, splines run away: filled in from around.
    rows, columns = jnp.abs(observation.to_rows).T, jnp.abs(observation.to_columns)
    counted = rows @ (observation.certainty > 0) @ columns
    told = counted >= _TOLD * (jnp.sum(rows, axis=1)[:, None] * jnp.sum(columns, axis=0))
    least = _LEAST * jnp.mean(palpation.mesh().thickness)
    surface = ThicknessMap(jnp.maximum(observation.surface, least), extent=palpation.extent, mask=~told)
    return Imprint(surface.filled())
