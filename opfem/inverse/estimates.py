"""Estimates of the pressure without finite elements: small-strain elasticity of the layer, and uniaxial compression."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import ScalarLike
from ..measurement import ThicknessMap
from ..model import Bonded, Palpation
from ..model.homogeneous import cauchy_stress
from ..model.plausible import check_against_layer
from ..solvers.compiling import QuickJit
from .conjugate_gradients import LeastSquares, least_squares
from .noise import noise_std
from .observation import Nodes, Observation, observe
from .prior import AbstractPrior, cosine_transform, from_cosines, on_nodes
from .transfer import Base, poisson_ratio, transfer_function, wave_numbers

# Relative gradient at which the linear estimate counts as solved, and most iterations.
_RTOL = 1e-8
_STEPS = 1000


class LinearEstimate(eqx.Module):
    """The pressure that small-strain elasticity of a flat layer gives.

    Attributes:
        normal: Pressure per reference area at the interface's nodes `(ny+1, nx+1)` [MPa].
        heights: Height of the interface under it [mm].
        chi2: Sum of squared standardised misfits [-].
    """

    normal: Nodes
    heights: Nodes
    chi2: Array


def response(palpation: Palpation, thickness: ScalarLike, base: Base | None = None) -> Float[Array, "my mx"]:
    """Compute the indentation per pressure of every cosine mode [mm/MPa].

    Args:
        palpation: The experiment.
        thickness: Of the layer [mm].
        base: What the window does; None: its own kind, where one with friction counts as slipping.
    """
    mesh, material = palpation.mesh(), palpation.layer.material
    base = base or ("bonded" if isinstance(palpation.window, Bonded) else "slip")
    k = wave_numbers(mesh.thickness.shape, mesh.spacing)
    return transfer_function(k, thickness, material.shear, poisson_ratio(material), base)


@QuickJit
def solve_linear(palpation: Palpation, observation: Observation, prior: AbstractPrior) -> LeastSquares:
    """Find the white unknowns of the linear estimate."""
    mesh = palpation.mesh()
    gain, held = response(palpation, jnp.mean(mesh.thickness)), jnp.asarray(prior.penalised(mesh.thickness.shape))
    mean = on_nodes(prior, mesh.thickness.shape)
    spread = prior.mode_std(wave_numbers(held.shape, mesh.spacing), mesh.spacing)
    diagonal = held**2 + (spread * gain) ** 2 * jnp.mean(observation.precision)

    def indentation(normal):
        return from_cosines(gain * cosine_transform(normal))

    def jacobian(white):
        return observation.misfit_change(-indentation(prior.expand(white, mesh.spacing))), held * white

    _, pull = jax.vjp(jacobian, jnp.zeros(held.shape))
    start = observation.misfit(mesh.thickness - indentation(mean)), jnp.zeros(held.shape)
    b = jax.tree.map(jnp.negative, start)
    return least_squares(jacobian, lambda r: pull(r)[0], lambda r: r / diagonal, b, _RTOL, _STEPS)


def linear_estimate(palpation: Palpation, thickness: ThicknessMap, prior: AbstractPrior) -> LinearEstimate:
    """Estimate the pressure by small-strain elasticity, instantly.

    The layer counts as flat, of its mean thickness; without friction at the window unless bonded there; and its
    points as not moving sideways. Good up to a few percent of strain.

    Args:
        palpation: The experiment.
        thickness: The measured map, its `std` known; masked pixels need no fill.
        prior: What is known of the pressure.

    Raises:
        ValueError: If the map's std is missing or not positive.
    """
    std = noise_std("linear_estimate", thickness)
    check_against_layer("linear_estimate.thickness", thickness, palpation.layer.thickness, palpation.extent, 3)
    mesh = palpation.mesh()
    observation = observe(mesh, thickness, std)
    white = solve_linear(palpation, observation, prior).x
    normal = on_nodes(prior, white.shape) + prior.expand(white, mesh.spacing)
    heights = mesh.thickness - from_cosines(response(palpation, jnp.mean(mesh.thickness)) * cosine_transform(normal))
    return LinearEstimate(normal, heights, jnp.sum(observation.misfit(heights) ** 2))


def uniaxial_estimate(palpation: Palpation, thickness: ThicknessMap) -> Nodes:
    """Estimate the pressure as classic optical palpation does: every point by itself in uniaxial compression.

    Returns:
        Pressure per current area, the Cauchy stress, at the interface's nodes `(ny+1, nx+1)` [MPa].

    Source:
        Kennedy et al., Optics Letters 39 (2014) 3014: the layer's local strain and its stress–strain curve.
    """
    check_against_layer("uniaxial_estimate.thickness", thickness, palpation.layer.thickness, palpation.extent, 3)
    mesh = palpation.mesh()
    stretch = thickness.sample(*mesh.plane()) / mesh.thickness
    return -cauchy_stress(palpation.layer.material, stretch)
