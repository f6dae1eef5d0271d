"""What is known of the traction before it is measured: priors on the interface's nodes.

A prior turns white noise into tractions, `mean + expand(white)`: what is fitted is the white noise, so that the prior
itself costs nothing and its preconditioner is at hand. All of it by cosine transforms, O(n log n).
"""

import itertools

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.fft
import numpy as np
from jaxtyping import Array, Float

from .._checks import Leaf, check_finite, check_positive
from .._types import ScalarLike
from .transfer import wave_numbers

Nodes = Float[Array, "my mx"]
Spacing = tuple[ScalarLike, ScalarLike]
# How firmly a prior holds what it says nothing of, over what it holds: its standard deviation is as much larger.
_HARDLY = 1e-3


def cosine_transform(values: Nodes) -> Nodes:
    """Expand nodal values in orthonormal cosines."""
    return jax.scipy.fft.dctn(values, norm="ortho")


def from_cosines(modes: Nodes) -> Nodes:
    """Sum orthonormal cosines: inverse, and transpose, of `cosine_transform`."""
    return jax.scipy.fft.idctn(modes, norm="ortho")


class AbstractPrior(eqx.Module):
    """A Gaussian prior on one traction component at the nodes of the interface [MPa]."""

    mean: eqx.AbstractVar[Array | None]

    def mode_std(self, k: Nodes, spacing: Spacing) -> Nodes:
        """Compute the standard deviation of every orthonormal cosine mode [MPa]."""
        raise NotImplementedError

    def scale(self, shape: tuple[int, ...], spacing: Spacing) -> Nodes | Array:
        """Compute what nodal values are multiplied with after the cosine transform [-]."""
        raise NotImplementedError

    def penalised(self, shape: tuple[int, ...]) -> np.ndarray:
        """Tell how firmly the prior holds white unknowns near zero: 1, or `_HARDLY` where it says nothing."""
        return np.ones(shape)

    def held(self, white: Nodes, spacing: Spacing) -> Array:
        """Compute what the prior holds near zero, standardised: half its sum of squares is the prior's energy."""
        del spacing
        return jnp.asarray(self.penalised(white.shape)) * white

    def expand(self, white: Nodes, spacing: Spacing) -> Nodes:
        """Turn white unknowns into deviations from the mean [MPa]."""
        k = wave_numbers(white.shape, spacing)
        modes = self.mode_std(k, spacing) * white
        return self.scale(white.shape, spacing) * from_cosines(modes)

    def whiten(self, deviation: Nodes, spacing: Spacing) -> Nodes:
        """Turn deviations from the mean into white unknowns: the inverse of `expand`, but for waves it excludes."""
        std = self.mode_std(wave_numbers(deviation.shape, spacing), spacing)
        modes = cosine_transform(deviation / self.scale(deviation.shape, spacing))
        return jnp.where(std > 0, modes / jnp.where(std > 0, std, 1.0), 0.0)


class Matern(AbstractPrior):
    """A Matérn field: of one standard deviation everywhere, correlated over a length.

    Points d apart correlate by (1 + √3 d/length) exp(-√3 d/length) at the default smoothness. Within a
    length of the edges points correlate more, as if the field were mirrored there; the standard
    deviation stays.

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
        """Compute what nodal values are multiplied with, so that all have the same standard deviation [-]."""
        variance = self.mode_std(wave_numbers(shape, spacing), spacing) ** 2
        for axis in (0, 1):
            squares = jnp.asarray(_squared_cosines(shape[axis]))
            variance = jnp.moveaxis(jnp.tensordot(squares, variance, ((1,), (axis,))), 0, axis)
        return self.std / jnp.sqrt(variance)


class Tikhonov(AbstractPrior):
    """A penalty on slopes or curvature: weight² ∫ |∇^order p|² over the interface.

    It says nothing of the mean pressure.

    Args:
        order: 1: slopes, 2: curvature.
        weight: Square root of the penalty's factor [mm^(order-1)/MPa].
        mean: What differences are taken from, a number or interface nodes `(ny+1, nx+1)` [MPa]; None: zero.

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
        """Compute the standard deviation of every orthonormal cosine mode [MPa]; of the free one, a large number."""
        hx, hy = spacing
        lowest = jnp.min(jnp.where(k > 0, k, jnp.inf))
        unit = 1.0 / (self.weight * jnp.sqrt(hx * hy))
        return unit * jnp.where(k > 0, jnp.where(k > 0, k, 1.0) ** -float(self.order), lowest**-self.order)

    def scale(self, shape: tuple[int, ...], spacing: Spacing) -> Array:
        """Compute what nodal values are multiplied with: 1."""
        return jnp.ones(())

    def penalised(self, shape: tuple[int, ...]) -> np.ndarray:
        """Tell how firmly the prior holds white unknowns near zero: all but the mean."""
        held = np.ones(shape)
        held[0, 0] = _HARDLY
        return held


class TotalVariation(AbstractPrior):
    """A penalty on edges by their height, not their steepness: weight ∫ (√(|∇p|² + slope²) - slope) over the interface.

    Smooth below `slope`, where it is `Tikhonov(1, √(weight/slope))`. It says nothing of the mean pressure. Its
    posterior is that of the quadratic penalty which touches it at the optimum.

    Args:
        weight: Factor of the penalty [1/(MPa mm)].
        slope: Gradient of the pressure above which it counts as an edge [MPa/mm].
        mean: What differences are taken from, a number or interface nodes `(ny+1, nx+1)` [MPa]; None: zero.

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

    def penalised(self, shape: tuple[int, ...]) -> np.ndarray:
        """Tell how firmly the prior holds white unknowns near zero where the pressure is smooth: all but the mean."""
        return self._smooth.penalised(shape)

    def held(self, white: Nodes, spacing: Spacing) -> tuple[Array, Array]:
        """Compute slopes, standardised so that half their sum of squares is the penalty; and what holds the mean."""
        hx, hy = spacing
        p = self.expand(white, spacing)
        along_x, along_y = (p[:, 1:] - p[:, :-1]) / hx, (p[1:] - p[:-1]) / hy
        # Of each element every corner with its two edges: differences across it would not see a checkerboard.
        edges = itertools.product((along_x[:-1], along_x[1:]), (along_y[:, :-1], along_y[:, 1:]))
        slopes = jnp.stack([jnp.stack(pair) for pair in edges])
        length = jnp.sqrt(jnp.sum(slopes**2, axis=1, keepdims=True) + self.slope**2)
        factor = jnp.sqrt(0.5 * self.weight * hx * hy / (length + self.slope))
        return factor * slopes, _HARDLY * white[0, 0]


def on_nodes(prior: AbstractPrior, shape: tuple[int, ...]) -> Array:
    """Spread the prior's mean over the interface's nodes [MPa], of both components where it is of a lateral traction.

    Raises:
        ValueError: If it is a map of another shape.
    """
    mean = jnp.zeros(()) if prior.mean is None else prior.mean
    if mean.ndim and mean.shape != shape:
        axes = "(ny+1, nx+1)" if len(shape) == 2 else "(2, ny+1, nx+1)"
        raise ValueError(
            f"{type(prior).__name__}.mean [MPa] must be a number or interface nodes {axes} = {shape}, got {mean.shape}."
        )
    return jnp.broadcast_to(mean, shape)


def _squared_cosines(n: int) -> np.ndarray:
    """Square the orthonormal cosines: by node and mode."""
    i = np.arange(n)
    cosines = np.cos(np.pi * (i[:, None] + 0.5) * i / n) * np.sqrt(2.0 / n)
    cosines[:, 0] = np.sqrt(1.0 / n)
    return cosines**2
