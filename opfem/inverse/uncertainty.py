"""Laplace approximation of the posterior: draws, covariance products and resolution kernels.

All of it solves linear systems with the normal matrix at the optimum, by the preconditioned CGLS of the fit.
"""

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .._checks import concrete
from ..mechanics.face import nodal_area_vector, tributary_area
from ..model import Palpation
from ..optimise.conjugate_gradients import LeastSquares, least_squares, plus
from ..solvers import Solution
from ..solvers.compiling import QuickJit, is_traced
from .measured_surface import Nodes
from .objective import Objective, normal_traction, normal_weights
from .preconditioner import Unknowns

# Limit of CG iterations per linear system; a solve that reaches it warns.
MAX_ITERATIONS = 200
# Relative gradient of each system: 1 % of a draw is well below the sampling error of 16 draws, 18 %.
_RTOL = 1e-2
# Points along each axis of the grid that resolution is computed on: kernels must not overlap.
_GRID = 4
# Fixed-point iterations that find the applied traction of a transmitted one.
_PASSES = 4
# Full width at half maximum over the standard deviation of a Gaussian.
_FWHM = np.sqrt(8.0 * np.log(2.0))


class Posterior(eqx.Module):
    """The Gaussian posterior of white unknowns, represented by the Jacobian of all residuals at the optimum.

    Attributes:
        white: The optimum.
        jacobian: Derivative of all standardised residuals, the prior's included, by white unknowns: a `Jacobian` or a
            linear operator of lineax.
        precondition: Approximate inverse of its normal matrix.
        rtol: Relative gradient of the linear system of each draw or product.
    """

    white: PyTree
    jacobian: Any
    precondition: Callable[[PyTree], PyTree]
    rtol: float | Array = _RTOL

    def solve(self, residual: PyTree, gradient: PyTree | None = None) -> LeastSquares:
        """Solve min ‖J x - r‖² - 2 gᵀx by preconditioned CGLS.

        Args:
            residual: Right-hand side r, by residual.
            gradient: Term g added to the right-hand side of the normal equations; None: zero.

        Returns:
            The solution; NaN where the iteration diverged. A warning reports the iteration limit, unless the number of
            iterations is traced.
        """
        if gradient is None:
            gradient = jax.tree.map(jnp.zeros_like, self.white)
        traced = is_traced((self, residual, gradient))
        solved = (QuickJit(_solve) if traced else _solve)(self, residual, gradient)
        iterations = concrete(solved.iterations)
        if iterations is not None and iterations >= MAX_ITERATIONS:
            warnings.warn(
                f"A linear system of the posterior stopped at its limit of {MAX_ITERATIONS} iterations: draws, "
                "standard deviations, covariances and degrees of freedom are inaccurate. Use a prior of smaller std or "
                "longer length.",
                stacklevel=3,
            )
        return solved

    def push(self, change: PyTree) -> PyTree:
        """Compute J v, the change of the residuals with a change of the unknowns."""
        return self.jacobian.mv(change)

    def pull(self, residuals: PyTree) -> PyTree:
        """Compute Jᵀ w, for weights of the residuals."""
        return self.jacobian.T.mv(residuals)

    def residual_structure(self) -> PyTree:
        """Return shapes and types of the residuals."""
        return self.jacobian.out_structure()

    def covariance(self, weights: PyTree) -> PyTree:
        """Compute the product of the posterior covariance of the white unknowns with weights."""
        nothing = jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), self.residual_structure())
        return self.solve(nothing, weights).x

    def draw(self, key: PRNGKeyArray) -> tuple[PyTree, PyTree, Array]:
        """Draw a deviation from the optimum.

        The least-squares solution for white noise in every residual has exactly the posterior's covariance.

        Returns:
            Deviation of the white unknowns; of the residuals; iterations, `MAX_ITERATIONS` where the limit was reached.
            The sum of squares of a part of the residuals, averaged over draws, is the number of degrees of freedom that
            this part determines.
        """
        noise = _noise(self.residual_structure(), key)
        solved = self.solve(noise)
        return solved.x, plus(noise, solved.residual, -1.0), solved.iterations


def _solve(posterior: Posterior, residual: PyTree, gradient: PyTree) -> LeastSquares:
    J, rtol = posterior.jacobian, posterior.rtol
    added = eqx.Partial(_constant, gradient)
    solved = least_squares(J.mv, J.T.mv, posterior.precondition, residual, rtol, MAX_ITERATIONS, added=added)
    return _if_solved(solved)


def _constant(gradient: PyTree, _: PyTree) -> PyTree:
    return gradient


@QuickJit
def _if_solved(solved: LeastSquares) -> LeastSquares:
    # Inexact Jacobian products can make CGLS diverge.
    good = solved.relative_gradient <= 1.0
    return jax.tree.map(lambda v: jnp.where(good, v, jnp.nan) if eqx.is_inexact_array(v) else v, solved)


@QuickJit
def _noise(structure: PyTree, key: PRNGKeyArray) -> PyTree:
    """Draw white noise."""
    leaves, tree = jax.tree.flatten(structure)
    keys = jax.random.split(key, len(leaves))
    each = [jax.random.normal(k, leaf.shape, leaf.dtype) for k, leaf in zip(keys, leaves, strict=True)]
    return jax.tree.unflatten(tree, each)


def pressure_change(
    palpation: Palpation, traction: Float[Array, "3 my mx"], u: Float[Array, "3 my mx"], change: Nodes, moved: Array
) -> Nodes:
    """Compute the derivative of the pressure on the current area along changes of traction and displacement.

    Args:
        palpation: The experiment.
        traction: Force on the layer per reference area [MPa]; its lateral part keeps its ratio to the normal one.
        u: Displacement of the interface [mm].
        change: Change of the normal traction [MPa].
        moved: Change of the displacement [mm].
    """
    X = palpation.mesh().positions()[:, -1]
    normal = -traction[2]
    pushes = jnp.abs(normal) > 1e-12 * jnp.max(jnp.abs(normal))
    direction = jnp.where(pushes, traction / jnp.where(pushes, normal, 1.0), jnp.array([0.0, 0.0, -1.0])[:, None, None])
    area = tributary_area(X)

    def pressure(normal, u):
        outward = nodal_area_vector(X + u)
        return -jnp.sum(direction * (normal * area) * outward, axis=0) / jnp.sum(outward**2, axis=0)

    return jax.jvp(pressure, (normal, u), (change, moved))[1]


def pressure_deviations(
    solutions: list[Solution], deviations: Float[Array, "draws maps my mx"], moves: Float[Array, "draws maps 3 my mx"]
) -> Float[Array, "draws maps my mx"]:
    """Convert deviations of the normal traction to those of the pressure on the current area [MPa]."""
    each = [_pressure_changes(s, deviations[:, i], moves[:, i]) for i, s in enumerate(solutions)]
    return jnp.stack(each, axis=1)


@QuickJit
def _pressure_changes(
    s: Solution, deviations: Float[Array, "draws my mx"], moves: Float[Array, "draws 3 my mx"]
) -> Array:
    def one(change, move):
        return pressure_change(s.palpation, s.traction, s.displacement[:, -1], change, move)

    return jax.vmap(one)(deviations, moves)


def root_mean_square(deviations: Float[Array, "draws maps my mx"]) -> Float[Array, "maps my mx"]:
    """Compute the root mean square over draws."""
    return jnp.sqrt(jnp.mean(deviations**2, axis=0))


def local_size(error: Float[Array, "maps my mx"]) -> Float[Array, "maps my mx"]:
    """Compute the root mean square of an error over the 3 × 3 nodes around each.

    The error is a wave, and vanishes where it changes its sign. On the built-in example the standard deviations cover
    the traction on twice as fine a mesh (1.96 of them) at 89 % of nodes with the error itself, at 95 % with its size,
    at 65 % without.
    """
    padded = jnp.pad(error**2, ((0, 0), (1, 1), (1, 1)), mode="edge")
    my, mx = error.shape[1:]
    return jnp.sqrt(sum(padded[:, i : i + my, j : j + mx] for i in range(3) for j in range(3)) / 9.0)


def normal_covariance(posterior: Posterior, weights: Float[Array, "maps my mx"]) -> Float[Array, "maps my mx"]:
    """Compute the product of the posterior covariance of the normal traction with weights [-]."""
    nothing = jax.tree.map(lambda like: jnp.zeros(like.shape, like.dtype), posterior.residual_structure())
    pulled = posterior.pull({**nothing, "normal": normal_weights(weights)})
    return normal_traction(posterior.push(posterior.covariance(pulled)))


def number_covariance(posterior: Posterior) -> Float[Array, "numbers numbers"]:
    """Compute the posterior covariance of the fitted numbers' white unknowns [-]."""
    names = list(posterior.white.numbers)
    if not names:
        return jnp.zeros((0, 0))
    nothing = jax.tree.map(jnp.zeros_like, posterior.white)

    def column(one):
        weights = nothing._replace(numbers=dict(zip(names, one, strict=True)))
        pulled = posterior.covariance(weights).numbers
        return jnp.stack([pulled[name] for name in names])

    columns = jnp.stack([column(one) for one in jnp.eye(len(names))])
    return 0.5 * (columns + columns.T)


def resolution(
    posterior: Posterior, objective: Objective
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "maps n"]]:
    """Compute the width of the resolution kernel on a grid of points.

    The points are far apart, so that one solve gives all kernels; each is cut off half the distance to the next.

    Returns:
        Points (x, y) [mm]; widths [mm], see `TractionFit.resolution_width`.
    """
    mesh = objective.palpation.mesh()
    (hx, hy), (my, mx) = (float(h) for h in mesh.spacing), mesh.thickness.shape
    rows, columns = (np.unique(np.round((np.arange(_GRID) + 0.5) / _GRID * (n - 1)).astype(int)) for n in (my, mx))
    points = np.zeros((posterior.white.normal.shape[0], my, mx))
    points[:, rows[:, None], columns] = 1.0
    image = np.asarray(_image(posterior, objective, jnp.asarray(points)))
    reach_y, reach_x = (max(int(np.diff(n).min()) // 2, 1) if n.size > 1 else max(my, mx) for n in (rows, columns))
    widths = np.empty((len(image), rows.size, columns.size))
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            near = image[:, max(row - reach_y, 0) : row + reach_y + 1, max(column - reach_x, 0) : column + reach_x + 1]
            with np.errstate(divide="ignore", invalid="ignore"):  # NaN of a failed fit
                squares = np.sum(near**2, axis=(1, 2)) / image[:, row, column] ** 2 * hx * hy
            widths[:, i, j] = _FWHM * np.sqrt(squares / np.pi)
    y, x = np.meshgrid(rows * hy, columns * hx, indexing="ij")
    return np.stack([x, y], axis=-1).reshape(-1, 2), widths.reshape(len(image), -1)


def _image(posterior: Posterior, objective: Objective, points: Array) -> Array:
    """Compute the fit's response to the change of the maps under unit changes of the traction at some nodes."""
    _, residuals = transmitting(posterior.jacobian, posterior.white, objective, points)
    data = {name: part if name == "maps" else jax.tree.map(jnp.zeros_like, part) for name, part in residuals.items()}
    return normal_traction(posterior.push(posterior.solve(data).x))


def transmitting(
    jacobian: Any, white: Unknowns, objective: Objective, wanted: Float[Array, "maps my mx"]
) -> tuple[Unknowns, dict[str, Any]]:
    """Find the change of the unknowns whose transmitted normal traction [MPa] is wanted, and that of the residuals."""
    slope = _slope(white, objective)
    change = jax.tree.map(jnp.zeros_like, white)
    transmitted = jnp.zeros_like(wanted)
    for _ in range(_PASSES + 1):
        change = change._replace(normal=change.normal + _white(objective, (wanted - transmitted) / slope))
        residuals = jacobian.mv(change)
        transmitted = normal_traction(residuals)
    return change, residuals


@QuickJit
def _slope(white: Unknowns, objective: Objective) -> Array:
    """Compute the derivative of the normal traction by the Gaussian field [-]: 1 without a softplus."""
    latent = objective.latent(white)
    return jax.jvp(objective.latent_to_normal, (latent,), (jnp.ones_like(latent),))[1]


@QuickJit
def _white(objective: Objective, normal: Array) -> Array:
    return jax.vmap(lambda part: objective.prior.whiten(part, objective.palpation.mesh().spacing))(normal)
