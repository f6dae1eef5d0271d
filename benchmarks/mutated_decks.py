"""Damaged decks: each is read as what it says, or refused in one line with file and line number.

Run `python -m benchmarks.mutated_decks [--count 5000] [--seed 0]` in the repository's root. Decks are small ones as the
published toolbox, Abaqus/CAE and `write_inp` write them, for both codes, with bytes changed, lines dropped, repeated,
moved or cut off, and with fields, keywords and options replaced. Chunks run in processes of their own with limited
memory. Prints one JSON line; a mutant is made by the seed and its number alone. `--size 50` instead writes a
published-like deck of 50 MB and prints the time and memory that reading takes.
"""

import argparse
import json
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import jax
import numpy as np

import opfem as op
from tests.decks.texts import imprint_deck, stacked_deck, text
from tests.experiments import inclusion_experiment, published_palpation

CHUNK = 250
MEMORY = 2**30  # bytes that reading may take
SECONDS = 10
ODD = ("", "-1", "0", "1e400", "nan", "inf", "x", "1.5", "9" * 20, "4294967296", "-0.0", "1e-300", "ALL", "S7")
ODD += ("*Node", "a=b", "=", '"', "1 2", "é")
KEYWORDS = ("*Node", "*End Part", "*Step", "*End Step", "*Elset, elset=A", "*Include, input=deck.inp", "*Friction", "*")
LINE = re.compile(r"[\w.]+:\d+: [^\n]+")


def originals(folder: Path) -> list[bytes]:
    """Make the decks that are damaged."""
    x, y = np.meshgrid(np.arange(-2, 9) / 3, np.arange(-3, 9) / 3)
    loaded = op.Imprint(op.ThicknessMap(0.45 + 0.01 * np.sin(x) * y, spacing=1 / 3, origin=(-2 / 3, -1.0)))
    side = op.Contact(op.LinearOverclosure(10.0), 0.1, stick_slope=0.1)
    path = folder / "written.inp"
    decks = [text(imprint_deck()).encode(), text(stacked_deck()).encode()]
    op.write_inp(path, published_palpation(window=side, sample=side, element="full"), loaded, code="calculix")
    decks.append(path.read_bytes())
    op.write_inp(path, inclusion_experiment(), op.Compression(0.2))
    return [*decks, path.read_bytes()]


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Change bytes, lines, fields or keywords."""
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        lines = content.split(b"\n")
        at = int(rng.integers(len(lines)))
        if rng.random() < 0.5:  # nodes and elements are most of a deck
            heads = [k for k, line in enumerate(lines) if line.startswith(b"*")]
            at = min(int(rng.choice(heads)) + int(rng.integers(2)), len(lines) - 1) if heads else at
        match rng.integers(9):
            case 0:
                data = bytearray(content)
                data[int(rng.integers(len(data)))] = int(rng.integers(256))
                content = bytes(data)
                continue
            case 1:
                content = content[: int(rng.integers(1, len(content)))]
                continue
            case 6:
                digits = [k for k, letter in enumerate(lines[at]) if chr(letter).isdigit()]
                if digits:
                    k = int(rng.choice(digits))
                    lines[at] = lines[at][:k] + str(rng.integers(10)).encode() + lines[at][k + 1 :]
            case 2:
                del lines[at]
            case 3:
                lines.insert(at, lines[int(rng.integers(len(lines)))])
            case 4:
                other = int(rng.integers(len(lines)))
                lines[at], lines[other] = lines[other], lines[at]
            case 5:
                lines.insert(at, rng.choice(KEYWORDS).encode())
            case _:
                fields = re.split(rb"([,=])", lines[at])
                fields[int(rng.integers(len(fields)))] = str(rng.choice(ODD)).encode("latin-1", "replace")
                lines[at] = b"".join(fields)
        content = b"\n".join(lines) or b"\n"
    return content


def stated(path: Path) -> str:
    """Write all that opfem takes from a deck."""
    deck = op.read_inp(path)
    problem = deck.experiment(bulk=0.1)
    loads = [jax.tree.map(np.asarray, load) for load in deck.loads()]
    return repr((problem, [jax.tree.leaves(load) for load in loads], deck.solver(), deck.assumed(bulk=0.1)))


def judge(path: Path, content: bytes, original: str) -> tuple[str, str]:
    """Read a damaged deck; return how that ended, and what was said."""
    path.write_bytes(content)
    try:
        said = stated(path)
    except op.DeckError as refusal:
        return "refused" if LINE.fullmatch(str(refusal)) else "no line", str(refusal)
    except TimeoutError:
        return "hang", ""
    except BaseException as cause:
        return "traceback", f"{type(cause).__name__}: {cause}"
    return "same" if said == original else "other", ""


def child(seed: int, first: int, count: int) -> None:
    """Read a chunk of damaged decks; print what came of them."""
    jax.config.update("jax_enable_x64", True)

    def stop(*_: object) -> None:
        raise TimeoutError

    signal.signal(signal.SIGALRM, stop)
    endings: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "deck.inp"
        decks = originals(Path(scratch))
        truths = []
        for deck in decks:
            path.write_bytes(deck)
            truths.append(stated(path))
        used = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_DATA, (used + MEMORY, -1))
        for index in range(first, first + count):
            rng = np.random.default_rng([seed, index])
            which = int(rng.integers(len(decks)))
            content = damaged(decks[which], rng)
            signal.alarm(SECONDS)
            ending, said = judge(path, content, truths[which])
            signal.alarm(0)
            endings[ending] += 1
            if ending not in ("same", "other", "refused"):
                print(json.dumps({"mutant": index, "ending": ending, "said": said[:500]}), file=sys.stderr)
    print(json.dumps(endings))


def large(megabytes: int) -> dict:
    """Read a deck of so many MB, of the published kind."""
    n = int(np.sqrt(megabytes * 1e6 / 1480))  # bytes a column of the layer and of the surface over it take
    palpation = op.Palpation(
        op.Layer(0.5, op.MooneyRivlin(0.00223, 0.000703, 0.11732)), (7.0, 7.0), (n, n, 4),
        op.Contact(op.HardOverclosure(), 0.15), op.Contact(op.ExponentialOverclosure(2.0, 0.01), 0.05),
    )  # fmt: skip
    loaded = op.ThicknessMap(np.full((50, 50), 0.4), extent=(7.0, 7.0))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "large.inp"
        op.write_inp(path, palpation, op.Imprint(loaded))
        code = "import sys, opfem as op; deck = op.read_inp(sys.argv[1])"
        begin = time.perf_counter()
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-c", code, str(path)], check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return {
            "MB": round(path.stat().st_size / 1e6, 1),
            "elements": palpation.elements,
            "seconds": round(time.perf_counter() - begin, 2),
            "CPU_seconds": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 2),
            "peak_MB": round(after.ru_maxrss / 1024),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, help="MB of one sound deck to read instead")
    parser.add_argument("--chunk", type=int, nargs=2, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.size:
        print(json.dumps(large(chosen.size)))
        return
    if chosen.chunk:
        child(chosen.seed, *chosen.chunk)
        return
    total: Counter[str] = Counter()
    for first in range(0, chosen.count, CHUNK):
        count = min(CHUNK, chosen.count - first)
        command = [sys.executable, "-m", "benchmarks.mutated_decks", "--seed", str(chosen.seed), "--chunk"]
        run = subprocess.run([*command, str(first), str(count)], stdout=subprocess.PIPE)
        total += Counter(json.loads(run.stdout)) if run.returncode == 0 else Counter({"crash": count})
    print(json.dumps(dict(total)))


if __name__ == "__main__":
    main()
