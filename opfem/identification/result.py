"""Fitted numbers of an experiment: posterior, intervals, and advice on what the observations say."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..inverse.parameters import AbstractNumberPrior
from ..solvers import Solution

SCALE = "scale"
"""Name of the common factor of all increments: wavelength over refractive index, relative to the assumed ratio."""

_STICK = 1  # status of a contact point
_PRIOR_DOMINATED = 0.7  # posterior over prior standard deviation: the data halve the variance below it
_CORRELATED = 0.95  # correlation above which two numbers are identified only in combination
_CHI2 = 2.0  # per datum, above which the model does not explain a source
_CHI2_LEAST = 15.0  # of one datum, 3.9 standard deviations off: one in 10 000 by chance


class ParameterFit(eqx.Module):
    """Numbers of an experiment fitted to observations.

    Attributes:
        names: Names of the fitted numbers; static.
        priors: Their priors, by name.
        white: Their values as standard normal numbers of their priors, in the order of `names` [-].
        white_covariance: Posterior covariance of those, without the mesh error [-].
        white_mesh_covariance: Covariance of their changes with the estimated mesh error [-].
        insensitive: Names of numbers that the observations do not depend on; static.
        residuals: Standardised residuals by source: "phase", "force", "thickness", "bulge" [-].
        solutions: The states at the optimum.
        converged: Whether the fit converged; static.
        steps: Number of steps; static.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    priors: dict[str, AbstractNumberPrior]
    white: Float[Array, " k"]
    white_covariance: Float[Array, "k k"]
    white_mesh_covariance: Float[Array, "k k"]
    insensitive: tuple[str, ...] = eqx.field(static=True)
    residuals: dict[str, Float[Array, " _"]]
    solutions: tuple[Solution, ...]
    converged: bool = eqx.field(static=True)
    steps: int = eqx.field(static=True)

    @property
    def numbers(self) -> dict[str, Array]:
        """Values by name."""
        return {name: self.priors[name].number(white) for name, white in zip(self.names, self.white, strict=True)}

    @property
    def _slope(self) -> Float[Array, " k"]:
        """Derivative of each number by its white one."""
        return jnp.stack(
            [jax.grad(self.priors[name].number)(w) for name, w in zip(self.names, self.white, strict=True)]
        )

    @property
    def covariance(self) -> Float[Array, "k k"]:
        """Posterior covariance of the numbers, in the order of `names`, that of the mesh error included."""
        return self._slope * (self.white_covariance + self.white_mesh_covariance) * self._slope[:, None]

    @property
    def std(self) -> dict[str, Array]:
        """Standard deviations by name."""
        return dict(zip(self.names, jnp.sqrt(jnp.diag(self.covariance)), strict=True))

    @property
    def mesh_std(self) -> dict[str, Array]:
        """Part of the standard deviations that is due to the mesh, by name.

        Nodes that begin to slip one after the other may keep the fit from its optimum: what was left is included.
        """
        return dict(zip(self.names, self._slope * jnp.sqrt(jnp.diag(self.white_mesh_covariance)), strict=True))

    @property
    def prior_share(self) -> dict[str, Array]:
        """Posterior over prior standard deviation of the white numbers, without the mesh error, by name [-]."""
        return dict(zip(self.names, jnp.sqrt(jnp.diag(self.white_covariance)), strict=True))

    @property
    def white_std(self) -> dict[str, Array]:
        """Standard deviations of the white numbers, that of the mesh error included, by name [-]."""
        variance = jnp.diag(self.white_covariance + self.white_mesh_covariance)
        return dict(zip(self.names, jnp.sqrt(variance), strict=True))

    @property
    def correlation(self) -> Float[Array, "k k"]:
        """Correlation of the numbers, in the order of `names` [-]."""
        return _correlation(self.covariance)

    def intervals(self, coverage: float = 0.95) -> dict[str, tuple[float, float]]:
        """Compute credible intervals of the numbers, by name.

        Args:
            coverage: Probability of an interval [-].
        """
        half = float(jax.scipy.stats.norm.ppf(0.5 + 0.5 * coverage))
        found = {}
        for (name, std), white in zip(self.white_std.items(), self.white, strict=True):
            low, high = (float(self.priors[name].number(white + sign * half * std)) for sign in (-1.0, 1.0))
            found[name] = low, high
        return found

    @property
    def chi2(self) -> dict[str, Array]:
        """Sum of squared residuals by source [-]."""
        return {name: jnp.sum(values**2) for name, values in self.residuals.items()}

    def advice(self) -> list[str]:
        """Name poorly identified numbers and sources that the model does not explain."""
        said = []
        for name in self.names:
            if name != SCALE and (name in self.insensitive or float(self.prior_share[name]) > _PRIOR_DOMINATED):
                said.append(f"{name} is prior-dominated: the observations do not identify it.")
        correlation = np.asarray(_correlation(self.white_covariance))
        for a in range(len(self.names)):
            for b in range(a):
                if abs(correlation[a, b]) > _CORRELATED:
                    said.append(
                        f"{self.names[b]} and {self.names[a]} are identified only in combination (correlation "
                        f"{correlation[a, b]:+.2f}). Mid-depth data do not separate two frictions: observe all depths, "
                        "or the force."
                    )
        for name, values in self.residuals.items():
            free = max(values.size - len(self.names), 1)
            if float(jnp.sum(values**2)) > max(_CHI2 * free, _CHI2_LEAST):
                said.append(
                    f"χ² of {name} is {float(jnp.sum(values**2)) / free:.1f} a datum: the model cannot explain it. Is "
                    "a fixed number wrong, such as the bulk modulus, or the mesh too coarse?"
                )
        for face, name in (("window", "window.friction"), ("sample", "sample.friction")):
            status = np.stack([np.asarray(getattr(one, face).status) for one in self.solutions])
            if name in self.names and np.all(status <= _STICK):
                low = float(self.numbers[name] - 1.645 * self.std[name])
                said.append(f"The layer sticks to the {face} everywhere: friction is above {max(low, 0.0):.3g} (95 %).")
        return said


def _correlation(covariance: Float[Array, "k k"]) -> Float[Array, "k k"]:
    std = jnp.sqrt(jnp.diag(covariance))
    return covariance / std / std[:, None]
