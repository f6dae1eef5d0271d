"""Reading and writing maps: formats, orientation, units, missing pixels, and every way a file can be bad."""

import h5py
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.io
import scipy.sparse
import tifffile

from opfem.io import read_thickness, write_thickness
from opfem.measurement import MeasurementError, ThicknessMap
from tests.tolerances import ROUNDOFF

EXTENT = (5.0, 2.5)
SHAPE = (6, 11)


@pytest.fixture
def values():
    return np.random.default_rng(0).uniform(0.3, 0.5, SHAPE)


def save_mat73(path, **variables):
    """Write as MATLAB does: a 512-byte header, columns first, a class on each variable."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in variables.items():
            if isinstance(value, str):
                node = file.create_dataset(name, data=np.array([[ord(c)] for c in value], np.uint16))
                node.attrs["MATLAB_class"] = np.bytes_("char")
            elif np.iscomplexobj(value):
                pairs = np.zeros(value.T.shape, [("real", "f8"), ("imag", "f8")])
                pairs["real"], pairs["imag"] = value.T.real, value.T.imag
                file.create_dataset(name, data=pairs).attrs["MATLAB_class"] = np.bytes_("double")
            else:
                kind = {"f8": "double", "f4": "single", "b1": "logical"}.get(value.dtype.str[1:], "int16")
                data = value.T.astype(np.uint8) if kind == "logical" else value.T
                file.create_dataset(name, data=data).attrs["MATLAB_class"] = np.bytes_(kind)
    with open(path, "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\x00\x02IM")


def save_mat5(path, **variables):
    scipy.io.savemat(path, variables)


def save(path, values):
    """Write one array in the format that the suffix names."""
    match path.suffix:
        case ".mat":
            (save_mat73 if "73" in path.stem else save_mat5)(path, in_L0=values)
        case ".npy":
            np.save(path, values)
        case ".npz":
            np.savez(path, in_L0=values)
        case ".tif" | ".tiff":
            tifffile.imwrite(path, values, photometric="minisblack" if values.ndim > 1 else None)
        case ".csv":
            np.savetxt(path, values, delimiter=",", fmt="%.17g")


FILES = ["v5.mat", "v73.mat", "a.npy", "a.npz", "a.tif", "a.tiff", "a.csv"]


@pytest.mark.parametrize("name", FILES)
class TestEveryFormat:
    def test_reads_rows_as_y(self, tmp_path, values, name):
        save(tmp_path / name, values)
        read = read_thickness(tmp_path / name, extent=EXTENT, std=0.003, origin=(1.0, 2.0))
        np.testing.assert_array_equal(read.values, values)
        assert tuple(read.extent.tolist()) == EXTENT
        assert tuple(read.origin.tolist()) == (1.0, 2.0)
        assert read.std == 0.003
        assert not read.mask.any()
        assert read.steps[0].name == "read"

    def test_masks_and_counts_missing(self, tmp_path, values, name):
        values[1, 2] = np.nan
        values[4, 7] = np.inf
        save(tmp_path / name, values)
        read = read_thickness(tmp_path / name, spacing=0.5)
        assert np.argwhere(read.mask).tolist() == [[1, 2], [4, 7]]
        assert read.steps[0].numbers["missing_pixels"] == 2
        assert read.values[1, 2] == np.median(values[np.isfinite(values)])
        assert not read.is_filled

    def test_empty_file(self, tmp_path, name):
        (tmp_path / name).write_bytes(b"")
        with pytest.raises(MeasurementError, match=rf"{name}: the file is empty"):
            read_thickness(tmp_path / name, extent=EXTENT)

    def test_missing_file(self, tmp_path, name):
        with pytest.raises(MeasurementError, match=rf"{name}: no such file"):
            read_thickness(tmp_path / name, extent=EXTENT)

    def test_folder(self, tmp_path, name):
        (tmp_path / name).mkdir()
        with pytest.raises(MeasurementError, match=rf"{name}: is a folder"):
            read_thickness(tmp_path / name, extent=EXTENT)

    def test_rubbish(self, tmp_path, name):
        (tmp_path / name).write_bytes(b"these are no numbers, \x93\xff" * 50)
        with pytest.raises(MeasurementError, match=name):
            read_thickness(tmp_path / name, extent=EXTENT)

    def test_truncated(self, tmp_path, name):
        if name.endswith(".csv"):
            pytest.skip("a csv cut at a line's end is a shorter csv; cut rows are tested with ragged rows")
        values = np.random.default_rng(0).uniform(0.3, 0.5, (60, 50))
        save(tmp_path / name, values)
        whole = (tmp_path / name).read_bytes()
        for share in (0.02, 0.3, 0.8):
            (tmp_path / name).write_bytes(whole[: int(share * len(whole))])
            with pytest.raises(MeasurementError, match=name):
                read_thickness(tmp_path / name, extent=EXTENT)

    def test_needs_a_grid(self, tmp_path, values, name):
        save(tmp_path / name, values)
        with pytest.raises(MeasurementError, match=r"either extent=.*or spacing=.*neither.*\(6, 11\)"):
            read_thickness(tmp_path / name)

    @pytest.mark.parametrize("shape", [(11,), (3, 4, 11)])
    def test_refuses_other_dimensions(self, tmp_path, name, shape):
        if name == "a.csv" and len(shape) == 3:
            pytest.skip("csv holds rows of numbers, at most 2-D")
        array = np.full(shape, 0.4)
        save(tmp_path / name, array)
        with pytest.raises(MeasurementError, match=r"must be a 2-D map|holds"):
            read_thickness(tmp_path / name, extent=EXTENT)


@pytest.mark.filterwarnings("ignore::opfem.measurement.MeasurementWarning")
def test_bit_flips_never_pass_as_another_error(tmp_path):
    """A flipped byte gives a map or a MeasurementError, whatever the library underneath does."""
    rng = np.random.default_rng(0)
    values = rng.uniform(0.3, 0.5, (20, 30))
    refused = 0
    for name in FILES:
        path = tmp_path / name
        if name == "v5.mat":
            scipy.io.savemat(path, {"in_L0": values}, do_compression=True)
        elif name == "a.npz":
            np.savez_compressed(path, in_L0=values)
        else:
            save(path, values)
        whole = path.read_bytes()
        for place in rng.integers(0, min(len(whole), 4000), 12):
            path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
            try:
                read = read_thickness(path, extent=(2.9, 1.9))
            except MeasurementError as error:
                assert name in str(error)  # noqa: PT017
                refused += 1
            else:
                assert jnp.isfinite(read.values).all()
    assert refused > 10


class TestNumberTypes:
    @pytest.mark.parametrize("name", FILES)
    @pytest.mark.parametrize("dtype", ["f4", ">f4", "f2", ">f8", "i2", ">u2", "u1", "i8"])
    def test_of_arrays_become_float64(self, tmp_path, name, dtype):
        if name.endswith(".mat") and dtype == "f2":
            pytest.skip("MATLAB has no 16-bit floats")
        counts = np.random.default_rng(0).integers(90, 110, SHAPE).astype(dtype)
        save(tmp_path / name, counts)
        read = read_thickness(tmp_path / name, extent=EXTENT, scale=3.7)
        assert read.values.dtype == np.float64
        np.testing.assert_allclose(read.values, 3.7e-3 * counts.astype(float), ROUNDOFF)

    @pytest.mark.parametrize("kind", [np.float32, np.float16, np.int64, lambda v: np.array(v, ">f4")])
    def test_of_arguments(self, tmp_path, values, kind):
        np.save(tmp_path / "a.npy", values)
        read = read_thickness(
            tmp_path / "a.npy", spacing=kind(1), origin=(kind(1), kind(2)), std=kind(1), scale=float(kind(1)) * 1e3
        )
        leaves = [read.extent, read.origin, read.std, read.values]
        assert {leaf.dtype.name for leaf in leaves} == {"float64"}
        assert read.extent.tolist() == [10.0, 5.0]


class TestUnits:
    @pytest.mark.parametrize(("unit", "factor"), [("mm", 1.0), ("um", 1e3), ("µm", 1e3), ("m", 1e-3)])
    def test_converts(self, tmp_path, values, unit, factor):
        np.save(tmp_path / "a.npy", values * factor)
        read = read_thickness(tmp_path / "a.npy", extent=EXTENT, unit=unit)
        np.testing.assert_allclose(read.values, values, ROUNDOFF)

    @pytest.mark.parametrize(
        ("factor", "unit", "message"),
        [
            (1e3, "mm", r'Thickness map spans 3\d\d\.?\d* to 49\d\.?\d* mm; is it in µm\? Pass unit="um"\.'),
            (1e-3, "mm", r'mm; is it in metres\? Pass unit="m"\.'),
            (1.0, "um", r"when read with unit='um'; is it in mm\? Pass unit=\"mm\"\."),
            (1.0, "m", r"is it in mm\? Pass unit=\"mm\"\."),
            (1e-3, "um", r"is it in m\? Pass unit=\"m\"\."),
            (1e9, "mm", r"is it in µm\? Convert it to mm\."),
            (1.0, "inch", r"unit must be one of mm, um, µm.*got 'inch'"),
        ],
    )
    def test_doubts(self, tmp_path, values, factor, unit, message):
        np.save(tmp_path / "a.npy", values * factor)
        with pytest.raises(MeasurementError, match=message):
            read_thickness(tmp_path / "a.npy", extent=EXTENT, unit=unit)

    def test_doubts_pixels(self, tmp_path):
        np.save(tmp_path / "a.npy", np.arange(60, 126).reshape(SHAPE))
        with pytest.raises(MeasurementError, match="is it in µm or pixels"):
            read_thickness(tmp_path / "a.npy", extent=EXTENT)


class TestMissing:
    def test_too_many(self, tmp_path, values):
        values[:4] = np.nan
        np.save(tmp_path / "a.npy", values)
        with pytest.raises(MeasurementError, match=r"44 of 66 pixels \(67%\) .* above max_missing=0\.5"):
            read_thickness(tmp_path / "a.npy", extent=EXTENT)
        assert read_thickness(tmp_path / "a.npy", extent=EXTENT, max_missing=0.7).mask.sum() == 44

    def test_all(self, tmp_path, values):
        np.save(tmp_path / "a.npy", np.full_like(values, np.nan))
        with pytest.raises(MeasurementError, match="66 of 66"):
            read_thickness(tmp_path / "a.npy", extent=EXTENT, max_missing=1.0)

    def test_zero_is_not_missing(self, tmp_path, values):
        values[0, 3] = 0
        np.save(tmp_path / "a.npy", values)
        with pytest.raises(MeasurementError, match=r"a\.npy: .*positive, got 0 .*\[y=0, x=3\]; pass missing=0"):
            read_thickness(tmp_path / "a.npy", extent=EXTENT)


SAVERS = pytest.mark.parametrize("save_mat", [save_mat5, save_mat73], ids=["v5", "v7.3"])


@SAVERS
class TestMatVariables:
    def test_only_map_is_taken(self, tmp_path, values, save_mat):
        save_mat(tmp_path / "a.mat", note="by hand", dx=np.array([[0.5]]), L1=values)
        np.testing.assert_array_equal(read_thickness(tmp_path / "a.mat", extent=EXTENT).values, values)

    def test_several_maps_need_a_name(self, tmp_path, values, save_mat):
        save_mat(tmp_path / "a.mat", L1=values, L0=values + 0.1)
        with pytest.raises(MeasurementError, match=r"pass variable=.*L1 \(6, 11\)"):
            read_thickness(tmp_path / "a.mat", extent=EXTENT)
        read = read_thickness(tmp_path / "a.mat", extent=EXTENT, variable="L0")
        np.testing.assert_array_equal(read.values, values + 0.1)

    def test_wrong_name(self, tmp_path, values, save_mat):
        save_mat(tmp_path / "a.mat", L1=values)
        with pytest.raises(MeasurementError, match=r"no variable 'L0'; it holds L1 \(6, 11\)"):
            read_thickness(tmp_path / "a.mat", extent=EXTENT, variable="L0")

    def test_no_variable(self, tmp_path, save_mat):
        save_mat(tmp_path / "a.mat")
        with pytest.raises(MeasurementError, match="holds no variable"):
            read_thickness(tmp_path / "a.mat", extent=EXTENT)

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            ("just text", "got text, not real numbers"),
            (np.full(SHAPE, 0.4 + 0.1j), "got complex numbers, not real numbers"),
            (np.ones(SHAPE, bool), "got true/false values"),
            (np.full((1, 11), 0.4), "smaller than 2 by 2"),
            (np.full((2, 3, 4), 0.4), r"got 3-D, shape \(2, 3, 4\)"),
        ],
    )
    def test_not_a_map(self, tmp_path, save_mat, content, message):
        save_mat(tmp_path / "a.mat", L1=content)
        with pytest.raises(MeasurementError, match=message):
            read_thickness(tmp_path / "a.mat", extent=EXTENT)

    def test_integers_are_numbers(self, tmp_path, save_mat):
        save_mat(tmp_path / "a.mat", L1=np.full(SHAPE, 450, np.int16))
        np.testing.assert_allclose(read_thickness(tmp_path / "a.mat", extent=EXTENT, unit="um").values, 0.45, ROUNDOFF)


def test_mat_struct_and_cell(tmp_path, values):
    scipy.io.savemat(tmp_path / "s.mat", {"s": {"L1": values}})
    with pytest.raises(MeasurementError, match="got a struct"):
        read_thickness(tmp_path / "s.mat", extent=EXTENT)
    scipy.io.savemat(tmp_path / "c.mat", {"c": np.array([[values, "x"]], dtype=object)})
    with pytest.raises(MeasurementError, match="got a cell array"):
        read_thickness(tmp_path / "c.mat", extent=EXTENT)


def test_mat_sparse(tmp_path, values):
    scipy.io.savemat(tmp_path / "s.mat", {"s": scipy.sparse.csc_array(values)})
    with pytest.raises(MeasurementError, match="got a sparse matrix"):
        read_thickness(tmp_path / "s.mat", extent=EXTENT)


def test_mat_with_header_only(tmp_path, values):
    save_mat5(tmp_path / "a.mat", L1=values)
    (tmp_path / "a.mat").write_bytes((tmp_path / "a.mat").read_bytes()[:128])
    with pytest.raises(MeasurementError, match=r"a\.mat: the file holds no variable"):
        read_thickness(tmp_path / "a.mat", extent=EXTENT)


class TestOtherFormats:
    @pytest.mark.parametrize("name", ["a.png", "a"])
    def test_unknown_suffix(self, tmp_path, name):
        with pytest.raises(MeasurementError, match=r"opfem reads \.mat, \.npy, \.npz, \.tif, \.tiff, \.csv"):
            read_thickness(tmp_path / name, extent=EXTENT)

    def test_suffix_in_capitals(self, tmp_path, values):
        np.save(tmp_path / "a.npy", values)
        (tmp_path / "a.npy").rename(tmp_path / "A.NPY")
        np.testing.assert_array_equal(read_thickness(tmp_path / "A.NPY", extent=EXTENT).values, values)

    def test_pickles_are_refused(self, tmp_path):
        np.save(tmp_path / "a.npy", np.array([[{}, 1], [2, 3]], dtype=object))
        with pytest.raises(MeasurementError, match="got objects, which opfem never unpickles"):
            read_thickness(tmp_path / "a.npy", extent=EXTENT)

    def test_tiff_of_several_images(self, tmp_path, values):
        with tifffile.TiffWriter(tmp_path / "a.tif") as file:
            file.write(values)
            file.write(values[:4] + 0.1)
        with pytest.raises(MeasurementError, match=r"variable=.*0 \(6, 11\), 1 \(4, 11\)"):
            read_thickness(tmp_path / "a.tif", extent=EXTENT)
        assert read_thickness(tmp_path / "a.tif", spacing=0.5, variable="1").shape == (4, 11)

    @pytest.mark.parametrize(
        "text",
        ["0.4,0.5\n0.3,0.2\n", "# x\n0.4;0.5\n0.3;0.2", "0.4\t0.5\n\n0.3\t0.2\n", "\ufeff0.4 0.5\r\n0.3  0.2\r\n"],
    )
    def test_csv_separators(self, tmp_path, text):
        (tmp_path / "a.csv").write_text(text, encoding="utf-8")
        read = read_thickness(tmp_path / "a.csv", spacing=1.0)
        np.testing.assert_array_equal(read.values, [[0.4, 0.5], [0.3, 0.2]])

    def test_csv_empty_cells_are_missing(self, tmp_path):
        (tmp_path / "a.csv").write_text("0.4,,0.5\n0.3,0.2,NaN\n")
        read = read_thickness(tmp_path / "a.csv", spacing=1.0)
        assert read.mask.tolist() == [[False, True, False], [False, False, True]]

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("x,y\n0.3,0.2\n0.4,z", r"line 3, column 2: 'z' is not a number; start header lines with #"),
            ("0.3,0.2\n0.3\n", "line 2 has 1 columns, others have 2"),
            ("# nothing\n", "holds no variable"),
        ],
    )
    def test_bad_csv(self, tmp_path, text, message):
        (tmp_path / "a.csv").write_text(text)
        with pytest.raises(MeasurementError, match=message):
            read_thickness(tmp_path / "a.csv", spacing=1.0)

    def test_bad_arguments_name_the_file(self, tmp_path, values):
        np.save(tmp_path / "a.npy", values)
        with pytest.raises(MeasurementError, match=r"a\.npy: ThicknessMap\.extent .* must be positive"):
            read_thickness(tmp_path / "a.npy", extent=(0.0, 1.0))
        with pytest.raises(MeasurementError, match="got both"):
            read_thickness(tmp_path / "a.npy", extent=EXTENT, spacing=0.1)


class TestWriting:
    @pytest.mark.parametrize("std", [None, 0.003, "map"])
    def test_comes_back_whole(self, tmp_path, values, std):
        mask = np.zeros(SHAPE, bool)
        mask[2, 3:5] = True
        std = np.full(SHAPE, 0.002) if isinstance(std, str) else std
        written = ThicknessMap(values, extent=EXTENT, origin=(1.0, 2.0), std=std, mask=mask).filled().smoothed(0.7)
        write_thickness(written, tmp_path / "a.npz")
        read = read_thickness(tmp_path / "a.npz")
        assert read.is_filled
        assert [step.name for step in read.steps] == ["filled", "smoothed"]
        assert (read.std is None) == (std is None)
        for name in ("values", "extent", "origin", "mask", "noise_length") + (("std",) if std is not None else ()):
            np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
        for ours, theirs in zip(read.steps, written.steps, strict=True):
            assert {k: v.tolist() for k, v in ours.numbers.items()} == {
                k: v.tolist() for k, v in theirs.numbers.items()
            }

    def test_grid_is_not_passed_again(self, tmp_path, values):
        write_thickness(ThicknessMap(values, extent=EXTENT), tmp_path / "a.npz")
        with pytest.raises(MeasurementError, match="contains its grid; leave out extent"):
            read_thickness(tmp_path / "a.npz", extent=EXTENT)

    def test_refuses_other_suffix(self, tmp_path, values):
        with pytest.raises(ValueError, match=r"writes \.npz"):
            write_thickness(ThicknessMap(values, extent=EXTENT), tmp_path / "a.mat")

    def test_damaged_copy(self, tmp_path, values):
        write_thickness(ThicknessMap(values, extent=EXTENT), tmp_path / "a.npz")
        with np.load(tmp_path / "a.npz") as stored:
            parts = dict(stored)
        del parts["extent"]
        np.savez(tmp_path / "a.npz", **parts)
        with pytest.raises(MeasurementError, match=r"a\.npz: .*KeyError"):
            read_thickness(tmp_path / "a.npz")


def test_coin_is_oriented_as_the_published_deck(shared):
    """The deck's imprint, made from this map by the published toolbox, tells which axis is x."""
    coin = read_thickness(shared / "data" / "coin_5c_1-thickness.mat", extent=(5.0, 5.0))
    case = np.load(shared / "reference" / "ccx" / "cases" / "coin_ccxcontact_muwin0p15_mutop0_C3D8.npz")
    position, uz = case["imprint_nodes"][:3249], case["imprint_uz"][:3249]
    x, y = jnp.array(position[:, 0]), jnp.array(position[:, 1])
    assert coin.shape == (502, 502)
    np.testing.assert_allclose((coin.values.min(), coin.values.max()), (0.3166, 0.5), atol=1e-4)
    # Past the layer the toolbox extends the imprint in its own way; opfem continues it at its edge value.
    layer = (x >= 0) & (x <= 5) & (y >= 0) & (y <= 5)
    right = np.corrcoef(coin.sample(x, y)[layer], uz[layer])[0, 1]
    turned = np.corrcoef(coin.sample(y, x)[layer], uz[layer])[0, 1]
    assert right > 0.9999
    assert abs(turned) < 0.1
