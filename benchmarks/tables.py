"""Writes benchmarks/README.md from the figures in benchmarks/results/*.json; the documentation includes it.

Run `python -m benchmarks.tables`. A test compares the README with what this program makes. Each file of `results/` is a
subject: title, text, and figures with value, unit, ratio to a peer, program, commit, date, machine (of
`machines.json`) and what else ran (load). What is not known is left out and shown as a dash. `record` adds figures.
"""

import ast
import json
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
README = HERE / "README.md"
TOOLS = {"tables", "record", "calculix_cases"}

INTRODUCTION = """# Benchmarks

Figures are stored in `results/*.json`; `python -m benchmarks.tables` makes this page of them. Each program prints one
JSON line per case, and its first lines say how to run it; `PROGRAM | python -m benchmarks.record SUBJECT ...` stores a
number of these lines with commit, date and machine. Programs with a peer or a physical limit measure that in the same
run: the machines are shared, so ratios hold and seconds do not. A dash is what was not written down.
"""


def subjects() -> dict[str, dict[str, Any]]:
    """Read the subjects, in the order of their files' names."""
    paths = sorted(path for path in RESULTS.glob("*.json") if path.name != "machines.json")
    return {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in paths}


def machines() -> dict[str, str]:
    """Read what machines the figures are of."""
    return json.loads((RESULTS / "machines.json").read_text(encoding="utf-8"))


def number(value: float | list[float] | None) -> str:
    """Write a number, or the least and the largest of several."""
    if value is None:
        return "–"
    if isinstance(value, list):
        return f"{value[0]:g} to {value[-1]:g}"
    return f"{value:.0f}" if float(value).is_integer() else f"{value:g}"


def row(figure: dict[str, Any]) -> str:
    """Lay out a figure as a row of its table."""
    peer = f"{number(figure['ratio'])} {figure['peer']}" if "ratio" in figure else "–"
    program = f"`{figure['program']}`, " if "program" in figure else ""
    source = f"{program}{figure.get('commit', '–')}, {figure.get('date', '–')}, {figure['machine']}"
    source += f", {figure['load']}" if "load" in figure else ""
    cells = [figure["what"], f"{number(figure['value'])} {figure['unit'].removeprefix('1')}".strip(), peer]
    return f"| {' | '.join([*cells, figure.get('note', ''), source])} |"


def programs() -> str:
    """List the programs with the first line of their docstrings."""
    lines = ["| program | question |", "|---|---|"]
    for path in sorted(HERE.glob("*.py")):
        if path.stem not in TOOLS:
            text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
            lines.append(f"| `{path.name}` | {text.splitlines()[0]} |")
    return "\n".join(lines)


def render() -> str:
    """Make the whole page."""
    parts = [INTRODUCTION, "## Programs\n", programs() + "\n"]
    for subject in subjects().values():
        parts += [f"## {subject['title']}\n", subject["text"] + "\n"]
        parts += ["| what | figure | against a peer | note | program, commit, date, machine |\n|---|---|---|---|---|"]
        parts += ["\n".join(row(figure) for figure in subject["figures"]) + "\n"]
    parts += ["## Machines\n", "\n".join(f"- *{name}*: {text}." for name, text in machines().items())]
    return "\n".join(parts) + "\n"


if __name__ == "__main__":
    README.write_text(render(), encoding="utf-8")
