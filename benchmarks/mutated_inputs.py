"""Mutate input files by the thousand and read them: each ends in the right map, a warning, or one line of refusal.

`python benchmarks/mutated_inputs.py --count 20000` prints a table by format. A mutant is made by its format and
number alone, so that `--only csv:1234` makes it again and says what became of it. Every mutant is read in a worker
process that ends after 10 s of silence.
"""

import argparse
import collections
import contextlib
import io
import json
import os
import resource
import select
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
import scipy.io
import tifffile

import opfem as op
from opfem.measurement import MeasurementError, MeasurementWarning

SHAPE, EXTENT = (20, 30), (2.9, 1.9)  # square pixels of 0.1 mm
LONGEST, LARGEST = 10.0, 2**30  # s, bytes
OUTCOMES = ("right", "warned", "refused", "numbers", "grid", "traceback", "hang", "memory")
BAD = ("grid", "traceback", "hang", "memory")
MEANING = """right: the same map, or the same statement of a sweep. warned: read, and what was odd was named.
refused: in one line. numbers: the same grid, other numbers of plausible size, which nothing in such a file tells.
Never: grid (changed without a word), traceback (or a refusal of several lines), hang (10 s), memory (1 GiB)."""


class Verdict(NamedTuple):
    """What became of a mutant: one of OUTCOMES, and what was said."""

    outcome: str
    said: str


def true_map() -> np.ndarray:
    """A map with noise [mm], in steps of 0.1 µm."""
    x, y = np.meshgrid(np.linspace(0, EXTENT[0], SHAPE[1]), np.linspace(0, EXTENT[1], SHAPE[0]))
    dent = 0.07 * np.exp(-((x - 1.3) ** 2 + (y - 1.0) ** 2) / 0.4)
    return np.round(0.45 - dent + 0.003 * np.random.default_rng(0).standard_normal(SHAPE), 4)


def _mat5(path: Path, rng: np.random.Generator) -> None:
    struct = {"operator": "me", "power": 1.5, "b_scan": np.arange(40.0).reshape(5, 8)}
    contents = {"note": "left eye", "L1": true_map(), "scan": struct, "used": np.array([[True, False]])}
    scipy.io.savemat(path, contents, do_compression=bool(rng.integers(2)))


def _mat73(path: Path, rng: np.random.Generator) -> None:
    chunks = [{}, {"chunks": True, "compression": "gzip"}, {"chunks": (7, 9), "fletcher32": True}][rng.integers(3)]
    with h5py.File(path, "w", userblock_size=512) as file:
        file.create_dataset("L1", data=true_map().T, **chunks).attrs["MATLAB_class"] = np.bytes_("double")
        file.create_dataset("dx", data=[[0.1]]).attrs["MATLAB_class"] = np.bytes_("double")
        file.create_group("scan").create_dataset("b_scan", data=np.ones((3, 4)))
    with open(path, "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\x00\x02IM")


def _npy(path: Path, rng: np.random.Generator) -> None:
    np.save(path, true_map().astype(rng.choice(["<f8", ">f8"])))


def _npz(path: Path, rng: np.random.Generator) -> None:
    save = np.savez_compressed if rng.integers(2) else np.savez
    save(path, L1=true_map(), note="left eye", power=1.5)


def _tif(path: Path, rng: np.random.Generator) -> None:
    how = [{}, {"compression": "zlib"}, {"rowsperstrip": 4}, {"bigtiff": True}][rng.integers(4)]
    if rng.integers(4) == 0:
        how = {"imagej": True, "resolution": (10.0, 10.0), "metadata": {"unit": "mm"}}
    tifffile.imwrite(path, true_map().astype("f4"), photometric="minisblack", **how)


def _csv(path: Path, rng: np.random.Generator) -> None:
    rows = [[f"{value:.4f}" for value in row] for row in true_map()]
    x, y = ([f"{0.1 * index:.1f}" for index in range(count)] for count in SHAPE[::-1])
    mark = rng.choice([",", ";", "\t", " "])
    match rng.integers(6):
        case 0:
            rows = [["y\\x", *x], *([where, *row] for where, row in zip(y, rows, strict=True))]
        case 1:
            rows = [[f"V{index}" for index in range(SHAPE[1])], *rows]
        case 2:
            rows = [[x[i], y[j], rows[j][i]] for j in range(SHAPE[0]) for i in range(SHAPE[1])]
        case 3 if mark != ",":
            rows = [[cell.replace(".", ",") for cell in row] for row in rows]
    path.write_text("# thickness in mm\n" * int(rng.integers(2)) + "".join(mark.join(row) + "\n" for row in rows))


def _toml(path: Path, rng: np.random.Generator) -> None:
    np.save(path.parent / "map.npy", true_map())
    path.write_text(
        '[inputs]\nmap = "map.npy"\nextent = [2.9, 1.9]\nl0 = 0.5\nelements = [4, 4, 2]\nsmooth = 0.0\nbulk = 0.1\n'
        "\n[axes]\n"
        'c10 = { from = 2.0, to = 4.0, points = 3, log = true, unit = "kPa" }\nwindow_friction = [0.0, 0.15]\n'
        '\n[outputs]\nkeep = ["max_pressure", "force_sample"]\n\n[execution]\nmode = "map"\nsize = 1\n'
    )


FORMATS: dict[str, tuple[str, Callable[[Path, np.random.Generator], None]]] = {
    "mat v5": (".mat", _mat5),
    "mat v7.3": (".mat", _mat73),
    "npy": (".npy", _npy),
    "npz": (".npz", _npz),
    "tif": (".tif", _tif),
    "csv": (".csv", _csv),
    "toml": (".toml", _toml),
}


def _flipped(whole: bytes, rng: np.random.Generator) -> bytes:
    """Change 1 to 8 bytes; half of the time near the start, where headers are."""
    changed = bytearray(whole)
    reach = min(len(whole), 1024) if rng.integers(2) else len(whole)
    for place in rng.integers(reach, size=rng.integers(1, 9)):
        changed[place] = rng.integers(256)
    return bytes(changed)


def _truncated(whole: bytes, rng: np.random.Generator) -> bytes:
    return whole[: rng.integers(1, len(whole))]


def _extended(whole: bytes, rng: np.random.Generator) -> bytes:
    start = rng.integers(len(whole))
    more = [rng.bytes(rng.integers(1, 200)), bytes(int(rng.integers(1, 200))), whole[start : start + 200]][
        rng.integers(3)
    ]
    place = len(whole) if rng.integers(2) else int(rng.integers(len(whole)))
    return whole[:place] + more + whole[place:]


def _with_other_delimiters(whole: bytes, rng: np.random.Generator) -> bytes:
    """Replace, double or drop a delimiter: one of them, or every one."""
    old = rng.choice([mark for mark in (b",", b";", b"\t", b" ", b"\n", b".", b"=", b"[") if mark in whole])
    new = rng.choice([b",", b";", b"\t", b" ", b"", bytes(old) + bytes(old), b"\n", b"|"])
    if rng.integers(2):
        return whole.replace(bytes(old), bytes(new))
    places = [index for index in range(len(whole)) if whole[index : index + 1] == bytes(old)]
    place = rng.choice(places)
    return whole[:place] + bytes(new) + whole[place + 1 :]


def _with_other_lines(whole: bytes, rng: np.random.Generator) -> bytes:
    """Drop, repeat, empty or add a line; the first half of the time, where the header is."""
    lines = whole.split(b"\n")
    place = 0 if rng.integers(2) else int(rng.integers(len(lines)))
    new = [[], [lines[place]] * 2, [b""], [b"x,y", lines[place]], [b"1;2;3", lines[place]], [b"#", lines[place]]]
    return b"\n".join([*lines[:place], *new[rng.integers(len(new))], *lines[place + 1 :]])


def _with_other_cells(whole: bytes, rng: np.random.Generator) -> bytes:
    """Replace a number by something else that is found in cells."""
    places = [
        index
        for index in range(1, len(whole))
        if whole[index - 1 : index] in b",;\t\n [" and whole[index : index + 1].isdigit()
    ]
    if not places:
        return _flipped(whole, rng)
    start = int(rng.choice(places))
    end = start
    while whole[end : end + 1] not in (b",", b";", b"\t", b"\n", b" ", b"]", b""):
        end += 1
    words = [
        b"",
        b"NaN",
        b"#N/A",
        b"-",
        b'"',
        b'"0.4"',
        b"1e999",
        b"-1",
        b"x",
        b"0,4",
        b"9999",
        b"true",
        b"0x1F",
        b"\xff",
    ]
    return whole[:start] + words[rng.integers(len(words))] + whole[end:]


def mutant(name: str, number: int, folder: Path) -> Path:
    """Write one mutant; a format and number always make the same."""
    suffix, write = FORMATS[name]
    rng = np.random.default_rng([list(FORMATS).index(name), number])
    path = folder / f"mutant{suffix}"
    write(path, rng)
    changes = [_flipped, _truncated, _extended]
    if suffix in (".csv", ".toml"):
        changes += [_with_other_delimiters, _with_other_lines, _with_other_cells]
    path.write_bytes(changes[rng.integers(len(changes))](path.read_bytes(), rng))
    return path


def read_map(path: Path) -> Verdict:
    """Read a mutated map and judge what comes out."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        try:
            read = op.read_thickness(path, extent=EXTENT)
        except MeasurementError as refusal:
            return Verdict("refused" if "\n" not in str(refusal) else "traceback", str(refusal))
        except Exception as cause:  # what the table counts
            return Verdict("traceback", f"{type(cause).__name__}: {cause}")
    odd = [str(warning.message) for warning in said if issubclass(warning.category, MeasurementWarning)]
    other = [f"{warning.category.__name__}: {warning.message}" for warning in said if str(warning.message) not in odd]
    if other:
        return Verdict("traceback", other[0])
    if odd:
        return Verdict("warned", " | ".join(odd))
    if read.shape != SHAPE:
        return Verdict("grid", f"shape {read.shape}")
    values = np.asarray(read.values)
    same = np.allclose(values, true_map(), rtol=1e-6) and not np.any(read.mask)
    return Verdict(
        "right" if same else "numbers", f"{int(np.sum(~np.isclose(values, true_map(), 1e-6)))} pixels differ"
    )


class _Accepted(BaseException):
    """A sweep was about to compute."""


def read_config(path: Path) -> Verdict:
    """Hand a mutated file to `opfem sweep`, up to where it would compute, and judge what it says."""
    import opfem.cli
    from opfem.cli import sweep as command

    def stop(function: Callable, points: object, **_: object) -> None:
        raise _Accepted(repr(points))

    said = io.StringIO()
    real, command.compute = command.compute, stop
    with tempfile.TemporaryDirectory() as out, contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
        try:
            opfem.cli.main(["sweep", str(path), "--out", str(Path(out) / "sweep")])
        except _Accepted:
            lines = [line for line in said.getvalue().splitlines() if line.startswith("opfem: ")]
            same = "right" if _is_same_statement(path) else "numbers"
            return Verdict("warned" if lines else same, " | ".join(lines))
        except SystemExit:
            text = said.getvalue()
            refusal = text[text.find("opfem: ") :].strip()
            one_line = text.count("opfem: ") == 1 and "\n" not in refusal and "Traceback" not in text
            is_expected = one_line and "Unexpected" not in refusal
            return Verdict("refused" if is_expected else "traceback", refusal or text)
        except Exception as cause:  # what the table counts
            return Verdict("traceback", f"{type(cause).__name__}: {cause}")
        finally:
            command.compute = real
    return Verdict("traceback", "ended without a word")


def _is_same_statement(path: Path) -> bool:
    import tomllib

    with tempfile.TemporaryDirectory() as folder:
        original = Path(folder) / "original.toml"
        _toml(original, np.random.default_rng())
        return tomllib.loads(original.read_text()) == tomllib.loads(path.read_text(encoding="utf-8-sig"))


def judge(name: str, number: int) -> Verdict:
    """Make one mutant, read it, and judge what comes out."""
    with tempfile.TemporaryDirectory() as folder:
        path = mutant(name, number, Path(folder))
        return (read_config if name == "toml" else read_map)(path)


def work() -> None:
    """Judge mutants named on standard input, one a line, and write verdicts as JSON."""
    import jax

    jax.config.update("jax_enable_x64", True)
    answers = os.fdopen(os.dup(1), "w")
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        name, number = json.loads(line)
        verdict = judge(name, number)
        peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        print(json.dumps([*verdict, peak]), file=answers, flush=True)


class _Worker:
    def __init__(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, __file__, "--work"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
        )
        assert self.process.stdout is not None
        self.process.stdout.readline()  # it has started, which may take longer than a mutant may

    def judge(self, name: str, number: int) -> Verdict:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write((json.dumps([name, number]) + "\n").encode())
        ready, _, _ = select.select([self.process.stdout], [], [], LONGEST)
        line = self.process.stdout.readline() if ready else b""
        if not line:
            self.process.kill()  # where it has not died
            ended = self.process.wait()
            self.__init__()
            return Verdict("traceback", f"died: {ended}") if ready else Verdict("hang", "no answer in 10 s")
        outcome, said, peak = json.loads(line)
        if peak > LARGEST:
            self.process.kill()
            self.process.wait()
            self.__init__()
            return Verdict("memory", f"{peak / 2**20:.0f} MiB, {outcome}: {said}")
        return Verdict(outcome, said)


def verdicts(count: int) -> Iterator[tuple[str, int, Verdict]]:
    """Judge `count` mutants, the formats taking turns."""
    worker = _Worker()
    names = list(FORMATS)
    for index in range(count):
        name, number = names[index % len(names)], index // len(names)
        yield name, number, worker.judge(name, number)
    worker.process.kill()
    worker.process.wait()


def _of_workers() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--count", type=int, default=20000)
    asked.add_argument("--only", help="format:number of one mutant")
    asked.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    chosen = asked.parse_args()
    if chosen.work:
        return work()
    if chosen.only:
        name, number = chosen.only.split(":")
        print(*judge(name, int(number)), sep=": ")
        return None
    start, table = time.process_time(), {name: collections.Counter() for name in FORMATS}
    for name, number, verdict in verdicts(chosen.count):
        table[name][verdict.outcome] += 1
        if verdict.outcome in BAD:
            print(f"{name}:{number} {verdict.outcome}: {verdict.said[:300]}", flush=True)
    print(f"{'format':10}", *(f"{outcome:>9}" for outcome in OUTCOMES))
    for name, counts in table.items():
        print(f"{name:10}", *(f"{counts[outcome]:9}" for outcome in OUTCOMES))
    print(MEANING, f"{time.process_time() - start + _of_workers():.0f} CPU s.")
    return None


if __name__ == "__main__":
    main()
