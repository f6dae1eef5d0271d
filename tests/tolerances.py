"""Tolerances, named for what causes the difference. All are relative unless a test says otherwise."""

ROUNDOFF = 1e-12
"""Same formula, another order of operations, float64."""

ROUNDOFF_FLOAT32 = 1e-5
"""Same formula, another order of operations, float32."""

FINITE_DIFFERENCE = 1e-5
"""A central difference against a derivative, float64."""

SOLVER = 1e-7
"""Ten times the relative tolerance (1e-8) that the test asks of the iterative solver."""

RATE = 0.1
"""How far a measured convergence rate may be from its theory; the size of the error is not asserted."""

OTHER_CODE = 0.01
"""Another code with the same element on the same mesh; the test explains what is left."""

SAMPLING = 0.05
"""Statistics of a finite random sample with a fixed seed; the test states the sample's size."""
