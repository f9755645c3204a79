"""HTML tables, for reports and the display of objects in notebooks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

__all__ = ["html_table"]


def html_table(
    title: str,
    header: Sequence[str],
    rows: Iterable[Sequence[str]],
    remarks: Iterable[str] = (),
) -> str:
    """Return an HTML table with a caption, row headers in the first column and remarks below it.

    All texts are escaped.
    """
    lines = [f"<table><caption>{escape(title)}</caption><thead><tr>"]
    lines += [f"<th>{escape(name)}</th>" for name in header]
    lines.append("</tr></thead><tbody>")
    for name, *cells in rows:
        lines.append(f"<tr><th>{escape(name)}</th>")
        lines += [f"<td>{escape(cell)}</td>" for cell in cells]
        lines.append("</tr>")
    lines.append("</tbody></table>")
    lines += [f"<p>{escape(remark)}</p>" for remark in remarks]
    return "".join(lines)
