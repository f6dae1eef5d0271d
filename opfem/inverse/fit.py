"""`fit_traction`: the traction that explains a measured map, with its uncertainty (route B)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from .._checks import concrete
from ..measurement import ThicknessMap
from ..model import Contact, Palpation, Traction
from ..solvers import Newton, solve
from ..solvers.progress import FitProgress
from ..solvers.solve import require_float64
from .estimates import solve_linear
from .forward import press
from .gauss_newton import GaussNewton, PreconditionedDescent
from .noise import noise_std
from .observation import Nodes, Observation, interface_heights, observe
from .posterior import Posterior
from .preconditioner import layer_normal
from .prior import AbstractPrior, Matern, on_nodes
from .result import FitStatus, TractionFit

# Relative gradient of each Gauss–Newton system, and most iterations.
_CG_RTOL = 1e-2
_CG_STEPS = 60
# Standardised misfit [-] of every pixel where the layer does not carry the traction: the step is then halved.
_NOT_CARRIED = 1e4


class Misfit(eqx.Module):
    """What a fit minimises, as a function of white unknowns."""

    palpation: Palpation
    observation: Observation
    prior: AbstractPrior
    solver: Newton

    def normal(self, white: Nodes) -> Nodes:
        """Compute the normal traction [MPa] per reference area."""
        return on_nodes(self.prior, white.shape) + self.prior.expand(white, self.palpation.mesh().spacing)

    def __call__(self, white: Nodes) -> tuple[tuple[Array, Array], dict[str, Array]]:
        """Compute standardised misfit and what the prior holds near zero [-]; and how the solve went."""
        interface = press(self.palpation, Traction(self.normal(white)), self.solver)
        heights = interface_heights(self.palpation.mesh(), interface.u)
        carried = interface.reached >= 1.0
        misfit = jnp.where(carried, self.observation.misfit(heights), _NOT_CARRIED)
        aux = {"carried": carried, "heights": heights, "newton": interface.newton}
        return (misfit, jnp.asarray(self.prior.penalised(white.shape)) * white), aux


def _misfit(white: Nodes, misfit: Misfit):
    return misfit(white)


@eqx.filter_jit
def _step(solver, white, misfit, state):
    white, state, aux = solver.step(_misfit, white, misfit, {}, state, frozenset())
    done, _ = solver.terminate(_misfit, white, misfit, {}, state, frozenset())
    return white, state, aux, done


@eqx.filter_jit
def _posterior_draw(posterior: Posterior, key):
    return posterior.draw(key)


def fit_traction(
    palpation: Palpation,
    thickness: ThicknessMap,
    prior: AbstractPrior,
    *,
    solver: Newton = Newton(max_path=12),
    rtol: float = 1e-3,
    max_steps: int = 30,
    draws: int = 32,
    key: PRNGKeyArray | None = None,
    throw: bool = True,
    progress: bool = True,
) -> TractionFit:
    """Find the traction on the interface that explains a measured map.

    Least squares over misfit and prior, by Gauss–Newton through the nonlinear solve with its friction history. The
    normal traction is fitted; the lateral one follows the sample's friction (`Traction`).

    Args:
        palpation: The experiment; its sample a `Contact`.
        thickness: The measured map under load, with its `std`; masked pixels count for nothing.
        prior: What is known of the normal traction: `Matern` or `Tikhonov`.
        solver: Settings of the forward solve; `max_path` bounds its increments.
        rtol: The fit has settled where a step changes unknowns and residuals by less [-].
        max_steps: Most evaluations of the forward solve.
        draws: Draws of the posterior that standard deviations come from.
        key: Random key of the draws; None: always the same.
        throw: Raise where the fit fails. False: return what was reached, with its status.
        progress: Show a bar on a terminal or in a notebook.

    Raises:
        ValueError: If the sample is no `Contact`, the map's std is missing or not positive, the prior's length is
            below the mesh, or numbers are float32.
        RuntimeError: If the fit fails and `throw` is True.
    """
    require_float64(palpation)
    _check(palpation, prior)
    mesh = palpation.mesh()
    std = noise_std("fit_traction", thickness)
    observation = eqx.filter_jit(observe)(mesh, thickness, std)
    misfit = Misfit(palpation, observation, prior, solver.as_leaves())
    white = eqx.filter_jit(solve_linear)(palpation, observation, prior).x
    precondition = layer_normal(palpation, observation, prior)
    descent = PreconditionedDescent(precondition, jnp.asarray(_CG_RTOL), jnp.asarray(_CG_STEPS))
    gauss_newton = GaussNewton(jnp.asarray(rtol), jnp.asarray(rtol), descent)
    white, state, aux, steps, result = _iterate(gauss_newton, white, misfit, max_steps, progress)
    if throw and bool(result != FitStatus.successful):
        raise RuntimeError(f"The fit stopped after {steps} forward solves. {FitStatus[result]}")

    posterior = Posterior(white, state.f_info.jac, descent.precondition)
    key = jax.random.key(0) if key is None else key
    solution = solve(palpation, Traction(misfit.normal(white)), solver, throw=False, progress=False)
    deviations, dof, iterations = [], [], 0
    for one in jax.random.split(key, draws):
        deviation, determined, count = _posterior_draw(posterior, one)
        deviations.append(prior.expand(deviation, mesh.spacing))
        dof.append(determined)
        iterations += int(count)
    deviations = jnp.stack(deviations)
    normal_std = jnp.sqrt(jnp.mean(deviations**2, axis=0))
    residual = aux["heights"] - observation.surface
    stats = {
        "forward_solves": steps,
        "inner_iterations": int(state.descent_state.iterations),
        "posterior_iterations": iterations,
        "draws": draws,
        "std_error": 1.0 / (2.0 * draws) ** 0.5,
        "representation_rms": observation.representation_rms,
        "misfit_rms": jnp.sqrt(jnp.mean(residual**2)),
    }
    return TractionFit(
        solution=solution,
        pressure_std=normal_std * solution.pressure / -solution.traction[2],
        normal_std=normal_std,
        chi2=jnp.sum(state.f_info.residual[0] ** 2),
        effective_dof=jnp.mean(jnp.stack(dof)),
        observed=observation.informed,
        residual=residual,
        stats=stats,
        result=result,
        posterior=posterior,
        prior=prior,
        deviations=deviations,
    )


def _iterate(gauss_newton, white, misfit: Misfit, max_steps: int, progress: bool):
    structure, aux_structure = eqx.filter_eval_shape(_misfit, white, misfit)
    state = gauss_newton.init(_misfit, white, misfit, {}, structure, aux_structure, frozenset())
    with FitProgress(progress) as bar:
        for step in range(1, max_steps + 1):
            white, state, aux, done = _step(gauss_newton, white, misfit, state)
            loss = float(state.f_info.as_min())
            bar.show(step, loss, int(state.descent_state.iterations))
            if not bool(aux["carried"]):
                return white, state, aux, step, FitStatus.not_carried
            if not jnp.isfinite(loss) or not bool(jnp.all(jnp.isfinite(state.y_eval))):
                return white, state, aux, step, FitStatus.nonfinite
            if bool(done):
                return white, state, aux, step, FitStatus.successful
    return white, state, aux, max_steps, FitStatus.max_steps_reached


def _check(palpation: Palpation, prior: AbstractPrior) -> None:
    if not isinstance(palpation.sample, Contact):
        raise ValueError(
            f"fit_traction needs sample=Contact(law, friction), got sample={type(palpation.sample).__name__}()."
        )
    if not isinstance(prior, AbstractPrior):
        raise ValueError(f"fit_traction.prior must be Matern(...) or Tikhonov(...), got {type(prior).__name__}.")
    nx, ny, _ = palpation.elements
    if min(nx, ny) < 4:
        raise ValueError(f"fit_traction needs at least 4 elements along x and y, got {(nx, ny)}.")
    length = concrete(prior.length) if isinstance(prior, Matern) else None
    size = concrete(jnp.stack(palpation.mesh().spacing).max())
    if length is not None and size is not None and np.any(length < size):
        raise ValueError(
            f"Matern.length [mm] must be at least an element, {float(size):g}, got {float(length):g}: the mesh cannot "
            "follow it. Pass a longer length, or Palpation(elements=...) with more."
        )
