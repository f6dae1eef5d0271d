"""Solvers: implicit statics by Newton, multigrid and Krylov iterations; explicit dynamics."""

from .compiling import compiler_options as compiler_options
from .explicit import Explicit as Explicit
from .newton import Newton as Newton
from .solution import (
    CONVERGED as CONVERGED,
    RESULTS as RESULTS,
    BodyResult as BodyResult,
    ConvergenceError as ConvergenceError,
    ExperimentSolution as ExperimentSolution,
    FaceResult as FaceResult,
    LastConverged as LastConverged,
    Solution as Solution,
)
from .solve import solve as solve
