"""Stores a number that a benchmark prints as a figure of benchmarks/results/SUBJECT.json.

Run `python benchmarks/coin.py MAP | python -m benchmarks.record 01-coin --key seconds --unit s --what "second solve"
--program coin.py --machine intel [--ratio KEY --peer "times as fast as ..."] [--load ...] [--note ...]`.
KEY is taken from every line that has it; of several, the least and the largest are stored. A figure of the same `what`
is replaced. Commit and date are added. `--machine` names an entry of machines.json; `--describe` adds one. Lines pass
through. Then run `benchmarks.tables`.
"""

import argparse
import datetime
import json
import subprocess
import sys
from collections.abc import Iterable
from typing import Any

from benchmarks.tables import RESULTS, machines


def spread(rows: Iterable[dict[str, Any]], key: str) -> float | list[float]:
    """Take a key's number from all rows that have it: one, or the least and the largest."""
    values = sorted({float(row[key]) for row in rows if row.get(key) is not None})
    if not values:
        raise SystemExit(f"record: no line holds {key!r}.")
    return values[0] if len(values) == 1 else [values[0], values[-1]]


def stored(figures: list[dict[str, Any]], new: dict[str, Any]) -> list[dict[str, Any]]:
    """Put a figure in the place of the one of the same name, or at the end."""
    if any(old["what"] == new["what"] for old in figures):
        return [new if old["what"] == new["what"] else old for old in figures]
    return [*figures, new]


def commit() -> str:
    """Name the commit that is checked out; with uncommitted changes of the package it would be wrong."""
    if subprocess.run(["git", "diff", "--quiet", "HEAD", "--", "opfem", "benchmarks/*.py"], check=False).returncode:
        raise SystemExit("record: opfem or its benchmarks differ from the commit. Commit first.")
    found = subprocess.run(["git", "rev-parse", "--short=7", "HEAD"], capture_output=True, text=True, check=True)
    return found.stdout.strip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("subject")
    for name in ("key", "unit", "what", "program", "machine"):
        parser.add_argument(f"--{name}", required=True)
    for name in ("peer", "ratio", "load", "note", "describe"):
        parser.add_argument(f"--{name}")
    chosen = parser.parse_args()
    rows = []
    for line in sys.stdin:
        print(line, end="", flush=True)
        if line.startswith("{"):
            rows.append(json.loads(line))
    known = machines() | ({chosen.machine: chosen.describe} if chosen.describe else {})
    if chosen.machine not in known:
        raise SystemExit(f"record: machine {chosen.machine!r} is none of {', '.join(known)}. Pass --describe TEXT.")
    figure = {"what": chosen.what, "value": spread(rows, chosen.key), "unit": chosen.unit}
    if chosen.ratio:
        figure |= {"ratio": spread(rows, chosen.ratio), "peer": chosen.peer}
    figure |= {"program": chosen.program, "commit": commit(), "date": datetime.date.today().isoformat()}
    figure |= {name: getattr(chosen, name) for name in ("machine", "load", "note") if getattr(chosen, name)}
    path = RESULTS / f"{chosen.subject}.json"
    subject = json.loads(path.read_text(encoding="utf-8"))
    subject["figures"] = stored(subject["figures"], figure)
    for target, content in ((path, subject), (RESULTS / "machines.json", known)):
        target.write_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
