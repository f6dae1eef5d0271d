"""The procedure of a deck's steps as opfem's solver."""

import numpy as np

from ..solvers import Explicit, Newton
from .bodies import find_bodies
from .cards import Place
from .deck import Deck, Step
from .laws import is_soft


def solver_of(deck: Deck) -> Newton | Explicit:
    """Build the solver of a deck's steps."""
    if not deck.steps:
        raise Place(deck.name, 1).refuse("the deck has no *STEP, so that nothing is solved.")
    solvers = [_solver(step, deck) for step in deck.steps]
    for step, solver in zip(deck.steps, solvers, strict=True):
        if solver != solvers[0]:
            raise step.place.refuse("*STEP must be solved as the first one; opfem takes one solver for all.")
    return solvers[0]


def _solver(step: Step, deck: Deck) -> Newton | Explicit:
    if step.kind == "static":
        if step.first is None or step.largest is None or not np.isclose(step.first, step.largest):
            return Newton()  # increments that the code chooses
        return Newton(increments=max(1, round(step.time / step.first)))
    bodies = [body for body in find_bodies(deck) if is_soft(body, deck)]
    materials = {name for body in bodies for name in body.material.tolist()}
    densities = {deck.materials[name].density for name in materials}
    if len(densities) != 1 or None in densities:
        raise step.place.refuse("*DYNAMIC, EXPLICIT needs one *DENSITY of its soft materials.")
    smooth = {deck.amplitudes[c.amplitude].is_smooth for c in step.prescribed if c.amplitude}
    if len(smooth) > 1:
        raise step.place.refuse("*STEP: amplitudes of different kinds in one step are not supported.")
    try:
        return Explicit(
            duration=step.time,
            mass_scaling=step.mass_scaling,
            density=densities.pop(),
            bulk_viscosity=step.bulk_viscosity,
            damping=max(deck.materials[name].damping for name in materials),
            amplitude="smooth_step" if smooth == {True} else "ramp",
            output_every=None if step.frames is None else step.time / step.frames,
        )
    except ValueError as cause:
        raise step.place.refuse(str(cause)) from None
