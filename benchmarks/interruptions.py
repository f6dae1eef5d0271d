"""What is left of a finished result when its replacement is killed, or the disk is full, at a random moment.

Run `python benchmarks/interruptions.py`, as root or where `unshare -rm` is allowed: it mounts a small tmpfs. For
palpate, fit and sweep with --force over a finished result it prints how often the old and how often the new result
was whole afterwards, and how often neither was, before and after the next command completes what was begun.
"""

import argparse
import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
from PIL import Image

import opfem as op
from opfem.cli.folder import RESULT
from opfem.cli.sweep import RESULT as SWEEP
from opfem.io import finish

FULL_MB = 12  # of the tmpfs: an old result, a new one beside it, and little more
OLD, NEW = 0.15, 0.25  # window friction of the old result and of the new one
POINTS = 3
CONFIG = """
[inputs]
map = "map.npy"
extent = [2.0, 2.0]
l0 = 0.5
elements = [6, 6, 1]
smooth = 0.2
window_friction = {friction}
[axes]
sample_friction = {{ from = 0.0, to = 0.1, points = {points} }}
[outputs]
keep = ["max_pressure", "pressure"]
"""
MAP = ("--extent", "2", "2", "--l0", "0.5", "--elements", "6", "6", "1", "--smooth", "0.2")


def command(name: str, friction: float, work: Path, out: Path) -> list[str]:
    """The command line that makes a result; `friction` tells the old one from the new one."""
    start = [sys.executable, "-m", "opfem", name]
    if name == "sweep":
        config = work / f"{friction}.toml"
        config.write_text(CONFIG.format(friction=friction, points=POINTS))
        return [*start, str(config), "--out", str(out), "--force"]
    own = ("--std", "0.002", "--draws", "2") if name == "fit" else ()
    arguments = (*MAP, *own, "--window-friction", str(friction), "--out", str(out), "--force")
    return [*start, str(work / "map.npy"), *arguments]


def visible(out: Path) -> dict[str, str]:
    """Hashes of the files that are not hidden."""
    files = (path for path in out.rglob("*") if path.is_file())
    named = {str(path.relative_to(out)): path for path in files}
    return {
        name: hashlib.sha256(path.read_bytes()).hexdigest()
        for name, path in named.items()
        if not any(part.startswith(".") for part in Path(name).parts)
    }


def is_new(name: str, out: Path, old: dict[str, str]) -> bool:
    """Whether a folder holds the new result, all of it, and nothing of the old one."""
    found = visible(out)
    if set(found.values()) & set(old.values()):
        return False
    try:
        data = op.read_netcdf(out / "result.nc")
        if name == "sweep":
            count = sum(path.startswith("points/") for path in found)
            return count == POINTS and "sweep.json" in found and (data.status == "successful").all().item()
        for path in out.glob("*.png"):
            with Image.open(path) as picture:
                picture.load()
        numbers = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        together = numbers["settings"]["window_friction"] == NEW and f'"friction": {NEW}' in data.attrs["window"]
        return together and {path.split("/")[0] for path in found} == {path.split("/")[0] for path in old}
    except (OSError, ValueError, KeyError):
        return False


def state(name: str, out: Path, old: dict[str, str]) -> str:
    if visible(out) == old:
        return "old"
    return "new" if is_new(name, out, old) else "neither"


def fill(folder: Path) -> Path:
    """Fill a disk to the last byte."""
    filler = folder / ".filler"
    with filler.open("wb", buffering=0) as file:
        for size in (1 << 20, 1 << 12, 1):
            try:
                while True:
                    file.write(bytes(size))
            except OSError:
                continue
    return filler


def trial(name: str, disaster: str, moment: float, work: Path, disk: Path, old: dict[str, str]) -> tuple[str, str, str]:
    """Let a disaster happen at a moment [s]; return the state before and after completion, and what was said."""
    out = disk / "out"
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(work / name / name, out)
    process = subprocess.Popen(command(name, NEW, work, out), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    filler = None
    try:
        process.wait(moment)
    except subprocess.TimeoutExpired:
        if disaster == "kill":
            process.kill()
        else:
            filler = fill(disk)
    _, said = process.communicate()
    before = state(name, out, old)
    if filler is not None:
        filler.unlink()
    finish(out, SWEEP if name == "sweep" else RESULT)
    return before, state(name, out, old), said.decode()


def main(commands: list[str], moments: int) -> None:
    work, disk = Path("interruptions").absolute(), Path("interruptions_disk").absolute()
    for folder in (work, disk):
        folder.mkdir(exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={FULL_MB}m", "tmpfs", disk], check=True)
    x, y = np.meshgrid(np.linspace(0.0, 2.0, 21), np.linspace(0.0, 2.0, 17))
    np.save(work / "map.npy", 0.5 * (0.93 - 0.06 * np.exp(-((x - 1.2) ** 2 + (y - 0.8) ** 2) / 0.3)))
    chance = random.Random(0)
    print("command  disaster  runs  old  new  neither  neither after completion  said what is needed  seconds")
    try:
        for name in commands:
            for friction, place in ((NEW, "compiled"), (OLD, name), (NEW, "timed")):
                begin = time.perf_counter()
                subprocess.run(command(name, friction, work, work / place / name), check=True, capture_output=True)
                took = time.perf_counter() - begin
            old = visible(work / name / name)
            for disaster in ("kill", "full"):
                counts: Counter[str] = Counter()
                for number in range(moments):
                    # Half of them while results are drawn and written, in the last third.
                    moment = took * (chance.uniform(0.0, 1.0) if number % 2 else chance.uniform(0.67, 1.05))
                    before, after, said = trial(name, disaster, moment, work, disk, old)
                    counts.update([before, f"then {after}"])
                    counts["said"] += "MB are needed" in said
                    if after == "neither" or "Traceback" in said:
                        print(f"{name} {disaster} at {moment:.2f} s: {after}\n{said}", file=sys.stderr)
                print(
                    f"{name:8s} {disaster:8s}  {moments:4d} {counts['old']:4d} {counts['new']:4d} "
                    f"{counts['neither']:8d} {counts['then neither']:25d} {counts['said']:20d} {took:8.1f}",
                    flush=True,
                )
    finally:
        subprocess.run(["umount", disk], check=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--commands", nargs="+", default=["palpate", "fit", "sweep"])
    parser.add_argument("--moments", type=int, default=20)
    arguments = parser.parse_args()
    if os.geteuid() != 0:
        os.execvp("unshare", ["unshare", "-rm", sys.executable, *sys.argv])
    main(arguments.commands, arguments.moments)
