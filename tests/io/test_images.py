"""TIFF images: compressions, the pixel size that ImageJ and OME write, calibrated numbers, colours."""

import numpy as np
import PIL.Image
import pytest
import tifffile

from opfem.io import read_thickness
from opfem.measurement import MeasurementError, MeasurementWarning
from tests.tolerances import ROUNDOFF

COUNTS = (400 + 2 * np.arange(24)).reshape(4, 6)
EXTENT = (5.0, 3.0)


class TestCompressions:
    @pytest.mark.parametrize("compression", ["tiff_lzw", "packbits", "tiff_adobe_deflate", "zstd", None])
    @pytest.mark.parametrize("dtype", ["u2", ">u2", "f4", "i4"])
    def test_give_the_numbers(self, tmp_path, compression, dtype):
        if dtype == ">u2":
            image = PIL.Image.frombytes("I;16B", (6, 4), COUNTS.astype(dtype).tobytes())
        else:
            image = PIL.Image.fromarray(COUNTS.astype(dtype))
        image.save(tmp_path / "a.tif", compression=compression)
        got = read_thickness(tmp_path / "a.tif", extent=EXTENT, unit="um")
        np.testing.assert_allclose(got.values, 1e-3 * COUNTS, ROUNDOFF)

    @pytest.mark.parametrize("compression", ["zlib", "lzma", None])
    @pytest.mark.parametrize("layout", [{}, {"tile": (16, 32)}, {"rowsperstrip": 3}, {"bigtiff": True}], ids=str)
    def test_of_64_bits(self, tmp_path, compression, layout):
        tifffile.imwrite(tmp_path / "a.tif", 1e-3 * COUNTS, compression=compression, **layout)
        np.testing.assert_array_equal(read_thickness(tmp_path / "a.tif", extent=EXTENT).values, 1e-3 * COUNTS)

    def test_second_image_by_lzw(self, tmp_path):
        images = [PIL.Image.fromarray((COUNTS[:rows] + rows).astype("u2")) for rows in (3, 4)]
        images[0].save(tmp_path / "a.tif", compression="tiff_lzw", save_all=True, append_images=images[1:])
        got = read_thickness(tmp_path / "a.tif", extent=EXTENT, unit="um", variable="1")
        np.testing.assert_allclose(got.values, 1e-3 * (COUNTS + 4), ROUNDOFF)

    def test_refuses_what_would_come_out_inverted(self, tmp_path):
        image = PIL.Image.fromarray((COUNTS - 300).astype("u1"))
        image.save(tmp_path / "a.tif", compression="tiff_lzw", tiffinfo={262: 0})
        with pytest.raises(MeasurementError, match="LZW compression of uint8 needs imagecodecs: install it"):
            read_thickness(tmp_path / "a.tif", extent=EXTENT, unit="um")


class TestPixelSize:
    def imagej(self, folder, unit, across, down, **more):
        path = folder / "a.tif"
        metadata = {"unit": unit} | more
        tifffile.imwrite(path, COUNTS.astype("u2"), imagej=True, resolution=(1 / across, 1 / down), metadata=metadata)
        return path

    @pytest.mark.parametrize(
        ("unit", "size"),
        [("um", 1e-3), ("\\u00B5m", 1e-3), ("micron", 1e-3), ("nm", 1e-6), ("mm", 1.0), ("cm", 10.0), ("inch", 25.4)],
    )
    def test_of_imagej(self, tmp_path, unit, size):
        path = self.imagej(tmp_path, unit, 0.02 / size, 0.03 / size)
        got = read_thickness(path, unit="um")
        np.testing.assert_allclose(got.spacing, (0.02, 0.03), rtol=1e-4)  # stored as a fraction of 32-bit numbers
        assert got.steps[0].numbers["spacing_from_file"]

    @pytest.mark.parametrize("unit", ["um", "µm", "mm", "cm"])
    def test_of_ome(self, tmp_path, unit):
        size = {"um": 1e-3, "µm": 1e-3, "mm": 1.0, "cm": 10.0}[unit]
        metadata = {"PhysicalSizeX": 0.02 / size, "PhysicalSizeY": 0.03 / size}
        metadata |= {"PhysicalSizeXUnit": unit, "PhysicalSizeYUnit": unit} if unit != "µm" else {}
        tifffile.imwrite(tmp_path / "a.ome.tif", COUNTS.astype("u2"), metadata=metadata)
        np.testing.assert_allclose(read_thickness(tmp_path / "a.ome.tif", unit="um").spacing, (0.02, 0.03), ROUNDOFF)

    def test_stated_one_is_used_and_the_difference_said(self, tmp_path):
        path = self.imagej(tmp_path, "um", 20.0, 30.0)
        with pytest.warns(
            MeasurementWarning, match=r"pixels are 0\.02 × 0\.03 mm, but 0\.5 × 0\.5 mm as given is used"
        ):
            got = read_thickness(path, spacing=0.5, unit="um")
        np.testing.assert_allclose(got.spacing, 0.5)
        assert not got.steps[0].numbers["spacing_from_file"]
        assert read_thickness(path, spacing=(0.02, 0.03), unit="um").shape == (4, 6)

    @pytest.mark.parametrize("unit", ["pixel", "", "s"])
    def test_without_a_length_tells_no_grid(self, tmp_path, unit):
        with pytest.raises(MeasurementError, match="needs either extent"):
            read_thickness(self.imagej(tmp_path, unit, 20.0, 30.0), unit="um")

    def test_resolution_of_a_plain_file_is_not_believed(self, tmp_path):
        tifffile.imwrite(tmp_path / "a.tif", COUNTS.astype("u2"), resolution=(72, 72), resolutionunit="inch")
        with pytest.raises(MeasurementError, match="needs either extent"):
            read_thickness(tmp_path / "a.tif", unit="um")


class TestNumbers:
    def test_signed_ones_of_imagej(self, tmp_path):
        """ImageJ stores them as unsigned, with the offset in its description."""
        metadata = {"cf": 0, "c0": -32768.0, "c1": 1.0, "vunit": "gray value"}
        tifffile.imwrite(tmp_path / "a.tif", (COUNTS + 32768).astype("u2"), imagej=True, metadata=metadata)
        got = read_thickness(tmp_path / "a.tif", extent=EXTENT, unit="um")
        np.testing.assert_allclose(got.values, 1e-3 * COUNTS, ROUNDOFF)

    def test_calibrated_by_a_line(self, tmp_path):
        metadata = {"cf": 0, "c0": 100.0, "c1": 0.5}
        tifffile.imwrite(tmp_path / "a.tif", COUNTS.astype("u2"), imagej=True, metadata=metadata)
        got = read_thickness(tmp_path / "a.tif", extent=EXTENT, unit="um")
        np.testing.assert_allclose(got.values, 1e-3 * (100 + 0.5 * COUNTS), ROUNDOFF)

    def test_calibrated_by_a_curve_is_refused(self, tmp_path):
        metadata = {"cf": 4, "c0": 1.0, "c1": 2.0}
        tifffile.imwrite(tmp_path / "a.tif", COUNTS.astype("u2"), imagej=True, metadata=metadata)
        with pytest.raises(MeasurementError, match="calibrated by a curve in ImageJ; save it as 32-bit"):
            read_thickness(tmp_path / "a.tif", extent=EXTENT, unit="um")

    def test_colours_are_refused(self, tmp_path):
        tifffile.imwrite(tmp_path / "a.tif", np.zeros((4, 6, 3), "u1"), photometric="rgb")
        with pytest.raises(MeasurementError, match="got a colour image: it shows numbers but does not hold them"):
            read_thickness(tmp_path / "a.tif", extent=EXTENT)

    def test_pixels_that_are_missing_from_the_file(self, tmp_path):
        tifffile.imwrite(tmp_path / "a.tif", COUNTS.astype("f8"))
        stored = bytearray((tmp_path / "a.tif").read_bytes())
        with tifffile.TiffFile(tmp_path / "a.tif") as file:
            length = file.pages.first.tags["ImageLength"]
        stored[length.valueoffset] = 3
        (tmp_path / "a.tif").write_bytes(stored)
        with pytest.raises(MeasurementError, match=r"an image of shape \(3, 6\) takes 144 bytes, the file holds 192"):
            read_thickness(tmp_path / "a.tif", extent=EXTENT, unit="um")
