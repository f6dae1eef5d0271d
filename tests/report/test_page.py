"""What a report says, read from its page without a browser: parts, numbers with units, given and assumed, no code."""

import html
import json
import re

import numpy as np
import pytest
import xarray as xr

import opfem as op
from opfem.report.figures import STATUS_COLOURS
from opfem.report.maps import MOST_PIXELS

LARGEST = 8e6  # bytes
PARTS = (
    "In short", "Maps", "Section from A to B", "The layer in three dimensions", "Numbers", "What this rests on",
    "Convergence and energy", "How this was made",
)  # fmt: skip


@pytest.fixture(scope="module")
def page(dataset, loaded, tmp_path_factory):
    return written(dataset, tmp_path_factory.mktemp("report") / "report.html", loaded)


def written(data, path, measured=None) -> str:
    op.write_report(data, path, measured)
    assert path.stat().st_size < LARGEST
    return path.read_text(encoding="utf-8")


def words(page: str) -> str:
    """Text that a reader sees, without tags."""
    body = re.sub(r"<(script|style)[^>]*>.*?</\1>", " ", page, flags=re.DOTALL)
    return html.unescape(re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", body)))


def rows(page: str) -> dict[str, list[str]]:
    """Cells of every row of the tables, by the row's heading."""
    found = {}
    for row in re.findall(r"<tr>(.*?)</tr>", page):
        cells = [html.unescape(cell) for cell in re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row)]
        heading = html.unescape(re.search(r"<th[^>]*>(.*?)</th>", row)[1])
        found.setdefault(heading, []).append(cells)
    return found


def plots(page: str) -> dict:
    return json.loads(re.search(r'<script type="application/json" id="plots">(.*?)</script>', page, re.DOTALL)[1])


def test_page_stands_alone(page):
    assert page.startswith("<!DOCTYPE html>")
    assert [part for part in PARTS if f"<h2>{part}</h2>" not in page] == []
    markup = re.sub(r"<script>.*?</script>", "", page, flags=re.DOTALL)
    assert re.search(r"""(src|href)=|url\(|@import""", markup) is None
    assert page.count("<script") == page.count("</script") == 4


def test_maps_of_an_imprint(page):
    drawn = plots(page)
    assert list(drawn) == [
        "map-thickness", "map-compression", "map-pressure", "map-status", "map-window_status", "map-residual",
        "section", "layer",
    ]  # fmt: skip
    for name, figure in drawn.items():
        if name.startswith("map-"):
            layout = figure["layout"]
            assert layout["xaxis"]["title"]["text"] == "x [mm]"
            assert layout["yaxis"]["range"][0] > layout["yaxis"]["range"][1]  # row 0 at the top
            assert layout["yaxis"]["scaleanchor"] == "x"
            assert len(figure["data"][0]["z"]["shape"].split(",")) == 2
    low, high = (drawn["map-residual"]["data"][0][end] for end in ("zmin", "zmax"))
    assert low == -high < 0


def test_numbers_are_those_of_the_summary(page, solution):
    numbers, found = op.summary(solution), rows(page)
    assert found["Force on the layer"][0][1:3] == [f"{-1e3 * numbers['force_sample_N'][2]:.4g}", "mN"]
    assert found["Largest pressure"][0][1:3] == [f"{numbers['pressure_max_kPa']:.3g}", "kPa"]
    assert found["High pressure"][0][1] == f"{numbers['pressure_p99_kPa']:.3g}"
    assert found["Mean pressure"][0][1] == f"{numbers['pressure_mean_touching_kPa']:.3g}"
    for prefix, other in (("", "sample"), ("window_", "window")):
        areas = " / ".join(f"{numbers[f'{prefix}{state}_area_mm2']:.3g}" for state in ("open", "stick", "slip"))
        assert found[f"Contact with the {other}"][0][1:3] == [areas, "mm²"]
    assert found["Compression, mean"][0][1] == f"{numbers['compression_mean_percent']:.3g}"
    assert found["Compression, largest"][0][1] == f"{numbers['compression_max_percent']:.3g}"
    assert found["What the computation misses"][0][1:3] == [f"{numbers['residual_rms_um']:.2g}", "µm"]
    assert found["Increments, Newton steps"][0][1] == f"{numbers['increments_count']}, {numbers['newton_steps_count']}"
    assert found["Smallest volume ratio"][0][1] == f"{numbers['min_volume_ratio']:.3f}"
    assert float(found["Stored as strain energy"][0][1]) == pytest.approx(
        1e3 * float(solution.stats["strain_energy"]), rel=1e-3
    )


def test_given_or_assumed(page, dataset, tmp_path):
    assert "does not record which inputs were given" in words(page)
    recorded = dataset.assign_attrs(
        assumed=json.dumps(["layer.material.c10", "elements"]),
        assumptions=json.dumps(["D = 0 means K/µ = 20"]),
        command="opfem palpate map.mat",
    )
    page = written(recorded, tmp_path / "report.html")
    found = rows(page)
    assert found["C10"] == [["Layer", "C10", "2.23 kPa", "assumed"]]
    assert found["C01"] == [["Layer", "C01", "0.703 kPa", "given"]]
    assert [cells[0] for cells in found["friction coefficient"]] == ["Window", "Sample"]
    said = "Assumed, because nobody said otherwise. Layer: C10; D = 0 means K/µ = 20. Are they yours?"
    assert said in words(page)
    assert words(page).count("D = 0 means K/µ = 20") == 2
    assert found["Command line"] == [["Command line", "opfem palpate map.mat"]]


def test_sources(page, dataset):
    found = rows(page)
    assert found["Inputs, SHA-256"][0][1] == dataset.attrs["inputs_sha256"]
    assert f"opfem {dataset.attrs['opfem_version']}" in found["Versions"][0][1]
    for paper in ("Optics Letters 39, 3014 (2014)", "20160878 (2017)", "J. Biophotonics (2024)"):
        assert paper in words(page)


def test_names_of_files_are_no_code(dataset, tmp_path):
    name = '</script><script>alert("x")</script><b>.mat'
    page = written(dataset.assign_attrs(command=f"opfem palpate '{name}'", status_message=name), tmp_path / "a.html")
    assert name not in page
    assert "<b>" not in page
    assert name in html.unescape(page)
    assert page.count("<script") == 4


def test_stored_result_gives_the_same_page(page, dataset, loaded, tmp_path):
    op.write_netcdf(dataset, tmp_path / "result.nc")
    again = written(op.read_netcdf(tmp_path / "result.nc"), tmp_path / "report.html", loaded)
    undated = re.compile(r"Report written</th><td[^>]*>[^<]*")
    assert undated.sub("", again) == undated.sub("", page)


def test_open_and_missing_are_marked(dataset, loaded, tmp_path):
    status = dataset["contact_status"].copy(deep=True)
    status[:3, :3] = 0
    page = written(dataset.assign(contact_status=status), tmp_path / "report.html", loaded)
    assert "the layer does not touch the sample" in words(page)
    assert "not measured" in words(page)
    drawn = plots(page)
    for name in ("pressure", "residual"):
        assert len(drawn[f"map-{name}"]["data"]) == 2
    whole = loaded.filled() if not loaded.is_filled else loaded
    everywhere = op.ThicknessMap(whole.values, extent=whole.extent)
    plain = written(dataset, tmp_path / "plain.html", everywhere)
    assert "not measured;" not in words(plain)
    assert "does not touch" not in words(plain)
    assert len(plots(plain)["map-pressure"]["data"]) == 1


def test_large_map_is_thinned_and_says_so(dataset, tmp_path):
    fine = op.ThicknessMap(np.full((2 * MOST_PIXELS, 300), 0.45), extent=(2.0, 2.0))
    page = written(dataset, tmp_path / "report.html", fine)
    assert "Every 2nd pixel of the map is drawn" in words(page)
    assert plots(page)["map-thickness"]["data"][0]["z"]["shape"] == f"{MOST_PIXELS}, 150"


def test_status_reads_in_grey():
    light = [
        int(colour[1:3], 16) * 0.3 + int(colour[3:5], 16) * 0.59 + int(colour[5:], 16) * 0.11
        for colour in STATUS_COLOURS
    ]
    assert min(abs(a - b) for n, a in enumerate(light) for b in light[:n]) > 30


def test_experiment(truth, tmp_path):
    page = written(truth, tmp_path / "report.html")
    assert "the computed truth" in words(page)
    assert "map-residual" not in plots(page)
    found = rows(page)
    assert [cells[0] for cells in found["friction coefficient"]] == ["Window", "Layer on sample", "Plate"]
    assert found["approach of plate and window"][0][2] == "0.2 mm"
    seen = op.measured_thickness(truth, spacing=0.1, std=1e-3, seed=1)
    page = written(truth, tmp_path / "seen.html", seen)
    assert "Thickness, as it would be measured" in words(page)
    assert "map-residual" not in plots(page)  # it would be the noise


def test_energies_over_time_are_drawn(dataset, page, tmp_path):
    assert "energy" not in plots(page)
    time = np.linspace(0.0, 1.0, 5)
    names = ("strain", "kinetic", "contact", "friction", "viscous", "damping", "external")
    energies = {f"energy_{name}": ("output", (number + 1) * 1e-3 * time) for number, name in enumerate(names)}
    ratios = {"kinetic_ratio": 4e-3, "energy_drift": 1e-3}
    explicit = dataset.assign(output_time=("output", time), **energies, **{k: ((), v) for k, v in ratios.items()})
    page = written(explicit, tmp_path / "report.html")
    drawn = plots(page)["energy"]
    assert len(drawn["data"]) == len(names)
    assert drawn["layout"]["yaxis"]["title"]["text"] == "energy [µJ]"
    assert 'id="energy"' in page
    assert rows(page)["Kinetic energy"][0][1:3] == ["0.4", "%"]
    assert rows(page)["Time increments"][0][1] == f"{int(dataset['increments'])}"


def test_fit_shows_its_uncertainty(fitted, loaded, tmp_path):
    page = written(fitted, tmp_path / "report.html", loaded)
    drawn, found = plots(page), rows(page)
    assert "map-uncertainty" in drawn
    assert [curve["meta"]["stds"] for curve in drawn["section"]["data"]] == [0, 0, -2.0, 2.0, 0]
    assert found["Resolution"][0][1:3] == ["300", "µm"]
    assert found["correlation length"][0][2] == "0.5 mm"
    assert "far from 1" in words(page)
    # Without the map, what a fit misses is its own residual, which is computed less measured.
    alone = written(fitted.drop_vars(["imposed_thickness", "missing"]), tmp_path / "alone.html")
    assert plots(alone)["map-residual"]["data"][0]["z"]["shape"] == "7, 7"
    assert rows(alone)["What the computation misses"][0][1:3] == ["2", "µm"]
    assert "Thickness, computed" in words(alone)


def test_warnings_are_passed_on(solution, loaded, tmp_path):
    noisy = op.ThicknessMap(loaded.values - 0.02, extent=loaded.extent, std=1e-3)
    page = written(solution, tmp_path / "report.html", noisy)
    (warning,) = op.summary(solution, noisy)["warnings"]
    assert f'<li class="care">{html.escape(warning)}</li>' in page


def test_failed_solve_is_refused(failed_solution, tmp_path):
    with pytest.raises(ValueError, match="did not converge"):
        op.write_report(failed_solution, tmp_path / "report.html")
    assert list(tmp_path.iterdir()) == []
    assert isinstance(op.to_xarray(failed_solution), xr.Dataset)


def test_pixels_beyond_the_unloaded_layer_have_no_compression(solution, tmp_path):
    """As in the decks, whose surfaces are wider than the layer."""
    wide = op.ThicknessMap(np.full((111, 111), 0.45), extent=(2.2, 2.2), origin=(-0.1, -0.1))
    numbers, text = op.summary(solution, wide), written(op.to_xarray(solution), tmp_path / "report.html", wide)
    assert f"compressed by up to {numbers['compression_max_percent']:.0f} %" in text
