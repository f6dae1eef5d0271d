"""A file is written whole or not at all."""

import os
import subprocess
import sys

import pytest

from opfem.io import whole_file


def test_writes(tmp_path):
    with whole_file(tmp_path / "a.txt") as temporary:
        assert temporary.suffix == ".txt"
        assert temporary.parent == tmp_path
        temporary.write_text("new")
        assert not (tmp_path / "a.txt").exists()
    assert (tmp_path / "a.txt").read_text() == "new"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_error_leaves_the_old_file(tmp_path):
    (tmp_path / "a.txt").write_text("old")

    def write_half():
        with whole_file(tmp_path / "a.txt") as temporary:
            temporary.write_text("half")
            raise RuntimeError("mid-way")

    with pytest.raises(RuntimeError, match="mid-way"):
        write_half()
    assert (tmp_path / "a.txt").read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_crash_leaves_the_old_file(tmp_path):
    target = tmp_path / "a.txt"
    target.write_text("old")
    code = (
        "import os, sys\nfrom opfem.io import whole_file\n"
        "with whole_file(sys.argv[1]) as temporary:\n"
        "    temporary.write_text('half')\n    os._exit(9)\n"
    )
    assert subprocess.run([sys.executable, "-c", code, str(target)], check=False).returncode == 9
    assert target.read_text() == "old"


def test_missing_folder_and_nothing_written(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"folder .* does not exist"), whole_file(tmp_path / "no" / "a.txt"):
        pass
    with pytest.raises(FileNotFoundError, match="Nothing was written"), whole_file(tmp_path / "a.txt"):
        pass
