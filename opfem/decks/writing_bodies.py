"""Bodies of a deck as text: soft blocks, rigid surfaces and plates, with their numbers and sets."""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

_A_LINE = 16  # numbers of a line, the most that both codes read
_RIGID = 0.5  # thickness of rigid bodies [mm]


class Written(NamedTuple):
    """A body in a deck.

    Attributes:
        name: Of its sets of nodes and elements; those of its faces are NAME_LOW and NAME_HIGH.
        numbers: Of its nodes `(nz+1, ny+1, nx+1)`.
        elements: Of its elements `(nz, ny, nx)`.
    """

    name: str
    numbers: np.ndarray
    elements: np.ndarray


def show(value: Any) -> str:
    """Write a number in the 20 characters that both codes read of a field."""
    return f"{float(value):.13g}"


class Bodies:
    """Numbers nodes and elements one body after the other."""

    def __init__(self):
        self.nodes = 1
        self.elements = 1

    def block(self, name: str, kind: str, X: np.ndarray) -> tuple[Written, list[str]]:
        """Write a block of hexahedra.

        Args:
            name: Its name.
            kind: Type of its elements.
            X: Positions of its nodes `(3, nz+1, ny+1, nx+1)` [mm].
        """
        mz, my, mx = X.shape[1:]
        numbers = self.nodes + np.arange(mz * my * mx).reshape(mz, my, mx)
        shape = (mz - 1, my - 1, mx - 1)
        elements = self.elements + np.arange(np.prod(shape)).reshape(shape)
        self.nodes, self.elements = int(numbers.max()) + 1, int(elements.max()) + 1
        ring = ((0, 0), (0, 1), (1, 1), (1, 0))
        corners = np.stack(
            [numbers[k : k + mz - 1, j : j + my - 1, i : i + mx - 1] for k in (0, 1) for j, i in ring], axis=-1
        )
        lines = [f"*NODE, NSET={name}"]
        lines += [
            f"{number}, {show(x)}, {show(y)}, {show(z)}"
            for number, (x, y, z) in zip(numbers.ravel(), X.reshape(3, -1).T, strict=True)
        ]
        lines.append(f"*ELEMENT, TYPE={kind}, ELSET={name}")
        rows = np.concatenate([elements.reshape(-1, 1), corners.reshape(-1, 8)], axis=1)
        lines += [", ".join(map(str, row)) for row in rows.tolist()]
        for end, level, side in (("LOW", 0, 1), ("HIGH", -1, 2)):
            lines += generated("NSET", f"{name}_{end}", numbers[level])
            lines += generated("ELSET", f"{name}_{end}", elements[level])
            lines += [f"*SURFACE, TYPE=ELEMENT, NAME=S_{name}_{end}", f"{name}_{end}, S{side}"]
        return Written(name, numbers, elements), lines

    def plate(
        self, name: str, kind: str, extent: tuple[float, float], z: float, above: bool
    ) -> tuple[Written, list[str]]:
        """Write a rigid brick three times as wide as the layer, its face at z [mm]."""
        lx, ly = extent
        heights = (z, z + _RIGID) if above else (z - _RIGID, z)
        X = np.stack(np.meshgrid(heights, (-ly, 2.0 * ly), (-lx, 2.0 * lx), indexing="ij")[::-1])
        return self.block(name, kind, X)

    def surface(self, name: str, kind: str, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[Written, list[str]]:
        """Write a rigid body whose lower face has heights z `(my, mx)` [mm] at x and y."""
        across, along = np.meshgrid(x, y)
        X = np.stack([np.stack([across] * 2), np.stack([along] * 2), np.stack([z, z + _RIGID])])
        return self.block(name, kind, X)


def generated(kind: str, name: str, numbers: np.ndarray) -> list[str]:
    """Write a set of consecutive numbers."""
    return [f"*{kind}, {kind}={name}, GENERATE", f"{numbers.min()}, {numbers.max()}, 1"]


def listed(kind: str, name: str, numbers: Iterable[int]) -> list[str]:
    """Write a set number by number."""
    return [f"*{kind}, {kind}={name}", *_lines([str(number) for number in numbers])]


def _lines(words: list[str]) -> Iterator[str]:
    for start in range(0, len(words), _A_LINE):
        yield ", ".join(words[start : start + _A_LINE]) + ","
