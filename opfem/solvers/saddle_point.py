"""The linear system of the hybrid form: displacement and the cells' mean stress, solved together.

    [ A  Bᵀ    ] [du]   [ru]
    [ B -M/κ   ] [dp] = [rp]

A is the stiffness at constant mean stress, B the derivative of the cells' volume and M = diag(V). The bulk
modulus κ may be infinite. Augmented Lagrangian: adding γ Bᵀ M⁻¹ times the second row to the first leaves the
solution unchanged; the first block becomes A + γ Bᵀ M⁻¹ B. For a moderate γ, at any κ, a diagonal matrix then
approximates the Schur complement, and GMRES converges in few iterations.

Source: Benzi & Olshanskii, SIAM J. Sci. Comput. 28 (2006) 2095.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import LinearOperator, gmres, splu

# Symmetric minimum degree halves the fill-in of the default ordering; its pivots stay on the diagonal when they can.
_ORDERING = {"permc_spec": "MMD_AT_PLUS_A", "diag_pivot_thresh": 0.01, "options": {"SymmetricMode": True}}


class LinearSolution(NamedTuple):
    """Displacement [mm], mean stress [MPa], applications of the preconditioner, and whether it converged."""

    u: np.ndarray
    mean_stress: np.ndarray
    iterations: int
    converged: bool


def factorised(matrix: csc_array) -> Callable[[np.ndarray], np.ndarray]:
    """Factorise a sparse matrix; return the function that solves with it.

    Raises:
        RuntimeError: If the matrix is singular.
    """
    return splu(matrix, **_ORDERING).solve


class SaddlePoint:
    """The system above with one factorisation, for several right-hand sides.

    Args:
        augmented: A + γ Bᵀ M⁻¹ B of the free displacements [N/mm].
        volume: B, `(cells, free displacements)` [mm²].
        cell_volume: Diagonal of M [mm³].
        inverse_bulk: 1/κ [1/MPa], zero if incompressible.
        shear: Shear modulus [MPa].
        penalty: γ [MPa].
    """

    def __init__(
        self,
        augmented: csc_array,
        volume: csc_array,
        cell_volume: np.ndarray,
        inverse_bulk: float,
        shear: float,
        penalty: float,
    ):
        self.augmented, self.volume, self.transposed = augmented, volume.tocsr(), volume.T.tocsr()
        self.cell_volume, self.inverse_bulk, self.penalty = cell_volume, inverse_bulk, penalty
        self._invert = factorised(augmented)
        # Factor of Bᵀ after augmentation, and of the Schur complement -V × this.
        self._coupling = 1.0 - penalty * inverse_bulk
        self._compliance = inverse_bulk + self._coupling / (penalty + shear)
        # Rows are scaled to square roots of energy, independent of units.
        rows = np.abs(augmented.diagonal()), cell_volume / (penalty + shear)
        self._scale = 1.0 / np.sqrt(np.concatenate(rows))

    def solve(self, ru: np.ndarray, rp: np.ndarray, rtol: float, max_iterations: int) -> LinearSolution:
        """Solve for one right-hand side to a residual of rtol, relative."""
        b = self._scale * np.concatenate([ru + self.penalty * (self.transposed @ (rp / self.cell_volume)), rp])
        iterations = 0

        def count(_):
            nonlocal iterations
            iterations += 1

        # Right preconditioning: the residual is that of the original system.
        operator = LinearOperator((b.size, b.size), lambda y: self._scale * self._apply(self._precondition(y)))
        options = {"restart": max_iterations, "maxiter": 1, "callback": count, "callback_type": "pr_norm"}
        y, failed = gmres(operator, b, rtol=rtol, atol=0.0, **options)
        x = self._precondition(y)
        return LinearSolution(x[: ru.size], x[ru.size :], iterations, failed == 0)

    def _apply(self, x: np.ndarray) -> np.ndarray:
        u, p = np.split(x, [x.size - self.cell_volume.size])
        first = self.augmented @ u + self._coupling * (self.transposed @ p)
        return np.concatenate([first, self.volume @ u - self.inverse_bulk * self.cell_volume * p])

    def _precondition(self, r: np.ndarray) -> np.ndarray:
        ru, rp = np.split(r / self._scale, [r.size - self.cell_volume.size])
        p = -rp / (self.cell_volume * self._compliance)
        u = self._invert(ru - self._coupling * (self.transposed @ p))
        return np.concatenate([u, p])
