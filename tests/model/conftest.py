"""What tests of constructors share."""

import jaxtyping
import pytest


@pytest.fixture
def annotations_unchecked():
    """Constructors as users run them: what their own checks say, not what the tests' type checker says first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
