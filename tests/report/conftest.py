"""What is reported: a small imprint, and the same with what a fit adds to it."""

import json

import numpy as np
import pytest
import xarray as xr

import opfem as op


@pytest.fixture(scope="session")
def dataset(solution) -> xr.Dataset:
    return op.to_xarray(solution)


@pytest.fixture(scope="session")
def fitted(dataset) -> xr.Dataset:
    """The imprint with the variables of a fit, in made-up numbers: nothing is fitted."""
    prior = json.dumps({"class": "Matern", "length": 0.5, "std": 2e-3})
    fitted = dataset.drop_vars("residual").assign(
        pressure_std=0.1 * dataset["pressure"],
        residual=(("y", "x"), np.full(dataset["pressure"].shape, -2e-3)),
        reduced_chi2=((), 3.0),
        resolution_width=("resolution_point", [0.2, 0.3, 0.4]),
        model_std=((), 1e-3),
        **dict.fromkeys(("forward_solves", "inner_iterations", "std_error", "draws"), ((), 3.0)),
    )
    fitted = fitted.assign(misfit_rms=((), 2e-3)).assign_attrs(fit_status="successful", fit_message="", prior=prior)
    return fitted
