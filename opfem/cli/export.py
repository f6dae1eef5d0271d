"""`--write-inp`: the problem of a command as a deck for Abaqus or CalculiX, beside its solution."""

import dataclasses
from typing import Any, TypeVar

from rich.console import Console

from ..decks import write_inp
from ..model import Contact, Experiment, LinearOverclosure, Palpation
from .deck_options import WriteOptions

Problem = TypeVar("Problem", Palpation, Experiment)


def with_linear_contact(problem: Problem, options: WriteOptions) -> Problem:
    """Replace contact laws by the linear one that CalculiX has, where that is asked for."""
    if options.contact_stiffness is None:
        if options.stick_slope is not None:
            raise ValueError("--stick-slope needs --contact-stiffness: the linear contact that it belongs to.")
        return problem
    law = LinearOverclosure(options.contact_stiffness)
    names = ("window", "sample") if isinstance(problem, Palpation) else ("window", "interface", "plate")
    sides = {name: getattr(problem, name) for name in names}
    changed = {
        name: Contact(law, side.friction, stick_slope=options.stick_slope)
        for name, side in sides.items()
        if isinstance(side, Contact)
    }
    return dataclasses.replace(problem, **changed)


def linear_settings(options: WriteOptions) -> dict[str, float]:
    """Collect what was asked of the contact, for summary.json."""
    given = {"contact_stiffness": options.contact_stiffness, "stick_slope": options.stick_slope}
    return {name: value for name, value in given.items() if value is not None}


def export(problem: Palpation | Experiment, load: Any, solver: Any, options: WriteOptions) -> None:
    """Write the deck, where one is asked for.

    Raises:
        ValueError: If the code cannot say the problem exactly.
    """
    if options.write_inp is None:
        return
    write_inp(options.write_inp, problem, load, solver, code=options.code)
    Console(highlight=False).print(f"Wrote {options.write_inp} for {options.code}", markup=False, soft_wrap=True)
