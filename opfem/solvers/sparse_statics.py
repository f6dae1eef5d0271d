"""Statics of a body on an unstructured mesh, by assembled sparse matrices, on the host.

It serves verification: small meshes of any shape, dead forces, follower pressure and prescribed displacements,
with increments that are cut back where Newton's method fails. A layer is solved by `newton`, never here.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.sparse import coo_array, csc_array

from ..mechanics.follower_pressure import FollowerPressure
from ..mechanics.internal import SolidBody
from ..mechanics.unstructured import UnstructuredCells
from .saddle_point import LinearSolution, SaddlePoint, factorised

Status = Literal["successful", "increment_too_small"]

_force = eqx.filter_jit(lambda body, u, p: body.internal_force(u, p))
_stiffness = eqx.filter_jit(lambda body, u, p, bulk: body.cell_stiffness(u, p, bulk))
_volume_residual = eqx.filter_jit(lambda body, u, p: body.volume_residual(u, p))
_volume_vectors = eqx.filter_jit(lambda body, u: body.volume_vectors(u))
_pressure_force = eqx.filter_jit(lambda load, x: load.forces(x))
_pressure_stiffness = eqx.filter_jit(lambda load, x: load.stiffness(x))


class StaticProblem(NamedTuple):
    """A body with its supports and loads at full load.

    Attributes:
        body: The body, on unstructured cells.
        points: Reference positions of the nodes `(3, nodes)` [mm].
        fixed: Mask of prescribed displacement components `(3, nodes)`.
        displacement: Prescribed displacement `(3, nodes)` [mm]; read where `fixed`.
        force: Dead forces on the nodes `(3, nodes)` [N]; None: none.
        pressure: Follower pressure; None: none.
        control: Displacement control: weights c `(3, nodes)` and value d with sum(c u) = d [mm] at the end; the
            `load_factor` on force and pressure is then unknown.
    """

    body: SolidBody
    points: Float[np.ndarray, "3 nodes"]
    fixed: Bool[np.ndarray, "3 nodes"]
    displacement: Float[np.ndarray, "3 nodes"] | None = None
    force: Float[np.ndarray, "3 nodes"] | None = None
    pressure: FollowerPressure | None = None
    control: tuple[Float[np.ndarray, "3 nodes"], float] | None = None


class StaticSettings(NamedTuple):
    """Settings of the solver.

    Attributes:
        increments: Initial number of load increments.
        rtol: Largest out-of-balance force, relative to all nodal forces; also the largest error of a
            cell's volume, relative to the cell.
        max_steps: Newton steps of an increment before it is cut.
        max_cuts: The smallest increment is the first one cut to a quarter this many times.
        penalty: γ of the hybrid form, in shear moduli.
        krylov_rtol: Residual of the hybrid form's linear solves, relative.
        max_krylov: Limit of iterations of one solve.
    """

    increments: int = 1
    rtol: float = 1e-9
    max_steps: int = 14
    max_cuts: int = 5
    penalty: float = 20.0
    krylov_rtol: float = 1e-8
    max_krylov: int = 200


class StaticSolution(NamedTuple):
    """The last equilibrium; at full load only if `status` is "successful".

    Attributes:
        displacement: `(3, nodes)` [mm].
        mean_stress: Of each cell in the hybrid form `(cells,)` [MPa], tension positive; else None.
        status: "successful" or "increment_too_small".
        load_fraction: Load fraction reached, 1 if successful.
        load_factor: Factor on force and pressure; differs from `load_fraction` under `control`.
        reaction: Reaction of the prescribed components `(3, nodes)` [N]; zero elsewhere.
        smallest_J: Smallest volume ratio of any point [-].
        residuals: Relative out-of-balance force of every Newton step, by increments.
        krylov_iterations: Of every Newton step's linear solves, by increments; empty unless hybrid.
    """

    displacement: Float[np.ndarray, "3 nodes"]
    mean_stress: Float[np.ndarray, " cells"] | None
    status: Status
    load_fraction: float
    load_factor: float
    reaction: Float[np.ndarray, "3 nodes"]
    smallest_J: float
    residuals: tuple[tuple[float, ...], ...]
    krylov_iterations: tuple[tuple[int, ...], ...]


class _State(NamedTuple):
    u: np.ndarray
    p: np.ndarray | None
    factor: float


class _Balance(NamedTuple):
    ru: np.ndarray  # external minus internal force (3, nodes)
    rp: np.ndarray | None  # minus the volume residual (cells,)
    unit: np.ndarray  # external force of load factor one (3, nodes)
    size: float  # relative residual
    J: float


class _Step(NamedTuple):
    state: _State
    balance: _Balance
    iterations: int
    whole: bool  # a whole step: the prescribed displacement is reached


def solve_statics(
    problem: StaticProblem, settings: StaticSettings = StaticSettings(), throw: bool = True
) -> StaticSolution:
    """Find the equilibrium at full load, from the unloaded state.

    Args:
        problem: The body and its loads.
        settings: Settings.
        throw: Raise if full load is not reached; False: return the last equilibrium with its status.

    Returns:
        The equilibrium.

    Raises:
        ValueError: If the body's cells are not unstructured.
        RuntimeError: If full load is not reached and `throw`.
    """
    hybrid = problem.body.form == "hybrid"
    cells = _cells(problem.body).weight.shape[1]
    state = _State(np.zeros(problem.points.shape), np.zeros(cells) if hybrid else None, 0.0)
    balance = _balance(problem, state)
    residuals, krylov = [], []
    fraction, step = 0.0, 1.0 / settings.increments
    smallest = 0.99 * step * 0.25**settings.max_cuts
    while fraction < 1.0 and step >= smallest:
        target = min(1.0, fraction + step)
        target = 1.0 if 1.0 - target < 1e-9 else target
        attempt = _increment(problem, settings, state, target)
        if attempt is None:
            step *= 0.25
            continue
        state, balance, sizes, iterations = attempt
        residuals.append(sizes)
        krylov.append(iterations)
        fraction = target
        step = min(1.5 * step, 1.0 / settings.increments)
    status: Status = "successful" if fraction == 1.0 else "increment_too_small"
    if throw and status != "successful":
        raise RuntimeError(
            f"No equilibrium beyond {fraction:.4g} of the load: increments became too small. "
            "The load may exceed what the body can carry; throw=False returns the last equilibrium."
        )
    return StaticSolution(
        displacement=state.u,
        mean_stress=state.p,
        status=status,
        load_fraction=fraction,
        load_factor=state.factor,
        reaction=np.where(problem.fixed, -balance.ru, 0.0),
        smallest_J=balance.J,
        residuals=tuple(residuals),
        krylov_iterations=tuple(krylov),
    )


def _increment(
    problem: StaticProblem, settings: StaticSettings, state: _State, fraction: float
) -> tuple[_State, _Balance, tuple[float, ...], tuple[int, ...]] | None:
    """Newton's method at one load fraction; None if it fails."""
    sizes, iterations = [], []
    if problem.control is None:
        state = state._replace(factor=fraction)
    balance = _balance(problem, state)
    for _ in range(settings.max_steps):
        try:
            step = _newton_step(problem, settings, state, balance, fraction)
        except RuntimeError:  # singular
            return None
        if step is None:
            return None
        state, balance = step.state, step.balance
        iterations.append(step.iterations)
        sizes.append(balance.size)
        if step.whole and balance.size <= settings.rtol:
            return state, balance, tuple(sizes), tuple(iterations) if state.p is not None else ()
    return None


def _newton_step(
    problem: StaticProblem, settings: StaticSettings, state: _State, balance: _Balance, fraction: float
) -> _Step | None:
    """One step, halved until no point is inverted; None if the linear solve or the halving fails."""
    given = np.zeros_like(state.u)
    if problem.displacement is not None:
        given[problem.fixed] = fraction * problem.displacement[problem.fixed] - state.u[problem.fixed]
    linear = _Linearised(problem, settings, state)
    first = linear.solve(balance.ru, balance.rp, given)
    if not first.converged:
        return None
    du, dp, iterations, dfactor = first.u, first.mean_stress, first.iterations, 0.0
    if problem.control is not None:
        c, value = problem.control
        second = linear.solve(balance.unit, None if balance.rp is None else 0.0 * balance.rp, np.zeros_like(given))
        if not second.converged:
            return None
        iterations += second.iterations
        dfactor = float((fraction * value - np.sum(c * (state.u + du))) / np.sum(c * second.u))
        du, dp = du + dfactor * second.u, dp + dfactor * second.mean_stress
    scale = 1.0
    while scale > 0.01:
        p = None if state.p is None else state.p + scale * dp
        trial = _State(state.u + scale * du, p, state.factor + scale * dfactor)
        found = _balance(problem, trial)
        if found.J > 0.0 and np.isfinite(found.size):
            return _Step(trial, found, iterations, scale == 1.0)
        scale *= 0.5
    return None


def _balance(problem: StaticProblem, state: _State) -> _Balance:
    u = jnp.asarray(state.u)
    p = None if state.p is None else jnp.asarray(state.p)
    force, J = _force(problem.body, u, p)
    internal = np.asarray(force)
    unit = np.zeros_like(state.u) if problem.force is None else problem.force.copy()
    if problem.pressure is not None:
        forces = np.asarray(_pressure_force(problem.pressure, jnp.asarray(problem.points) + u))
        for axis in range(3):
            faces = np.asarray(problem.pressure.faces).ravel()
            unit[axis] += np.bincount(faces, weights=forces[..., axis].ravel(), minlength=unit.shape[1])
    ru = state.factor * unit - internal
    whole = np.linalg.norm(internal) + np.linalg.norm(state.factor * unit)
    size = np.linalg.norm(ru[~problem.fixed]) / whole if whole > 0.0 else 0.0
    rp = None
    if p is not None:
        rp = -np.asarray(_volume_residual(problem.body, u, p))
        size = max(size, np.abs(rp / np.asarray(problem.body.cells.weight).sum(axis=0)).max())
    return _Balance(ru, rp, unit, float(size), float(J))


class _Linearised:
    """The assembled tangent at one state, factorised."""

    def __init__(self, problem: StaticProblem, settings: StaticSettings, state: _State):
        body, hybrid = problem.body, state.p is not None
        bulk, shear = float(body.material.bulk), float(body.material.shear)
        self.penalty = min(settings.penalty * shear, bulk)
        self.settings, self.free = settings, ~problem.fixed.T.ravel()
        u = jnp.asarray(state.u)
        p = None if state.p is None else jnp.asarray(state.p)
        K = np.asarray(_stiffness(body, u, p, jnp.asarray(self.penalty) if hybrid else None))
        dof = _unknowns(np.asarray(_cells(body).cells))  # (a, 3, e)
        size, elements = self.free.size, dof.shape[-1]
        matrix = _sparse(K, dof[:, None, :, None], dof[None, :, None, :], (size, size))
        if problem.pressure is not None and state.factor != 0.0:
            load = np.asarray(_pressure_stiffness(problem.pressure, jnp.asarray(problem.points) + u))
            own = np.moveaxis(_unknowns(np.asarray(problem.pressure.faces).T), -1, 0)  # (faces, corners, 3)
            load = _sparse(load, own[:, :, :, None, None], own[:, None, None], (size, size))
            matrix = matrix - state.factor * load
        rows = matrix[self.free]
        block, self.prescribed = rows[:, self.free].tocsc(), rows[:, ~self.free]
        if not hybrid:
            self._invert = factorised(block)
            return
        vectors = np.asarray(_volume_vectors(body, u))
        volume = _sparse(vectors, np.arange(elements), dof, (elements, size))
        self.held_volume = volume[:, ~self.free]
        self.cell_volume = np.asarray(body.cells.weight).sum(axis=0)
        self.system = SaddlePoint(block, volume[:, self.free], self.cell_volume, 1.0 / bulk, shear, self.penalty)

    def solve(self, ru: np.ndarray, rp: np.ndarray | None, given: np.ndarray) -> LinearSolution:
        """Solve for the displacement `(3, nodes)` of which `given` is prescribed, and the mean stress."""
        known = given.T.ravel()[~self.free]
        right = ru.T.ravel()[self.free] - self.prescribed @ known
        if rp is None:
            solution = LinearSolution(self._invert(right), np.zeros(()), 0, True)
        else:
            # The columns of prescribed unknowns are augmented as well: their part of γ Bᵀ M⁻¹ B is compensated.
            volume = self.held_volume @ known
            right = right + self.penalty * (self.system.transposed @ (volume / self.cell_volume))
            solution = self.system.solve(right, rp - volume, self.settings.krylov_rtol, self.settings.max_krylov)
        u = np.zeros(self.free.size)
        u[self.free], u[~self.free] = solution.u, known
        return solution._replace(u=u.reshape(-1, 3).T)


def _cells(body: SolidBody) -> UnstructuredCells:
    if not isinstance(body.cells, UnstructuredCells):
        raise ValueError(f"StaticProblem.body must have UnstructuredCells, got {type(body.cells).__name__}.")
    return body.cells


def _unknowns(nodes: np.ndarray) -> np.ndarray:
    """Return the indices of the displacements of nodes `(a, e)`, numbered node by node: `(a, 3, e)`."""
    return 3 * nodes[:, None].astype(np.int32) + np.arange(3, dtype=np.int32)[:, None]


def _sparse(values: np.ndarray, rows: np.ndarray, columns: np.ndarray, shape: tuple[int, int]) -> csc_array:
    """Add values at rows and columns, each broadcast to the values."""
    at = tuple(np.broadcast_to(index, values.shape).ravel() for index in (rows, columns))
    return coo_array((values.ravel(), at), shape=shape).tocsc()
