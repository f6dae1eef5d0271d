"""The fit's preconditioner: the layer as its transfer function, as thick as it was measured.

Indentation grows about with the cube of the local thickness where the layer is thin against the waves of the
pressure. With that, and with what is masked, the normal matrix is no longer diagonal in cosines, but its products
cost four transforms: its systems are solved by conjugate gradients of their own.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from ..model import Palpation
from .estimates import response
from .observation import Nodes, Observation
from .prior import AbstractPrior, Spacing, cosine_transform, from_cosines
from .transfer import wave_numbers

_RTOL = 1e-3
_STEPS = 200


class LayerNormal(eqx.Module):
    """Approximate normal matrix of misfit and prior; calling it multiplies with its inverse.

    Attributes:
        prior: The prior.
        spacing: Node spacing (dx, dy) [mm].
        gain: Indentation per pressure of every cosine mode [mm/MPa].
        softness: Local indentation over that of the mean thickness [-].
        precision: Of the measured surface at the nodes [1/mm²].
    """

    prior: AbstractPrior
    spacing: Spacing
    gain: Nodes
    softness: Nodes
    precision: Nodes

    def __call__(self, gradient: Nodes) -> Nodes:
        """Multiply with the inverse, to 1e-3."""
        held = jnp.asarray(self.prior.penalised(gradient.shape)) ** 2
        spread = self.prior.mode_std(wave_numbers(gradient.shape, self.spacing), self.spacing)
        weight = self.softness**2 * self.precision
        diagonal = held + (spread * self.gain) ** 2 * jnp.mean(weight)

        def indentation(white):
            return from_cosines(self.gain * cosine_transform(self.prior.expand(white, self.spacing)))

        _, pull = jax.vjp(indentation, jnp.zeros_like(gradient))

        def multiply(white):
            return held * white + pull(weight * indentation(white))[0]

        return jax.scipy.sparse.linalg.cg(
            multiply, gradient, tol=_RTOL, atol=0.0, maxiter=_STEPS, M=lambda r: r / diagonal
        )[0]


def layer_normal(palpation: Palpation, observation: Observation, prior: AbstractPrior) -> LayerNormal:
    """Build the preconditioner of a fit."""
    mesh = palpation.mesh()
    pressed = observation.surface / jnp.mean(observation.surface)
    gain = response(palpation, jnp.mean(observation.surface))
    return LayerNormal(prior, mesh.spacing, gain, jnp.clip(pressed, 0.1, 10.0) ** 3, observation.precision)
