"""opfem: stress on tissue from the measured thickness of a soft layer.

Units are mm, N, MPa, s, tonne; maps are indexed [y, x]; tension is positive and contact
pressure is positive in compression.
"""

# What takes time is imported in the functions: `opfem --help` and Ctrl-C do not wait for it.
import functools


@functools.cache
def _homes() -> dict[str, str]:
    """Read which module holds each public name from `__init__.pyi`, the one list of them."""
    import ast
    from pathlib import Path

    stub = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    lines = [line for line in stub.body if isinstance(line, ast.ImportFrom)]
    return {alias.name: f".{line.module or alias.name}" for line in lines for alias in line.names}


def __getattr__(name: str) -> object:
    """Load what a name needs when it is first asked for: JAX takes half a second, pictures one more."""
    from importlib import import_module

    if name == "__version__":
        from importlib.metadata import version

        return version("opfem")
    if name == "__all__":
        return __dir__()
    unknown = AttributeError(f"module 'opfem' has no attribute {name!r}")
    if name.startswith("_"):
        raise unknown
    home = _homes().get(name, f".{name}")
    try:
        module = import_module(home, __name__)
    except ModuleNotFoundError as cause:
        if cause.name != __name__ + home:
            raise
        raise unknown from None
    value = module if home == f".{name}" else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return sorted([*_homes(), "__version__"])
