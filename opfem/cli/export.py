"""`--write-inp`: the problem of a command as a deck for Abaqus or CalculiX, beside its solution."""

import dataclasses
from typing import Any, TypeVar

from rich.console import Console

from ..decks import write_inp
from ..model import Contact, Experiment, LinearOverclosure, Palpation
from .deck_options import WriteOptions

Problem = TypeVar("Problem", Palpation, Experiment)


def with_linear_contact(problem: Problem, asked: WriteOptions) -> Problem:
    """Replace contact laws by the linear one that CalculiX has, where that is asked for."""
    if asked.contact_stiffness is None:
        if asked.stick_slope is not None:
            raise ValueError("--stick-slope needs --contact-stiffness: the linear contact that it belongs to.")
        return problem
    law = LinearOverclosure(asked.contact_stiffness)
    names = ("window", "sample") if isinstance(problem, Palpation) else ("window", "interface", "plate")
    sides = {name: getattr(problem, name) for name in names}
    changed = {
        name: Contact(law, side.friction, stick_slope=asked.stick_slope)
        for name, side in sides.items()
        if isinstance(side, Contact)
    }
    return dataclasses.replace(problem, **changed)


def linear_settings(asked: WriteOptions) -> dict[str, float]:
    """Collect what was asked of the contact, for summary.json."""
    given = {"contact_stiffness": asked.contact_stiffness, "stick_slope": asked.stick_slope}
    return {name: value for name, value in given.items() if value is not None}


def export(problem: Palpation | Experiment, load: Any, solver: Any, asked: WriteOptions) -> None:
    """Write the deck, where one is asked for.

    Raises:
        ValueError: If the code cannot say the problem exactly.
    """
    if asked.write_inp is None:
        return
    write_inp(asked.write_inp, problem, load, solver, code=asked.code)
    Console(highlight=False).print(f"Wrote {asked.write_inp} for {asked.code}", markup=False, soft_wrap=True)
