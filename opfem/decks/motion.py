"""Where the nodes of a body are constrained at the end of every step: conditions, amplitudes and steps put together."""

import numpy as np

from .bodies import Body
from .deck import Condition, Deck, Step


def displacements(body: Body, deck: Deck) -> np.ndarray:
    """Compute the prescribed displacements of a body at the end of every step `(steps, n, 3)` [mm], NaN where free.

    In a static step a condition states the displacement at its end. In an explicit one it states the change over the
    step: Abaqus/Explicit follows the slope of the amplitude, and jumps are nothing it can do.

    Raises:
        DeckError: If an explicit step has a displacement without amplitude.
    """
    constrained = np.full((len(body.numbers), 3), np.nan)
    for condition in deck.prescribed:
        _apply(condition, body, constrained, _factor(condition, deck, 0.0))
    ends, before = [], 0.0
    for step in deck.steps:
        begin = constrained.copy()
        if step.is_new:
            constrained = np.full_like(constrained, np.nan)
        for condition in step.prescribed:
            if step.kind == "static":
                _apply(condition, body, constrained, _factor(condition, deck, before + step.time, step.time))
            else:
                change = np.full_like(constrained, np.nan)
                _apply(condition, body, change, _change(condition, deck, before, step))
                moved = ~np.isnan(change)
                constrained[moved] = np.where(np.isnan(begin), 0.0, begin)[moved] + change[moved]
        before += step.time
        ends.append(constrained.copy())
    return np.array(ends).reshape(len(deck.steps), *constrained.shape)


def forces(body: Body, deck: Deck) -> np.ndarray:
    """Compute the concentrated forces on a body at the end of every step `(steps, n, 3)` [N]."""
    ends, acting, before = [], np.zeros((len(body.numbers), 3)), 0.0
    for step in deck.steps:
        for condition in step.forces:
            _apply(condition, body, acting, _factor(condition, deck, before + step.time, step.time))
        before += step.time
        ends.append(acting.copy())
    return np.array(ends).reshape(len(deck.steps), *acting.shape)


def _apply(condition: Condition, body: Body, constrained: np.ndarray, factor: float) -> None:
    if condition.instance != body.instance:
        return
    at = np.minimum(np.searchsorted(body.numbers, condition.nodes), body.numbers.size - 1)
    own = body.numbers[at] == condition.nodes
    constrained[at[own], condition.component] = factor * condition.values[own]


def _factor(condition: Condition, deck: Deck, total: float, time: float | None = None) -> float:
    if not condition.amplitude:
        return 1.0
    amplitude = deck.amplitudes[condition.amplitude]
    return amplitude.at(total if amplitude.is_total or time is None else time)


def _change(condition: Condition, deck: Deck, before: float, step: Step) -> float:
    if not condition.amplitude:
        if np.any(condition.values):
            raise condition.place.refuse(
                "*BOUNDARY: a displacement of an explicit step needs AMPLITUDE=; Abaqus/Explicit ignores it without."
            )
        return 1.0
    amplitude = deck.amplitudes[condition.amplitude]
    begin = before if amplitude.is_total else 0.0
    return amplitude.at(begin + step.time) - amplitude.at(begin)
