"""Nonlinear least squares: Gauss–Newton, its line search, and preconditioned conjugate gradients."""

from .conjugate_gradients import least_squares as least_squares
from .gauss_newton import GaussNewton as GaussNewton, PreconditionedDescent as PreconditionedDescent
from .line_search import ParabolicBacktracking as ParabolicBacktracking
