"""Gaussian priors of a traction component at the nodes of the interface.

A prior maps white noise to tractions, `mean + expand(white)`, by cosine transforms in O(n log n). A fit determines the
white noise: the prior's covariance is then the identity, and its inverse costs nothing.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.fft
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from .._checks import Leaf, check_finite, check_positive, concrete
from .._types import ScalarLike

Nodes = Float[Array, "my mx"]
Spacing = tuple[ScalarLike, ScalarLike]
# Weight of the prior's null space relative to its penalised modes: it makes an improper prior proper, with a standard
# deviation a thousand times that of the longest wave.
_NULL_SPACE_WEIGHT = 1e-3
# Limit of BFGS steps in the search for Matérn hyper-parameters, two unknowns.
_MAX_STEPS = 200


def cosine_transform(values: Nodes) -> Nodes:
    """Expand nodal values in orthonormal cosines."""
    return jax.scipy.fft.dctn(values, norm="ortho")


def from_cosines(modes: Nodes) -> Nodes:
    """Sum orthonormal cosines: inverse, and transpose, of `cosine_transform`."""
    return jax.scipy.fft.idctn(modes, norm="ortho")


def wave_numbers(shape: tuple[int, ...], spacing: tuple[ScalarLike, ScalarLike]) -> Float[Array, "my mx"]:
    """Compute the wave number [1/mm] of every mode of a two-dimensional cosine transform on nodes."""
    (my, mx), (hx, hy) = shape, spacing
    ky = jnp.pi * jnp.arange(my) / (my * hy)
    kx = jnp.pi * jnp.arange(mx) / (mx * hx)
    return jnp.sqrt(ky[:, None] ** 2 + kx**2)


class AbstractPrior(eqx.Module):
    """Prior of one traction component at the nodes of the interface [MPa]."""

    mean: eqx.AbstractVar[Array | None]

    def mode_std(self, k: Nodes, spacing: Spacing) -> Nodes:
        """Compute the standard deviation of every orthonormal cosine mode [MPa]."""
        raise NotImplementedError

    def scale(self, shape: tuple[int, ...], spacing: Spacing) -> Nodes | Array:
        """Compute the factor of nodal values after the cosine transform [-]."""
        raise NotImplementedError

    def mode_weight(self, shape: tuple[int, ...]) -> np.ndarray:
        """Return the prior's weight of every mode: 1, and 1e-3 in its null space."""
        return np.ones(shape)

    def residual(self, white: Nodes, spacing: Spacing) -> Array:
        """Compute the standardised residual: half its sum of squares is the negative log-density, up to a constant."""
        del spacing
        return jnp.asarray(self.mode_weight(white.shape)) * white

    def scaled(self, factor: float | Array) -> "AbstractPrior":
        """Return this prior with its standard deviation multiplied by a factor."""
        raise NotImplementedError

    def log_normaliser(self, shape: tuple[int, ...], spacing: Spacing) -> Array:
        """Compute half the log-determinant of the covariance: sum of the logarithms of mode deviations and factors."""
        modes = jnp.sum(jnp.log(self.mode_std(wave_numbers(shape, spacing), spacing)))
        return modes + jnp.sum(jnp.log(jnp.broadcast_to(self.scale(shape, spacing), shape)))

    def maximum_likelihood(
        self, deviations: Float[Array, "samples my mx"], spacing: Spacing, extent: Array
    ) -> tuple["AbstractPrior", float]:
        """Compute the hyper-parameters of maximum likelihood for samples: the M step of expectation–maximisation.

        Args:
            deviations: Samples of the posterior minus the prior's mean [MPa].
            spacing: Node spacing (dx, dy) [mm].
            extent: Extent of the layer [mm], the largest correlation length.

        Returns:
            The prior, and the largest change of the logarithm of a hyper-parameter.

        Raises:
            ValueError: For a prior whose normalising constant is unknown.

        Source:
            Dempster, Laird & Rubin, J. R. Stat. Soc. B 39 (1977) 1.
        """
        del deviations, spacing, extent
        raise ValueError(
            f'fit_traction(hyperparameters="evidence") needs Matern(...) or Tikhonov(...), got {type(self).__name__}: '
            'the normalising constant of its density is unknown. Use "discrepancy".'
        )

    def check_resolved(self, spacing: Spacing) -> None:
        """Raise ValueError where the mesh cannot resolve the prior's correlation length; without one, do nothing."""

    def expand(self, white: Nodes, spacing: Spacing) -> Nodes:
        """Map white unknowns to deviations from the mean [MPa]."""
        k = wave_numbers(white.shape, spacing)
        modes = self.mode_std(k, spacing) * white
        return self.scale(white.shape, spacing) * from_cosines(modes)

    def whiten(self, deviation: Nodes, spacing: Spacing) -> Nodes:
        """Map deviations from the mean to white unknowns: the inverse of `expand`, but for modes of no variance."""
        std = self.mode_std(wave_numbers(deviation.shape, spacing), spacing)
        modes = cosine_transform(deviation / self.scale(deviation.shape, spacing))
        return jnp.where(std > 0, modes / jnp.where(std > 0, std, 1.0), 0.0)


class Matern(AbstractPrior):
    """A Matérn field of uniform standard deviation.

    The correlation at distance d is (1 + √3 d/length) exp(-√3 d/length) at the default smoothness. Within a length of
    the edges it is larger, as for a field mirrored there; the standard deviation is the same.

    Args:
        length: Correlation length [mm].
        std: Standard deviation [MPa].
        smoothness: 1.5 by default: once differentiable. Infinity: exp(-d²/(2 length²)).
        mean: A number, or interface nodes `(ny+1, nx+1)` [MPa], of a lateral traction `(2, ny+1, nx+1)`; None: zero.

    Raises:
        ValueError: For a number that is not positive.

    Source:
        Rasmussen & Williams, Gaussian Processes for Machine Learning, section 4.2.
    """

    length: Array = eqx.field(converter=Leaf("Matern.length", "mm"))
    std: Array = eqx.field(converter=Leaf("Matern.std", "MPa"))
    smoothness: Array = eqx.field(converter=Leaf("Matern.smoothness", "-"), default=1.5)
    mean: Array | None = eqx.field(converter=Leaf("Matern.mean", "MPa", optional=True), default=None)

    def __check_init__(self):
        check_positive("Matern.length", "mm", self.length)
        check_positive("Matern.std", "MPa", self.std)
        check_positive("Matern.smoothness", "-", jnp.minimum(self.smoothness, 1e6))
        if self.mean is not None:
            check_finite("Matern.mean", "MPa", self.mean)

    def mode_std(self, k: Nodes, spacing: Spacing) -> Nodes:
        """Compute the standard deviation of every orthonormal cosine mode [MPa]."""
        k2 = (k * self.length) ** 2
        smooth = jnp.minimum(self.smoothness, 1e6)
        algebraic = -(smooth + 1.0) * jnp.log1p(k2 / (2.0 * smooth))
        log_density = jnp.where(jnp.isinf(self.smoothness), -0.5 * k2, algebraic)
        density = jnp.exp(log_density)
        # The mean variance over the nodes is std².
        return self.std * jnp.sqrt(density * k.size / jnp.sum(density))

    def scale(self, shape: tuple[int, ...], spacing: Spacing) -> Nodes:
        """Compute the factor of nodal values that makes their standard deviation uniform [-]."""
        variance = self.mode_std(wave_numbers(shape, spacing), spacing) ** 2
        for axis in (0, 1):
            squares = jnp.asarray(_squared_cosines(shape[axis]))
            variance = jnp.moveaxis(jnp.tensordot(squares, variance, ((1,), (axis,))), 0, axis)
        return self.std / jnp.sqrt(variance)

    def scaled(self, factor: float | Array) -> "Matern":
        """Return this prior with its standard deviation multiplied by a factor."""
        return eqx.tree_at(lambda p: p.std, self, self.std * factor)

    def maximum_likelihood(
        self, deviations: Float[Array, "samples my mx"], spacing: Spacing, extent: Array
    ) -> tuple["Matern", float]:
        """Compute std and length of maximum likelihood, the length between an element and the layer."""
        shape = deviations.shape[1:]
        shortest, longest = jnp.max(jnp.stack(spacing)), jnp.max(extent)

        def changed(x):
            length = shortest + (longest - shortest) * jax.nn.sigmoid(x[1])
            return eqx.tree_at(lambda p: (p.std, p.length), self, (self.std * jnp.exp(x[0]), length))

        def negative_log_likelihood(x, _):
            candidate = changed(x)
            white = jax.vmap(lambda d: candidate.whiten(d, spacing))(deviations)
            return 0.5 * jnp.mean(jnp.sum(white**2, axis=(1, 2))) + candidate.log_normaliser(shape, spacing)

        share = jnp.clip((self.length - shortest) / (longest - shortest), 1e-3, 1.0 - 1e-3)
        start = jnp.stack([jnp.zeros(()), jnp.log(share / (1.0 - share))])
        search = optx.BFGS(1e-5, 1e-5)
        found = optx.minimise(negative_log_likelihood, search, start, max_steps=_MAX_STEPS, throw=False).value
        chosen = changed(found)
        change = jnp.maximum(jnp.abs(jnp.log(chosen.std / self.std)), jnp.abs(jnp.log(chosen.length / self.length)))
        return chosen, float(change)

    def check_resolved(self, spacing: Spacing) -> None:
        """Raise ValueError where the correlation length is below the size of an element."""
        length, size = concrete(self.length), concrete(jnp.stack(spacing).max())
        if length is not None and size is not None and np.any(length < size):
            raise ValueError(
                f"Matern.length [mm] must be at least an element, {float(size):g}, got {float(length):g}: the mesh "
                "cannot resolve it. Pass a longer length, or Palpation(elements=...) with more."
            )


class Tikhonov(AbstractPrior):
    """A penalty on slopes or curvature: weight² ∫ |∇^order p|² over the interface.

    Its null space is the mean pressure.

    Args:
        order: 1: slopes, 2: curvature.
        weight: Square root of the penalty's factor [mm^(order-1)/MPa].
        mean: Reference of the penalised deviation, a number or interface nodes `(ny+1, nx+1)` [MPa]; None: zero.

    Raises:
        ValueError: If the order is neither 1 nor 2, or the weight is not positive.
    """

    order: int = eqx.field(static=True)
    weight: Array = eqx.field(converter=Leaf("Tikhonov.weight", "mm^(order-1)/MPa"))
    mean: Array | None = eqx.field(converter=Leaf("Tikhonov.mean", "MPa", optional=True), default=None)

    def __check_init__(self):
        if self.order not in (1, 2):
            raise ValueError(f"Tikhonov.order must be 1 (slopes) or 2 (curvature), got {self.order!r}.")
        check_positive("Tikhonov.weight", "mm^(order-1)/MPa", self.weight)
        if self.mean is not None:
            check_finite("Tikhonov.mean", "MPa", self.mean)

    def mode_std(self, k: Nodes, spacing: Spacing) -> Nodes:
        """Compute the standard deviation of every orthonormal cosine mode [MPa]; of the null space, the largest one."""
        hx, hy = spacing
        lowest = jnp.min(jnp.where(k > 0, k, jnp.inf))
        unit = 1.0 / (self.weight * jnp.sqrt(hx * hy))
        return unit * jnp.where(k > 0, jnp.where(k > 0, k, 1.0) ** -float(self.order), lowest**-self.order)

    def scale(self, shape: tuple[int, ...], spacing: Spacing) -> Array:
        """Compute what nodal values are multiplied with: 1."""
        return jnp.ones(())

    def mode_weight(self, shape: tuple[int, ...]) -> np.ndarray:
        """Return the prior's weight of every mode: 1, and 1e-3 of the mean."""
        weight = np.ones(shape)
        weight[0, 0] = _NULL_SPACE_WEIGHT
        return weight

    def scaled(self, factor: float | Array) -> "Tikhonov":
        """Return this prior with its standard deviation multiplied by a factor."""
        return eqx.tree_at(lambda p: p.weight, self, self.weight / factor)

    def maximum_likelihood(
        self, deviations: Float[Array, "samples my mx"], spacing: Spacing, extent: Array
    ) -> tuple["Tikhonov", float]:
        """Compute the weight of maximum likelihood, in closed form; the mean, in the null space, does not count."""
        del extent
        white = jax.vmap(lambda d: self.whiten(d, spacing))(deviations)
        factor = jnp.sqrt(jnp.sum(white.at[:, 0, 0].set(0.0) ** 2) / (white.size - white.shape[0]))
        return self.scaled(factor), float(jnp.abs(jnp.log(factor)))


class TotalVariation(AbstractPrior):
    """Smoothed total variation, which preserves edges: weight ∫ (√(|∇p|² + slope²) - slope) over the interface.

    Below `slope` it is `Tikhonov(1, √(weight/slope))`. Its null space is the mean pressure. Its posterior is that of
    its quadratic approximation at the optimum.

    Args:
        weight: Factor of the penalty [1/(MPa mm)].
        slope: Gradient of the pressure above which it counts as an edge [MPa/mm].
        mean: Reference of the penalised deviation, a number or interface nodes `(ny+1, nx+1)` [MPa]; None: zero.

    Raises:
        ValueError: If the weight or the slope is not positive.

    Source:
        Rudin, Osher & Fatemi, Physica D 60 (1992) 259, smoothed as in Vogel & Oman, SIAM J. Sci. Comput. 17 (1996) 227.
    """

    weight: Array = eqx.field(converter=Leaf("TotalVariation.weight", "1/(MPa mm)"))
    slope: Array = eqx.field(converter=Leaf("TotalVariation.slope", "MPa/mm"))
    mean: Array | None = eqx.field(converter=Leaf("TotalVariation.mean", "MPa", optional=True), default=None)

    def __check_init__(self):
        check_positive("TotalVariation.weight", "1/(MPa mm)", self.weight)
        check_positive("TotalVariation.slope", "MPa/mm", self.slope)

    @property
    def _smooth(self) -> Tikhonov:
        return Tikhonov(order=1, weight=jnp.sqrt(self.weight / self.slope))

    def mode_std(self, k: Nodes, spacing: Spacing) -> Nodes:
        """Compute the standard deviation of every orthonormal cosine mode [MPa] where the pressure is smooth."""
        return self._smooth.mode_std(k, spacing)

    def scale(self, shape: tuple[int, ...], spacing: Spacing) -> Array:
        """Compute what nodal values are multiplied with: 1."""
        return jnp.ones(())

    def mode_weight(self, shape: tuple[int, ...]) -> np.ndarray:
        """Return the prior's weight of every mode: 1, and 1e-3 of the mean."""
        return self._smooth.mode_weight(shape)

    def scaled(self, factor: float | Array) -> "TotalVariation":
        """Return this prior with the standard deviation of smooth pressure multiplied by a factor."""
        return eqx.tree_at(lambda p: p.weight, self, self.weight / factor**2)

    def residual(self, white: Nodes, spacing: Spacing) -> tuple[Array, Array]:
        """Compute slopes, standardised so that half their sum of squares is the penalty; and the mean's residual."""
        hx, hy = spacing
        p = self.expand(white, spacing)
        along_x, along_y = (p[:, 1:] - p[:, :-1]) / hx, (p[1:] - p[:-1]) / hy
        # Slopes at all four corners of an element: a checkerboard is in the null space of slopes at its centre.
        edges = itertools.product((along_x[:-1], along_x[1:]), (along_y[:, :-1], along_y[:, 1:]))
        slopes = jnp.stack([jnp.stack(pair) for pair in edges])
        length = jnp.sqrt(jnp.sum(slopes**2, axis=1, keepdims=True) + self.slope**2)
        factor = jnp.sqrt(0.5 * self.weight * hx * hy / (length + self.slope))
        return factor * slopes, _NULL_SPACE_WEIGHT * white[0, 0]


def on_nodes(prior: AbstractPrior, shape: tuple[int, ...]) -> Array:
    """Broadcast the prior's mean to the interface's nodes [MPa]; of a lateral traction, to both components.

    Raises:
        ValueError: If the mean has another shape.
    """
    mean = jnp.zeros(()) if prior.mean is None else prior.mean
    if mean.ndim and mean.shape != shape:
        axes = "(ny+1, nx+1)" if len(shape) == 2 else "(2, ny+1, nx+1)"
        raise ValueError(
            f"{type(prior).__name__}.mean [MPa] must be a number or interface nodes {axes} = {shape}, got {mean.shape}."
        )
    return jnp.broadcast_to(mean, shape)


def _squared_cosines(n: int) -> np.ndarray:
    """Compute the squared orthonormal cosines by node and mode."""
    i = np.arange(n)
    cosines = np.cos(np.pi * (i[:, None] + 0.5) * i / n) * np.sqrt(2.0 / n)
    cosines[:, 0] = np.sqrt(1.0 / n)
    return cosines**2
