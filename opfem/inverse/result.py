"""Result of a traction fit: traction, uncertainty, resolution and goodness of fit."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..measurement import ThicknessMap
from ..solvers import Solution
from ..solvers.compiling import QuickJit
from .objective import Objective, normal_traction
from .preconditioner import Unknowns
from .prior import AbstractPrior
from .uncertainty import Posterior, normal_covariance

# A direction is unobserved if its posterior standard deviation is above this part of the prior one.
_NOT_OBSERVED = 0.5
# Observed without a linear system where the posterior draws give half of that part: chance of error at most 2 % with
# 8 draws, 0.1 % with 16. On 28×16×2 elements the three systems take a quarter of the fit's time.
_ENOUGH_DRAWS = 8
# Bounds of χ² per degree of freedom outside of which `advice` names possible causes.
_CHI2_BOUNDS = (0.5, 2.0)
# Components of a direction below this part of the largest one are not named.
_MATTERS = 0.1
# The lowest cosine modes (rows, columns), which `unobserved` names.
_MODES = {"mean pressure": (0, 0), "pressure rising along x": (0, 1), "pressure rising along y": (1, 0)}


class FitStatus(eqx.Enumeration):
    """Status of a fit at its end."""

    successful = ""
    max_steps_reached = (
        "The fit did not converge within fit_traction(max_steps=...) Gauss–Newton steps. Raise the limit. Or start "
        "closer to the optimum: from the normal traction of a fit on a coarser mesh (start=...), or with a prior that "
        "has a mean, a longer length or a smaller std."
    )
    stalled = (
        "The line search found no sufficient decrease of the misfit, as where the layer snaps through under its "
        "traction. Start closer (start=...), or give the prior a mean, a longer length or a smaller std."
    )
    no_equilibrium = (
        "No equilibrium exists under the initial traction of the fit. Give the prior a smaller std or a longer length. "
        "Where the sample is not in contact, mask the map, or exclude traction that lifts the layer off its window by "
        "fit_traction(nonnegative=True)."
    )
    too_many_increments = (
        "The forward solve needs more increments than its derivative is limited to, as close to a limit load. Raise "
        "max_path of fit_traction(solver=Newton(max_path=...)), or set fewer increments. Otherwise give the prior a "
        "smaller std or a longer length, mask regions without contact, or pass fit_traction(nonnegative=True)."
    )
    nonfinite = "A derivative of the layer's response is not finite: a linear solve did not converge. Smooth the map."


class FitError(RuntimeError):
    """A fit ended without an optimum."""


class TractionFit(eqx.Module):
    """Traction fitted to a measured map, or to several: arrays then have a leading axis, one entry per map.

    Attributes:
        solution: The layer under the fitted traction, solved to the solver's tolerance. Its load acts through an
            elastic foundation (`Traction.stiffness`), which prevents snap-through on the load path, or as a dead load
            where that fails. `traction` is the transmitted one in both cases.
        pressure_std: Standard deviation of `pressure`, on the current area [MPa]: of the posterior, and `mesh_std`.
        normal_std: Standard deviation of the normal traction, per reference area [MPa]: likewise.
        mesh_std: Mesh error of `pressure` [MPa]: the change that makes the fit follow `mesh_error`, locally averaged;
            0 where it is not estimated (`FitSettings.model_std`). The posterior (`draws`, `covariance`) excludes it.
        chi2: Sum of squared standardised misfits between interface and measured surface, of all maps [-].
        effective_dof: Effective number of degrees of freedom that the maps determine [-].
        observed: Number of independent data of the maps on the mesh's splines [-].
        residual: Interface minus measured surface at the nodes of the mesh's undeformed grid [mm].
        resolution_points: Nodes (x, y) at which the resolution was computed [mm].
        resolution_width: Width of the posterior's resolution kernel there [mm]: full width at half maximum of the
            Gaussian of the same peak and sum of squares; 1.3 elements where the mesh is the limit.
        deviations: Posterior draws of the normal traction minus the optimum, from which standard deviations are
            computed [MPa].
        number_covariance: Posterior covariance of the white unknowns of fitted numbers, in the order of `numbers`; the
            prior covariance is the identity [-].
        objective: The objective, with the chosen prior.
        posterior: The posterior of the white unknowns.
        stats: `forward_solves`, `gauss_newton_steps`, `inner_iterations` (CG iterations, each one product with the
            Jacobian and one with its transpose), `posterior_iterations`, `draws`, `draws_cut_short` (those whose linear
            system reached its limit of iterations), `std_error` (relative standard error of the standard deviations
            [-]), `representation_rms` [mm] (representation error of the map on mesh-spaced splines), `mesh_error` [mm]
            (root mean square of that of the height), `model_std` [mm] (added to the noise), `misfit_rms` [mm];
            `lateral_informed` [-] where the lateral traction was fitted: its variance reduction, 0 for the prior alone.
        result: Status of the fit.
    """

    solution: Solution
    pressure_std: Array
    normal_std: Array
    mesh_std: Array
    chi2: Array
    effective_dof: Array
    observed: Array
    residual: Array
    resolution_points: Float[np.ndarray, "points 2"]
    resolution_width: Float[np.ndarray, "*maps points"]
    deviations: Array
    number_covariance: Float[Array, "numbers numbers"]
    objective: Objective
    posterior: Posterior
    stats: dict[str, Any]
    result: FitStatus

    @property
    def prior(self) -> AbstractPrior:
        """Prior of the normal traction, with the chosen hyper-parameters."""
        return self.objective.prior

    @property
    def traction(self) -> Float[Array, "*maps 3 my mx"]:
        """Force on the layer at the interface per reference area [MPa]."""
        return self.solution.traction

    @property
    def normal(self) -> Float[Array, "*maps my mx"]:
        """Normal traction per reference area, positive in compression [MPa]: the fitted field."""
        return -self.solution.traction[..., 2, :, :]

    @property
    def pressure(self) -> Float[Array, "*maps my mx"]:
        """Pressure on the sample, on the current area [MPa]."""
        return self.solution.pressure

    @property
    def thickness(self) -> ThicknessMap:
        """Thickness of the layer under the fitted traction, as a spatial map [mm]."""
        return self.solution.thickness

    @property
    def reduced_chi2(self) -> Array:
        """χ² over the remaining degrees of freedom: near 1 where model and noise are right."""
        return self.chi2 / (self.observed - self.effective_dof)

    def advice(self) -> str:
        """Name possible causes where `reduced_chi2` is far from 1; an empty string where it is near."""
        if self.reduced_chi2 > _CHI2_BOUNDS[1]:
            return (
                f"χ² per degree of freedom is {self.reduced_chi2:.3g} and should be near 1: the layer cannot explain "
                "the map (material, friction, L0, mask), its noise (std) is larger than given, or the prior is too "
                "strong. Standard deviations are then too small."
            )
        if self.reduced_chi2 < _CHI2_BOUNDS[0]:
            # Maps of OCT volumes of a coin: 0.41 at 16×16×4 elements, 0.15 at 40×40×4; coverage 91 and 99.7 %.
            return (
                f"χ² per degree of freedom is {self.reduced_chi2:.3g} and should be near 1. It is smaller where noise "
                "is correlated over pixels (noise_length), or where the traction is smoother than its prior "
                "assumes for the shortest waves of the mesh. Otherwise the given noise (std or model_std) is too "
                "large. Standard deviations are then too large."
            )
        return ""

    @property
    def numbers(self) -> dict[str, Array]:
        """Fitted numbers of the experiment, by name."""
        return self.objective.numbers(self.posterior.white)

    def number_intervals(self, coverage: float = 0.95) -> dict[str, tuple[float, float]]:
        """Compute credible intervals of fitted numbers, by name.

        Args:
            coverage: Probability of an interval [-].
        """
        half = float(jax.scipy.stats.norm.ppf(0.5 + 0.5 * coverage))
        spread = dict(zip(self.objective.parameters, jnp.sqrt(jnp.diag(self.number_covariance)), strict=True))
        white = self.posterior.white.numbers

        def end(name, prior, sign):
            return float(prior.number(white[name] + sign * half * spread[name]))

        return {
            name: (end(name, prior, -1.0), end(name, prior, 1.0)) for name, prior in self.objective.parameters.items()
        }

    def not_identified(self, within: float = 0.25) -> dict[str, float]:
        """Name poorly identified numbers.

        Args:
            within: Largest half width of the 95 % interval, over the fitted value, of an identified number [-].

        Returns:
            This relative half width where it is larger, by name [-].
        """
        values = self.numbers
        parts = {n: 0.5 * (high - low) / abs(float(values[n])) for n, (low, high) in self.number_intervals().items()}
        return {name: part for name, part in parts.items() if part > within}

    def draws(self, key: PRNGKeyArray, n: int) -> Float[Array, "n *maps my mx"]:
        """Draw normal tractions from the posterior [MPa].

        Args:
            key: Random key.
            n: Number of draws.
        """
        drawn = jnp.stack([normal_traction(self.posterior.draw(one)[1]) for one in jax.random.split(key, n)])
        return self.normal + self._like_normal(drawn)

    def covariance(self, weights: Float[Array, "*maps my mx"]) -> Float[Array, "*maps my mx"]:
        """Compute the posterior covariance of the normal traction with a weighted sum of it: Cov(p, Σ weights p).

        The variance of Σ weights p is the sum of weights times this covariance.

        Args:
            weights: Weight of every node `(ny+1, nx+1)` [-].
        """
        stacked = weights.reshape(self.posterior.white.normal.shape)
        return self._like_normal(normal_covariance(self.posterior, stacked)[None])[0]

    def unobserved(self) -> dict[str, tuple[float, float]]:
        """Name unobserved directions: their posterior standard deviation is above half of the prior one.

        Candidates are mean and tilt of the pressure of each map, and fitted numbers. Under a bonded, nearly
        incompressible layer a uniform pressure moves the interface very little: its mean is then determined by the
        prior. Correlated numbers, such as C10 and C01 at small strain, are named by their unobserved combination:
        "c01 - 0.31 c10", each in standard deviations of its prior.

        Returns:
            Posterior and prior standard deviation, by name [MPa for pressures, - for white unknowns of numbers].
        """
        found: dict[str, tuple[float, float]] = {}
        shape = self.posterior.white.normal.shape
        drawn = self.deviations.reshape(-1, *shape)
        # The null space of the prior has no prior standard deviation.
        modes = {n: mode for n, mode in _MODES.items() if self.prior.mode_weight(shape[1:])[mode] == 1.0}
        for i in range(shape[0]):
            for name, mode in modes.items():
                weights = jnp.zeros(shape).at[i].set(_cosine(shape[1:], mode))
                before = _prior_std(self.objective, self.posterior.white, weights)
                roughly = jnp.sqrt(jnp.mean(jnp.sum(weights * drawn, axis=(1, 2, 3)) ** 2))
                if len(drawn) >= _ENOUGH_DRAWS and roughly < 0.5 * _NOT_OBSERVED * before:
                    continue
                after = jnp.sqrt(jnp.sum(weights * normal_covariance(self.posterior, weights)))
                if after > _NOT_OBSERVED * before:
                    label = name if shape[0] == 1 else f"{name} of map {i}"
                    found[label] = (float(after), float(before))
        if self.objective.parameters:
            variances, directions = np.linalg.eigh(np.asarray(self.number_covariance))
            for variance, direction in zip(variances, directions.T, strict=True):
                if (after := np.sqrt(variance)) > _NOT_OBSERVED:
                    found[_direction_name(list(self.objective.parameters), direction)] = (float(after), 1.0)
        return found

    def _like_normal(self, stacked: Float[Array, "n maps my mx"]) -> Array:
        """Remove the axis of maps from draws of a single map."""
        return stacked if self.residual.ndim == 3 else stacked[:, 0]


@QuickJit
def _prior_std(objective: Objective, white: Unknowns, weights: Float[Array, "maps my mx"]) -> Array:
    """Compute the prior standard deviation [MPa] of a weighted sum of the normal traction."""
    return jnp.sqrt(jnp.sum(jax.vjp(objective.applied, white)[1](weights)[0].normal ** 2))


def _direction_name(names: list[str], direction: np.ndarray) -> str:
    """Format a direction as a sum of names, the largest component first."""
    order = np.argsort(-np.abs(direction))
    parts = direction[order] / direction[order[0]]
    others = [(part, names[i]) for part, i in zip(parts[1:], order[1:], strict=True) if abs(part) > _MATTERS]
    return names[order[0]] + "".join(f" {'+' if part > 0 else '-'} {abs(part):.2g} {name}" for part, name in others)


def _cosine(shape: tuple[int, ...], mode: tuple[int, int]) -> Array:
    """Compute weights of a cosine mode: an average for mode (0, 0), else a difference between opposite sides."""
    my, mx = shape
    y = jnp.cos(jnp.pi * mode[0] * (jnp.arange(my) + 0.5) / my)
    x = jnp.cos(jnp.pi * mode[1] * (jnp.arange(mx) + 0.5) / mx)
    return y[:, None] * x / (my * mx)
