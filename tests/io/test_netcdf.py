"""Datasets survive a netCDF file."""

import inspect
import os
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import opfem as op


@pytest.mark.parametrize("which", ["solution", "failed_solution"])
def test_comes_back_the_same(tmp_path, request, which):
    dataset = op.to_xarray(request.getfixturevalue(which))
    op.write_netcdf(dataset, tmp_path / "result.nc")
    xr.testing.assert_identical(op.read_netcdf(tmp_path / "result.nc"), dataset)
    assert os.listdir(tmp_path) == ["result.nc"]


def test_can_be_written_again(tmp_path, solution):
    op.write_netcdf(op.to_xarray(solution), tmp_path / "a.nc")
    op.write_netcdf(op.read_netcdf(tmp_path / "a.nc"), tmp_path / "b.nc")
    xr.testing.assert_identical(op.read_netcdf(tmp_path / "a.nc"), op.read_netcdf(tmp_path / "b.nc"))


def test_is_compressed(tmp_path):
    op.write_netcdf(xr.Dataset({"zeros": (("y", "x"), np.zeros((1000, 1000)))}), tmp_path / "a.nc")
    assert (tmp_path / "a.nc").stat().st_size < 100_000


def test_interruption_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.nc"
    op.write_netcdf(xr.Dataset({"x": 1.0}), path)
    before = path.read_bytes()

    write = Path.write_bytes

    def half(self, content):
        write(self, content[: len(content) // 2])
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(KeyboardInterrupt):
        op.write_netcdf(xr.Dataset({"x": 2.0}), path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.nc"]


def test_errors(tmp_path, solution):
    with pytest.raises(ValueError, match="to_xarray"):
        inspect.unwrap(op.write_netcdf)(solution, tmp_path / "a.nc")  # without the tests' own check of types
    with pytest.raises(FileNotFoundError, match="does not exist"):
        op.write_netcdf(xr.Dataset(), tmp_path / "no" / "a.nc")
    with pytest.raises(FileNotFoundError, match="no such file"):
        op.read_netcdf(tmp_path / "a.nc")
    (tmp_path / "a.nc").write_text("hello")
    with pytest.raises(ValueError, match="not a netCDF-4 file"):
        op.read_netcdf(tmp_path / "a.nc")
