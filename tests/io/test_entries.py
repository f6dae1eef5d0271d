"""One bad entry does not spoil a file: what is asked for is read, neighbours are named, nothing else is opened."""

import tracemalloc
import zipfile
import zlib

import h5py
import numpy as np
import pytest
import scipy.io
import tifffile

from opfem.io import read_thickness
from opfem.measurement import MeasurementError, MeasurementWarning
from tests.io.test_thickness import save_mat5, save_mat73

VALUES = 0.4 + 0.002 * np.arange(24).reshape(4, 6)
OTHER = VALUES + 0.1
EXTENT = (5.0, 3.0)


def read(path, variable=None, **how):
    return np.asarray(read_thickness(path, extent=EXTENT, variable=variable, **how).values)


def save_npz(path, **variables):
    np.savez_compressed(path, **variables)


def save_mat5_small(path, **variables):
    scipy.io.savemat(path, variables, do_compression=True)


def save_mat4(path, **variables):
    scipy.io.savemat(path, variables, format="4")


def save_hdf5(path, **variables):
    with h5py.File(path, "w") as file:
        for name, value in variables.items():
            file.create_dataset(name, data=value, compression="gzip" if np.ndim(value) else None)


SAVERS = {
    "a.npz": save_npz,
    "v5.mat": save_mat5,
    "small.mat": save_mat5_small,
    "v4.mat": save_mat4,
    "v73.mat": save_mat73,
    "a.h5": save_hdf5,
}
formats = pytest.mark.parametrize("name", SAVERS)


@formats
class TestNeighbours:
    def test_only_the_chosen_array_is_loaded(self, tmp_path, name):
        """32 MB beside the map are neither read nor held."""
        SAVERS[name](tmp_path / name, L1=VALUES, raw=np.zeros((2000, 2000)), after=OTHER)
        read(tmp_path / name, "L1")  # what is imported and compiled once is not counted
        tracemalloc.start()
        np.testing.assert_array_equal(read(tmp_path / name, "L1"), VALUES)
        assert tracemalloc.get_traced_memory()[1] < 4e6
        tracemalloc.stop()
        np.testing.assert_array_equal(read(tmp_path / name, "after"), OTHER)

    def test_too_large_an_array_is_refused_before_it_is_read(self, tmp_path, name):
        SAVERS[name](tmp_path / name, L1=VALUES, raw=np.zeros((2000, 2000)))
        with pytest.raises(
            MeasurementError, match=r"shape \(2000, 2000\) takes 32 MB once loaded, above max_bytes=1000000"
        ):
            read(tmp_path / name, "raw", max_bytes=10**6)
        np.testing.assert_array_equal(read(tmp_path / name, "L1", max_bytes=10**6), VALUES)


class TestDamage:
    def spoil(self, path, where, length=40):
        stored = bytearray(path.read_bytes())
        stored[where : where + length] = bytes(255 - byte for byte in stored[where : where + length])
        path.write_bytes(stored)

    @pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
    def test_in_a_member_of_an_npz(self, tmp_path, save):
        path = tmp_path / "a.npz"
        save(path, L1=VALUES, L0=OTHER)
        with zipfile.ZipFile(path) as archive:
            self.spoil(path, archive.getinfo("L0.npy").header_offset + 60)
        with pytest.warns(MeasurementWarning, match=r"a\.npz: L0 was passed over: damaged \("):
            np.testing.assert_array_equal(read(path), VALUES)
        np.testing.assert_array_equal(read(path, "L1"), VALUES)
        with pytest.raises(MeasurementError, match=r"variable 'L0' must be a 2-D map .* got damaged"):
            read(path, "L0")

    def test_in_a_variable_of_version_5(self, tmp_path):
        path = tmp_path / "a.mat"
        save_mat5_small(path, L1=VALUES, L0=OTHER)
        self.spoil(path, path.stat().st_size - 60)
        with pytest.warns(MeasurementWarning, match="variable 2 was passed over: damaged"):
            np.testing.assert_array_equal(read(path), VALUES)

    def test_file_cut_off_behind_the_map(self, tmp_path):
        path = tmp_path / "a.mat"
        save_mat5(path, L1=VALUES, L0=OTHER)
        path.write_bytes(path.read_bytes()[:-100])
        with pytest.warns(MeasurementWarning, match="the file is damaged or cut off from byte 376 on"):
            np.testing.assert_array_equal(read(path), VALUES)
        with pytest.raises(MeasurementError, match=r"no variable 'L0'; it holds L1.*; the file is damaged or cut off"):
            read(path, "L0")

    def test_type_of_data_on_which_scipy_ends_the_process(self, tmp_path):
        path = tmp_path / "a.mat"
        save_mat5(path, L1=VALUES)
        stored = bytearray(path.read_bytes())
        stored[stored.index(b"L1\x00\x00") + 4] = 165
        path.write_bytes(stored)
        with pytest.raises(MeasurementError, match="is damaged: it holds data of type 165 with 192 bytes"):
            read(path)

    def test_more_cells_than_there_are(self, tmp_path):
        path = tmp_path / "a.mat"
        cells = np.empty((3, 7), object)
        cells[:] = "x"
        save_mat5(path, scan={"c": cells, "L1": VALUES})
        stored = bytearray(path.read_bytes())
        size = stored.index(np.array([3, 7], "<i4").tobytes())
        stored[size : size + 8] = np.array([2**15, 2**15], "<i4").tobytes()
        path.write_bytes(stored)
        with pytest.raises(MeasurementError, match="is damaged: it holds fewer cells or structs than it says"):
            read(path, "scan.L1")

    def test_shape_that_does_not_fit_the_numbers(self, tmp_path):
        np.save(tmp_path / "a.npy", VALUES)
        stored = (tmp_path / "a.npy").read_bytes()
        (tmp_path / "a.npy").write_bytes(stored.replace(b"(4, 6)", b"(3, 6)"))
        with pytest.raises(
            MeasurementError, match=r"header states 272 bytes \(shape \(3, 6\), float64\), the file holds 320"
        ):
            read(tmp_path / "a.npy")

    def test_dataset_that_was_never_written(self, tmp_path):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file.create_dataset("L1", (4, 6), "f8", chunks=(2, 6), fillvalue=0.4)[:2] = 0.5
        with pytest.raises(MeasurementError, match="got damaged or never wholly written"):
            read(tmp_path / "a.h5")


class TestInflation:
    """Compressed data that hold more than they state."""

    BOMB = zlib.compress(bytes(2 * 10**8), 9)

    def test_of_a_chunk(self, tmp_path):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            node = file.create_dataset("L1", (4, 6), "f8", chunks=(4, 6), compression="gzip")
            node.id.write_direct_chunk((0, 0), self.BOMB)
        with pytest.raises(MeasurementError, match="is damaged: a chunk inflates to more than max_bytes=1000000"):
            read(tmp_path / "a.h5", max_bytes=10**6)

    def test_chunk_larger_than_its_array(self, tmp_path):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            node = file.create_dataset(
                "L1", (4, 6), "f8", chunks=(1000, 1000), maxshape=(None, None), compression="gzip"
            )
            node[:] = VALUES
        with pytest.raises(
            MeasurementError, match=r"shape \(1000, 1000\) takes 8 MB once loaded, above max_bytes=1000000"
        ):
            read(tmp_path / "a.h5", max_bytes=10**6)
        np.testing.assert_array_equal(read(tmp_path / "a.h5"), VALUES)

    def test_tile_larger_than_its_image(self, tmp_path):
        tifffile.imwrite(tmp_path / "a.tif", VALUES, tile=(1024, 1024), compression="zlib")
        with pytest.raises(
            MeasurementError, match=r"shape \(1024, 1024\) takes 8 MB once loaded, above max_bytes=1000000"
        ):
            read(tmp_path / "a.tif", max_bytes=10**6)
        np.testing.assert_array_equal(read(tmp_path / "a.tif"), VALUES)

    def test_of_a_strip(self, tmp_path, monkeypatch):
        tifffile.imwrite(tmp_path / "a.tif", VALUES, compression="zlib")
        with tifffile.TiffFile(tmp_path / "a.tif") as file:
            offsets, counts = (file.pages.first.tags[name] for name in ("StripOffsets", "StripByteCounts"))
        stored = bytearray((tmp_path / "a.tif").read_bytes())
        for tag, value in ((offsets, len(stored)), (counts, len(self.BOMB))):
            size = 2 if tag.dtype == 3 else 4
            stored[tag.valueoffset : tag.valueoffset + size] = value.to_bytes(size, "little")
        (tmp_path / "a.tif").write_bytes(stored + self.BOMB)
        with pytest.raises(
            MeasurementError, match="is damaged: a part of an image inflates to more than its 192 bytes"
        ):
            read(tmp_path / "a.tif")

    @pytest.mark.parametrize("save", [save_mat5_small, save_npz])
    def test_of_a_variable(self, tmp_path, save):
        path = tmp_path / ("a.mat" if save is save_mat5_small else "a.npz")
        save(path, L1=np.zeros((4000, 3000)))
        assert path.stat().st_size < 10**6
        with pytest.raises(MeasurementError, match="takes 96 MB once loaded, above max_bytes=50000000"):
            read(path, max_bytes=5 * 10**7)


class TestOtherThings:
    def test_objects_are_named_and_passed_over(self, tmp_path):
        np.savez(tmp_path / "a.npz", L1=VALUES, about=np.array([{"day": 1}], dtype=object))
        with pytest.warns(MeasurementWarning, match="about was passed over: objects, which opfem never unpickles"):
            np.testing.assert_array_equal(read(tmp_path / "a.npz"), VALUES)
        with pytest.raises(MeasurementError, match="got objects, which opfem never unpickles"):
            read(tmp_path / "a.npz", "about")

    def test_members_that_are_no_arrays(self, tmp_path):
        np.savez(tmp_path / "a.npz", L1=VALUES)
        with zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
            archive.writestr("readme.txt", "by hand")
        np.testing.assert_array_equal(read(tmp_path / "a.npz"), VALUES)

    def test_name_that_is_there_twice(self, tmp_path):
        np.savez(tmp_path / "a.npz", L1=VALUES)
        with pytest.warns(UserWarning, match="Duplicate name"), zipfile.ZipFile(tmp_path / "a.npz", "a") as archive:
            archive.writestr("L1.npy", "other")
        with pytest.raises(MeasurementError, match="got stored twice"):
            read(tmp_path / "a.npz")

    def test_text_cells_and_sparse_in_version_5(self, tmp_path):
        cells = np.array([[1, "x"]], dtype=object)
        scipy.io.savemat(tmp_path / "a.mat", {"note": "by hand", "c": cells, "used": VALUES > 0, "L1": VALUES})
        np.testing.assert_array_equal(read(tmp_path / "a.mat"), VALUES)


class TestFields:
    @pytest.mark.parametrize("variable", ["scan.thickness", "scan.inner.L0"])
    @pytest.mark.parametrize("small", [False, True])
    def test_of_version_5(self, tmp_path, variable, small):
        scan = {"thickness": VALUES, "operator": "me", "inner": {"L0": VALUES}}
        scipy.io.savemat(tmp_path / "a.mat", {"scan": scan, "L1": OTHER}, do_compression=small)
        np.testing.assert_array_equal(read(tmp_path / "a.mat", variable), VALUES)
        np.testing.assert_array_equal(read(tmp_path / "a.mat"), OTHER)

    @pytest.mark.parametrize("variable", ["scan.thickness", "scan/thickness", "scan.inner.L0"])
    def test_of_version_73(self, tmp_path, variable):
        save_mat73(tmp_path / "a.mat", L1=OTHER)
        with h5py.File(tmp_path / "a.mat", "a") as file:
            file["scan/thickness"], file["scan/inner/L0"] = VALUES.T, VALUES.T
            file["scan"].attrs["MATLAB_class"] = np.bytes_("struct")
        np.testing.assert_array_equal(read(tmp_path / "a.mat", variable), VALUES)

    def test_are_listed_where_none_was_chosen(self, tmp_path):
        scipy.io.savemat(tmp_path / "a.mat", {"scan": {"thickness": VALUES, "n": 3}, "note": "x"})
        with pytest.raises(MeasurementError, match=r"scan \(a struct\), scan\.thickness \(4, 6\), scan\.n \(1, 1\)"):
            read(tmp_path / "a.mat")
        with pytest.raises(MeasurementError, match=r"no variable 'scan\.thicknes'; it holds scan"):
            read(tmp_path / "a.mat", "scan.thicknes")

    def test_of_several_structs_are_not_chosen(self, tmp_path):
        structs = np.zeros((1, 2), dtype=[("L1", object)])
        structs["L1"][0, 0], structs["L1"][0, 1] = VALUES, OTHER
        scipy.io.savemat(tmp_path / "a.mat", {"scan": structs})
        with pytest.raises(MeasurementError, match=r"no variable 'scan\.L1'"):
            read(tmp_path / "a.mat", "scan.L1")


class TestLinks:
    @pytest.fixture
    def path(self, tmp_path):
        with h5py.File(tmp_path / "other.h5", "w") as file:
            file["L1"] = OTHER
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file["scans/day 1/L1"] = VALUES
            file["scans/latest"] = h5py.SoftLink("day 1")
            file["hard"] = file["scans/day 1/L1"]
            file["soft"] = h5py.SoftLink("/scans/latest/L1")
            file["chain"] = h5py.SoftLink("soft")
            file["away"] = h5py.ExternalLink("other.h5", "/L1")
            file["hidden"] = h5py.SoftLink("/away")
            file["circle"], file["round"] = h5py.SoftLink("/round"), h5py.SoftLink("/circle")
            file["nowhere"] = h5py.SoftLink("/scans/day 2/L1")
            file["itself"] = file["/"]
            file.create_dataset("raw", (4, 6), "f8", external=[(str(tmp_path / "raw.bin"), 0, 192)])
            layout = h5py.VirtualLayout((4, 6), "f8")
            layout[:] = h5py.VirtualSource(tmp_path / "other.h5", "L1", (4, 6))
            file.create_virtual_dataset("virtual", layout)
        OTHER.tofile(tmp_path / "raw.bin")
        return tmp_path / "a.h5"

    @pytest.mark.parametrize(
        "variable", ["scans/day 1/L1", "scans/latest/L1", "hard", "soft", "chain", "itself/hard", "itself/itself/chain"]
    )
    def test_within_the_file_are_followed(self, path, variable):
        np.testing.assert_array_equal(read(path, variable), VALUES)

    @pytest.mark.parametrize(
        ("variable", "message"),
        [
            ("away", r"got an external link, to other\.h5, which opfem does not follow"),
            ("hidden", r"got an external link, to other\.h5, which opfem does not follow"),
            ("circle", "got a link that leads in a circle"),
            ("nowhere", "got a link to /scans/day 2/L1, which is not there"),
            ("raw", "got stored in another file, which opfem does not open"),
            ("virtual", "got stored in another file, which opfem does not open"),
        ],
    )
    def test_out_of_the_file_are_refused(self, path, variable, message):
        with pytest.raises(MeasurementError, match=message):
            read(path, variable)

    def test_beside_a_map_are_named(self, tmp_path):
        save_mat73(tmp_path / "a.mat", L1=VALUES)
        with h5py.File(tmp_path / "a.mat", "a") as file:
            file["L0"] = h5py.ExternalLink("other.mat", "/L0")
        with pytest.warns(MeasurementWarning, match=r"L0 was passed over: an external link, to other\.mat"):
            np.testing.assert_array_equal(read(tmp_path / "a.mat"), VALUES)
