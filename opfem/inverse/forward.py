"""From traction to the interface's displacement, with a Jacobian that is cheap to multiply with."""

from typing import NamedTuple

import jax
from jaxtyping import Array, Float

from ..model import Palpation, Traction
from ..solvers.derivative import linearise_path
from ..solvers.discretise import discretise
from ..solvers.newton import Newton
from ..solvers.stepping import attempt, begin, unfinished


class Interface(NamedTuple):
    """The interface under a traction.

    Attributes:
        u: Displacement of its nodes [mm].
        reached: Load fraction that the solve reached [-].
        newton: Newton steps taken.
    """

    u: Float[Array, "3 my mx"]
    reached: Array
    newton: Array


def press(palpation: Palpation, load: Traction, solver: Newton) -> Interface:
    """Solve under a traction. First derivatives to 1e-3, for least squares (`linearise_path`)."""
    problem = discretise(palpation, load, None, solver.face_rule)
    start = begin(problem.initial_state(), solver, True)
    frozen, settings = jax.lax.stop_gradient((problem, solver))
    end = jax.lax.while_loop(unfinished, lambda s: attempt(frozen, s, settings), jax.lax.stop_gradient(start))
    _, state = linearise_path(problem, start.state, end.path, end.kept, settings)
    return Interface(state.u[:, -1], end.state.fraction, end.newton)
