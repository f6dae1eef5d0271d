"""Fixtures of all tests of the command line."""

import pytest


@pytest.fixture(autouse=True)
def _cache_of_the_user_is_left_alone(monkeypatch):
    monkeypatch.setenv("OPFEM_NO_CACHE", "1")
