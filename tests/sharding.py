"""`--shard K/N`: run part K of N of the tests, so that consecutive runs of CI share the slow ones; a pytest plugin."""

import zlib

import pytest


def pytest_addoption(parser):
    parser.addoption("--shard", metavar="K/N", help="run part K, from 0, of N; every test is in one part")


def pytest_collection_modifyitems(config, items):
    asked = config.getoption("--shard")
    if asked is None:
        return
    try:
        part, parts = (int(number) for number in asked.split("/"))
    except ValueError:
        part, parts = 0, 0
    if not 0 <= part < parts:
        raise pytest.UsageError(f"--shard must be K/N, whole numbers with 0 <= K < N, got {asked!r}.")

    def is_ours(item):
        # By its own name: a test stays in its part when others come and go.
        return zlib.crc32(item.nodeid.encode()) % parts == part

    config.hook.pytest_deselected(items=[item for item in items if not is_ours(item)])
    items[:] = [item for item in items if is_ours(item)]
