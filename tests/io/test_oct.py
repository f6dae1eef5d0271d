"""OCT volumes come back from every kind of file as they were, and what is wrong with a file is said in one line."""

import json
import re
import shutil
import zipfile

import h5py
import numpy as np
import pytest
import scipy.io
import tifffile
from PIL import Image

import opfem as op
from tests.tolerances import ROUNDOFF

SHAPE = (5, 7, 11)  # differs on each axis


def samples(dtype=np.float32):
    rng = np.random.default_rng(3)
    values = 40.0 + 10.0 * rng.standard_normal(SHAPE)
    return (
        (values + 1j * rng.standard_normal(SHAPE)).astype(dtype)
        if np.dtype(dtype).kind == "c"
        else values.astype(dtype)
    )


def volume(scale="db", **more):
    return op.OctVolume(
        samples(np.complex64 if scale == "complex" else np.float32), (0.01, 0.02), 2.5e-3, scale,
        origin=(0.1, 0.2), depth_origin=0.03, wavelength=845e-6, **more,
    )  # fmt: skip


def same(read, written):
    np.testing.assert_array_equal(read.values, written.values)
    assert read.scale == written.scale
    assert read.phase_sign == written.phase_sign
    for name in ("spacing", "origin", "optical_spacing", "depth_origin", "wavelength"):
        np.testing.assert_allclose(getattr(read, name), getattr(written, name), rtol=ROUNDOFF)


def rewritten(source, target, compression=zipfile.ZIP_STORED, slash="\\", header=lambda text: text, leave_out=()):
    """Write the entries of a ZIP file again, in another way."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", compression) as new:
        for info in old.infolist():
            content = old.read(info)
            if info.filename == "Header.xml":
                content = header(content.decode()).encode()
            if info.filename not in leave_out:
                new.writestr(zipfile.ZipInfo(info.filename.replace("\\", slash)), content, compression)
    return target


@pytest.mark.parametrize("suffix", [".h5", ".oct"])
@pytest.mark.parametrize("scale", ["db", "complex"])
def test_written_volume_comes_back(tmp_path, suffix, scale):
    written = volume(scale, phase_sign=-1 if scale == "complex" else None)
    op.write_oct(written, tmp_path / f"a{suffix}")
    read = op.read_oct(tmp_path / f"a{suffix}")
    same(read, written)
    assert isinstance(read.values, np.memmap)  # read in place


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
@pytest.mark.parametrize("slash", ["\\", "/"])
@pytest.mark.parametrize("index", [1.0, 1.4])
def test_thorlabs_file(tmp_path, compression, slash, index):
    written = volume()
    op.write_oct(written, tmp_path / "a.oct")
    text = f"<RefractiveIndex>{index:f}</RefractiveIndex>"
    path = rewritten(
        tmp_path / "a.oct", tmp_path / "b.oct", compression, slash,
        lambda header: header.replace("<RefractiveIndex>1.000000</RefractiveIndex>", text),
    )  # fmt: skip
    read = op.read_oct(path)
    np.testing.assert_array_equal(read.values, written.values)
    # ThorImage divides depth by its index.
    np.testing.assert_allclose(read.optical_spacing, index * 2.5e-3, rtol=ROUNDOFF)
    np.testing.assert_allclose(op.read_oct(path, index_applied=1.0).optical_spacing, 2.5e-3, rtol=ROUNDOFF)


def test_thorlabs_folder(tmp_path):
    written = volume()
    op.write_oct(written, tmp_path / "a.oct")
    folder = tmp_path / "unpacked"
    (folder / "data").mkdir(parents=True)
    with zipfile.ZipFile(tmp_path / "a.oct") as archive:
        for info in archive.infolist():
            (folder / info.filename.replace("\\", "/")).write_bytes(archive.read(info))
    same(op.read_oct(folder), written)
    # Programs that do not know the backslash make it part of the name.
    shutil.move(folder / "data" / "Intensity.data", folder / "data\\Intensity.data")
    same(op.read_oct(folder), written)


def test_two_dimensional_thorlabs_file(tmp_path):
    op.write_oct(volume(), tmp_path / "a.oct")

    def flat(header):
        header = re.sub(r'SizeX="7" SizeY="5"', 'SizeX="35"', header)
        return re.sub(r' RangeY="[^"]*"', "", header)

    read = op.read_oct(rewritten(tmp_path / "a.oct", tmp_path / "b.oct", header=flat))
    np.testing.assert_array_equal(read.values, samples().reshape(1, 35, 11))


def test_two_cameras(tmp_path):
    written = volume("complex")
    op.write_oct(written, tmp_path / "a.oct")

    def twice(header):
        (found,) = re.findall(r"<DataFile .*?</DataFile>", header)
        return header.replace(found, found.replace("Complex.data", "Complex_Cam0.data") + found)

    path = rewritten(tmp_path / "a.oct", tmp_path / "b.oct", header=twice)
    with pytest.raises(op.MeasurementError, match="several: Complex_Cam0, Complex; pass variable="):
        op.read_oct(path)
    np.testing.assert_array_equal(op.read_oct(path, variable="Complex").values, written.values)


@pytest.mark.parametrize("order", ["zxy", "xzy", "yxz"])
def test_orders_of_stored_axes(tmp_path, order):
    """Raw numbers, .npy, HDF5 and .mat of one volume, its axes stored in one order, are equal."""
    values = samples()
    stored = np.ascontiguousarray(values.transpose(["yxz".index(axis) for axis in order[::-1]]))
    stored.tofile(tmp_path / "a.raw")
    np.save(tmp_path / "a.npy", stored)
    np.save(tmp_path / "b.npy", np.asfortranarray(stored.T))
    scipy.io.savemat(tmp_path / "a.mat", {"volume": stored.T, "other": np.eye(3)})
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["volume"] = stored
        file["chunked"] = np.zeros(3)
    tifffile.imwrite(tmp_path / "a.tif", stored)
    stated = {"spacing": (0.01, 0.02), "depth_spacing": 2.5e-3, "scale": "db", "order": order}
    for name in ("a.npy", "b.npy", "a.mat", "a.h5", "a.tif"):
        read = op.read_oct(tmp_path / name, **stated)
        np.testing.assert_array_equal(read.values, values, err_msg=name)
    np.testing.assert_array_equal(op.read_oct(tmp_path / "a.raw", shape=SHAPE, **stated).values, values)


def test_complex_numbers_as_matlab_stores_them(tmp_path):
    values = samples(np.complex64)
    with h5py.File(tmp_path / "a.mat", "w") as file:
        compound = values.view([("real", "<f4"), ("imag", "<f4")])
        file.create_dataset("c", data=compound, chunks=(1, 7, 11), compression="gzip")
    read = op.read_oct(
        tmp_path / "a.mat", spacing=0.01, depth_spacing=2.5e-3, scale="complex", order="zxy", phase_sign=1
    )
    np.testing.assert_array_equal(read.values, values)
    assert read.phase_sign == 1


def myoct(path, version=3, dtype=np.uint16, **change):
    """A stack as myOCT writes it: pages of z by x, its JSON in the first page's tag 305."""
    ny, nx, nz = SHAPE
    levels = np.random.default_rng(5).integers(0, 2**16, (ny, nz, nx)).astype(dtype)
    levels[0, 0, 0] = 0
    grid = {axis: {"units": "millimeters", "values": (step * np.arange(n) - 0.02).tolist()}
            for axis, step, n in (("x", 0.01, nx), ("y", 0.02, ny))}  # fmt: skip
    grid["z"] = {"units": "microns", "values": (2.0 * np.arange(nz)).tolist()}
    said = json.dumps({"metadata": grid, "clim": [-20.0, 45.534], "version": version} | change)
    first, *rest = (Image.fromarray(page) for page in levels)
    first.save(path, save_all=True, append_images=rest, compression="packbits", tiffinfo={305: said})
    return levels


def test_stack_of_myoct(tmp_path):
    levels = myoct(tmp_path / "a.tif")
    read = op.read_oct(tmp_path / "a.tif", index_applied=1.4)
    expected = -20.0 + 1e-3 * (levels.astype(float) - 1.0)  # dB: 65.534 over 65534 steps
    expected[0, 0, 0] = np.nan
    np.testing.assert_allclose(read.values, np.moveaxis(expected, 1, 2), atol=1e-4)
    np.testing.assert_allclose(read.spacing, (0.01, 0.02), rtol=1e-6)
    np.testing.assert_allclose(read.optical_spacing, 1.4 * 2e-3, rtol=1e-6)
    assert read.scale == "db"
    with pytest.raises(op.MeasurementError, match="needs index_applied=: myOCT does not state"):
        op.read_oct(tmp_path / "a.tif")
    myoct(tmp_path / "b.tif", metadata=None)
    with pytest.raises(op.MeasurementError, match=r"needs spacing=\(dx, dy\)"):
        op.read_oct(tmp_path / "b.tif", index_applied=1.4)
    stated = op.read_oct(tmp_path / "b.tif", spacing=0.01, depth_spacing=2e-3)
    np.testing.assert_allclose(stated.values, read.values)
    for message, change in (
        ("myOCT's of version '2' in uint8", {"version": 2, "dtype": np.uint8}),
        ("clim must be two numbers", {"clim": None}),
    ):
        myoct(tmp_path / "b.tif", **change)
        with pytest.raises(op.MeasurementError, match=message):
            op.read_oct(tmp_path / "b.tif")


def test_what_is_not_stated_is_asked_for(tmp_path):
    np.save(tmp_path / "a.npy", samples())
    stated = {"order": "zxy", "scale": "db", "spacing": 0.01, "depth_spacing": 2.5e-3}
    asked = {
        "order": r"needs order=, the axes of the array of shape \(5, 7, 11\)",
        "scale": "values span 10.* looks like dB",
        "spacing": r"needs spacing=\(dx, dy\) \[mm\]",
        "depth_spacing": r"needs depth_spacing= \[mm\], as in air",
    }
    for name, message in asked.items():
        rest = {key: value for key, value in stated.items() if key != name}
        with pytest.raises(op.MeasurementError, match=message):
            op.read_oct(tmp_path / "a.npy", **rest)
    with pytest.raises(op.MeasurementError, match="is it in µm"):
        op.read_oct(tmp_path / "a.npy", **{**stated, "spacing": 10.0})
    samples().tofile(tmp_path / "a.raw")
    with pytest.raises(op.MeasurementError, match=r"float32 takes 1120 bytes, the file has 1540"):
        op.read_oct(tmp_path / "a.raw", shape=(5, 7, 8), **stated)


def test_what_is_wrong_with_a_thorlabs_file(tmp_path):
    path = tmp_path / "a.oct"
    op.write_oct(volume(), path)

    def refused(message, **change):
        with pytest.raises(op.MeasurementError, match=message) as caught:
            op.read_oct(rewritten(path, tmp_path / "b.oct", **change))
        assert "\n" not in str(caught.value)

    refused("Intensity.data is missing; the ZIP file holds Header.xml", leave_out=("data\\Intensity.data",))
    refused("11 × 7 × 6 numbers of 4 bytes, 1848 bytes, got 1540", header=lambda h: h.replace('SizeY="5"', 'SizeY="6"'))
    refused("SizeZ must be a positive whole number, got '-3'", header=lambda h: h.replace('SizeZ="11"', 'SizeZ="-3"'))
    refused("states no RangeX", header=lambda h: re.sub('RangeX="[^"]*"', "", h))
    refused("repeated B-scans", header=lambda h: re.sub('RangeY="[^"]*"', 'RangeY="0"', h))
    refused(
        "holds no complex or intensity or spectra; it holds Other",
        header=lambda h: h.replace("Intensity.data", "Other.data"),
    )
    refused("is not XML", header=lambda h: h[:200])
    bomb = '<!DOCTYPE a [<!ENTITY b "bbbbbbbbbb"><!ENTITY c "&b;&b;&b;&b;">]>'
    refused("declares a document type", header=lambda h: h.replace("<Ocity", bomb + "<Ocity", 1))
    deep = "<a>" * 5000 + "</a>" * 5000
    refused("elements", header=lambda h: h.replace("</Ocity>", deep + "</Ocity>"))


def test_cut_off_file(tmp_path):
    op.write_oct(volume(), tmp_path / "a.oct")
    whole = (tmp_path / "a.oct").read_bytes()
    for size in (10, 500, len(whole) - 40):
        (tmp_path / "b.oct").write_bytes(whole[:size])
        with pytest.raises(op.MeasurementError, match=r"b\.oct: "):
            op.read_oct(tmp_path / "b.oct")


def test_refusal_of_a_damaged_name_is_short(tmp_path):
    """An entry whose name is said to be as long as the file is not quoted whole."""
    op.write_oct(volume(), tmp_path / "a.oct")
    path = rewritten(tmp_path / "a.oct", tmp_path / "b.oct", zipfile.ZIP_DEFLATED)
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        at = archive.getinfo("data\\Intensity.data").header_offset
    content[at + 26 : at + 28] = (1500).to_bytes(2, "little")
    path.write_bytes(content)
    with pytest.raises(op.MeasurementError, match=r"BadZipFile: File name in directory .* …\)") as refusal:
        op.read_oct(path)
    assert len(str(refusal.value)) < 700


def test_claims_beyond_memory_are_refused(tmp_path):
    """An entry that says it unpacks to terabytes is never unpacked."""
    op.write_oct(volume(), tmp_path / "a.oct")
    path = rewritten(tmp_path / "a.oct", tmp_path / "b.oct", zipfile.ZIP_DEFLATED)
    with zipfile.ZipFile(path) as archive:
        size = archive.getinfo("data\\Intensity.data").file_size.to_bytes(4, "little")
    path.write_bytes(path.read_bytes().replace(size, (2**31 - 8).to_bytes(4, "little")))
    huge = r'SizeZ="11" SizeX="7" SizeY="5"', 'SizeZ="4194302" SizeX="128" SizeY="1"'
    with pytest.raises(op.MeasurementError):
        op.read_oct(rewritten_header(path, tmp_path / "c.oct", *huge))


def rewritten_header(source, target, old, new):
    with zipfile.ZipFile(source) as archive:
        header = archive.read("Header.xml")
    content = source.read_bytes()
    assert old.encode() in header
    target.write_bytes(content)
    with zipfile.ZipFile(target, "a") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("Header.xml", header.decode().replace(old, new))
    return target


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.oct", b"", "empty"),
        ("a.oct", b"\x00" * 900, "not Thorlabs' .oct, which is a ZIP file"),
        ("a.OCT", b"\x01\x02\x0b\x00\x00\x00FRAMEHEADER" + b"\0" * 900, "Bioptigen's"),
        ("a.dcm", b"\0" * 128 + b"DICM" + b"\0" * 900, "is DICOM"),
        ("a.IMG", b"\x01" * 900, "swept-source .IMG"),
    ],
)
def test_other_formats_are_named(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(op.MeasurementError, match=message):
        op.read_oct(tmp_path / name)


def test_pictures_and_empty_volumes_are_refused(tmp_path):
    stated = {"spacing": 0.01, "depth_spacing": 2.5e-3, "scale": "linear"}
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((5, 11, 7, 3), np.uint8), photometric="rgb")
    with pytest.raises(op.MeasurementError, match="colour-mapped picture"):
        op.read_oct(tmp_path / "a.tif", **stated)
    np.save(tmp_path / "a.npy", np.zeros(SHAPE, np.float32))
    with pytest.raises(op.MeasurementError, match="all samples are 0"):
        op.read_oct(tmp_path / "a.npy", order="zxy", **stated)
    np.save(tmp_path / "a.npy", np.full(SHAPE, np.nan, np.float32))
    with pytest.raises(op.MeasurementError, match="100% of the samples are NaN"):
        op.read_oct(tmp_path / "a.npy", order="zxy", **stated)


def test_write_refuses_another_suffix(tmp_path):
    with pytest.raises(ValueError, match=r"writes \.h5 or \.oct"):
        op.write_oct(volume(), tmp_path / "a.tif")


def test_linear_power_is_written_as_decibels(tmp_path):
    written = op.OctVolume(np.abs(samples()), 0.01, 2.5e-3, "linear")
    op.write_oct(written, tmp_path / "a.oct")
    read = op.read_oct(tmp_path / "a.oct")
    np.testing.assert_allclose(read.intensity(), written.values, rtol=1e-5)  # float32 of 16 dB


def spectra(repeats=(1, 1), is_ascending=False):
    """Whole counts of random scenes, on a chirped spectrometer of an odd number of pixels."""
    rng = np.random.default_rng(4)
    pixels = 45
    even = np.linspace(0.0, 1.0, pixels)
    reference = 2e4 * np.exp(-(((even - 0.45) / 0.3) ** 2)) + 0.3
    counts = rng.integers(200, 60_000, (2 * repeats[0], 3 * repeats[1], pixels)).astype(np.uint16)
    return op.Spectra(
        counts, (0.01, 0.02), 5e-3, reference=reference, offset=100.0 + 10.0 * even,
        chirp=(pixels - 1) * (even + 0.1 * even * (1 - even)), origin=(0.1, 0.2), wavelength=845e-6,
        dispersion=(3.0, -1.5), is_ascending=is_ascending, repeats=repeats,
    )  # fmt: skip


@pytest.mark.parametrize("suffix", [".h5", ".oct"])
@pytest.mark.parametrize("repeats", [(1, 1), (2, 3)])
def test_written_spectra_come_back(tmp_path, suffix, repeats):
    written = spectra(repeats)
    op.write_oct(written, tmp_path / f"a{suffix}")
    read = op.read_spectra(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(read.values, written.values)
    # Thorlabs' files hold float32, and the reference as whole counts of 25 lines.
    coarse = suffix == ".oct"
    np.testing.assert_allclose(read.reference, written.reference, atol=0.02 if coarse else 0.0)
    for name in ("offset", "chirp"):
        np.testing.assert_allclose(getattr(read, name), getattr(written, name), rtol=1e-6 if coarse else 0.0)
    for name in ("spacing", "origin", "optical_spacing", "wavelength", "dispersion"):
        np.testing.assert_allclose(getattr(read, name), getattr(written, name), rtol=ROUNDOFF)
    assert (read.repeats, read.is_ascending, read.shape) == (repeats, False, (2, 3, 45))
    volume, direct = op.read_oct(tmp_path / f"a{suffix}"), written.to_volume()
    assert volume.scale == ("complex" if repeats == (1, 1) else "linear")
    np.testing.assert_allclose(volume.values, direct.values, atol=1e-4 * np.abs(direct.values).max())


def test_ascending_spectra_are_turned_round(tmp_path):
    written = spectra(is_ascending=True)
    op.write_oct(written, tmp_path / "a.oct")
    op.write_oct(written, tmp_path / "a.h5")
    turned, kept = op.read_oct(tmp_path / "a.oct"), op.read_oct(tmp_path / "a.h5")
    assert (turned.phase_sign, kept.phase_sign) == (-1, 1)
    top = np.abs(kept.values).max()
    np.testing.assert_allclose(np.conj(turned.values), kept.values, atol=1e-3 * top)


def test_counts_of_electrons_take_four_bytes(tmp_path):
    few = spectra()
    many = op.Spectra(
        540.0 * few.values, few.spacing, few.optical_spacing, reference=540.0 * few.reference, chirp=few.chirp
    )
    op.write_oct(many, tmp_path / "a.oct")
    np.testing.assert_array_equal(op.read_spectra(tmp_path / "a.oct").values, many.values)


def test_repeats_in_a_header(tmp_path):
    """Of one file: repeats that do not divide, all B-scans at one place, and what only the header names."""
    op.write_oct(spectra((2, 3)), tmp_path / "a.oct")

    def read(change):
        return op.read_spectra(rewritten(tmp_path / "a.oct", tmp_path / "b.oct", header=change))

    with pytest.raises(op.MeasurementError, match="has 9 A-lines, which averaging over 2 does not divide"):
        read(lambda header: header.replace("<AScans>3<", "<AScans>2<"))
    one_place = read(lambda header: re.sub('RangeY="[^"]*"', 'RangeY="-1"', header))
    assert one_place.repeats == (4, 3)
    assert one_place.to_volume().shape == (1, 3, 22)
    speckle = "<SpeckleAveraging><FastAxis>3</FastAxis><SlowAxis>4</SlowAxis></SpeckleAveraging><RefractiveIndex>"
    averaged = read(
        lambda header: re.sub(r"<(AScans|BScans)>\d<", r"<\1>1<", header).replace("<RefractiveIndex>", speckle)
    )
    assert averaged.repeats == (4, 3)


def test_repeated_lines_are_averaged_in_power():
    """Speckle of a scatterer whose phase is another one each time neither fades nor stays."""
    pixels, times = 256, 64
    rng = np.random.default_rng(0)
    place = np.arange(pixels)
    turns = np.exp(2j * np.pi * rng.random((1, times, 1)))
    fringes = (np.exp(2j * np.pi * 40 * place / pixels) * turns).real
    counts = 1e4 * (1 + 0.1 * np.concatenate([fringes, 2 * fringes], axis=1))
    read = op.Spectra(counts, 0.01, 5e-3, reference=np.full(pixels, 1e4), repeats=(1, times)).to_volume("none")
    assert (read.shape, read.scale, read.phase_sign) == ((1, 2, 128), "linear", None)
    np.testing.assert_allclose(read.values[0, :, 40], [0.05**2, 0.1**2], rtol=1e-5)


def test_raw_spectra_of_a_thorlabs_file(tmp_path):
    """Mirrors in two B-scans of raw spectra, with apodisation lines, offset and chirp, come back at their depths."""
    pixels, lines = 1024, 3
    wavelength = np.linspace(830e-6, 930e-6, pixels)  # mm; short to long, as Thorlabs' spectrometers
    k = 2 * np.pi / wavelength
    chirp = (k[0] - k) / (k[0] - k[-1]) * (pixels - 1)
    light = 2e4 * np.exp(-0.5 * ((wavelength - 880e-6) / 30e-6) ** 2)
    offset = np.full(pixels, 90.0, "<f4")
    depths = np.array([[0.2, 0.4], [0.6, 0.8]])  # mm, as in air
    dark = np.broadcast_to(light, (2, lines, pixels))
    fringes = light * (1 + 0.3 * np.cos(2 * k * depths[..., None]))
    counts = np.concatenate([dark, fringes], axis=1) + offset
    reach = np.pi / (k[0] - k[-1]) * (pixels - 1) / 2  # mm that the volume covers
    part = '<DataFile Type="Raw" SizeZ="1024" SizeX="5" SizeY="1" RangeZ="{}" RangeX="0.02" RangeY="0.01" '
    part += 'BytesPerPixel="2" ApoRegionStart0="0" ApoRegionEnd0="3" ScanRegionStart0="3" ScanRegionEnd0="5">'
    part += "data\\Spectral{}.data</DataFile>"
    vector = '<DataFile Type="Real" SizeZ="1024" BytesPerPixel="4">data\\{}.data</DataFile>'
    files = "".join(part.format(float(reach), row) for row in range(2)) + vector.format("Chirp")
    header = (
        f"<Ocity><DataFiles>{files}{vector.format('OffsetErrors')}</DataFiles>"
        "<Instrument><RawDataIsSigned>False</RawDataIsSigned><CentralWavelength>880</CentralWavelength></Instrument></Ocity>"
    )
    with zipfile.ZipFile(tmp_path / "a.oct", "w") as archive:
        archive.writestr("Header.xml", header)
        archive.writestr("data\\Chirp.data", chirp.astype("<f4").tobytes())
        archive.writestr("data\\OffsetErrors.data", offset.tobytes())
        for row in range(2):
            archive.writestr(f"data\\Spectral{row}.data", np.round(counts[row]).astype("<u2").tobytes())
    spectra = op.read_spectra(tmp_path / "a.oct", spacing=(0.01, 0.01))
    assert spectra.shape == (2, 2, pixels)
    np.testing.assert_allclose(spectra.reference, light, atol=0.6)
    volume = op.read_oct(tmp_path / "a.oct", spacing=(0.01, 0.01))
    assert volume.scale == "complex"
    assert volume.phase_sign == -1
    power = np.log(volume.intensity())
    top = np.argmax(power[..., 8:-8], axis=2) + 8
    low, mid, high = (np.take_along_axis(power, top[..., None] + step, axis=2)[..., 0] for step in (-1, 0, 1))
    found = (top + 0.5 * (low - high) / (low - 2 * mid + high)) * float(volume.optical_spacing)
    np.testing.assert_allclose(found, depths, atol=0.5e-3)
    with pytest.raises(op.MeasurementError, match="holds no intensity; it holds Spectral0"):
        op.read_oct(tmp_path / "a.oct", quantity="intensity")
