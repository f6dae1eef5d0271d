"""The deformable sample of a virtual experiment: its thickness, its material and the inclusions in it."""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._checks import Leaf, as_leaf, check_positive, concrete
from .._repr import with_units
from .._types import Points
from ..measurement import ThicknessMap
from .inclusion import AbstractInclusion
from .material import AbstractMaterial
from .material_field import combined, points_of, widened
from .plausible import check_unloaded

Inside = Bool[Array, "nz ny nx"]
"""Elements of the sample that an inclusion takes."""


class Sample(eqx.Module):
    """A sample between the layer and the plate: flat on the plate, its highest point on the unloaded layer.

    Args:
        thickness: Thickness [mm]: one number, or a `ThicknessMap` for a face towards the layer that is uneven.
        material: Hyperelastic law; its numbers may be arrays `(nz, ny, nx)`, one an element, from the layer's side on.
        levels: Heights of the nodes of a column as fractions of its thickness `(nz+1,)` [-], rising from 0 at the
            layer to 1 at the plate: small steps first make a thick sample cheap. None: equal elements.
        inclusions: Inclusions of `with_inclusion`: (where, material) of each; the last one wins.

    Raises:
        ValueError: If a number is out of range, or laws cannot be combined.
    """

    thickness: Array | ThicknessMap = eqx.field(metadata={"unit": "mm"})
    material: AbstractMaterial
    levels: Array | None = eqx.field(converter=Leaf("Sample.levels", "-", optional=True))
    inclusions: tuple[tuple[AbstractInclusion | Inside, AbstractMaterial], ...]

    def __init__(self, thickness, material: AbstractMaterial, levels=None, inclusions=()):
        if not isinstance(thickness, ThicknessMap):
            if np.ndim(thickness) != 0:
                raise ValueError(
                    f"Sample.thickness [mm] must be a number or a ThicknessMap, got an array of shape "
                    f"{np.shape(thickness)}. Pass ThicknessMap(values, extent=(Lx, Ly))."
                )
            thickness = as_leaf(thickness, "Sample.thickness", "mm")
            check_positive("Sample.thickness", "mm", thickness)
        check_unloaded(thickness, "Sample.thickness")
        self.thickness = thickness
        self.material = material
        self.levels = levels
        self.inclusions = tuple(inclusions)

    def __check_init__(self):
        for law in (self.material, *(law for _, law in self.inclusions)):
            if not isinstance(law, AbstractMaterial):
                raise ValueError(f"Sample's materials must be laws such as NeoHooke(...), got {law!r}.")
        if self.inclusions:
            widened([self.material, *(law for _, law in self.inclusions)])
        levels = None if self.levels is None else concrete(self.levels)
        if self.levels is not None and self.levels.ndim != 1:
            raise ValueError(f"Sample.levels [-] must be a row of nz+1 numbers, got shape {self.levels.shape}.")
        if levels is not None and not (
            levels.size > 1 and math.isclose(levels[0], 0.0, abs_tol=1e-9) and math.isclose(levels[-1], 1.0)
        ):
            raise ValueError(
                f"Sample.levels [-] must run from 0 (the layer's side) to 1 (the plate), got {levels.tolist()}."
            )
        if levels is not None and np.any(np.diff(levels) <= 0):
            raise ValueError(f"Sample.levels [-] must rise from node to node, got {levels.tolist()}.")

    def __pdoc__(self, **options: Any) -> Any:
        return with_units(self, **options)

    def with_inclusion(
        self, where: AbstractInclusion | Any, material: AbstractMaterial | Sequence[AbstractMaterial]
    ) -> "Sample":
        """Add an inclusion: the elements with their centre in a shape, or those of a mask or label image.

        Args:
            where: `Cylinder`, `Sphere`, `Box` or `HalfSpace`; or an array `(nz, ny, nx)`, one an element, from the
                layer's side on: True inside, or labels, of which 0 is no inclusion.
            material: Law inside; one for each label 1, 2, … where `where` has several.

        Raises:
            ValueError: If the array has a wrong shape or type, or labels and laws do not match.
        """
        if isinstance(where, AbstractInclusion):
            if not isinstance(material, AbstractMaterial):
                raise ValueError(f"Sample.with_inclusion takes one law for a shape, got {material!r}.")
            return self._with([(where, material)])
        labels = where if isinstance(where, jax.Array) else np.asarray(where)
        if labels.ndim != 3 or labels.dtype.kind not in "bui":
            raise ValueError(
                "Sample.with_inclusion takes a Cylinder, Sphere, Box, HalfSpace, or an array (nz, ny, nx) of booleans "
                f"or whole numbers, got shape {labels.shape} of {labels.dtype}."
            )
        if isinstance(material, AbstractMaterial):
            return self._with([(jnp.asarray(labels != 0), material)])
        known = concrete(labels)
        if known is not None and (known.min() < 0 or known.max() != len(material)):
            raise ValueError(
                f"Sample.with_inclusion needs one law for each label 1 to {known.max()}, got {len(material)}; labels "
                f"run from {known.min()}."
            )
        return self._with([(jnp.asarray(labels == k), law) for k, law in enumerate(material, start=1)])

    def _with(self, more: Sequence[tuple[AbstractInclusion | Inside, AbstractMaterial]]) -> "Sample":
        return Sample(self.thickness, self.material, self.levels, (*self.inclusions, *more))

    def thickness_at(self, x: Points, y: Points) -> Points:
        """Sample the thickness [mm] at positions [mm]."""
        if isinstance(self.thickness, ThicknessMap):
            return self.thickness.sample(x, y)
        return self.thickness + 0.0 * x

    def fractions(self, elements: int) -> Float[Array, " levels"]:
        """Return the heights of the nodes of a column as fractions of its thickness [-].

        Args:
            elements: Number through the thickness.

        Raises:
            ValueError: If `levels` are not as many.
        """
        if self.levels is None:
            return jnp.linspace(0.0, 1.0, elements + 1)
        if self.levels.size != elements + 1:
            raise ValueError(
                f"Sample.levels [-] must be nz+1 = {elements + 1} numbers for {elements} elements through the "
                f"sample, got {self.levels.size}."
            )
        return self.levels

    def inside(self, x: Points, y: Points, depth: Points) -> list[Bool[Array, "*points"]]:
        """Return which points lie in each inclusion, later ones notwithstanding.

        Args:
            x: Of the points [mm].
            y: Of the points [mm].
            depth: From the sample's highest point towards the plate [mm].

        Raises:
            ValueError: If an inclusion is given by elements, `(nz, ny, nx)`, and the points are not as many.
        """
        return [
            where.contains(x, y, depth)
            if isinstance(where, AbstractInclusion)
            else _of_elements("inclusion", where, x.shape)
            for where, _ in self.inclusions
        ]

    def material_at(self, x: Points, y: Points, depth: Points) -> AbstractMaterial:
        """Evaluate the material at points.

        Args:
            x: Of the points [mm].
            y: Of the points [mm].
            depth: From the sample's highest point towards the plate [mm].

        Returns:
            A law whose numbers have the shape of x; `material` itself where it is the same everywhere.

        Raises:
            ValueError: If material or an inclusion is given by elements, `(nz, ny, nx)`, and the points are not as
                many.
        """
        for law in (self.material, *(law for _, law in self.inclusions)):
            if points_of(law) != () and points_of(law) != x.shape:
                raise ValueError(
                    f"Sample's {type(law).__name__} [MPa] has numbers for {points_of(law)} elements (nz, ny, nx); the "
                    f"sample has {x.shape}."
                )
        laws = [law for _, law in self.inclusions]
        return combined(self.material, list(zip(self.inside(x, y, depth), laws, strict=True)), x.shape)


def _of_elements(name: str, mask: Array, shape: tuple[int, ...]) -> Array:
    if mask.shape != shape:
        raise ValueError(f"Sample's {name} is given for {mask.shape} elements (nz, ny, nx); the sample has {shape}.")
    return mask
