"""Linear layer: transfer function of small-strain elasticity, and pressure estimates without finite elements.

u_z(h) = -G(k) p cos(k x) for a pressure p cos(k x) on a layer of thickness h. G gives the linear estimate, and from it
the preconditioner and the warm start of a fit.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import ScalarLike
from ..measurement import ThicknessMap
from ..model import Bonded, Palpation
from ..model.homogeneous import cauchy_stress
from ..model.material import AbstractMaterial
from ..model.plausible import check_against_layer
from ..optimise.conjugate_gradients import LeastSquares, least_squares
from ..solvers.compiling import QuickJit
from .measured_surface import MeasuredSurface, Nodes, noise_std, project_map
from .prior import AbstractPrior, cosine_transform, from_cosines, on_nodes, wave_numbers

Base = Literal["bonded", "slip"]
# Beyond this k h the layer is a half-space to round-off; hyperbolic functions would overflow.
_DEEP = 300.0
# Below this k h numerator and denominator cancel; G differs from its limit by less than 1e-8.
_SHALLOW = 1e-4
# CGLS tolerance of the linear estimate, well below its model error, and limit of iterations.
_RTOL = 1e-8
_STEPS = 1000


def poisson_ratio(material: AbstractMaterial) -> Array:
    """Compute Poisson's ratio at small strain [-]; 1/2 for an infinite bulk modulus."""
    ratio = material.shear / material.bulk
    return (3.0 - 2.0 * ratio) / (6.0 + 2.0 * ratio)


def transfer_function(
    k: Float[Array, "*modes"],
    thickness: ScalarLike,
    shear: ScalarLike,
    poisson: ScalarLike | Float[Array, "*ratios"],
    base: Base,
) -> Array:
    """Compute G(k) [mm/MPa], indentation per pressure.

    Args:
        k: Wave numbers [1/mm].
        thickness: Thickness of the layer [mm].
        shear: Shear modulus [MPa].
        poisson: Poisson's ratio [-], 1/2 included.
        base: Boundary condition of the other face: "bonded", or "slip" without friction.

    Source:
        Plane-strain elasticity of a layer; for the bonded one Johnson, Contact Mechanics, section 5.8.
    """
    x = jnp.clip(k * thickness, _SHALLOW, _DEEP)
    # Hyperbolic functions divided by exp(2 x).
    decay = jnp.exp(-4.0 * x)
    sinh, cosh, one = 0.5 * (1.0 - decay), 0.5 * (1.0 + decay), jnp.exp(-2.0 * x)
    if base == "bonded":
        a = 3.0 - 4.0 * poisson
        above = a * sinh - 2.0 * x * one
        below = a * cosh + (2.0 * x**2 + 5.0 - 12.0 * poisson + 8.0 * poisson**2) * one
        shallow = (1.0 - 2.0 * poisson) / (2.0 * (1.0 - poisson))
    else:
        above = cosh - one
        below = sinh + 2.0 * x * one
        shallow = 0.5 * (1.0 - poisson)
    moderate = (1.0 - poisson) / x * above / below
    deep = (1.0 - poisson) / jnp.maximum(k * thickness, _DEEP)
    per_shear = jnp.where(k * thickness < _SHALLOW, shallow, jnp.where(k * thickness > _DEEP, deep, moderate))
    return per_shear * thickness / shear


class LinearEstimate(eqx.Module):
    """Pressure by small-strain elasticity of a flat layer.

    Attributes:
        normal: Pressure per reference area at interface nodes `(ny+1, nx+1)` [MPa].
        heights: Height of the interface under this pressure [mm].
        chi2: Sum of squared standardised misfits [-].
    """

    normal: Nodes
    heights: Nodes
    chi2: Array


def response(palpation: Palpation, thickness: ScalarLike, base: Base | None = None) -> Float[Array, "my mx"]:
    """Compute the indentation per pressure of every cosine mode [mm/MPa].

    Args:
        palpation: The experiment.
        thickness: Thickness of the layer [mm].
        base: Boundary condition at the window; None: that of the experiment, with a frictional window as "slip".
    """
    mesh, material = palpation.mesh(), palpation.layer.material
    base = base or ("bonded" if isinstance(palpation.window, Bonded) else "slip")
    k = wave_numbers(mesh.thickness.shape, mesh.spacing)
    return transfer_function(k, thickness, material.shear, poisson_ratio(material), base)


@QuickJit
def solve_linear(palpation: Palpation, measured: MeasuredSurface, prior: AbstractPrior) -> LeastSquares:
    """Solve for the white unknowns of the linear estimate."""
    mesh = palpation.mesh()
    gain, weight = response(palpation, jnp.mean(mesh.thickness)), jnp.asarray(prior.mode_weight(mesh.thickness.shape))
    mean = on_nodes(prior, mesh.thickness.shape)
    spread = prior.mode_std(wave_numbers(weight.shape, mesh.spacing), mesh.spacing)
    diagonal = weight**2 + (spread * gain) ** 2 * jnp.mean(measured.precision)

    def indentation(normal):
        return from_cosines(gain * cosine_transform(normal))

    def jacobian(white):
        return measured.misfit_change(-indentation(prior.expand(white, mesh.spacing))), weight * white

    _, pull = jax.vjp(jacobian, jnp.zeros(weight.shape))
    start = measured.misfit(mesh.thickness - indentation(mean)), jnp.zeros(weight.shape)
    b = jax.tree.map(jnp.negative, start)
    return least_squares(jacobian, lambda r: pull(r)[0], lambda r: r / diagonal, b, _RTOL, _STEPS)


def linear_estimate(palpation: Palpation, thickness: ThicknessMap, prior: AbstractPrior) -> LinearEstimate:
    """Estimate the pressure by small-strain elasticity, instantly.

    Assumptions: a flat layer of the mean thickness, no friction at the window unless bonded, no lateral displacement of
    the interface. Valid up to a few per cent of strain.

    Args:
        palpation: The experiment.
        thickness: The measured map with its `std`; masked pixels are ignored.
        prior: Prior of the pressure.

    Raises:
        ValueError: If the map's std is missing or not positive.
    """
    std = noise_std("linear_estimate", thickness)
    check_against_layer("linear_estimate.thickness", thickness, palpation.layer.thickness, palpation.extent, 3)
    mesh = palpation.mesh()
    measured = project_map(mesh, thickness, std)
    white = solve_linear(palpation, measured, prior).x
    normal = on_nodes(prior, white.shape) + prior.expand(white, mesh.spacing)
    heights = mesh.thickness - from_cosines(response(palpation, jnp.mean(mesh.thickness)) * cosine_transform(normal))
    return LinearEstimate(normal, heights, jnp.sum(measured.misfit(heights) ** 2))


def uniaxial_estimate(palpation: Palpation, thickness: ThicknessMap) -> Nodes:
    """Estimate the pressure as classic optical palpation does: uniaxial compression at every point.

    Returns:
        Cauchy stress, the pressure on the current area, at interface nodes `(ny+1, nx+1)` [MPa].

    Source:
        Kennedy et al., Optics Letters 39 (2014) 3014: local strain and stress–strain curve of the layer.
    """
    check_against_layer("uniaxial_estimate.thickness", thickness, palpation.layer.thickness, palpation.extent, 3)
    mesh = palpation.mesh()
    stretch = thickness.sample(*mesh.plane()) / mesh.thickness
    return -cauchy_stress(palpation.layer.material, stretch)
