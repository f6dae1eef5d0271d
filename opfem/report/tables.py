"""Tables and lists of a report as HTML; every text is escaped, whoever wrote it."""

from collections.abc import Iterable, Sequence
from html import escape

from .inputs import Input
from .numbers import Row


def number_table(rows: Iterable[Row]) -> str:
    """Write numbers with their units and what they mean."""
    return _table(
        "numbers",
        (
            f"{_heading(row.name)}{_cell(row.value, 'value')}{_cell(row.unit, 'unit')}{_cell(row.words, 'words')}"
            for row in rows
        ),
    )


def input_table(rows: Iterable[Input], sentences: Sequence[str]) -> str:
    """Write inputs, marked as given or assumed, and what else was assumed in sentences."""
    head = "<thead><tr><th>of</th><th>input</th><th>value</th><th>given or assumed</th></tr></thead>"
    lines = (
        f"{_cell(row.part, 'part')}{_heading(row.name)}{_cell(row.value, 'value')}"
        f"{_cell(row.mark, 'assumed' if row.mark == 'assumed' else 'words')}"
        for row in rows
    )
    said = f"<p>Assumed in reading the input:</p><ul>{items(sentences)}</ul>" if sentences else ""
    return _table("inputs", lines, head) + said


def source_table(rows: Iterable[tuple[str, str]]) -> str:
    """Write names and values."""
    return _table("sources", (f"{_heading(name)}{_cell(value, 'value')}" for name, value in rows))


def items(sentences: Iterable[str]) -> str:
    """Write the items of a list."""
    return "".join(f"<li>{escape(sentence)}</li>" for sentence in sentences)


def _table(kind: str, lines: Iterable[str], head: str = "") -> str:
    return f'<table class="{kind}">{head}<tbody>{"".join(f"<tr>{line}</tr>" for line in lines)}</tbody></table>'


def _heading(text: str) -> str:
    return f'<th scope="row">{escape(text)}</th>'


def _cell(text: str, kind: str) -> str:
    return f'<td class="{kind}">{escape(text)}</td>'
