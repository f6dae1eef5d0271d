"""The bed of springs that a fit presses with.

A dead load as sharp as a coin's edges makes the layer snap where an imprint does not: no path of loads leads to the
traction that is looked for. Springs between the load and the layer hold every node on its way. What they do is known,
so that the traction which the layer carries in the end, and not the load behind the springs, is what is fitted.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..measurement import ThicknessMap
from ..model import Imprint, Palpation
from ..solvers import Newton, Solution, solve
from ..solvers.solution import is_failure
from .observation import Nodes, Observation
from .preconditioner import fit_normal, indentation
from .prior import AbstractPrior

# Stiffness over shear modulus per thickness [-]. The published coin snaps at 2.5 and less, at 8 and more it does not.
# On 40×40×4 elements a first direction to 1e-2 takes 23 inner iterations at 75 and 29 at 200; at 8, 60 do not do.
_STIFFNESS = 75.0


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
    solutions = [_imprint(palpation, surface, solver) for surface in observations.surface]
    if any(bool(is_failure(solution.result)) for solution in solutions):
        return None
    stiffness = _STIFFNESS * palpation.layer.material.shear / jnp.mean(palpation.mesh().thickness)
    normal = jnp.stack([-solution.traction[2] for solution in solutions])
    uz = jnp.stack([solution.displacement[2, -1] for solution in solutions])
    return Bed(stiffness, normal, uz, bed.gain, bed.softness)


def _imprint(palpation: Palpation, surface: Nodes, solver: Newton) -> Solution:
    imprint = Imprint(ThicknessMap(surface, extent=palpation.extent))
    return solve(palpation, imprint, solver, throw=False, progress=False)
