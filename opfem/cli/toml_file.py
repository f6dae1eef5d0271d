"""Files of commands that take more than options can say: TOML, its values checked against types."""

import math
import tomllib
import types
import typing
from pathlib import Path
from typing import Any, Literal


def read_toml(path: Path) -> dict[str, Any]:
    """Read a file.

    Raises:
        ValueError: Where it cannot be read, or is not TOML.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as cause:
        raise ValueError(f"Cannot read {path}: {cause.strerror}.") from cause
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as cause:
        raise ValueError(f"{path} is not TOML: {cause}.") from cause


def converted(what: str, hint: Any, value: Any) -> Any:
    """Convert a value of TOML to the type of an option; raise ValueError where it is of another.

    Args:
        what: Its name, for messages.
        hint: The type: of numbers, text, Literal, tuples of these, or a union.
        value: As TOML gives it.
    """
    choices = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    for choice in choices:
        parts = typing.get_args(choice)
        if typing.get_origin(choice) is Literal:
            if value in parts:
                return value
        elif typing.get_origin(choice) is tuple and parts[-1] is Ellipsis:
            items = value if isinstance(value, list) else [value]
            return tuple(converted(what, parts[0], item) for item in items)
        elif typing.get_origin(choice) is tuple:
            if isinstance(value, list) and len(value) == len(parts):
                return tuple(converted(what, part, item) for part, item in zip(parts, value, strict=True))
        elif choice is float and isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
        elif choice is not float and type(value) is choice:
            return value
    expected = " or ".join(filter(None, map(_in_words, choices)))
    raise ValueError(f"{what} must be {expected}, got {value!r}.")


def _in_words(choice: Any) -> str:
    """Name a type as TOML's users do."""
    parts = typing.get_args(choice)
    if typing.get_origin(choice) is Literal:
        return "one of " + ", ".join(map(str, parts))
    if typing.get_origin(choice) is tuple and parts[-1] is Ellipsis:
        return f"{_in_words(parts[0])}, or a list of such"
    if typing.get_origin(choice) is tuple:
        return f"a list of {len(parts)}, each {_in_words(parts[0])}"
    return {bool: "true or false", int: "a whole number", float: "a number", str: "text"}.get(choice, "")


def as_json(value: Any) -> Any:
    """Write infinite numbers as text; JSON has none."""
    if isinstance(value, dict):
        return {name: as_json(entry) for name, entry in value.items()}
    if isinstance(value, list):
        return [as_json(entry) for entry in value]
    return str(value) if isinstance(value, float) and math.isinf(value) else value
