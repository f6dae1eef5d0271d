"""From traction to displacement, with a Jacobian that is cheap to multiply with."""

from typing import NamedTuple

import jax
from jaxtyping import Array, Float

from ..model import Palpation, Traction
from ..solvers.derivative import follow_path, linearise_path
from ..solvers.discretise import discretise
from ..solvers.newton import Newton
from ..solvers.stepping import attempt, begin, unfinished


class Pressed(NamedTuple):
    """The layer under a traction.

    Attributes:
        u: Displacement of its nodes [mm].
        reached: Load fraction that the solve reached [-].
        newton: Newton steps taken.
        followed: Whether its derivative follows all increments. The solve ends where they are more than
            `Newton.max_path`, those on the way through a snap included: a snap that long counts as not carried.
    """

    u: Float[Array, "3 mz my mx"]
    reached: Array
    newton: Array
    followed: Array


def press(palpation: Palpation, load: Traction, solver: Newton, exact: bool = False) -> Pressed:
    """Solve under a traction.

    Args:
        palpation: The experiment.
        load: The traction.
        solver: Settings.
        exact: Derivatives of any order, to 1e-10 (`follow_path`). Else first derivatives to 1e-4, whose products cost
            little, for least squares (`linearise_path`).
    """
    problem = discretise(palpation, load, None, solver.face_rule)
    start = begin(problem.initial_state(), solver, True)
    frozen, settings = jax.lax.stop_gradient((problem, solver))

    def goes_on(s):
        return unfinished(s) & (s.length <= settings.max_path)

    end = jax.lax.while_loop(goes_on, lambda s: attempt(frozen, s, settings), jax.lax.stop_gradient(start))
    through = follow_path if exact else linearise_path
    _, state = through(problem, start.state, end.path, end.kept, settings)
    return Pressed(state.u, end.state.fraction, end.newton, end.kept <= solver.max_path)
