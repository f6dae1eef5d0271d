"""Where a result comes from: the inputs in words, their hash, and the versions that computed it.

Part of `to_xarray`; all of it runs on the host, after the solve, so no input becomes a static field.
"""

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ..measurement import ThicknessMap

# Arrays up to this size are written out; larger ones are named by shape and range.
_WRITTEN_OUT = 8


def versions() -> dict[str, str]:
    """Name the versions of opfem, jax and numpy in use."""
    return {f"{name}_version": _version(name) for name in ("opfem", "jax", "numpy")}


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed (run from its source)"


def describe(part: Any) -> Any:
    """Describe an input by class names and numbers, in types that JSON knows.

    Args:
        part: A module such as a material or a contact, or one of its fields.

    Returns:
        A dict with `class` for a module; large arrays by shape and range.
    """
    if isinstance(part, ThicknessMap):
        return _describe_map(part)
    if isinstance(part, eqx.Module):
        fields = {field.name: describe(getattr(part, field.name)) for field in dataclasses.fields(part)}
        return {"class": type(part).__name__, **fields}
    if isinstance(part, jax.Array | np.ndarray | np.generic):
        values = np.asarray(part)
        if values.size <= _WRITTEN_OUT:
            return values.tolist()
        return {"shape": list(values.shape), "min": values.min().item(), "max": values.max().item()}
    if isinstance(part, tuple | list):
        return [describe(item) for item in part]
    return part


def _describe_map(thickness: ThicknessMap) -> dict[str, Any]:
    return {
        "class": "ThicknessMap",
        "shape": list(thickness.shape),
        "extent": describe(thickness.extent),
        "origin": describe(thickness.origin),
        "missing_pixels": int(np.sum(thickness.mask)),
        "min": float(np.min(thickness.values)),
        "max": float(np.max(thickness.values)),
    }


def steps_as_json(thickness: ThicknessMap) -> str:
    """Write the processing steps of a map as a JSON list of names and numbers."""
    return json.dumps(
        [
            {"step": step.name, **{name: describe(number) for name, number in step.numbers.items()}}
            for step in thickness.steps
        ]
    )


def inputs_hash(**inputs: Any) -> str:
    """Hash every number, name and choice of the inputs.

    Args:
        inputs: The modules that a solve took, by name.

    Returns:
        SHA-256 in hexadecimal; the same inputs give the same hash on every machine.
    """
    digest = hashlib.sha256()
    for name, part in inputs.items():
        for piece in _pieces(name, part):
            digest.update(piece)
    return digest.hexdigest()


def _pieces(path: str, part: Any) -> Iterator[bytes]:
    """Yield the path and the bytes of every leaf, in the order of the fields."""
    if isinstance(part, eqx.Module):
        yield f"{path}={type(part).__name__};".encode()
        for field in dataclasses.fields(part):
            yield from _pieces(f"{path}.{field.name}", getattr(part, field.name))
    elif isinstance(part, dict):
        for key in sorted(part):
            yield from _pieces(f"{path}.{key}", part[key])
    elif isinstance(part, tuple | list):
        yield f"{path}={len(part)};".encode()
        for place, item in enumerate(part):
            yield from _pieces(f"{path}[{place}]", item)
    elif isinstance(part, jax.Array | np.ndarray | np.generic):
        values = np.asarray(part)
        yield f"{path}={values.dtype.str[1:]}{values.shape};".encode()
        yield np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes()
    else:
        yield f"{path}={part!r};".encode()
