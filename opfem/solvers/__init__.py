"""Solvers: implicit statics by Newton, multigrid and Krylov iterations."""

from .newton import Newton as Newton
from .solution import (
    RESULTS as RESULTS,
    ConvergenceError as ConvergenceError,
    FaceResult as FaceResult,
    LastConverged as LastConverged,
    Solution as Solution,
)
from .solve import solve as solve
