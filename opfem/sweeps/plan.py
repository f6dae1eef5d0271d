"""Plan of the batches of a sweep, which determines the bits of a result besides its inputs."""

import dataclasses
from typing import Any, Literal, get_args

from .._device import choices

Mode = Literal["auto", "map", "vmap", "call"]
# Default number of points per batch of `vmap`.
_VMAP_SIZE = 32


@dataclasses.dataclass(frozen=True)
class Plan:
    """Plan of the batches, which determines the bits of a result besides the inputs.

    Attributes:
        mode: "map": one point after the other in one program; "vmap": together, until the slowest is done; "call":
            the function as it is, not compiled.
        size: Points of a batch on each device.
        devices: Devices that a batch is spread over.
    """

    mode: str
    size: int
    devices: int = 1

    @property
    def points(self) -> int:
        """Points of a batch."""
        return self.size * self.devices


def settled(size: int | None, mode: str, devices: int, begun: Plan | None) -> Plan:
    """Choose what is left open: as begun, else `map` on CPU and `vmap` elsewhere; benchmarks/sweep.py measures both."""
    if mode == "auto":
        mode = begun.mode if begun is not None else "map" if choices().threads else "vmap"
    if mode == "call":
        return Plan(mode, 1)
    default = begun.size if begun is not None else _VMAP_SIZE if mode == "vmap" else 8 if devices > 1 else 1
    return Plan(mode, size or default, devices)


def check_settings(settings: Any, name: str, counts: tuple[str, ...]) -> None:
    """Raise ValueError unless counts are None or at least 1, and the mode is known."""
    for count in counts:
        value = getattr(settings, count)
        if value is not None and (not isinstance(value, int) or value < 1):
            raise ValueError(f"{name}.{count} must be a whole number of at least 1, or None, got {value!r}.")
    if settings.mode not in get_args(Mode):
        raise ValueError(f"{name}.mode must be one of {get_args(Mode)}, got {settings.mode!r}.")
