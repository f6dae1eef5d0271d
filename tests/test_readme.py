"""The README's commands and Python run as they stand, on a map of the reader's own in the folder they start from."""

import re
import shlex

import pytest

from opfem.cli import main
from tests.documents import ROOT, blocks, own_files

README = ROOT / "README.md"


def test_python():
    (code,) = blocks(README, "python")
    assert len(code.strip().splitlines()) <= 8
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    assert 0 < float(names["data"].pressure.mean()) < 0.1


def test_commands(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    own_files()
    run_here = [line for block in blocks(README, "sh") for line in block.splitlines() if line.startswith("opfem ")]
    assert run_here
    for line in run_here:
        with pytest.raises(SystemExit) as end:
            main(shlex.split(line)[1:])
        assert end.value.code in (0, None)
    assert (tmp_path / "stress_map" / "result.nc").exists()


def test_the_first_two_commands_are_those_of_ci():
    install, tests = (block.strip() for block in blocks(README, "sh")[:2])
    ci = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert f"({install})" in ci
    assert f"({tests})" in ci


def test_readme_is_short_and_its_links_lead_somewhere():
    text = README.read_text(encoding="utf-8")
    assert len(text.split()) <= 700
    links = [link for link in re.findall(r"\]\(([^)#]+)", text) if not link.startswith("http")]
    assert len(links) > 8
    assert [link for link in links if not (ROOT / link).exists()] == []
