"""Energy, internal force and stiffness of a solid body, over any cells.

The forms differ in the strain measure of their cells:

- `full`: F at each point. Locks when nearly incompressible.
- `mean_dilatation`: J is the cell's mean (energy of F with the mean J: symmetric, free of volumetric
  locking). Source: Simo, Taylor & Pister, CMAME 51 (1985) 177.
- `hybrid`: the same with the cell's mean stress as an independent unknown, up to the incompressible limit.
- `reduced`: one point with the cell's mean F, and hourglass control by a small energy of F's deviation
  from its mean, which vanishes in uniform strain and is objective.
"""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..model import AbstractMaterial, BlockMesh, LayerMesh
from ..model.deformation import Kinematics, ProductSum, identity_like, kinematics
from .kinematics import AbstractCells, LayerCells, layer_cells

Form = Literal["full", "mean_dilatation", "hybrid", "reduced"]

# Cells and form of every element that a layer can be made of.
ELEMENT_FORMS: dict[str, tuple[str, Form]] = {
    "mean_dilatation": ("hex8", "mean_dilatation"),
    "full": ("hex8", "full"),
    "reduced": ("hex8", "reduced"),
    "hybrid": ("hex8", "hybrid"),
    "tet4": ("tet4", "full"),
    "tet10": ("tet10", "full"),
}
# Stiffness of the hourglass modes of `reduced`, relative to the shear modulus.
HOURGLASS = 0.05


class SolidBody(eqx.Module):
    """A deformable body: its material, with numbers for all or for each element, its cells and form.

    Every method takes the displacement u [mm] at the nodes, `(3, *nodes)`, and for `hybrid` the cells'
    mean stress [MPa], `(*cells)`, tension positive; None for the other forms.
    """

    material: AbstractMaterial
    cells: AbstractCells
    form: Form = eqx.field(static=True)

    @property
    def shear(self) -> Array:
        """Shear modulus at rest [MPa]; the geometric mean of those of the elements, where they differ."""
        return typical(self.material.shear)

    def energy(self, u: Array, mean_stress: Array | None = None) -> Float[Array, ""]:
        """Compute the strain energy [N mm]."""
        H = self.cells.displacement_gradient(u)
        k, weight = self._measured(self.cells, H)
        return jnp.sum(self._energy_density(k, mean_stress) * weight) + self._hourglass_energy(H)

    def internal_force(self, u: Array, mean_stress: Array | None = None) -> tuple[Array, Array]:
        """Compute dEnergy/du [N] at the nodes and the smallest J of any point."""
        H = self.cells.displacement_gradient(u)
        k, _ = self._measured(self.cells, H)
        P = self.material.first_piola(k, self._mean_stress(self.cells, k, mean_stress))
        if self.form == "reduced":
            P = P + self._hourglass_stiffness * (H - self.cells.mean(H, 2))
        return self.cells.assemble(self.cells.nodal_vectors(P * self.cells.weight)), jnp.min(k.J)

    def internal_force_with(self, u: Array, extra_stress: Callable[[Array], Array]) -> tuple[Array, Array]:
        """Compute the force [N] with a mean stress [MPa] added by each cell's mean J - 1, and that mean."""
        H = self.cells.displacement_gradient(u)
        k, weight = self._measured(self.cells, H)
        change = jnp.sum(k.volume_change * weight, axis=0, keepdims=True) / self.cells.volume
        P = self.material.first_piola(k, self._mean_stress(self.cells, k, None) + extra_stress(change[0]))
        if self.form == "reduced":
            P = P + self._hourglass_stiffness * (H - self.cells.mean(H, 2))
        return self.cells.assemble(self.cells.nodal_vectors(P * self.cells.weight)), change[0]

    def cell_stiffness(
        self, u: Array, mean_stress: Array | None = None, bulk: Array | None = None, more: Array | None = None
    ) -> Array:
        """Compute the stiffness [N/mm] of each cell, K[a, b, i, k] = df[a, i]/du[b, k].

        Args:
            u: Displacement.
            mean_stress: For `hybrid`.
            bulk: For `hybrid`: stiffness of each cell's volume [MPa] that is added to the stiffness at
                constant mean stress; None: none.
            more: Stiffness [N/mm] that is added to every cell's, `(a, b, 3, 3)`; None: none.

        Returns:
            `(a, b, 3, 3, *cells)`; in a layer, layers first: `(nz, a, b, 3, 3, ny, nx)`.
        """
        fields = () if mean_stress is None else (mean_stress,)
        of_elements, law = eqx.partition(self.material, lambda number: number.ndim == 3)
        numbers, structure = jax.tree.flatten(of_elements)
        if not numbers:
            return self.cells.in_parts(self._tangent, partial(self._stiffness, bulk=bulk, more=more), u, *fields)

        def body(numbers):
            material = eqx.combine(jax.tree.unflatten(structure, numbers), law)
            return eqx.tree_at(lambda body: body.material, self, material)

        def prepare(cells, H, *fields):
            own, fields = fields[len(fields) - len(numbers) :], fields[: len(fields) - len(numbers)]
            return body(own)._tangent(cells, H, *fields), own

        def finish(cells, parts):
            return body(parts[1])._stiffness(cells, parts[0], bulk=bulk, more=more)

        return self.cells.in_parts(prepare, finish, u, *fields, *numbers)

    def point_tangent(self, u: Array) -> Float[Array, "3 3 3 3 points *cells"]:
        """Compute dP/dF times the points' volumes [N mm], of a form with F at each point."""
        assert self.form == "full"
        k, weight = self._measured(self.cells, self.cells.displacement_gradient(u))
        return self.full_tangent(k).entries() * weight

    def volume_residual(self, u: Array, mean_stress: Array) -> Array:
        """Compute V (mean J - 1 - mean stress/bulk) of each cell [mm³], zero in a `hybrid` equilibrium."""
        k, _ = self._measured(self.cells, self.cells.displacement_gradient(u))
        change = self.cells.mean(k.volume_change)[0]
        return self.cells.volume[0] * (change - mean_stress / self.material.bulk)

    def volume_vectors(self, u: Array) -> Float[Array, "a 3 *cells"]:
        """Compute the derivative of each cell's volume by its nodes [mm²]."""
        k, weight = self._measured(self.cells, self.cells.displacement_gradient(u))
        return self.cells.nodal_vectors(k.J * k.G * weight)

    def fields(self, u: Array, mean_stress: Array | None = None) -> tuple[Array, Array, Array]:
        """Compute F [-], Cauchy stress [MPa] and energy per reference volume [MPa] at the points.

        `reduced` has one point per cell. The energy excludes hourglass control.
        """
        k = self.kinematics(u)
        P = self.material.first_piola(k, self._mean_stress(self.cells, k, mean_stress))
        cauchy = sum(P[:, j, None] * k.F[None, :, j] for j in range(3)) / k.J
        return k.F, cauchy, self._energy_density(k, mean_stress)

    def kinematics(self, u: Array) -> Kinematics:
        """Compute the kinematics at the points of `fields`."""
        return self._measured(self.cells, self.cells.displacement_gradient(u))[0]

    def field_volume(self) -> Array:
        """Compute the reference volume [mm³] that each value of `fields` stands for."""
        return self.cells.volume if self.form == "reduced" else self.cells.weight

    def _measured(self, cells: AbstractCells, H: Array) -> tuple[Kinematics, Array]:
        """Compute the kinematics of the form's strain measure, and the volume of each of its points."""
        if self.form == "reduced":
            return kinematics(cells.mean(H, 2)), cells.volume
        return kinematics(H), cells.weight

    @property
    def _of_mean_volume(self) -> bool:
        return self.form in ("mean_dilatation", "hybrid")

    def _mean_stress(self, cells: AbstractCells, k: Kinematics, mean_stress: Array | None) -> Array:
        if self.form == "hybrid":
            assert mean_stress is not None
            return mean_stress[None]
        return self.material.volumetric_stress(self._volume_change(cells, k))

    def _volume_change(self, cells: AbstractCells, k: Kinematics) -> Array:
        return cells.mean(k.volume_change) if self._of_mean_volume else k.volume_change

    def _energy_density(self, k: Kinematics, mean_stress: Array | None) -> Array:
        change = self._volume_change(self.cells, k)
        volumetric = self.material.volumetric_energy(change) if mean_stress is None else 0.5 * mean_stress * change
        return self.material.isochoric_energy(k) + volumetric

    def full_tangent(self, k: Kinematics) -> ProductSum:
        """Compute dP/dF [MPa] of a form with F at each point."""
        A = self.material.tangent(k, self.material.volumetric_stress(k.volume_change))
        return A + ProductSum(direct=((self.material.bulk * k.J**2, k.G, k.G),))

    def _tangent(
        self, cells: AbstractCells, H: Array, mean_stress: Array | None = None
    ) -> tuple[ProductSum, Array | None]:
        """Compute the tangent times volume at the points, and the derivative of the cells' volumes by their nodes.

        The latter is None for forms that do not need it.
        """
        k, weight = self._measured(cells, H)
        if self._of_mean_volume:
            A = self.material.tangent(k, self._mean_stress(cells, k, mean_stress))
            return cells.referred(A.scaled(weight)), cells.nodal_vectors(k.J * k.G * weight)
        A = self.full_tangent(k)
        if self.form == "reduced":  # hourglass control does not act on the mean strain
            A = A + self._uniform_tangent(-self._hourglass_stiffness, k.F)
            return A.scaled(weight), None
        return cells.referred(A.scaled(weight)), None

    def _stiffness(
        self, cells: AbstractCells, parts: tuple[ProductSum, Array | None], bulk: Array | None, more: Array | None
    ) -> Array:
        A, dv = parts
        K = self._reduced_stiffness(cells, A) if self.form == "reduced" else cells.matrices(A)
        if more is not None:
            K = K + jnp.expand_dims(more, tuple(range(4, K.ndim)))
        stiffness = bulk if self.form == "hybrid" else self.material.bulk
        if stiffness is None or dv is None:
            return K
        return K + (stiffness / cells.volume[0]) * (dv[:, None, :, None] * dv[None, :, None, :])

    @property
    def _hourglass_stiffness(self) -> Array:
        return HOURGLASS * self.material.shear

    def _hourglass_energy(self, H: Array) -> Array | float:
        if self.form != "reduced":
            return 0.0
        deviation = H - self.cells.mean(H, 2)
        return 0.5 * self._hourglass_stiffness * jnp.sum(deviation**2 * self.cells.weight)

    def _uniform_tangent(self, stiffness: Array, like: Array) -> ProductSum:
        """Build the tangent of a stiffness of every entry of F, at points like those of a tensor."""
        eye = jnp.broadcast_to(identity_like(like), like.shape)
        return ProductSum(legs=((jnp.broadcast_to(stiffness, like.shape[2:]), eye, eye),))

    def _reduced_stiffness(self, cells: AbstractCells, A: ProductSum) -> Array:
        nothing = jnp.zeros((3, 3, *cells.weight.shape), cells.weight.dtype)
        eye, control = identity_like(nothing), self._uniform_tangent(self._hourglass_stiffness, nothing)
        K = cells.matrices(cells.referred(control.scaled(cells.weight)))
        mean = cells.nodal_vectors(eye * (cells.weight / cells.volume))  # mean dN_a/dX_J `(a, J, *cells)`
        own = A.entries()[:, :, :, :, 0]
        for J, L in itertools.product(range(3), repeat=2):
            K = K + mean[:, None, None, None, J] * own[None, None, :, J, :, L] * mean[None, :, None, None, L]
        return K


def typical(numbers: Array) -> Array:
    """Average a positive number over elements, geometrically; one for all stays as it is."""
    return numbers if numbers.ndim == 0 else jnp.exp(jnp.mean(jnp.log(numbers)))


class LayerBody(SolidBody):
    """The deformable layer: a body of structured cells."""

    cells: LayerCells


def layer_body(mesh: LayerMesh | BlockMesh, material: AbstractMaterial, element: str) -> LayerBody:
    """Build the deformable layer.

    Args:
        mesh: Its mesh.
        material: Its material.
        element: One of `ELEMENT_FORMS`.
    """
    cells, form = ELEMENT_FORMS[element]
    return LayerBody(material, layer_cells(mesh, cells), form)
