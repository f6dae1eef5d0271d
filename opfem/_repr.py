"""How parts of a model are written: numbers with their units, arrays by their range.

A class takes part by `__pdoc__`, which equinox's `repr` asks wherever the part appears.
"""

import dataclasses
from typing import Any

import jax
import numpy as np
import wadler_lindig as wl

from ._checks import concrete

# Arrays up to this size are written out.
_WRITTEN_OUT = 6


def with_units(module: Any, **options: Any) -> wl.AbstractDoc:
    """Write a module by its fields, whose unit is that of their `Leaf` or `metadata={"unit": ...}`; None is left out.

    Args:
        module: A frozen dataclass.
        options: Of `wadler_lindig.pdoc`.
    """
    docs = []
    for field in dataclasses.fields(module):
        value = getattr(module, field.name)
        if value is None:
            continue
        unit = field.metadata.get("unit") or getattr(field.metadata.get("converter"), "unit", "")
        is_number = isinstance(value, jax.Array | np.ndarray)
        doc = wl.TextDoc(quantity(value, unit)) if is_number else wl.pdoc(value, **options)
        docs.append(wl.TextDoc(f"{field.name}=") + doc)
    begin, end = wl.TextDoc(f"{type(module).__name__}("), wl.TextDoc(")")
    return wl.bracketed(begin=begin, docs=docs, sep=wl.comma, end=end, indent=options["indent"])


def quantity(value: Any, unit: str) -> str:
    """Write a number or an array with its unit.

    Args:
        value: An array, traced or not.
        unit: Its unit; "-" for none.
    """
    after = "" if unit in ("", "-") else f" {unit}"
    known = concrete(value)
    if known is None:
        return f"traced {value.dtype}{list(value.shape)}{after}"
    if known.ndim == 0:
        return f"{known.item():.6g}{after}"
    if known.size <= _WRITTEN_OUT and known.ndim == 1:
        return f"({', '.join(f'{number:.6g}' for number in known.tolist())}){after}"
    low, high = known.min(), known.max()
    return f"{low:.4g}{'' if low == high else f' to {high:.4g}'}{after} {list(known.shape)}"
