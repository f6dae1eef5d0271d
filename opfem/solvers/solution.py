"""What a solve returns: fields, status and statistics."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._checks import concrete
from ..measurement import ThicknessMap
from ..model import Load, Palpation, unstable_stretch
from .equilibrium import State
from .explicit_step import Motion

OPEN, STICK, SLIP = 0, 1, 2


class RESULTS(eqx.Enumeration):
    """How a solve ended. Anything but what `CONVERGED` names leaves NaN fields."""

    successful = ""
    slides_off = (
        "Converged, but only because the in-plane hold carries a lateral force: friction cannot. "
        "stats['force_hold'] says how much."
    )
    increment_too_small = (
        "The load increment became smaller than Newton.min_increment without convergence. Smooth the map "
        "(smoothed(fwhm=...)), use more elements, or raise Newton.max_steps; last_converged holds the last state."
    )
    max_increments_reached = (
        "Newton.max_increments were tried before the load was reached. Raise it, or smooth the map; "
        "last_converged holds the last state."
    )
    kinetic_energy_high = (
        "Solved, but not quasi-statically: kinetic energy was above 1% of all energy after the first tenth of the "
        "duration, stats['kinetic_ratio']. Raise Explicit.duration, or lower mass_scaling."
    )
    energy_drifts = (
        "The energies do not add up: stats['energy_drift'] of the largest one is missing. The increment is too long: "
        "lower Explicit.safety or increment."
    )
    element_inverted = (
        "An element inverted. Smooth the map (smoothed(fwhm=...)), raise Explicit.duration, or lower Explicit.safety."
    )
    material_unstable = (
        "Solved, but elements are stretched beyond where the material law is stable (Drucker): it resists less, the "
        "more it deforms, and the answer need not be the only one. Take a law that fits these stretches."
    )
    nonfinite = "The inputs lead to NaN or infinite forces. Check the map, the thickness and the material."


CONVERGED = ("successful", "slides_off", "kinetic_energy_high", "material_unstable")
"""How a solve ends that has reached its load."""


def is_failure(result: RESULTS) -> Bool[Array, ""]:
    """Tell whether a solve has not reached its load."""
    return ~functools.reduce(jnp.logical_or, [result == getattr(RESULTS, name) for name in CONVERGED])


def judged(solution: "Solution") -> "Solution":
    """Note in stats and status where a solve stretched elements beyond what its law is stable for."""
    stats = solution.stats
    unstable = unstable_stretch(solution.palpation.layer.material, stats["min_stretch"], stats["max_stretch"])
    solution = dataclasses.replace(solution, stats={**stats, "unstable_stretch": unstable})
    known = concrete(unstable)
    if known is not None and not known:
        return solution
    beyond = (unstable > 0) & ~is_failure(solution.result)
    return dataclasses.replace(solution, result=RESULTS.where(beyond, RESULTS.material_unstable, solution.result))


class FaceResult(eqx.Module):
    """What acts on one face of the layer, at its nodes `(ny+1, nx+1)`.

    Attributes:
        pressure: Contact pressure -n·σn on the current area [MPa], positive in compression.
        traction: Force on the layer per reference area, x y z [MPa].
        slip: Tangential slip along x and y against the body [mm].
        status: 0 open, 1 stick, 2 slip: the elastic slip is at its limit, or within a tenth of it.
    """

    pressure: Float[Array, "my mx"]
    traction: Float[Array, "3 my mx"]
    slip: Float[Array, "2 my mx"]
    status: Int[Array, "my mx"]


class LastConverged(eqx.Module):
    """The last converged state of a solve.

    Attributes:
        displacement: `(3, nz+1, ny+1, nx+1)` [mm].
        load_fraction: How much of the load it carries [-].
        state: The same with its friction history, for `solve(..., start=)`.
    """

    displacement: Float[Array, "3 mz my mx"]
    load_fraction: Float[Array, ""]
    state: State | Motion


class Solution(eqx.Module):
    """The solved palpation.

    Attributes:
        displacement: `(3, nz+1, ny+1, nx+1)` [mm].
        positions: Reference positions of the nodes, same shape [mm].
        sample: What acts at the sample–layer interface.
        window: What acts at the window.
        thickness: Deformed interface as a spatial map on the load's grid [mm], masked where no
            interface point lies above.
        stress_zz: Cauchy stress σ_zz, mean over each top element `(ny, nx)` [MPa].
        stats: Iterations, residual, energies, forces [N]; see `solve`.
        result: How the solve ended.
        last_converged: The last converged state and its load fraction.
        palpation: The experiment that was solved.
        load: Its load.
    """

    displacement: Float[Array, "3 mz my mx"]
    positions: Float[Array, "3 mz my mx"]
    sample: FaceResult
    window: FaceResult
    thickness: ThicknessMap
    stress_zz: Float[Array, "ny nx"]
    stats: dict[str, Any]
    result: RESULTS
    last_converged: LastConverged
    palpation: Palpation
    load: Load

    @property
    def pressure(self) -> Float[Array, "*maps my mx"]:
        """Contact pressure on the sample [MPa], on the current area."""
        return self.sample.pressure

    @property
    def traction(self) -> Float[Array, "*maps 3 my mx"]:
        """Force on the layer at the interface per reference area [MPa]."""
        return self.sample.traction

    @property
    def slip(self) -> Float[Array, "*maps 2 my mx"]:
        """Slip of the interface along the sample [mm]."""
        return self.sample.slip

    @property
    def contact_status(self) -> Int[Array, "*maps my mx"]:
        """Status of the interface: 0 open, 1 stick, 2 slip."""
        return self.sample.status


class ConvergenceError(RuntimeError):
    """A solve did not reach its load. `solution` holds its status and last converged state."""

    def __init__(self, message: str, solution: Solution):
        super().__init__(message)
        self.solution = solution
