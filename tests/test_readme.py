"""The README's commands and Python run as they stand, on a map of the reader's own in the folder they start from."""

import re
import shlex
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.io

import opfem as op
from opfem.cli import main

README = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```", README, re.MULTILINE | re.DOTALL)


@pytest.fixture
def own_map(tmp_path, monkeypatch):
    """A complete map.mat, as MATLAB would write it, in the current folder."""
    monkeypatch.chdir(tmp_path)
    values = np.asarray(op.datasets.example().filled().values)
    scipy.io.savemat("map.mat", {"thickness": values})


def test_python(own_map):
    (code,) = blocks("python")
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    assert 0 < float(names["data"].pressure.mean()) < 0.1
    assert plt.gcf().axes
    plt.close("all")


def test_commands(own_map, tmp_path):
    run_here = [line for block in blocks("sh") for line in block.splitlines() if line.startswith("opfem ")]
    assert run_here
    for line in run_here:
        with pytest.raises(SystemExit) as end:
            main(shlex.split(line)[1:])
        assert end.value.code in (0, None)
    assert (tmp_path / "stress_map" / "result.nc").exists()
