"""Result of a solve: fields, status and statistics."""

import dataclasses
import functools
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._checks import concrete
from ..measurement import ThicknessMap
from ..model import Compression, Experiment, Load, Palpation, unstable_stretch
from .equations import State
from .explicit_step import Motion

OPEN, STICK, SLIP = 0, 1, 2


class RESULTS(eqx.Enumeration):
    """Status of a solve. Fields are NaN unless it is one of `CONVERGED`."""

    successful = ""
    slides_off = (
        "Converged, but only because the in-plane hold balances a lateral force: friction cannot. "
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
"""Statuses of solves that reached their load."""


def is_failure(result: RESULTS) -> Bool[Array, ""]:
    """Return whether a solve has not reached its load."""
    return ~functools.reduce(jnp.logical_or, [result == getattr(RESULTS, name) for name in CONVERGED])


def judged(solution: "AnySolution") -> "AnySolution":
    """Report in stats and status stretches beyond the stable or calibrated range of the law."""
    stats = solution.stats
    layer = solution.palpation.layer if isinstance(solution, Solution) else solution.experiment.layer
    unstable = unstable_stretch(layer.material, stats["min_stretch"], stats["max_stretch"])
    stats = {**stats, "unstable_stretch": unstable}
    if layer.material.calibrated is not None:
        low, high = layer.material.calibrated
        beyond = jnp.maximum(stats["max_stretch"] / high, low / stats["min_stretch"]) - 1.0
        stats["beyond_calibration"] = jnp.maximum(beyond, 0.0)
    solution = dataclasses.replace(solution, stats=stats)
    known = concrete(unstable)
    if known is not None and not known:
        return solution
    beyond = (unstable > 0) & ~is_failure(solution.result)
    return dataclasses.replace(solution, result=RESULTS.where(beyond, RESULTS.material_unstable, solution.result))


class FaceResult(eqx.Module):
    """Contact fields on one face of the layer, at its nodes `(ny+1, nx+1)`.

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
        displacement: `(3, nz+1, ny+1, nx+1)` [mm]; of an experiment, the layer's and the sample's.
        load_fraction: Load fraction reached [-].
        state: The state with its friction history, for `solve(..., start=)`.
    """

    displacement: PyTree[Float[Array, "3 _ _ _"]]
    load_fraction: Float[Array, ""]
    state: State | Motion


class Solution(eqx.Module):
    """The solved palpation.

    Attributes:
        displacement: `(3, nz+1, ny+1, nx+1)` [mm].
        positions: Reference positions of the nodes, same shape [mm].
        sample: Contact fields at the sample–layer interface.
        window: Contact fields at the window.
        thickness: Deformed interface as a spatial map on the load's grid [mm], masked where no
            interface point lies above.
        stress_zz: Cauchy stress σ_zz, mean over each top element `(ny, nx)` [MPa].
        stats: Iterations, residual, energies, forces [N]; see `solve`.
        result: Status of the solve.
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
    def interface(self) -> FaceResult:
        """Contact fields at the sample–layer interface."""
        return self.sample

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


class BodyResult(eqx.Module):
    """One body of a solved experiment.

    Attributes:
        displacement: `(3, nz+1, ny+1, nx+1)` [mm].
        positions: Reference positions of the nodes, same shape [mm].
        mean_stress: Mean stress of "hybrid" elements `(nz, ny, nx)` [MPa]; None for others.
        stress: Cauchy stress, mean over each element `(3, 3, nz, ny, nx)` [MPa].
        min_stretch: Smallest principal stretch, without volume change [-].
        max_stretch: Largest principal stretch, without volume change [-].
    """

    displacement: Float[Array, "3 mz my mx"]
    positions: Float[Array, "3 mz my mx"]
    mean_stress: Float[Array, "nz ny nx"] | None
    stress: Float[Array, "3 3 nz ny nx"]
    min_stretch: Float[Array, ""]
    max_stretch: Float[Array, ""]


class ExperimentSolution(eqx.Module):
    """The solved experiment: the fields of a `Solution` for the layer and its interface, and both bodies.

    Attributes:
        layer: The layer.
        sample: The sample.
        window: Contact fields of the layer at the window.
        interface: Contact fields of the layer at its interface with the sample.
        plate: Contact fields of the sample at the plate.
        thickness: Thickness of the deformed layer as a spatial map on the interface's nodes [mm], as OCT sees it.
        stats: Iterations, residual, energies, forces [N]; see `solve`.
        result: Status of the solve.
        last_converged: The last converged state and its load fraction.
        experiment: The experiment that was solved.
        load: Its load.
    """

    layer: BodyResult
    sample: BodyResult
    window: FaceResult
    interface: FaceResult
    plate: FaceResult
    thickness: ThicknessMap
    stats: dict[str, Any]
    result: RESULTS
    last_converged: LastConverged
    experiment: Experiment
    load: Compression

    @property
    def displacement(self) -> Float[Array, "*maps 3 mz my mx"]:
        """Displacement of the layer's nodes [mm]."""
        return self.layer.displacement

    @property
    def positions(self) -> Float[Array, "*maps 3 mz my mx"]:
        """Reference positions of the layer's nodes [mm]."""
        return self.layer.positions

    @property
    def stress_zz(self) -> Float[Array, "*maps ny nx"]:
        """Cauchy stress σ_zz, mean over each of the layer's top elements [MPa]."""
        return self.layer.stress[..., 2, 2, -1, :, :]

    @property
    def pressure(self) -> Float[Array, "*maps my mx"]:
        """Contact pressure between layer and sample [MPa], on the current area."""
        return self.interface.pressure

    @property
    def traction(self) -> Float[Array, "*maps 3 my mx"]:
        """Force on the layer at the interface per reference area [MPa]."""
        return self.interface.traction

    @property
    def slip(self) -> Float[Array, "*maps 2 my mx"]:
        """Slip of the layer along the sample [mm]."""
        return self.interface.slip

    @property
    def contact_status(self) -> Int[Array, "*maps my mx"]:
        """Status of the interface: 0 open, 1 stick, 2 slip."""
        return self.interface.status


AnySolution = TypeVar("AnySolution", Solution, ExperimentSolution)


class ConvergenceError(RuntimeError):
    """A solve did not reach its load. `solution` holds its status and last converged state."""

    def __init__(self, message: str, solution: "Solution | ExperimentSolution"):
        super().__init__(message)
        self.solution = solution
