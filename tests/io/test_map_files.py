"""Maps for other programs: the right way round, in their units, whole or not at all."""

import shutil
import subprocess

import numpy as np
import pytest
import scipy.io
import tifffile

import opfem as op

OCTAVE = """
d = load('result.mat');
[~, k] = max(d.pressure_kPa(:));
[row, column] = ind2sub(size(d.pressure_kPa), k);
printf('%d %d %.12g %.12g %.12g %.12g\\n', size(d.pressure_kPa), d.x_mm(column), d.y_mm(row), ...
       d.pressure_kPa(1, 3), d.compression_percent(2, 1));
"""


@pytest.fixture(scope="module")
def dataset(solution):
    return op.to_xarray(solution)


@pytest.fixture(scope="module")
def maps(dataset, loaded):
    return op.on_pixels(dataset, loaded)


def test_mat_file_holds_the_maps_as_they_are_shown(tmp_path, dataset, loaded, maps):
    op.write_mat(dataset, tmp_path / "result.mat", loaded)
    held = scipy.io.loadmat(tmp_path / "result.mat")
    assert held["x_mm"].shape == (1, 21)
    np.testing.assert_allclose(held["y_mm"][0], loaded.y)
    np.testing.assert_array_equal(held["pressure_kPa"], 1e3 * maps.pressure)
    np.testing.assert_array_equal(held["compression_percent"], 1e2 * maps.compression)
    np.testing.assert_array_equal(held["residual_um"], 1e3 * maps.residual)
    np.testing.assert_array_equal(held["missing"], maps.missing)
    np.testing.assert_array_equal(held["contact_status"], maps.contact_status)


def test_mat_file_in_octave(tmp_path, dataset, loaded, maps):
    if shutil.which("octave-cli") is None:
        pytest.skip("needs GNU Octave; octave-cli is not there")
    op.write_mat(dataset, tmp_path / "result.mat", loaded)
    answer = subprocess.run(
        ["octave-cli", "--quiet", "--no-init-file", "--eval", OCTAVE], cwd=tmp_path, capture_output=True, text=True
    )
    rows, columns, x, y, pressure, compression = (float(number) for number in answer.stdout.split())
    assert (rows, columns) == loaded.shape
    peak = np.unravel_index(np.argmax(maps.pressure.values), maps.pressure.shape)
    assert (x, y) == pytest.approx((float(loaded.x[peak[1]]), float(loaded.y[peak[0]])))
    assert pressure == pytest.approx(1e3 * float(maps.pressure[0, 2]))
    assert compression == pytest.approx(1e2 * float(maps.compression[1, 0]))


def test_tiff_file_opens_with_its_pixel_size(tmp_path, dataset, loaded, maps):
    op.write_tiff(dataset, tmp_path / "result.tif", loaded)
    with tifffile.TiffFile(tmp_path / "result.tif") as file:
        metadata, tags, stack = file.imagej_metadata, file.pages[0].tags, file.asarray()
    labels = metadata["Labels"]
    assert labels == [name for name in scipy_names(tmp_path, dataset, loaded) if name not in ("x_mm", "y_mm")]
    assert metadata["unit"] == "mm"
    across, down = (tags[name].value for name in ("XResolution", "YResolution"))
    assert across[1] / across[0] == pytest.approx(float(loaded.spacing[0]), rel=1e-6)
    assert down[1] / down[0] == pytest.approx(float(loaded.spacing[1]), rel=1e-6)
    np.testing.assert_array_equal(stack[labels.index("pressure_kPa")], (1e3 * maps.pressure).astype(np.float32))
    assert np.isnan(stack[labels.index("residual_um")][3, 4])


def scipy_names(folder, dataset, loaded) -> list[str]:
    op.write_mat(dataset, folder / "names.mat", loaded)
    return [name for name, _, _ in scipy.io.whosmat(folder / "names.mat")]


def test_csv_file_has_a_row_for_each_pixel(tmp_path, dataset, loaded, maps):
    op.write_csv(dataset, tmp_path / "result.csv", loaded)
    table = np.genfromtxt(tmp_path / "result.csv", delimiter=",", names=True)
    assert table.size == loaded.values.size
    pixel = table[4 * 21 + 7]
    assert (pixel["x_mm"], pixel["y_mm"]) == pytest.approx((float(loaded.x[7]), float(loaded.y[4])))
    assert pixel["pressure_kPa"] == pytest.approx(1e3 * float(maps.pressure[4, 7]), rel=1e-5)
    assert pixel["thickness_um"] == pytest.approx(1e3 * float(maps.thickness[4, 7]), rel=1e-5)
    assert np.isnan(table[3 * 21 + 4]["residual_um"])


@pytest.mark.parametrize("write", [op.write_csv, op.write_tiff, op.write_mat])
def test_what_cannot_be_written(tmp_path, dataset, failed_solution, write):
    suffix = {"write_csv": ".csv", "write_tiff": ".tif", "write_mat": ".mat"}[write.__name__]
    with pytest.raises(ValueError, match=rf"must end in \{suffix}"):
        write(dataset, tmp_path / "result.dat")
    path = tmp_path / f"result{suffix}"
    path.write_text("an earlier result")
    with pytest.raises(ValueError, match="did not converge"):
        write(op.to_xarray(failed_solution), path)
    assert path.read_text() == "an earlier result"
    with pytest.raises(FileNotFoundError, match="does not exist"):
        write(dataset, tmp_path / "none" / path.name)


def test_vtu_opens_in_vtk(tmp_path, dataset):
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

    op.write_vtu(dataset, tmp_path / "result.vtu")
    reader = vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(tmp_path / "result.vtu"))
    reader.Update()
    grid = reader.GetOutput()
    assert (grid.GetNumberOfCells(), grid.GetNumberOfPoints()) == (72, 147)
    assert reader.GetErrorCode() == 0
