"""A report as a reader meets it: opened in a browser without a network, pointed at, zoomed, its line dragged."""

import numpy as np
import pytest

import opfem as op
from opfem import cli
from tests.report.browser import CHROMIUM, run_in_page

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium; `apt install chromium` brings it")

PIXEL, HOLE = (6, 12), (3, 4)  # row and column of the map: under the bump, and where it holds no data
STATES = ("open", "sticks", "slips")

# What a reader does, in this order; the mouse is moved by the events that a browser sends.
_READER = """
const maps = [...document.querySelectorAll(".plot.map")];
const pressure = document.getElementById("map-pressure"), section = document.getElementById("section");
const at = (x, y) => {
  const box = pressure.querySelector(".nsewdrag").getBoundingClientRect(), {xaxis, yaxis} = pressure._fullLayout;
  return {clientX: box.left + xaxis.l2p(x), clientY: box.top + yaxis.l2p(y), bubbles: true, view: window};
};
pressure.scrollIntoView();
const under = ({clientX, clientY}) => document.elementFromPoint(clientX, clientY);
const mouse = (target, kind, where, buttons = 0) => target.dispatchEvent(new MouseEvent(kind, {...where, buttons}));
const said = () => Object.fromEntries(maps.map(
  div => [div.id.replace("map-", ""), div.querySelector(".hoverlayer").textContent]));
const point = async (x, y) => {
  const target = under(at(x, y));
  mouse(target, "mouseover", at(x, y));
  mouse(target, "mousemove", at(x, y));
  await wait(400);
  const shown = said();
  mouse(target, "mouseout", at(x, y));
  await wait(400);
  return shown;
};
const profile = () => ({
  words: document.getElementById("line-ends").textContent,
  pressure: [...section.data.find(curve => curve.meta.map === "pressure" && !curve.meta.stds).y],
});
const found = {shown: await point(...PIXEL), gone: said(), hole: await point(...HOLE), first: profile()};

const {x0, y0} = pressure.layout.shapes[0], there = at(...PIXEL);
mouse(under(at(x0, y0)), "mousedown", at(x0, y0), 1);
mouse(document, "mousemove", there, 1);
await wait(100);
mouse(document, "mouseup", there);
await wait(400);
found.dragged = profile();
found.lines = maps.map(div => div.layout.shapes.map(({x0, y0}) => [x0, y0])).flat();

const box = {"xaxis.range[0]": 0.5, "xaxis.range[1]": 1.5, "yaxis.range[0]": 1.6, "yaxis.range[1]": 0.6};
await Plotly.relayout(pressure, box);
await wait(200);
found.zoomed = maps.map(div => [div.layout.xaxis.range, div.layout.yaxis.range]);

const layer = document.getElementById("layer");
found.layer = {width: layer.querySelector("canvas").width, faces: layer.data.length};
return found;
"""


@pytest.fixture(scope="module")
def told(dataset, loaded, tmp_path_factory):
    scratch = tmp_path_factory.mktemp("report")
    op.write_report(dataset, scratch / "report.html", measured=loaded)
    places = {name: [float(loaded.x[column]), float(loaded.y[row])] for name, (row, column) in
              (("PIXEL", PIXEL), ("HOLE", HOLE))}  # fmt: skip
    script = _READER
    for name, place in places.items():
        script = script.replace(f"...{name}", f"...{place}")
    return run_in_page(scratch / "report.html", script, scratch)


@pytest.fixture
def found(told):
    return told["found"]


def test_nothing_is_complained_of_or_fetched(told):
    assert told["complaints"] == []
    assert told["requests"] == []


def test_every_map_says_its_value_where_one_is_pointed_at(found, dataset, loaded):
    x, y = float(loaded.x[PIXEL[1]]), float(loaded.y[PIXEL[0]])
    place = f"x {x:.2f}, y {y:.2f} mm"
    pressure = 1e3 * float(dataset["pressure_image"][PIXEL])
    measured, computed = 1e3 * float(loaded.values[PIXEL]), 1e3 * float(dataset["thickness"][PIXEL])
    node = round(PIXEL[0] * 6 / 16), round(PIXEL[1] * 6 / 20)  # the nearest, as the layer hardly moves sideways
    assert found["shown"] == {
        "thickness": f"{place}{measured:.1f} µm",
        "compression": f"{place}{100 * (1 - computed / 500):.2f} %",
        "pressure": f"{place}{pressure:.2f} kPa",
        "status": f"{place}{STATES[int(dataset['contact_status'][node])]}",
        "window_status": f"{place}{STATES[int(dataset['window_contact_status'][node])]}",
        "residual": f"{place}{measured - computed:.2f} µm",
    }
    assert set(found["gone"].values()) == {""}


def test_missing_pixel_says_no_thickness(found, loaded):
    assert bool(loaded.mask[HOLE])
    assert found["hole"]["thickness"] == found["hole"]["residual"] == ""
    assert "kPa" in found["hole"]["pressure"]


def test_line_is_dragged_and_the_section_follows(found, dataset, loaded):
    x, y = float(loaded.x[PIXEL[1]]), float(loaded.y[PIXEL[0]])
    assert found["first"]["words"].startswith("A (0.25, 1.00) mm to B (1.75, 1.00) mm, 1.50 mm long")
    assert found["dragged"]["words"].startswith(f"A ({x:.2f}, {y:.2f}) mm to B (1.75, 1.00) mm")
    np.testing.assert_allclose(found["lines"], np.broadcast_to([x, y], (12, 2)), atol=0.01)  # a pixel of the screen
    expected = 1e3 * float(dataset["pressure_image"][PIXEL])
    assert found["dragged"]["pressure"][0] == pytest.approx(expected, rel=0.02)  # a pixel of the screen beside it
    assert found["first"]["pressure"][0] != pytest.approx(expected, rel=0.1)


def test_zoom_is_shared(found):
    assert all(np.allclose(ranges, found["zoomed"][0]) for ranges in found["zoomed"])
    np.testing.assert_allclose(found["zoomed"][0], [[0.5, 1.5], [1.6, 0.6]], atol=0.05)


def test_layer_is_drawn_in_three_dimensions(found):
    assert found["layer"]["width"] > 300
    assert found["layer"]["faces"] == 6


# What any report shows once it is drawn: maps of one size, curves with values, the layer.
_LOOK = """
const maps = [...document.querySelectorAll(".plot.map")];
const drawn = maps.map(div => div.querySelector(".plot .xy, .cartesianlayer .plot").getBoundingClientRect());
return {
  names: maps.map(div => div.id.replace("map-", "")),
  sizes: drawn.map(({width, height}) => [Math.round(width), Math.round(height)]),
  curves: document.getElementById("section").data.map(({y}) => y.filter(value => value !== null).length),
  layer: document.querySelector("#layer canvas").width,
  paper: await printed(),
};
async function printed() {
  const image = document.getElementById("layer-on-paper");
  while (!image.naturalWidth) await wait(20);
  dispatchEvent(new Event("beforeprint"));
  return [getComputedStyle(image).display, getComputedStyle(document.getElementById("layer")).display];
}
"""
IMPRINT = ["thickness", "compression", "pressure", "status", "window_status", "residual"]


def looked_at(page, scratch, expected):
    told = run_in_page(page, _LOOK, scratch)
    assert told["complaints"] == told["requests"] == []
    found = told["found"]
    assert found["names"] == expected
    assert len({tuple(size) for size in found["sizes"]}) == 1
    assert min(found["curves"]) > 200
    assert found["layer"] > 300
    assert found["paper"] == ["block", "none"]


def test_fit_opens(fitted, loaded, tmp_path):
    op.write_report(fitted, tmp_path / "report.html", loaded)
    looked_at(tmp_path / "report.html", tmp_path, [*IMPRINT[:3], "uncertainty", *IMPRINT[3:]])


def test_experiment_opens(truth, tmp_path):
    op.write_report(truth, tmp_path / "report.html")
    looked_at(tmp_path / "report.html", tmp_path, IMPRINT[:-1])


@pytest.mark.slow
@pytest.mark.parametrize("which", ["example", "coin"])
def test_report_of_a_command_opens(which, tmp_path, request):
    map = "example"
    if which == "coin":
        map = request.getfixturevalue("shared") / "data" / "coin_5c_1-thickness.mat"
    given = ("--extent", "5", "5", "--l0", "0.5") if which == "coin" else ()
    with pytest.raises(SystemExit) as end:
        cli.main(["palpate", str(map), *given, "--out", str(tmp_path / "out")])
    assert end.value.code == 0
    page = tmp_path / "out" / "report.html"
    assert 5e6 < page.stat().st_size < 8e6
    looked_at(page, tmp_path, IMPRINT)
