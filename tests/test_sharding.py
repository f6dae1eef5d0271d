"""Parts of the tests, as CI runs them, in a folder of its own: each test in one part, whatever others there are."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
NAMES = [f"test_{k}" for k in range(40)]
PARTS = 5


@pytest.fixture
def run(tmp_path):
    def in_folder(names, *options):
        (tmp_path / "test_few.py").write_text("".join(f"def {name}(): pass\n" for name in names), encoding="utf-8")
        command = [sys.executable, "-m", "pytest", "-p", "tests.sharding", "-p", "no:cacheprovider", *options]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
        return subprocess.run([*command, "-v"], cwd=tmp_path, env=environment, capture_output=True, text=True)

    return in_folder


def ran(answer):
    assert answer.returncode in (0, 5), answer.stdout + answer.stderr  # 5: no test in this part
    return {line.split("::")[1].split()[0] for line in answer.stdout.splitlines() if " PASSED" in line}


def test_every_test_is_in_one_part(run):
    parts = [ran(run(NAMES, "--shard", f"{k}/{PARTS}")) for k in range(PARTS)]
    assert sum(len(part) for part in parts) == len(NAMES)
    assert set.union(*parts) == set(NAMES)
    assert all(parts)


def test_a_test_keeps_its_part_when_others_go(run):
    few = NAMES[::3]
    assert ran(run(few, "--shard", "1/5")) == ran(run(NAMES, "--shard", "1/5")) & set(few)


def test_a_part_without_tests_is_no_success(run):
    assert run([], "--shard", "0/5").returncode == pytest.ExitCode.NO_TESTS_COLLECTED
    empty = [run(NAMES[:1], "--shard", f"{k}/{PARTS}").returncode for k in range(PARTS)]
    assert sorted(empty) == [pytest.ExitCode.OK, *[pytest.ExitCode.NO_TESTS_COLLECTED] * (PARTS - 1)]


@pytest.mark.parametrize("asked", ["5/5", "-1/5", "1", "a/b", "0/0"])
def test_what_is_no_part_is_refused(run, asked):
    answer = run(NAMES[:1], f"--shard={asked}")
    assert answer.returncode == pytest.ExitCode.USAGE_ERROR
    assert f"--shard must be K/N, whole numbers with 0 <= K < N, got {asked!r}" in answer.stderr + answer.stdout
