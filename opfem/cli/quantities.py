"""What an option takes: its unit, and the numbers that make sense.

Checks the command line and the files of `opfem sweep` alike.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_origin

if TYPE_CHECKING:
    from cyclopts import Token


@dataclass(frozen=True)
class Quantity:
    """The numbers that an option takes; a validator of cyclopts.

    Args:
        unit: Their unit.
        expected: What they must be, in words.
        least: The lowest of them.
        most: The highest of them.
        above: Whether they must lie above `least`.
        infinite: Whether infinity is one of them.
    """

    unit: str
    expected: str
    least: float = -math.inf
    most: float = math.inf
    above: bool = False
    infinite: bool = False

    def __call__(self, hint: Any, value: Any) -> None:
        """Raise ValueError unless all numbers of a value are as expected; None is not given."""
        numbers = () if value is None else value if isinstance(value, tuple | list) else (value,)
        if not all(self._takes(number) for number in numbers):
            raise ValueError(f"{self.wanted}, got {' '.join(f'{number:g}' for number in numbers)}.")

    @property
    def wanted(self) -> str:
        """Unit and expectation, as messages say them."""
        return f"[{self.unit}] must be {self.expected}"

    def _takes(self, number: float | int) -> bool:
        if math.isnan(number) or (math.isinf(number) and not (self.infinite and number > 0)):
            return False
        return (number > self.least if self.above else number >= self.least) and number <= self.most


def positive(unit: str, expected: str = "a positive number", *, infinite: bool = False) -> Quantity:
    """Numbers above zero."""
    return Quantity(unit, expected, 0.0, above=True, infinite=infinite)


def not_negative(unit: str) -> Quantity:
    """Zero and numbers above."""
    return Quantity(unit, "zero or a positive number", 0.0)


def count(expected: str = "a whole number of at least 1") -> Quantity:
    """Whole numbers above zero; `whole` sees to it that they are whole."""
    return Quantity("1", expected, 1.0)


def whole(hint: Any, tokens: Sequence["Token"]) -> int | tuple[int, ...]:
    """Convert to whole numbers; cyclopts would round others."""
    numbers = tuple(int(token.value) for token in tokens)
    return numbers if get_origin(hint) is tuple else numbers[0]


@dataclass(frozen=True)
class NumberOrFile:
    """A positive number, or the path of a file that exists.

    Args:
        unit: Unit of the number.
        file: What the file is.
    """

    unit: str
    file: str

    def __call__(self, hint: Any, value: str | None) -> None:
        """Raise ValueError unless the value is a positive number or there is such a file."""
        if value is None:
            return
        try:
            number = float(value)
        except ValueError:
            if not Path(value).exists():
                raise ValueError(f"{self.wanted}, got {value!r}: there is no such file.") from None
        else:
            if not 0 < number < math.inf:
                raise ValueError(f"{self.wanted}, got {value}.")

    @property
    def wanted(self) -> str:
        """Unit and expectation, as messages say them."""
        return f"[{self.unit}] must be a positive number, or the path of {self.file}"


@dataclass(frozen=True)
class OldFile:
    """A file that exists.

    Args:
        file: What it is.
    """

    file: str

    def __call__(self, hint: Any, value: str | None) -> None:
        """Raise ValueError unless there is such a file."""
        if value is not None and not Path(value).is_file():
            raise ValueError(f"{self.wanted}, got {value!r}: there is no such file.")

    @property
    def wanted(self) -> str:
        """Expectation, as messages say it."""
        return f"must be the path of {self.file}"


@dataclass(frozen=True)
class NewFile:
    """A file that can be made: of the right suffix, in a folder that exists.

    Args:
        suffix: The suffix.
    """

    suffix: str

    def __call__(self, hint: Any, value: Path | None) -> None:
        """Raise ValueError unless such a file can be."""
        if value is not None and (value.suffix != self.suffix or not value.parent.is_dir()):
            raise ValueError(f"{self.wanted}, got {str(value)!r}.")

    @property
    def wanted(self) -> str:
        """Expectation, as messages say it."""
        return f"must be a {self.suffix} file in a folder that exists"
