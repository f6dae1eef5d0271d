"""Settings of a traction fit: its options, and every number that tunes its algorithm, with source or measurement."""

import dataclasses
from typing import Any, Literal

import equinox as eqx
from jaxtyping import ArrayLike, PRNGKeyArray

from .._types import ScalarLike
from ..optimise.line_search import ParabolicBacktracking
from ..solvers import Newton

Choice = Literal["given", "discrepancy", "evidence"]


class FitSettings(eqx.Module):
    """Settings of `fit_traction`, which takes each by name as well.

    Attributes:
        nonnegative: Constrain the traction to be non-negative, by a softplus.
        model_std: Standard deviation of the computed height [mm], independent from element to element, that is added to
            the map's noise. None: the part of the representation error that exceeds the noise, which the mesh misses as
            well; and the standard deviations include what `mesh_error` changes in the traction
            (`TractionFit.mesh_std`). They do not for an odd or small number of elements along an axis, where it cannot
            be estimated.
        hyperparameters: "given": the prior as it is. "discrepancy": its standard deviation (or weight) at which χ² of
            the map equals its expectation, the strongest prior that the data allow. "evidence": standard deviation and
            length of maximum likelihood (Laplace).
        start: Initial normal traction [MPa], interface nodes `(ny+1, nx+1)` of this mesh or a coarser one, such as
            the `normal` of an earlier fit; of each map where there are several. None: that of an imprint of the map or,
            where the imprint cannot be solved, the linear estimate.
        solver: Settings of the forward solve. With its `rtol` of 1e-4 the coin's map on 20×20×2 elements is within 5 nm
            of that at 1e-9, in 10 load increments instead of 14. Its `max_path` limits those: the coin's fit at 40×40×4
            took twice as many solves with 12 as with 24.
        rtol: The fit has converged when the next step would change the residuals by less than this part of their norm
            [-]: about the remaining error over the posterior's standard deviations, which 16 draws give to 18 %. None:
            3e-2; 1e-2 where numbers are fitted, along which all of that error may lie: at 3e-2 95 % intervals of C10
            held it in 93 of 100 fits. The coin on 40×40×4 elements takes 13 solves and 310 CG iterations to 3e-2, 18
            and 446 to 1e-2; χ² then differs by 0.1 %.
        max_steps: Limit of evaluations of the forward solve.
        draws: Posterior draws that standard deviations are computed from.
        key: Random key of the draws; None: always the same.
        throw: Raise where the fit fails. False: return the last iterate, with its status.
        progress: Show a bar on a terminal or in a notebook.
        cg_rtol: Relative gradient of each Gauss–Newton system near the optimum [-].
        cg_negligible: Error of a direction over the posterior's standard deviations at which CG stops
            [-].
        cg_steps: Limit of CG iterations of each system. None: 60; 300 with a fitted lateral traction, which the
            preconditioner does not include.
        line_search: The line search.
        stall: Step length below which the fit has stalled [-].
        foundation_stiffness: Stiffness of the elastic foundation over shear modulus per thickness [-]; 0: a dead load.
            The published coin snaps through at 2.5 and less, not at 8 and more. A fit on 40×40×4 elements of 5 × 5 mm
            takes 45 CG iterations in 5 solves at 7.5, 52 in 5 at 19, 68 in 6 at 75, and 92 in 13 without foundation.
            The coin, under the sample's friction and fitted to `rtol` 1e-2, takes 13 solves at 20 and at 60, with 191
            and 206 CG iterations; more at 7.5.
        contact_pressure: Mean pressure over the shear modulus above which the layer counts as in contact with its
            window [-]; the foundation alone would balance a layer that has lifted off.
        softness: Pressure over the shear modulus below which a non-negative pressure approaches zero smoothly [-]: 0.3
            kPa for the published silicone.
        hyperparameter_rtol: Change of the logarithm of a hyper-parameter at which it has converged [-].
        hyperparameter_fits: Limit of fits under changed hyper-parameters.
        draws_at_once: Posterior draws computed concurrently; each waits for the host between programs of milliseconds.
            On 20×20×2 elements and two busy cores 2 reduce a fit from 54 to 40 s.
    """

    nonnegative: bool = False
    model_std: ScalarLike | None = None
    hyperparameters: Choice = "given"
    start: ArrayLike | None = None
    solver: Newton = Newton(rtol=1e-4, max_path=24)
    rtol: float | None = None
    max_steps: int = 50
    draws: int = 16
    key: PRNGKeyArray | None = None
    throw: bool = True
    progress: bool = True
    cg_rtol: float = 1e-2
    cg_negligible: float = 0.03
    cg_steps: int | None = None
    line_search: ParabolicBacktracking = ParabolicBacktracking()
    stall: float = 5e-3
    foundation_stiffness: float = 20.0
    contact_pressure: float = 1e-4
    softness: float = 0.05
    hyperparameter_rtol: float = 0.05
    hyperparameter_fits: int = 8
    draws_at_once: int = 2

    def changed(self, **fields: Any) -> "FitSettings":
        """Return settings with some fields changed.

        Raises:
            TypeError: For a name that is no setting.
        """
        names = [field.name for field in dataclasses.fields(self)]
        for name in fields:
            if name not in names:
                raise TypeError(
                    f"fit_traction got an unknown argument {name!r}; its settings (FitSettings) are {', '.join(names)}."
                )
        return dataclasses.replace(self, **fields)
