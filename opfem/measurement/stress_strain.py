"""A stress–strain curve of the layer's material, and the branch of its hysteresis.

Readers make it, `calibrate` fits a material law to it. Compression has stretches below one and negative stress.
"""

from itertools import pairwise
from typing import Any, Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from .._checks import as_leaf, check_finite, check_positive, concrete
from .thickness import Step

Mode = Literal["uniaxial", "equibiaxial", "planar"]
MODES: tuple[Mode, ...] = ("uniaxial", "equibiaxial", "planar")
Branch = Literal["loading", "unloading", "mean"]
BRANCHES: tuple[Branch, ...] = ("loading", "unloading", "mean")
Kind = Literal["nominal", "true"]
KINDS: tuple[Kind, ...] = ("nominal", "true")

# The strain has turned round when it is this far back, of its range: load frames hold and overshoot by a few per cent.
_TURNED = 0.05
# Rows before the ramp whose strain is within this part of its range rest.
_AT_REST = 1e-3


class StressStrain(eqx.Module):
    """Measured nominal stress at measured stretches, in the order of the test.

    Attributes:
        stretch: Deformed over initial length along the load [-]; below one in compression.
        nominal: Force over initial area [MPa], tension positive.
        std: Standard deviation of the stress [MPa], a number or one a point; None when not known.
        area: Initial area [mm²] that the file's own force and stress give; None without a force.
        height: Initial height [mm] that the file's own position and strain give; None without a position.
        energy_loss: Part of the work of loading that unloading does not return [-]; None without unloading.
        rate: Median strain rate [1/s]; None without a time.
        mode: "uniaxial", "equibiaxial" or "planar" (pure shear); static.
        branch: "loading", "unloading" or their "mean"; static.
        kind: "nominal" or "true": kind of stress in the file; static.
        steps: Processing steps of the curve, in order.

    Example:
        >>> import numpy as np
        >>> import opfem as op
        >>> stretch = np.linspace(1.0, 0.7, 31)
        >>> op.StressStrain(stretch, 2 * 3e-3 * (stretch - stretch**-2)).stretch.shape
        (31,)
    """

    stretch: Float[Array, " n"]
    nominal: Float[Array, " n"]
    std: Array | None
    area: Array | None
    height: Array | None
    energy_loss: Array | None
    rate: Array | None
    mode: Mode = eqx.field(static=True)
    branch: Branch = eqx.field(static=True)
    kind: Kind = eqx.field(static=True)
    steps: tuple[Step, ...]

    def __init__(
        self,
        stretch: Any,
        nominal: Any,
        std: Any = None,
        mode: Mode = "uniaxial",
        *,
        branch: Branch = "loading",
        kind: Kind = "nominal",
        area: Any = None,
        height: Any = None,
        energy_loss: Any = None,
        rate: Any = None,
        steps: tuple[Step, ...] = (),
    ):
        """Make a curve from arrays.

        Args:
            stretch: Stretches [-], shape (n,).
            nominal: Nominal stress [MPa], shape (n,).
            std: Standard deviation of the stress [MPa], a number or shape (n,).
            mode: "uniaxial", "equibiaxial" or "planar".
            branch: Branch of the test.
            kind: Kind of stress in the file; it is nominal here.
            area: Initial area [mm²] by the file.
            height: Initial height [mm] by the file.
            energy_loss: Energy loss of the cycle [-].
            rate: Strain rate [1/s].
            steps: Previous processing steps.

        Raises:
            ValueError: For shapes that do not match, and numbers out of range.
        """
        self.stretch = as_leaf(stretch, "StressStrain.stretch", "-")
        self.nominal = as_leaf(nominal, "StressStrain.nominal", "MPa")
        self.std = None if std is None else as_leaf(std, "StressStrain.std", "MPa")
        optional = {"area": area, "height": height, "energy_loss": energy_loss, "rate": rate}
        for name, value in optional.items():
            setattr(self, name, None if value is None else as_leaf(value, f"StressStrain.{name}"))
        self.mode, self.branch, self.kind, self.steps = mode, branch, kind, steps
        if self.stretch.ndim != 1 or self.stretch.shape != self.nominal.shape or self.stretch.size < 2:
            raise ValueError(
                "StressStrain.stretch [-] and StressStrain.nominal [MPa] must be two lists of one length, at least 2, "
                f"got shapes {self.stretch.shape} and {self.nominal.shape}."
            )
        if self.std is not None and self.std.shape not in ((), self.stretch.shape):
            raise ValueError(
                f"StressStrain.std [MPa] must be a number or one a point, shape {self.stretch.shape}, got "
                f"{self.std.shape}."
            )
        check_positive("StressStrain.stretch", "-", self.stretch)
        check_finite("StressStrain.nominal", "MPa", self.nominal)
        if self.std is not None:
            check_positive("StressStrain.std", "MPa", self.std)
        for name, value, known in (("mode", mode, MODES), ("branch", branch, BRANCHES), ("kind", kind, KINDS)):
            if value not in known:
                raise ValueError(f"StressStrain.{name} must be one of {', '.join(known)}, got {value!r}.")

    def cropped(self, low: float, high: float) -> "StressStrain":
        """Keep the points within a range of stretch [-], both ends included.

        Raises:
            ValueError: When fewer than 2 points remain, and under jit.
        """
        known = concrete(self.stretch)
        if known is None:
            raise ValueError("StressStrain.cropped needs known stretches; crop before jit, grad or vmap.")
        inside = (known >= low) & (known <= high)
        if inside.sum() < 2:
            raise ValueError(
                f"StressStrain.cropped: at least 2 points must lie between stretches {low:g} and {high:g}; the curve "
                f"has {known.min():.4g} to {known.max():.4g}."
            )
        std = self.std if self.std is None or self.std.ndim == 0 else self.std[inside]
        return StressStrain(
            self.stretch[inside],
            self.nominal[inside],
            std,
            self.mode,
            branch=self.branch,
            kind=self.kind,
            area=self.area,
            height=self.height,
            energy_loss=self.energy_loss,
            rate=self.rate,
            steps=(*self.steps, Step("cropped", low=low, high=high)),
        )


class Cycle(NamedTuple):
    """Rows of a test by branch.

    Attributes:
        loading: True where the size of the strain grows.
        unloading: True where it falls.
    """

    loading: np.ndarray
    unloading: np.ndarray


def cycle_of(strain: Float[np.ndarray, " n"]) -> Cycle:
    """Separate loading from unloading by the turning points of the strain; rest before the first ramp is neither.

    Rows at rest at a turning point belong to the following branch, so that a hold at the peak is no loading.

    Args:
        strain: Strain of every row [-], of either sign.
    """
    size = np.abs(strain - strain[0])
    reach = float(size.max())
    turns, extreme, rising = [0], 0, True
    for row in range(1, size.size):
        ahead = size[row] > size[extreme] if rising else size[row] < size[extreme]
        if ahead:
            extreme = row
        elif abs(size[row] - size[extreme]) > _TURNED * reach:
            turns.append(extreme)
            extreme, rising = row, not rising
    if len(turns) == 1 or extreme > turns[-1]:
        turns.append(extreme)
    loading, unloading = np.zeros(size.size, bool), np.zeros(size.size, bool)
    for number, (first, last) in enumerate(pairwise(turns)):
        (loading, unloading)[number % 2][first if number == 0 else first + 1 : last + 1] = True
    moving = np.flatnonzero(size > _AT_REST * reach)
    loading[: max(int(moving[0]) - 1, 0) if moving.size else 0] = False
    return Cycle(loading, unloading)


def on_branch(
    strain: Float[np.ndarray, " n"], stress: Float[np.ndarray, " n"], branch: Branch
) -> tuple[np.ndarray, np.ndarray, float | None]:
    """Take one branch of a cycle.

    Args:
        strain: Strain of every row [-].
        stress: Stress of every row, in any unit.
        branch: "loading", "unloading", or the "mean" of both at the strains of loading that both reach.

    Returns:
        Strain, stress, and the energy loss of the cycle [-], None where nothing unloads.

    Raises:
        ValueError: Where the branch is not there.
    """
    cycle = cycle_of(strain)
    has_unloading = bool(cycle.unloading.sum() > 1)
    if branch != "loading" and not has_unloading:
        raise ValueError(f'branch="{branch}" needs rows that unload; the strain only grows. Pass branch="loading".')
    loss = None
    if has_unloading:
        work = np.append(0.0, 0.5 * (stress[1:] + stress[:-1]) * np.diff(strain))
        loss = float(1.0 + work[cycle.unloading].sum() / work[cycle.loading].sum())
    if branch != "mean":
        rows = cycle.loading if branch == "loading" else cycle.unloading
        return strain[rows], stress[rows], loss
    order = np.argsort(strain[cycle.unloading])
    back = strain[cycle.unloading][order], stress[cycle.unloading][order]
    up, load = strain[cycle.loading], stress[cycle.loading]
    both = (up >= back[0][0]) & (up <= back[0][-1])
    return up[both], 0.5 * (load[both] + np.interp(up[both], *back)), loss
