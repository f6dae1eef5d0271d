"""What a fit returns: traction, its uncertainty, and how well it explains the map."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ..measurement import ThicknessMap
from ..solvers import Solution
from ..solvers.compiling import QuickJit
from .misfit import Misfit, carried, normal_covariance
from .posterior import Posterior
from .preconditioner import Unknowns
from .prior import AbstractPrior

# A direction counts as not observed when the data leave it this part of its standard deviation before.
_NOT_OBSERVED = 0.5
# χ² per degree of freedom that model and noise explain.
_CHI2_BOUNDS = (0.5, 2.0)
# A number takes part in a direction from this share of the largest one on.
_MATTERS = 0.1
# The lowest cosine modes (rows, columns) that are looked at by name.
_MODES = {"mean pressure": (0, 0), "pressure rising along x": (0, 1), "pressure rising along y": (1, 0)}


class FitStatus(eqx.Enumeration):
    """How a fit ended."""

    successful = ""
    max_steps_reached = (
        "The fit took fit_traction(max_steps=...) Gauss–Newton steps without settling. Raise it, or start closer: "
        "from the normal traction of a fit on a coarser mesh (start=...), a prior with a mean, a longer length or a "
        "smaller std."
    )
    stalled = (
        "Hardly any step along the directions of the fit lowers its misfit, as where the layer snaps under its "
        "traction. Start closer (start=...), or give the prior a mean, a longer length or a smaller std."
    )
    not_carried = (
        "The layer does not carry the traction that the fit starts from. Give the prior a smaller std or a longer "
        "length; where the sample does not touch, mask the map, or keep the layer from being pulled off its window by "
        "fit_traction(nonnegative=True)."
    )
    too_many_increments = (
        "The forward solve takes more increments than its derivative follows, as where the layer hardly carries the "
        "traction. Raise max_path of fit_traction(solver=Newton(max_path=...)), or ask for fewer increments; else give "
        "the prior a smaller std or a longer length, mask what does not touch, or pass fit_traction(nonnegative=True)."
    )
    nonfinite = "A derivative of the layer's response is not finite: a linear solve did not converge. Smooth the map."


class FitError(RuntimeError):
    """A fit ended without an optimum."""


class TractionFit(eqx.Module):
    """The traction fitted to a measured map, or to several: arrays then have a leading axis, one entry per map.

    Attributes:
        solution: The layer under the fitted traction, solved to the solver's own tolerance. Its load is pressed by
            springs (`Traction.stiffness`), near an imprint of the map, so that the layer does not snap on its way; a
            dead one where springs do not do. `traction` is what the layer carries either way.
        pressure_std: Posterior standard deviation of `pressure`, on the current area [MPa].
        normal_std: The same of the normal traction, per reference area [MPa].
        chi2: Sum of squared misfits between interface and measured surface over their noise, of all maps [-].
        effective_dof: How many degrees of freedom the maps determine [-].
        observed: How many they could have determined [-]: their independent numbers on the mesh's splines.
        residual: Interface minus measured surface at the mesh's own grid in space [mm].
        resolution_points: Where the resolution was looked at, (x, y) of nodes [mm].
        resolution_width: Width of the posterior's resolution kernel there [mm]: what a point of truth is smeared over.
            That of the Gaussian of the same peak and sum of squares, full width at half maximum: 1.3 elements where
            the mesh itself is the limit.
        deviations: Draws of the normal traction minus the optimum, which standard deviations come from [MPa].
        number_covariance: Posterior covariance of the white unknowns of fitted numbers, each of variance 1 before the
            fit, in the order of `numbers` [-].
        misfit: What was minimised, with the prior as chosen.
        posterior: The posterior of the white unknowns.
        stats: `forward_solves`, `gauss_newton_steps`, `inner_iterations` (each one product with the Jacobian and one
            with its transpose), `posterior_iterations`, `draws`, `draws_cut_short` (those whose linear system was
            not solved), `std_error` (relative standard error of the standard deviations [-]), `representation_rms`
            [mm] (what the map has beyond mesh-spaced splines), `misfit_rms` [mm]; `lateral_informed` [-] where the
            lateral traction was fitted: 0 where it rests on its prior alone, 1 where on the maps.
        result: How the fit ended.
    """

    solution: Solution
    pressure_std: Array
    normal_std: Array
    chi2: Array
    effective_dof: Array
    observed: Array
    residual: Array
    resolution_points: Float[np.ndarray, "points 2"]
    resolution_width: Float[np.ndarray, "*maps points"]
    deviations: Array
    number_covariance: Float[Array, "numbers numbers"]
    misfit: Misfit
    posterior: Posterior
    stats: dict[str, Any]
    result: FitStatus

    @property
    def prior(self) -> AbstractPrior:
        """The prior of the normal traction, its hyper-parameters as chosen."""
        return self.misfit.prior

    @property
    def traction(self) -> Float[Array, "*maps 3 my mx"]:
        """Force on the layer at the interface per reference area [MPa]."""
        return self.solution.traction

    @property
    def normal(self) -> Float[Array, "*maps my mx"]:
        """Normal traction per reference area, positive in compression [MPa]: what was fitted."""
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
        """χ² over the degrees of freedom that are left to judge it by: near 1 where model and noise are right."""
        return self.chi2 / (self.observed - self.effective_dof)

    def advice(self) -> str:
        """Say what to look at where `reduced_chi2` is far from 1; nothing where it is near."""
        if self.reduced_chi2 > _CHI2_BOUNDS[1]:
            return (
                f"χ² per degree of freedom is {self.reduced_chi2:.3g} and should be near 1: the layer cannot explain "
                "the map (material, friction, L0, mask), its noise (std) or what the mesh misses (model_std) is larger "
                "than given, or the prior is too strong. Standard deviations are then too small."
            )
        if self.reduced_chi2 < _CHI2_BOUNDS[0]:
            # Maps of OCT volumes of a coin: 0.41 at 16×16×4 elements, 0.15 at 40×40×4; 91 and 99.7 % inside the bands.
            return (
                f"χ² per degree of freedom is {self.reduced_chi2:.3g} and should be near 1. It is less where noise is "
                "correlated over pixels (noise_length) or the traction is smoother than its prior: the shortest waves "
                "of the mesh then hold less than is assumed. Otherwise the noise given (std or model_std) is too "
                "large. Standard deviations are rather too large."
            )
        return ""

    @property
    def numbers(self) -> dict[str, Array]:
        """Fitted numbers of the experiment, by name."""
        return self.misfit.numbers(self.posterior.white)

    def number_intervals(self, coverage: float = 0.95) -> dict[str, tuple[float, float]]:
        """Compute intervals that hold fitted numbers with the probability asked for, by name."""
        half = float(jax.scipy.stats.norm.ppf(0.5 + 0.5 * coverage))
        spread = dict(zip(self.misfit.parameters, jnp.sqrt(jnp.diag(self.number_covariance)), strict=True))
        white = self.posterior.white.numbers

        def end(name, prior, sign):
            return float(prior.number(white[name] + sign * half * spread[name]))

        return {name: (end(name, prior, -1.0), end(name, prior, 1.0)) for name, prior in self.misfit.parameters.items()}

    def not_identified(self, within: float = 0.25) -> dict[str, float]:
        """Name fitted numbers that the data do not tell to a part of their value.

        Args:
            within: Half of the 95 % interval, over the fitted value, that counts as told [-].

        Returns:
            That part where it is larger, by name [-].
        """
        values = self.numbers
        parts = {n: 0.5 * (high - low) / abs(float(values[n])) for n, (low, high) in self.number_intervals().items()}
        return {name: part for name, part in parts.items() if part > within}

    def draws(self, key: PRNGKeyArray, n: int) -> Float[Array, "n *maps my mx"]:
        """Draw normal tractions from the posterior [MPa].

        Args:
            key: Random key.
            n: How many.
        """
        drawn = jnp.stack([carried(self.posterior.draw(one)[1]) for one in jax.random.split(key, n)])
        return self.normal + self._like_normal(drawn)

    def covariance(self, weights: Float[Array, "*maps my mx"]) -> Float[Array, "*maps my mx"]:
        """Multiply the posterior covariance of the normal traction with weights: Cov(p, Σ weights p).

        The variance of the weighted sum Σ weights p is the sum of weights times the answer.

        Args:
            weights: Of every node `(ny+1, nx+1)` [-].
        """
        stacked = weights.reshape(self.posterior.white.normal.shape)
        return self._like_normal(normal_covariance(self.posterior, stacked)[None])[0]

    def unobserved(self) -> dict[str, tuple[float, float]]:
        """Name what the maps do not tell: directions that keep over half of their standard deviation before the fit.

        Looked at are mean and tilt of the pressure of each map, and fitted numbers. Under a bonded, nearly
        incompressible layer a uniform pressure hardly moves the interface: its mean then rests on the prior. Numbers
        that are known only together, such as C10 and C01 at small strain, are named by the combination that is not
        known: "c01 - 0.31 c10" counts white unknowns, so each in standard deviations of its prior.

        Returns:
            By name: standard deviation after and before the fit [MPa for pressures, - for numbers' white unknowns].
        """
        found: dict[str, tuple[float, float]] = {}
        shape = self.posterior.white.normal.shape
        for i in range(shape[0]):
            for name, mode in _MODES.items():
                weights = jnp.zeros(shape).at[i].set(_cosine(shape[1:], mode))
                after = jnp.sqrt(jnp.sum(weights * normal_covariance(self.posterior, weights)))
                before = _std_before(self.misfit, self.posterior.white, weights)
                label = name if shape[0] == 1 else f"{name} of map {i}"
                # What the prior does not hold has no standard deviation before the fit.
                penalised = self.prior.penalised(shape[1:])[mode] == 1.0
                if penalised and after > _NOT_OBSERVED * before:
                    found[label] = (float(after), float(before))
        if self.misfit.parameters:
            variances, directions = np.linalg.eigh(np.asarray(self.number_covariance))
            for variance, direction in zip(variances, directions.T, strict=True):
                if (after := np.sqrt(variance)) > _NOT_OBSERVED:
                    found[_direction_name(list(self.misfit.parameters), direction)] = (float(after), 1.0)
        return found

    def _like_normal(self, stacked: Float[Array, "n maps my mx"]) -> Array:
        """Add nothing to draws of several maps; of a single one take the axis of maps away."""
        return stacked if self.residual.ndim == 3 else stacked[:, 0]


@QuickJit
def _std_before(misfit: Misfit, white: Unknowns, weights: Float[Array, "maps my mx"]) -> Array:
    """Compute the prior standard deviation [MPa] of a weighted sum of the normal traction."""
    return jnp.sqrt(jnp.sum(jax.vjp(misfit.asked, white)[1](weights)[0].normal ** 2))


def _direction_name(names: list[str], direction: np.ndarray) -> str:
    """Write a direction as a sum of names, the largest first and alone where no other matters."""
    order = np.argsort(-np.abs(direction))
    parts = direction[order] / direction[order[0]]
    others = [(part, names[i]) for part, i in zip(parts[1:], order[1:], strict=True) if abs(part) > _MATTERS]
    return names[order[0]] + "".join(f" {'+' if part > 0 else '-'} {abs(part):.2g} {name}" for part, name in others)


def _cosine(shape: tuple[int, ...], mode: tuple[int, int]) -> Array:
    """Make weights of mean one-node size: an average for mode (0, 0), else a difference between the sides."""
    my, mx = shape
    y = jnp.cos(jnp.pi * mode[0] * (jnp.arange(my) + 0.5) / my)
    x = jnp.cos(jnp.pi * mode[1] * (jnp.arange(mx) + 0.5) / mx)
    return y[:, None] * x / (my * mx)
