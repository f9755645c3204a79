"""Pages of results: CSV files, Markdown tables and text wrapped at 100 columns.

A page is written from its stored data alone: option ``--page`` of a script rewrites the page and
its figures without computing anything.
"""

from __future__ import annotations

import csv
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

__all__ = ["number", "read", "save", "table", "text"]


def read(path: Path) -> list[dict[str, str]]:
    """Read the rows of a CSV file."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def save(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows to a CSV file with all digits; its columns are those of all rows together."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def number(value: float | str, digits: int = 3) -> str:
    """Format a number for a table; an empty string remains empty."""
    return "" if value == "" else f"{float(value):.{digits}g}"


def table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[str]:
    """Return the lines of a Markdown table, followed by an empty line."""
    cells = [[str(cell).replace("|", "\\|") for cell in row] for row in (header, *rows)]
    lines = [f"| {' | '.join(row)} |" for row in cells]
    return [lines[0], "|" + "---|" * len(header), *lines[1:], ""]


def text(*paragraphs: str) -> list[str]:
    """Return paragraphs wrapped at 100 columns, each followed by an empty line.

    Items of a list are paragraphs that begin with "- "; no empty line is between them.
    """
    lines: list[str] = []
    for paragraph in paragraphs:
        item = paragraph.startswith("- ")
        if item and len(lines) > 1 and lines[-2].startswith(("- ", "  ")):
            lines.pop()
        lines += textwrap.wrap(
            " ".join(paragraph.split()),
            100,
            subsequent_indent="  " if item else "",
            break_long_words=False,
            break_on_hyphens=False,
        )
        lines.append("")
    return lines
