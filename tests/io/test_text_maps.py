"""Maps from text: whatever programs put around the numbers, the grid is the map's, or the file is refused."""

import numpy as np
import pytest

from opfem.io import read_thickness
from opfem.measurement import MeasurementError, MeasurementWarning
from tests.tolerances import ROUNDOFF

EXTENT = (5.0, 3.0)  # pixels of 1 mm
VALUES = 0.4 + 0.002 * np.arange(24).reshape(4, 6)
CELLS = [[f"{value:.4f}" for value in row] for row in VALUES]
X, Y = [f"{i}.0" for i in range(6)], [f"{j}.0" for j in range(4)]

commas = pytest.mark.parametrize("mark", [",", ";", "\t"], ids=["comma", "semicolon", "tab"])


def text(rows, mark=",", tail="", end="\n"):
    return "".join(mark.join(row) + tail + end for row in rows)


def read(folder, written, name="map.csv", encoding="utf-8", **how):
    with open(folder / name, "w", encoding=encoding, newline="") as file:
        file.write(written)
    return read_thickness(folder / name, **({"extent": EXTENT} | how))


def check(got, missing=()):
    """The map on its grid, and just the missing pixels missing."""
    assert got.shape == VALUES.shape
    np.testing.assert_allclose(got.spacing, (1.0, 1.0), ROUNDOFF)
    assert [tuple(pixel) for pixel in np.argwhere(got.mask)] == sorted(missing)
    np.testing.assert_allclose(np.where(got.mask, VALUES, got.values), VALUES, ROUNDOFF)


def without(*pixels):
    return [["" if (j, i) in pixels else cell for i, cell in enumerate(row)] for j, row in enumerate(CELLS)]


def with_axes(corner, x=X, y=Y, cells=CELLS):
    return [[corner, *x], *([where, *row] for where, row in zip(y, cells, strict=True))]


class TestDelimitersTooMany:
    @pytest.mark.parametrize("mark", [",", ";", "\t", " "])
    def test_at_the_end_of_lines(self, tmp_path, mark):
        check(read(tmp_path, text(CELLS, mark, mark)))

    @commas
    def test_at_the_start_of_lines(self, tmp_path, mark):
        check(read(tmp_path, text([["", *row] for row in CELLS], mark)))

    @commas
    @pytest.mark.parametrize("place", [0, 4])
    def test_whole_lines(self, tmp_path, mark, place):
        rows = [*CELLS[:place], [""] * 6, *CELLS[place:]]
        check(read(tmp_path, text(rows, mark)))

    @commas
    def test_used_range_of_a_spreadsheet(self, tmp_path, mark):
        """Two lines and three columns more than there are numbers."""
        rows = [*([*row, "", "", ""] for row in CELLS), [""] * 9, [""] * 9]
        check(read(tmp_path, text(rows, mark)))

    def test_some_lines_only(self, tmp_path):
        lines = text(CELLS).splitlines()
        with pytest.warns(MeasurementWarning, match="some lines end in a delimiter"):
            check(read(tmp_path, f"{lines[0]},\n" + "\n".join(lines[1:]) + "\n"))

    def test_end_of_lines_with_a_spacing(self, tmp_path):
        with pytest.warns(MeasurementWarning, match="0 rows and 1 columns at the end are empty"):
            check(read(tmp_path, text(CELLS, tail=","), extent=None, spacing=1.0))

    @pytest.mark.parametrize("how", [{"extent": (7.3, 3.0)}, {"extent": None, "spacing": 1.0}])
    def test_refuses_what_the_grid_does_not_settle(self, tmp_path, how):
        with pytest.raises(MeasurementError, match=r"line 4, column 1: empty in every line, a delimiter too many or"):
            read(tmp_path, text([["", *row] for row in CELLS]), **how)


class TestMissingCells:
    @commas
    @pytest.mark.parametrize(
        "missing",
        [
            [(2, 0)],
            [(0, 5)],
            [(0, 0)],
            [(3, 5)],
            [(1, 2), (1, 3)],
            [(j, 0) for j in range(4)],
            [(j, 5) for j in range(4)],
            [(1, i) for i in range(6)],
            [(0, i) for i in range(6)],
        ],
    )
    def test_empty(self, tmp_path, mark, missing):
        check(read(tmp_path, text(without(*missing), mark)), missing)

    @pytest.mark.parametrize(
        "word",
        [
            "#N/A",
            "#DIV/0!",
            "#VALUE!",
            "#NV",
            "#WERT!",
            "NaN",
            "nan",
            "-",
            "NA",
            "inf",
            "-Inf",
            "1.#QNAN",
            '""',
            '"#N/A"',
        ],
    )
    def test_words_for_it(self, tmp_path, word):
        rows = [row[:3] + [word] * 3 for row in CELLS[:1]] + [[word, *row[1:]] for row in CELLS[1:2]] + CELLS[2:]
        check(read(tmp_path, text(rows)), [(0, 3), (0, 4), (0, 5), (1, 0)])

    def test_narrow_column_is_not_missing(self, tmp_path):
        with pytest.raises(
            MeasurementError, match="line 1, column 3: '####' is what a spreadsheet shows in too narrow"
        ):
            read(tmp_path, text([[*CELLS[0][:2], "####", *CELLS[0][3:]], *CELLS[1:]]))


class TestHeadersAndCoordinates:
    @pytest.mark.parametrize(
        "rows",
        [
            [["a", "b", "c", "d", "e", "f"], *CELLS],
            [["a", "b", "c", "d", "e", "f"], ["mm"] * 6, *CELLS],
            [["", *"abcdef"], *([str(j), *row] for j, row in enumerate(CELLS))],
            [["index", *"abcdef"], *([str(j + 1), *row] for j, row in enumerate(CELLS))],
            [["", *"abcdef"], *([f"row {j}", *row] for j, row in enumerate(CELLS))],
            [list("abcdef"), *([f'"{j}"', *row] for j, row in enumerate(CELLS))],
            [[str(i) for i in range(6)], *CELLS],
            [[str(j), *row] for j, row in enumerate(CELLS)],
            with_axes("", [str(i) for i in range(6)], [str(j) for j in range(4)]),
            with_axes("y/x"),
            with_axes(""),
            with_axes("0"),
            with_axes("", [f"{1e3 * i:g}" for i in range(6)], [f"{1e3 * j:g}" for j in range(4)]),
            [["# made by hand, today"], *CELLS, ["# end"]],
            [["% x, y"], *CELLS],
        ],
        ids=str,
    )
    def test_are_no_thickness(self, tmp_path, rows):
        check(read(tmp_path, text(rows)))

    def test_descending_rows_are_turned(self, tmp_path):
        check(read(tmp_path, text(with_axes("", X, Y[::-1], CELLS[::-1]))))

    def test_span_of_another_size_is_said(self, tmp_path):
        with pytest.warns(
            MeasurementWarning, match=r"line 1, column 2: the coordinates span 2\.5 × 1\.5, which is not"
        ):
            check(read(tmp_path, text(with_axes("", [f"{0.5 * i + 0.5}" for i in range(6)], ["0.5", "1", "1.5", "2"]))))

    def test_span_of_another_shape_is_refused(self, tmp_path):
        with pytest.raises(MeasurementError, match=r"span 5 × 6, which is not extent= \(5\.0, 3\.0\) mm; .*right"):
            read(tmp_path, text(with_axes("", [f"{i + 0.5}" for i in range(6)], ["0", "2", "4", "6"])))

    def test_spacing_is_held_against_them_too(self, tmp_path):
        rows = text(with_axes("", [f"{i + 0.5}" for i in range(6)], ["1", "2", "3", "4"]))
        check(read(tmp_path, rows, extent=None, spacing=1.0))
        with pytest.warns(
            MeasurementWarning, match=r"span 5 × 3, which is not spacing= \(0\.7, 0\.7\) mm; what was given"
        ):
            read(tmp_path, rows, extent=None, spacing=0.7)

    def test_positions_of_columns_and_an_index_of_rows(self, tmp_path):
        check(read(tmp_path, text(with_axes("", [f"{i + 0.5}" for i in range(6)], [str(j) for j in range(4)]))))

    def test_corner_that_may_be_a_pixel_is_refused(self, tmp_path):
        with pytest.raises(
            MeasurementError, match="line 1, column 1 is empty: coordinates of columns and rows, or a mis"
        ):
            read(tmp_path, text(with_axes("", X, CELLS[0][:4])))

    def test_word_among_numbers_is_refused(self, tmp_path):
        with pytest.raises(MeasurementError, match=r"line 2, column 3: 'O\.4' is not a number"):
            read(tmp_path, text([CELLS[0], [*CELLS[1][:2], "O.4", *CELLS[1][3:]], *CELLS[2:]]))


class TestTriplets:
    points = tuple([X[i], Y[j], CELLS[j][i]] for j in range(4) for i in range(6))

    @pytest.mark.parametrize(
        "rows",
        [
            points,
            points[::-1],
            [["x", "y", "z"], *points],
            [["X (mm)", "Y (mm)", "thickness"], *sorted(points)],
            [[str(k), *point] for k, point in enumerate(points)],
        ],
        ids=["rows", "backwards", "header", "columns", "index"],
    )
    @pytest.mark.parametrize("mark", [",", "\t", " "])
    def test_are_read_as_the_map(self, tmp_path, rows, mark):
        if mark == " ":
            rows = [[cell.replace(" ", "_") for cell in row] for row in rows]
        check(read(tmp_path, text(rows, mark)))

    def test_missing_thickness(self, tmp_path):
        rows = [[x, y, "NaN" if (x, y) == ("2.0", "1.0") else z] for x, y, z in self.points]
        check(read(tmp_path, text(rows)), [(1, 2)])

    @pytest.mark.parametrize("lost", [0, 7, 23])
    def test_without_a_point_are_refused(self, tmp_path, lost):
        with pytest.raises(
            MeasurementError, match=r"line 1, column 1: 23 points x, y, z fill no grid .*6 positions in x"
        ):
            read(tmp_path, text([point for k, point in enumerate(self.points) if k != lost]))

    def test_scattered_points_are_refused(self, tmp_path):
        x, y = np.random.default_rng(0).uniform(0, 5, (2, 60))
        with pytest.raises(MeasurementError, match="60 rows of 3 columns look like a list of points"):
            read(tmp_path, "".join(f"{a},{b},0.4\n" for a, b in zip(x, y, strict=True)))

    def test_uneven_grid_is_refused(self, tmp_path):
        rows = [[{"5.0": "9.0"}.get(x, x), y, z] for x, y, z in self.points]
        with pytest.raises(MeasurementError, match="fill no grid of equal steps"):
            read(tmp_path, text(rows))


class TestDecimals:
    @pytest.mark.parametrize("mark", [";", "\t", " "])
    def test_commas(self, tmp_path, mark):
        check(read(tmp_path, text([[cell.replace(".", ",") for cell in row] for row in CELLS], mark)))

    def test_commas_in_quotes(self, tmp_path):
        check(read(tmp_path, text([[f'"{cell.replace(".", ",")}"' for cell in row] for row in CELLS])))

    @pytest.mark.parametrize(
        ("rows", "message"),
        [
            ([["0,4000"] * 3, ["0,4100"] * 3], "line 1, column 2: every second column lies apart"),
            ([["412,05"] * 3, ["410,10"] * 3], "line 1, column 2: '05' starts with a zero"),
            ([['"1,234"'] * 3, ['"1,200"'] * 3], "line 1, column 1: '1,234' may be a decimal or thousands"),
            ([['"0,4"', "0.4"], ["0.4", "0.4"]], "line 1, column 1: '0,4' has a comma, other numbers have a point"),
            ([["0.4 mm", "0.4 mm"], ["0.4 mm", "0.4 mm"]], "line 1, column 1: '0.4 mm' is not a number"),
            ([["0.4", "4_0"], ["0.4", "0.4"]], "line 1, column 2: '4_0' is not a number"),
            ([["0.4", "1e999"], ["0.4", "0.4"]], "line 1, column 2: 1e999 is too large"),
        ],
    )
    def test_refuses_what_may_be_either(self, tmp_path, rows, message):
        with pytest.raises(MeasurementError, match=message):
            read(tmp_path, text(rows), unit="um")

    def test_exponents(self, tmp_path):
        check(read(tmp_path, text([[f"{float(cell):.6E}".replace("E", "D") for cell in row] for row in CELLS])))


class TestFiles:
    @pytest.mark.parametrize("name", ["map.txt", "map.tsv", "map.CSV"])
    def test_suffixes(self, tmp_path, name):
        check(read(tmp_path, text(CELLS, "\t"), name))

    @pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1"])
    def test_encodings(self, tmp_path, encoding):
        check(read(tmp_path, "# thickness in µm\n" + text(CELLS, "\t"), encoding=encoding))

    @pytest.mark.parametrize("end", ["\n", "\r\n", "\r", "\n\n"])
    def test_line_ends(self, tmp_path, end):
        check(read(tmp_path, text(CELLS, end=end)))

    def test_delimiter_stated_for_a_spreadsheet(self, tmp_path):
        check(read(tmp_path, "sep=;\n" + text(CELLS, ";")))

    def test_quotes(self, tmp_path):
        check(read(tmp_path, text([[f'"{cell}"' for cell in row] for row in CELLS], ", ")))
        with pytest.raises(MeasurementError, match="line 4: its quotes do not match"):
            read(tmp_path, text([*CELLS[:3], ['"0.4', *CELLS[3][1:]]]))

    def test_two_maps_are_refused(self, tmp_path):
        with pytest.raises(MeasurementError, match="line 5 is blank or a comment between rows of numbers"):
            read(tmp_path, text(CELLS) + "\n" + text(CELLS))

    def test_cut_off(self, tmp_path):
        with pytest.raises(MeasurementError, match="line 4 has 5 columns, others have 6"):
            read(tmp_path, text(CELLS)[:-8])
        with pytest.warns(MeasurementWarning, match=r"the last number, '0\.44', is shorter than all others"):
            read(tmp_path, text(CELLS)[:-3])

    def test_lost_row_shows_in_the_pixels(self, tmp_path):
        with pytest.warns(MeasurementWarning, match=r"the 6 × 3 pixels 1 × 1\.5 mm large, not square: is a row"):
            read(tmp_path, text(CELLS[:3]))

    @pytest.mark.parametrize(
        ("stored", "message"),
        [
            (b"PK\x03\x04 and more", "is a spreadsheet or an archive, not text"),
            (b"0.4,0.4\n0.4,\x00\n", "line 2 holds a zero byte"),
            (b"0.4,0.4\n0.4,\xff\n", "line 2, column 2: 'ÿ' is not a number"),
        ],
    )
    def test_what_is_no_text(self, tmp_path, stored, message):
        (tmp_path / "map.csv").write_bytes(stored)
        with pytest.raises(MeasurementError, match=message):
            read_thickness(tmp_path / "map.csv", spacing=1.0)
