"""A file is written whole or not at all."""

import errno
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from opfem.io import atomic, finish, take_place, whole_file, write_together

NAMES = ("points", "picture.png", "fit.png", "summary.json", "result.nc")
OLD = {"fit.png": b"old fit", "summary.json": b"old numbers", "result.nc": b"old result"}
NEW = {"picture.png": b"new picture", "summary.json": b"new numbers", "result.nc": b"new result"}


def contents(folder) -> dict[str, bytes]:
    """Read every file of a folder, hidden ones too."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def old_result(folder) -> Path:
    for name, content in OLD.items():
        (folder / name).write_bytes(content)
    return folder


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


@pytest.mark.parametrize("number", [errno.EINVAL, errno.ENOTSUP, errno.ENOSYS, errno.EBADF, errno.EACCES])
def test_a_folder_that_cannot_be_flushed_is_no_error(tmp_path, monkeypatch, number):
    flush = os.fsync

    def refuse(handle):
        if os.path.isdir(f"/proc/self/fd/{handle}"):
            raise OSError(number, os.strerror(number))
        flush(handle)

    monkeypatch.setattr(os, "fsync", refuse)
    with whole_file(tmp_path / "a.txt") as temporary:
        temporary.write_text("new")
    write_together(tmp_path, NEW, NAMES)
    assert contents(tmp_path) == {"a.txt": b"new", **NEW}


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_a_file_that_did_not_reach_the_disk_is_an_error(tmp_path, monkeypatch, number):
    def fail(handle):
        raise OSError(number, os.strerror(number))

    def write():
        with whole_file(tmp_path / "a.txt") as temporary:
            temporary.write_text("new")

    (tmp_path / "a.txt").write_text("old")
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="full" if number == errno.ENOSPC else "Input/output"):
        write()
    assert contents(tmp_path) == {"a.txt": b"old"}


class TestLinks:
    def test_a_link_is_followed_and_stays(self, tmp_path):
        (tmp_path / "elsewhere").mkdir()
        (tmp_path / "elsewhere" / "a.txt").write_text("old")
        (tmp_path / "link.txt").symlink_to(Path("elsewhere") / "a.txt")
        with whole_file(tmp_path / "link.txt") as temporary:
            temporary.write_text("new")
        assert (tmp_path / "link.txt").is_symlink()
        assert contents(tmp_path / "elsewhere") == {"a.txt": b"new"}

    def test_a_link_to_a_file_that_is_not_there_yet(self, tmp_path):
        (tmp_path / "link.txt").symlink_to("a.txt")
        with whole_file(tmp_path / "link.txt") as temporary:
            temporary.write_text("new")
        assert (tmp_path / "link.txt").is_symlink()
        assert (tmp_path / "a.txt").read_text() == "new"

    def test_a_link_into_a_folder_that_is_not_there(self, tmp_path):
        (tmp_path / "link.txt").symlink_to("none/a.txt")
        with pytest.raises(FileNotFoundError, match="none does not exist"), whole_file(tmp_path / "link.txt"):
            pass

    def test_a_linked_folder_of_results(self, tmp_path):
        (tmp_path / "scratch").mkdir()
        (tmp_path / "out").symlink_to("scratch")
        write_together(tmp_path / "out", NEW, NAMES)
        assert contents(tmp_path / "scratch") == NEW


class TestResults:
    def test_the_new_takes_the_place_of_the_old(self, tmp_path):
        (old_result(tmp_path) / "notes.txt").write_text("mine")
        write_together(tmp_path, NEW, NAMES)
        assert contents(tmp_path) == {**NEW, "notes.txt": b"mine"}
        assert sorted(os.listdir(tmp_path)) == sorted([*NEW, "notes.txt"])

    def test_a_folder_in_a_result_is_replaced_as_a_whole(self, tmp_path):
        for folder, content in ((tmp_path, "old"), (tmp_path / "staged", "new")):
            (folder / "points").mkdir(parents=True)
            (folder / "points" / content).write_text(content)
        take_place(tmp_path, tmp_path / "staged", NAMES)
        assert contents(tmp_path) == {"points/new": b"new"}

    @pytest.mark.parametrize("call", ["mkdir", "write_bytes"])
    def test_a_full_disk_leaves_the_old_result(self, tmp_path, monkeypatch, call):
        def full(*_, **__):
            raise OSError(errno.ENOSPC, "No space left on device")

        old_result(tmp_path)
        with monkeypatch.context() as patched:
            patched.setattr(Path, call, full)
            with pytest.raises(OSError, match=r"The disk is full: 2\.4 MB are needed") as raised:
                write_together(tmp_path, {"result.nc": bytes(2_400_000)}, NAMES)
        assert raised.value.errno == errno.ENOSPC
        assert contents(tmp_path) == OLD

    @pytest.mark.parametrize("step", range(8))
    def test_killed_at_any_step_the_old_or_the_new_is_whole(self, tmp_path, step):
        """Eight names change, of six files and two folders; the process dies before one of them."""
        old_result(tmp_path)
        with pytest.MonkeyPatch.context() as patched:
            die_before(step, patched)
            with pytest.raises(KilledError):
                write_together(tmp_path, NEW, NAMES)
        seen = visible(tmp_path)
        assert "result.nc" not in seen or seen in (OLD, NEW)  # what is there belongs together
        finish(tmp_path, NAMES)
        assert visible(tmp_path) == (OLD if step == 0 else NEW)

    def test_killed_again_while_it_is_completed(self, tmp_path):
        old_result(tmp_path)
        for step in (3, 1, 1, 0, 2):
            with pytest.MonkeyPatch.context() as patched:
                die_before(step, patched)
                with pytest.raises(KilledError):
                    finish(tmp_path, NAMES) if step != 3 else write_together(tmp_path, NEW, NAMES)
        finish(tmp_path, NAMES)
        assert visible(tmp_path) == NEW

    def test_what_a_killed_process_left_is_removed_in_the_end(self, tmp_path):
        for name, age in ((".opfem-new-0", 7200.0), (".opfem-new-1", 0.0)):
            (tmp_path / name).mkdir()
            os.utime(tmp_path / name, (time.time() - age,) * 2)
        write_together(tmp_path, NEW, NAMES)
        assert sorted(os.listdir(tmp_path)) == [".opfem-new-1", *sorted(NEW)]


class KilledError(BaseException):
    """The process is killed: it tidies nothing."""


def die_before(step: int, patched: pytest.MonkeyPatch) -> None:
    """Die when names have changed so many times."""
    left = [step]

    def dying(change):
        def changed(source, target):
            if left[0] == 0:
                raise KilledError
            if Path(source).exists():
                left[0] -= 1
            change(source, target)

        return changed

    for name in ("replace", "rename"):
        patched.setattr(os, name, dying(getattr(os, name)))
    patched.setattr(atomic.shutil, "rmtree", lambda *_, **__: None)


def visible(folder) -> dict[str, bytes]:
    """Read the files of a folder that are not hidden in another."""
    return {name: content for name, content in contents(folder).items() if not name.startswith(".")}
