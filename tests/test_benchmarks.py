"""Figures of benchmarks: the page is made of the stored numbers, and every number says where it comes from."""

import json
import re
import subprocess
import sys

import pytest

from benchmarks import record, tables
from tests.documents import ROOT

FIGURES = [(name, figure) for name, subject in tables.subjects().items() for figure in subject["figures"]]
KEYS = {"what", "value", "unit", "ratio", "peer", "program", "commit", "date", "machine", "load", "note"}


def test_readme_is_made_of_the_stored_figures():
    assert tables.README.read_text(encoding="utf-8") == tables.render(), "run python -m benchmarks.tables"


@pytest.mark.parametrize(("subject", "figure"), FIGURES)
def test_figure_says_where_it_comes_from(subject, figure):
    assert set(figure) <= KEYS
    assert {"what", "value", "unit", "machine"} <= set(figure)
    assert ("ratio" in figure) == ("peer" in figure)
    assert figure["machine"] in tables.machines()
    if "program" in figure:
        assert (ROOT / "benchmarks" / figure["program"].split()[0]).exists()
    if "commit" in figure:
        assert re.fullmatch(r"[0-9a-f]{7}", figure["commit"])
    if "date" in figure:
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", figure["date"])


def test_spread_is_of_the_lines_that_have_the_number():
    rows = [{"seconds": 3.0}, {"seconds": 2.5}, {"other": 1.0}, {"seconds": None}]
    assert record.spread(rows, "seconds") == [2.5, 3.0]
    assert record.spread(rows, "other") == 1.0
    with pytest.raises(SystemExit, match="no line holds 'missing'"):
        record.spread(rows, "missing")


def test_a_figure_is_replaced_in_its_place():
    old = [{"what": "a", "value": 1}, {"what": "b", "value": 2}]
    assert record.stored(old, {"what": "a", "value": 3}) == [{"what": "a", "value": 3}, old[1]]
    assert record.stored(old, {"what": "c", "value": 3}) == [*old, {"what": "c", "value": 3}]


def test_lines_are_stored_and_pass_through(tmp_path, monkeypatch, capsys):
    (tmp_path / "machines.json").write_text('{"here": "a machine"}')
    (tmp_path / "coin.json").write_text(json.dumps({"title": "Coin", "text": "", "figures": []}))
    for module in (record, tables):
        monkeypatch.setattr(module, "RESULTS", tmp_path)
    monkeypatch.setattr(record, "commit", lambda: "0123456")
    monkeypatch.setattr(
        sys, "stdin", ["starting\n", '{"seconds": 2.0, "over": 20}\n', '{"seconds": 3.0, "over": 22}\n']
    )
    options = (
        "record coin --key seconds --unit s --what solve --program coin.py --machine here --ratio over --peer of-ccx"
    )
    monkeypatch.setattr(sys, "argv", options.split())
    record.main()
    assert capsys.readouterr().out.startswith("starting\n")
    (figure,) = json.loads((tmp_path / "coin.json").read_text())["figures"]
    assert (figure["value"], figure["ratio"], figure["peer"]) == ([2.0, 3.0], [20.0, 22.0], "of-ccx")
    assert figure["commit"] == "0123456"
    assert "| solve | 2 to 3 s | 20 to 22 of-ccx |" in tables.row(figure)


def test_program_runs_as_the_page_says():
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.record", "--help"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0
    assert "--key" in done.stdout
