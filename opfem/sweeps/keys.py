"""Hash of a function: of its code, and of everything that it captures.

A resumed sweep must not mix results of two functions. Objects that cannot be hashed are refused.
"""

import dataclasses
import dis
import enum
import functools
import hashlib
import platform
import sys
import types
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path, PurePath
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr

from ..results.provenance import versions

_LIBRARIES = frozenset(sys.stdlib_module_names) | {"opfem", "jax", "jaxlib", "equinox", "numpy", "scipy", "xarray"}


def environment() -> dict[str, str]:
    """Return what else determines the bits of a result: versions, precision and kind of device."""
    return {
        **versions(),
        "jaxlib_version": version("jaxlib"),
        "python": ".".join(platform.python_version_tuple()[:2]),
        "float": np.dtype(jax.dtypes.canonicalize_dtype(float)).name,
        "platform": jax.default_backend(),
    }


def hash_of(what: str, part: Any) -> str:
    """Hash a function, an array, or anything made of those.

    Args:
        what: Its name in a message.
        part: Functions count by their code and by everything that they capture: closures, defaults and the globals
            that they name; functions of libraries by their name.

    Returns:
        SHA-256 in hexadecimal, the same in every process.

    Raises:
        ValueError: If it contains an object of unknown content, such as an open file or a random generator.
    """
    return _Hashes().of(what, part).hex()


class _Hashes:
    """Hashes part by part, with a memo for functions that call each other or are called often."""

    def __init__(self):
        self.seen: dict[int, tuple[Any, bytes]] = {}

    def of(self, path: str, part: Any) -> bytes:
        simple = _simple(part)
        if simple is not None:
            return _digest(simple)
        if id(part) not in self.seen:
            # Met again inside itself it counts by its name. It is kept, so that no other object gets its id.
            self.seen[id(part)] = (part, _digest([f"recursion {_full_name(part)}".encode()]))
            self.seen[id(part)] = (part, _digest(self._parts(path, part)))
        return self.seen[id(part)][1]

    def _parts(self, path: str, part: Any) -> Iterator[bytes]:
        if isinstance(part, Mapping):
            yield f"mapping {len(part)}".encode()
            for key in sorted(part, key=repr):
                yield self.of(f"{path} key", key)
                yield self.of(f"{path}[{key!r}]", part[key])
        elif isinstance(part, tuple | list):
            yield f"{type(part).__name__} {len(part)}".encode()
            for place, item in enumerate(part):
                yield self.of(f"{path}[{place}]", item)
        elif isinstance(part, set | frozenset):
            yield self.of(path, sorted(part, key=repr))
        elif isinstance(part, types.ModuleType):
            yield from self._module(part)
        elif isinstance(part, type):
            yield from self._class(path, part)
        elif isinstance(part, functools.partial):
            yield self.of(path, ("partial", part.func, part.args, part.keywords))
        elif isinstance(part, types.MethodType):
            yield self.of(path, ("method", part.__func__, part.__self__))
        elif isinstance(part, types.CodeType):
            yield from self._code(path, part)
        elif isinstance(part, types.FunctionType):
            yield from self._function(path, part)
        elif callable(part) and hasattr(part, "__wrapped__") and not isinstance(part, types.FunctionType):
            yield self.of(path, ("wrapped", type(part).__name__, part.__wrapped__))  # jax.jit and its like
        elif isinstance(part, xr.DataArray | xr.Dataset):
            yield self.of(path, part.to_dict(data="array"))
        elif dataclasses.is_dataclass(part):  # eqx.Module included
            names = [field.name for field in dataclasses.fields(part)]
            yield self.of(path, ("object", type(part)))
            for name in names:
                yield self.of(f"{path}.{name}", getattr(part, name))
        elif hasattr(part, "__name__") and (isinstance(part, np.ufunc) or _is_library(part)):
            yield f"library {_full_name(part)}".encode()
        else:
            raise ValueError(
                f"{path} is a {type(part).__name__}, whose content op.sweep cannot hash: it could not distinguish a "
                "finished point from one of another function. Capture arrays, numbers, opfem objects and plain "
                "functions, create other objects inside the function, or sweep without out=."
            )

    def _function(self, path: str, fn: types.FunctionType) -> Iterator[bytes]:
        home = sys.modules.get(fn.__globals__.get("__name__", "__main__"))
        if home is not None and _is_library(home):  # its version determines its code and its globals
            yield f"library {home.__name__}.{fn.__code__.co_qualname}".encode()
            if hasattr(fn, "__wrapped__"):
                yield self.of(path, fn.__wrapped__)
                return
        else:
            yield from self._code(path, fn.__code__)
            for name in sorted(_global_names(fn.__code__) & fn.__globals__.keys()):
                yield self.of(name, fn.__globals__[name])
        yield self.of(f"{path} defaults", (fn.__defaults__, fn.__kwdefaults__))
        for name, cell in zip(fn.__code__.co_freevars, fn.__closure__ or (), strict=True):
            try:
                content = cell.cell_contents
            except ValueError:  # not yet assigned
                content = None
            yield self.of(name, content)

    def _code(self, path: str, code: types.CodeType) -> Iterator[bytes]:
        """Yield the parts of the code that determine its results, without its position."""
        yield code.co_code
        names = (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
        yield repr((names, code.co_argcount, code.co_kwonlyargcount, code.co_flags)).encode()
        for constant in code.co_consts:
            yield self.of(path, constant)

    def _module(self, module: types.ModuleType) -> Iterator[bytes]:
        yield f"module {module.__name__}".encode()
        file = getattr(module, "__file__", None)
        if file is not None and not _is_library(module):
            yield Path(file).read_bytes()

    def _class(self, path: str, cls: type) -> Iterator[bytes]:
        yield f"class {_full_name(cls)}".encode()
        if not _is_library(cls):
            yield self.of(path, cls.__bases__)
            own = {k: v for k, v in vars(cls).items() if isinstance(v, types.FunctionType | int | float | str)}
            own = {k: v for k, v in own.items() if k not in ("__module__", "__doc__", "__firstlineno__")}
            yield self.of(path, own)


def _digest(pieces: Iterable[bytes]) -> bytes:
    digest = hashlib.sha256()
    for piece in pieces:
        digest.update(len(piece).to_bytes(8, "little") + piece)
    return digest.digest()


def _simple(part: Any) -> list[bytes] | None:
    """Return the bytes of an object without parts, else None."""
    if isinstance(part, jax.Array) and jnp.issubdtype(part.dtype, jax.dtypes.prng_key):
        part = jax.random.key_data(part)
    if isinstance(part, jax.Array | np.ndarray | np.generic):
        values = np.asarray(part)
        if values.dtype.kind == "O":
            return None
        stored = np.ascontiguousarray(values, values.dtype.newbyteorder("<"))
        return [f"{values.dtype.str[1:]}{values.shape}".encode(), stored.tobytes()]
    if isinstance(part, enum.Enum | PurePath):
        return [f"{type(part).__name__} {part}".encode()]
    if part is None or part is Ellipsis or isinstance(part, bool | int | float | complex | str | bytes | np.dtype):
        return [f"{type(part).__name__} {part!r}".encode()]
    return None


def _global_names(code: types.CodeType) -> set[str]:
    """Collect the names that code, and functions inside it, look up outside."""
    own = {i.argval for i in dis.get_instructions(code) if i.opname in ("LOAD_GLOBAL", "LOAD_NAME")}
    inner = (constant for constant in code.co_consts if isinstance(constant, types.CodeType))
    return own.union(*map(_global_names, inner))


def _is_library(part: Any) -> bool:
    """Return whether a name identifies a module: it comes with Python, opfem or a dependency of opfem."""
    module = part.__name__ if isinstance(part, types.ModuleType) else getattr(part, "__module__", None)
    if not isinstance(module, str) or module == "__main__":  # which may be a program that runs the user's code
        return False
    found = sys.modules.get(module)
    installed = "site-packages" in (getattr(found, "__file__", None) or "")
    return module.partition(".")[0] in _LIBRARIES or installed


def _full_name(part: Any) -> str:
    name = getattr(part, "__qualname__", None) or getattr(part, "__name__", type(part).__name__)
    return f"{getattr(part, '__module__', None)}.{name}"
