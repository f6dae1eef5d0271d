"""Internal force of a layer of hexahedra by sum-factorised gradients: the inner loop of explicit dynamics.

The same forces as `SolidBody` gives for `full` and `mean_dilatation` and a law in the invariants, several times
faster. A field is interpolated one axis at a time; Gauss points are leading axes (qz, qy, qx), x is innermost. Stress
is a closed form of the displacement gradient, so that float32 does not lose digits at small strain.
"""

from collections.abc import Callable
from functools import reduce
from operator import add
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._device import choices
from ..model.deformation import inverse_cube_root
from ..model.material import AbstractInvariantMaterial
from .hex8 import _GAUSS, pad_axis
from .internal import LayerBody

Nodal = Float[Array, "3 mz my mx"]
Cells = Float[Array, "nz ny nx"]
# H[i][J], each over (qz, qy, qx, nz, ny, nx) with axes of one where it does not depend on a point.
Gradient = list[list[Array]]

_X, _Y, _Z = -1, -2, -3
_NEAR, _FAR = float(_GAUSS[1]), float(_GAUSS[0])  # weight of the near and of the far end at a Gauss point
_BLOCK = 8192  # elements per block
_keep = jax.lax.optimization_barrier  # values that many kernels read are computed once


class LayerForce(eqx.Module):
    """Internal force of a layer of hexahedra.

    Attributes:
        body: The layer.
        uniform: Whether all elements are the same brick, which saves half of the memory traffic.
    """

    body: LayerBody
    uniform: bool = eqx.field(static=True)

    def __call__(self, u: Nodal, extra_stress: Callable, *fields: Any) -> tuple[Nodal, Cells]:
        """Compute the internal force.

        Args:
            u: Displacement [mm].
            extra_stress: Additional mean stress [MPa] of each element, from its mean J - 1 [-] and its part of the
                fields.
            fields: Arguments of the stress: trees of numbers and of arrays `(nz, ny, nx)`.

        Returns:
            Force [N] at the nodes, and mean J - 1 of every element [-]; it is -1 or less, or NaN, where one inverts.
        """
        if not _is_fast(self.body):
            return self.body.internal_force_with(u, lambda change: extra_stress(change, *fields))
        nz, ny, nx = (n - 1 for n in u.shape[1:])
        rows = _block_rows(nz * nx, ny) if choices().one_by_one else ny
        if rows == ny:
            return self._of_rows(u, extra_stress, fields)

        def of_block(k):
            def part(leaf):
                if eqx.is_array(leaf) and leaf.shape[-2:] == (ny, nx):
                    return jax.lax.dynamic_slice_in_dim(leaf, k * rows, rows, axis=leaf.ndim - 2)
                return leaf

            block = self if self.uniform else jax.tree.map(part, self)
            own = jax.lax.dynamic_slice_in_dim(u, k * rows, rows + 1, axis=2)
            return block._of_rows(own, extra_stress, jax.tree.map(part, fields))

        force, mean = jax.lax.map(of_block, jnp.arange(ny // rows))
        return _joined_rows(force), jnp.moveaxis(mean, 0, 1).reshape(nz, ny, nx)

    def _of_rows(self, u: Nodal, extra_stress: Callable, fields: Any) -> tuple[Nodal, Cells]:
        cells, material = self.body.cells, self.body.material
        assert isinstance(material, AbstractInvariantMaterial)  # checked by `_is_fast`
        H = self._gradient(u)
        change = _keep(_volume_change(H))
        weight = None if self.uniform else _by_axes(cells.weight)
        mean = _point_mean(change, weight)
        extra = extra_stress(mean, *fields)
        of_mean = self.body.form == "mean_dilatation"
        stress = material.volumetric_stress(mean if of_mean else change) + extra
        P = _piola(material, H, change, _keep(stress))
        return self._assemble(P, weight), mean

    def _gradient(self, u: Nodal) -> Gradient:
        hx, hy = self.body.cells.spacing
        along_x, at_x = _difference(u, _X) / hx, _interpolate(u, _X)
        xi = _interpolate(_interpolate(along_x, _Y), _Z)[:, :, :, None]  # i, qz, qy, 1
        eta = _interpolate(_difference(at_x, _Y) / hy, _Z)[:, :, None]  # i, qz, 1, qx
        zeta = _difference(_interpolate(at_x, _Y), _Z)[:, None]  # i, 1, qy, qx
        if self.uniform:
            zeta = zeta / self.body.cells.depth[0, 0, 0, 0]
            xi, eta, zeta = _keep((xi, eta, zeta))
            return [[xi[i], eta[i], zeta[i]] for i in range(3)]
        xi, eta, zeta = _keep((xi, eta, zeta))
        depth, sx, sy = (_by_axes(v) for v in (self.body.cells.depth, *self._slopes()))
        return [[xi[i] - sx * zeta[i], eta[i] - sy * zeta[i], zeta[i] / depth] for i in range(3)]

    def _slopes(self) -> tuple[Array, Array]:
        hx, hy = self.body.cells.spacing
        return self.body.cells.slope_x / hx, self.body.cells.slope_y / hy

    def _assemble(self, P: Gradient, weight: Array | None) -> Nodal:
        """Sum P[i, J] dN_a/dX_J over the points, into nodes: the transpose of `_gradient`."""
        cells = self.body.cells
        hx, hy = cells.spacing
        if weight is None:
            volume = cells.weight[0, 0, 0, 0]
            fx, fy, fz = volume / hx, volume / hy, volume / cells.depth[0, 0, 0, 0]
        else:
            depth, sx, sy = (_by_axes(v) for v in (cells.depth, *self._slopes()))
            P = [[p[0], p[1], p[2] / depth - sx * p[0] - sy * p[1]] for p in P]
            P = [[weight * entry for entry in p] for p in P]
            fx, fy, fz = 1.0 / hx, 1.0 / hy, jnp.ones_like(hx)
        xi = jnp.stack([_keep(_pair(p[0], 2)) for p in P])  # i, qz, qy
        eta = jnp.stack([_keep(_pair(p[1], 1)) for p in P])  # i, qz, qx
        zeta = jnp.stack([_keep(_pair(p[2], 0)) for p in P])  # i, qy, qx
        along_x = _spread(_spread(xi, _Z), _Y)
        at_x = _spread_difference(fy * _spread(eta, _Z), _Y) + _spread(_spread_difference(fz * zeta, _Z), _Y)
        return _spread_difference(fx * along_x, _X) + _spread(at_x, _X)


def _block_rows(elements_in_row: int, ny: int) -> int:
    """Choose the number of rows of elements per block, so that a block fits the cache."""
    divisors = [rows for rows in range(1, ny + 1) if ny % rows == 0]
    fitting = [rows for rows in divisors if rows * elements_in_row <= _BLOCK]
    return max(fitting, default=1) if ny * elements_in_row > 2 * _BLOCK else ny


def _joined_rows(force: Float[Array, "blocks 3 mz rows mx"]) -> Nodal:
    """Add the forces of blocks of rows, each with the last row of nodes that it shares with the next."""
    blocks, _, mz, n, mx = force.shape
    rows = n - 1
    own = jnp.moveaxis(force[:, :, :, :rows], 0, 2).reshape(3, mz, blocks * rows, mx)
    last = jnp.moveaxis(force[:, :, :, rows:], 0, 2)
    last = jnp.pad(last, [(0, 0)] * 3 + [(0, rows - 1), (0, 0)]).reshape(3, mz, blocks * rows, mx)
    return pad_axis(own, 2, (0, 1)) + pad_axis(last, 2, (rows, 0))[:, :, : blocks * rows + 1]


def _is_fast(body: LayerBody) -> bool:
    return (
        body.cells.name == "hex8"
        and body.form in ("full", "mean_dilatation")
        and isinstance(body.material, AbstractInvariantMaterial)
    )


def _piola(material: AbstractInvariantMaterial, H: Gradient, change: Array, mean_stress: Array) -> Gradient:
    """Compute the first Piola–Kirchhoff stress [MPa] from the displacement gradient.

    As `AbstractInvariantMaterial.isochoric_piola`, but with F = I + H, F^-T = I + g, I1 = 3 + i1, I2 = 3 + i2 the
    terms of order one are cancelled by hand: every term left is as small as the strain.
    """
    minors = _minors(H)
    c = _cauchy_green_change(H)
    i1 = c[0][0] + c[1][1] + c[2][2]
    i2 = 2.0 * i1 + sum(c[m][m] * c[n][n] - c[m][n] ** 2 for m, n in ((0, 1), (1, 2), (0, 2)))
    J = 1.0 + change
    j = inverse_cube_root(J) ** 2
    by_I1, by_I2 = material.slopes(3.0 * (j - 1.0) + j * i1)
    a, b = 2.0 * by_I1 * j, 2.0 * by_I2 * j * j
    pull = -(a * i1 + 2.0 * b * i2) / 3.0
    pressure = mean_stress * J
    by_H = a + b * (2.0 + i1)
    by_g = (pull - a - 2.0 * b + pressure) / J
    by_eye = b * i1 + pull + pressure
    trace = H[0][0] + H[1][1] + H[2][2] - change
    by_H, by_g, by_eye, b = _keep((by_H, by_g, by_eye, b * jnp.ones_like(J)))

    def entry(i: int, k: int) -> Array:
        g = minors[i][k] - H[k][i] + (trace if i == k else 0.0)  # times J
        along_C = c[i][k] + sum(H[i][m] * c[m][k] for m in range(3))
        return by_H * H[i][k] + by_g * g - b * along_C + (by_eye if i == k else 0.0)

    return [[entry(i, k) for k in range(3)] for i in range(3)]


def _minors(H: Gradient) -> Gradient:
    """Compute the cofactor matrix of H."""

    def minor(i: int, k: int) -> Array:
        a, b, c, d = (i + 1) % 3, (i + 2) % 3, (k + 1) % 3, (k + 2) % 3
        return H[a][c] * H[b][d] - H[a][d] * H[b][c]

    return [[minor(i, k) for k in range(3)] for i in range(3)]


def _volume_change(H: Gradient) -> Array:
    """Compute J - 1 without cancellation."""
    minors = _minors(H)
    determinant = sum(H[0][k] * minors[0][k] for k in range(3))
    return reduce(add, (H[i][i] + minors[i][i] for i in range(3))) + determinant


def _cauchy_green_change(H: Gradient) -> Gradient:
    """Compute C - I = H + Hᵀ + HᵀH."""
    upper = {
        (m, n): H[m][n] + H[n][m] + sum(H[k][m] * H[k][n] for k in range(3)) for m in range(3) for n in range(m, 3)
    }
    return [[upper[min(m, n), max(m, n)] for n in range(3)] for m in range(3)]


def _by_axes(values: Float[Array, "8 _ ny nx"]) -> Float[Array, "2 2 2 _ ny nx"]:
    return values.reshape(2, 2, 2, *values.shape[1:])


def _point_mean(values: Array, weight: Array | None) -> Cells:
    if weight is None:
        return reduce(add, (values[q] for q in _POINTS)) / 8.0
    total = reduce(add, (weight[q] for q in _POINTS))
    return reduce(add, (values[q] * weight[q] for q in _POINTS)) / total


_POINTS = [(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]


def _pair(values: Array, axis: int) -> Array:
    """Add the two points along one of the three leading axes."""
    return jax.lax.index_in_dim(values, 0, axis, False) + jax.lax.index_in_dim(values, 1, axis, False)


def _ends(values: Array, axis: int) -> tuple[Array, Array]:
    axis += values.ndim
    n = values.shape[axis]
    return jax.lax.slice_in_dim(values, 0, n - 1, axis=axis), jax.lax.slice_in_dim(values, 1, n, axis=axis)


def _difference(values: Array, axis: int) -> Array:
    low, high = _ends(values, axis)
    return high - low


def _interpolate(values: Array, axis: int) -> Array:
    """Interpolate to the two points between nodes along an axis: a new axis after the components."""
    low, high = _ends(values, axis)
    shape = (1, 2, *[1] * (values.ndim - 1))
    near = jnp.array([_NEAR, _FAR], values.dtype).reshape(shape)
    return low[:, None] * near + high[:, None] * near[:, ::-1]


def _spread(values: Array, axis: int) -> Array:
    """Transpose `_interpolate`."""
    low = _NEAR * values[:, 0] + _FAR * values[:, 1]
    high = _FAR * values[:, 0] + _NEAR * values[:, 1]
    return pad_axis(low, axis, (0, 1)) + pad_axis(high, axis, (1, 0))


def _spread_difference(values: Array, axis: int) -> Array:
    """Transpose `_difference`."""
    return pad_axis(values, axis, (1, 0)) - pad_axis(values, axis, (0, 1))
