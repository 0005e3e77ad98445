"""The report for a terminal: the content of `content.py`, in columns."""

from collections.abc import Iterator
from typing import Any

from crazyem.diagnosis.report.content import Bar, Cell, Items, Meter, Table, sections
from crazyem.diagnosis.report.verdict import Document, verdict

MOST_ROWS = 12  # rows of a table


def text_of(document: Document) -> str:
    """The diagnosis for a terminal, without the sections for the page alone."""
    lines = [verdict(document)]
    for section in sections(document):
        if section.page or not section.parts:
            continue
        lines += ["", section.title]
        for part in section.parts:
            if isinstance(part, Table):
                lines += _columns(part)
            elif isinstance(part, Items):
                lines += [f"  {part.title}:"] * bool(part.title) + [f"  - {text}" for text in part.items]
            else:
                lines.append(f"  {part.text}")
    return "\n".join(lines)


def _columns(table: Table) -> Iterator[str]:
    rows = [[_plain(cell) for cell in row] for row in table.rows[:MOST_ROWS]]
    used = [k for k in range(len(table.heads)) if any(row[k] for row in rows)]
    width = {k: max(len(row[k]) for row in [list(table.heads), *rows]) for k in used}
    if table.title:
        yield f"  {table.title}"
    for row in [list(table.heads), *rows]:
        cells = (row[k].rjust(width[k]) if k in table.right else row[k].ljust(width[k]) for k in used)
        yield "    " + "  ".join(cells).rstrip()
    if len(table.rows) > MOST_ROWS:
        yield f"    and {len(table.rows) - MOST_ROWS} more"


def _plain(cell: Any) -> str:
    """A cell as text; "" for a picture."""
    return "" if isinstance(cell, Bar | Meter) else cell.text if isinstance(cell, Cell) else str(cell)
