"""What the command line says when something is wrong: in its own words, the options.

An error of the parser becomes one line: option, unit, expected, got. What the library says of its arguments is said
of the options that they come from.
"""

import difflib
import re
import types
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Literal, Union, get_args, get_origin

if TYPE_CHECKING:
    from cyclopts import CycloptsError
    from cyclopts.argument import Argument

# Arguments and fields of the library, and the options that they come from; others are called as the option is.
_FIELDS = {
    "Layer.thickness": "--l0",
    "Imprint.thickness": "MAP",
    "Palpation.extent": "--layer-extent",
    "Contact.friction": "--window-friction or --sample-friction",
    "ExponentialOverclosure.pressure": "--p0",
    "ExponentialOverclosure.clearance": "--c0",
    "Matern.length": "--prior-length",
    "Matern.std": "--prior-std",
    "Matern.mean": "--prior-mean",
    "Checkpoint.path": "--checkpoint",
    "smoothed.fwhm": "--smooth",
    "calibrate.bulk": "--bulk-ratio",
}
_OWNERS = (
    "Palpation|MooneyRivlin|ExponentialOverclosure|Newton|Explicit|Imprint|fit_traction|ThicknessMap|read_thickness|"
    "find_interface|OctVolume|OctSystem|calibrate|axial_displacement|read_inp"
)
_ARGUMENTS = (
    "unit|extent|spacing|std|variable|max_missing|max_bytes|missing|mask|scale|elements|element|sides|bulk|c10|c01|"
    "increments|duration|mass_scaling|precision|checkpoint|correct_approach|hyperparameters|nonnegative|model_std|draws|"
    "depth_spacing|index_applied|optical_spacing|shape|order|dtype|edge|search|average|max_slope|confidence|window|"
    "strain|stress|columns|sign|kind|mode|branch|area|height|diameter|terms|weights|platens|code|layer|interpolation"
)
_FIELD = re.compile("|".join(map(re.escape, _FIELDS)) + rf"|\b(?:{_OWNERS})\.({_ARGUMENTS})\b")
_CALL = re.compile(rf"\b(?:{_OWNERS})\(({_ARGUMENTS})=\.\.\.\)")
_KEYWORD = re.compile(rf"""(?<![\w/\\.])({_ARGUMENTS})=("[^"]*"|'[^']*'|\([^()]*\)|[\w.+-]*)""")
# Two names are alike from here on: "frction" and "friction" are, "frction" and "fraction" less so.
_ALIKE = 0.7


def in_options(message: str) -> str:
    """Say in options what a message says in arguments: `unit="um"` is `--unit um`, `Layer.thickness` is `--l0`."""

    def keyword(found: re.Match[str]) -> str:
        value = found[2].strip("\"'()").replace(",", "")
        return f"{_option(found[1])} {value}".rstrip()

    message = message.replace("holds no variable ", "holds no --variable ")
    message = _CALL.sub(lambda found: _option(found[1]), message)
    message = _FIELD.sub(lambda found: _FIELDS.get(found[0]) or _option(found[1]), message)
    return _KEYWORD.sub(keyword, message)


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def alike(word: str, names: Iterable[str]) -> list[str]:
    """Find the names that a word was meant to be, by the whole or by one of their parts; those most alike."""

    def likeness(name: str) -> float:
        whole = difflib.SequenceMatcher(None, word, name).ratio()
        parts = [difflib.SequenceMatcher(None, word, part).ratio() for part in name.split("-")]
        return max(whole, 0.99 * max(parts))

    scores = {name: likeness(name) for name in names}
    best = max(scores.values(), default=0.0)
    return [name for name, score in scores.items() if score >= max(_ALIKE, 0.95 * best)]


def say(error: "CycloptsError") -> str:
    """Say in one line what was wrong with the command line.

    Args:
        error: What cyclopts raised.
    """
    from cyclopts.exceptions import (
        CoercionError,
        MissingArgumentError,
        RepeatArgumentError,
        UnknownCommandError,
        UnknownOptionError,
        UnusedCliTokensError,
        ValidationError,
    )

    name = "" if error.argument is None else error.argument.name
    match error:
        case ValidationError() if error.argument is not None:
            return f"{name} {error.exception_message}"
        case CoercionError() if error.argument is not None:
            got = " ".join(token.value for token in error.argument.tokens) or getattr(error.token, "value", "nothing")
            keyword = getattr(error.token, "keyword", None) or name  # a flag goes by two names
            return f"{keyword} {_wanted(error.argument)}, got {got!r}.{_meant(error)}"
        case MissingArgumentError() if error.argument is not None:
            return _missing(error)
        case RepeatArgumentError():
            return f"{error.token.keyword} must be given once, got it twice."
        case UnknownOptionError():
            return f"There is no option {error.token.keyword or error.token.value}.{_meant(error)}{_more(error)}"
        case UnknownCommandError():
            return f"There is no command {(error.unused_tokens or ['?'])[0]}.{_meant(error)} See opfem --help."
        case UnusedCliTokensError():
            extra = " ".join(error.unused_tokens or [])
            return f"{' '.join(('opfem', *(error.command_chain or ())))} has no place for {extra!r}.{_more(error)}"
    return str(error)


def _missing(error: Any) -> str:
    argument, got = error.argument, error.tokens_so_far
    name, wanted = error.keyword or argument.name, _wanted(argument)
    if argument.tokens or error.keyword or got:
        return f"{name} {wanted}, got {' '.join(got) or 'nothing'}."
    return f"{name} is needed: {argument.parameter.help}{_more(error)}"


def _more(error: "CycloptsError") -> str:
    return f" See {' '.join(('opfem', *(error.command_chain or ())))} --help."


def _meant(error: Any) -> str:
    """Suggest what a word was meant to be."""
    if getattr(error, "argument_collection", None) is not None:
        names = [name for argument in error.argument_collection for name in argument.names if name.startswith("--")]
        word = (error.token.keyword or error.token.value).partition("=")[0]
        near = [f"--{name}" for name in alike(word.lstrip("-"), [name.lstrip("-") for name in names])]
    elif error.unused_tokens and error.app is not None:
        near = alike(error.unused_tokens[0], [name for name in error.app if not name.startswith("-")])
    else:
        near = alike(getattr(error.token, "value", ""), _choices(error.argument.hint))
    return f" Did you mean {' or '.join(near)}?" if near else ""


def _wanted(argument: "Argument") -> str:
    """Say what an option takes: by its check, else by its type."""
    for check in validators(argument.parameter.validator):
        if hasattr(check, "wanted"):
            return check.wanted
    if argument.hint is bool:
        return "must be given without a value"
    choices = _choices(argument.hint)
    return f"must be {'one of ' + ', '.join(choices) if choices else 'given with a value'}"


def validators(stated: Any) -> tuple[Any, ...]:
    """Return the validators of an option, one or many."""
    return () if stated is None else tuple(stated) if isinstance(stated, Iterable) else (stated,)


def _choices(hint: Any) -> list[str]:
    if get_origin(hint) in (Union, types.UnionType, tuple):
        return [choice for part in get_args(hint) for choice in _choices(part)]
    return [str(choice) for choice in get_args(hint)] if get_origin(hint) is Literal else []
