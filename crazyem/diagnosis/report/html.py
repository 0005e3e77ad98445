"""The report as one self-contained HTML page: the words of `content.py` and pictures, by a template (Jinja2).

The page loads no other file and runs no script. Every text of a recording or a file is escaped.
"""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from crazyem.atomic_file import write_file
from crazyem.diagnosis.report.content import facts, sections
from crazyem.diagnosis.report.pictures import Series, data_uri
from crazyem.diagnosis.report.verdict import Document, changes, claim
from crazyem.extras import require

if TYPE_CHECKING:
    pass

if TYPE_CHECKING:
    from jinja2 import Template


def write_report(path: str | Path, document: Document, pictures: Mapping[str, Series] | None = None) -> None:
    """Write the report of a diagnosis.

    Args:
        path: of the HTML file; replaced as a whole, or not at all.
        document: the result of a diagnosis, as its JSON has it. A missing key leaves out its part.
        pictures: by name, in order; see `Series.section`.

    Raises: UsageError if the file cannot be written. MissingExtraError: no Jinja2, or no matplotlib.
    """
    write_file(path, report(document, pictures or {}))


def report(document: Document, pictures: Mapping[str, Series]) -> str:
    """The report as text."""
    drawn = [(series.section, series.title, data_uri(series)) for series in pictures.values()]
    return _template().render(
        claim=claim(document), changes=changes(document), differs=bool(document.get("mismatch")),
        facts=facts(document), sections=sections(document), drawn=drawn,
    )  # fmt: skip


@cache
def _template() -> "Template":
    require("jinja2", "A report")
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("crazyem.diagnosis.report", "."), autoescape=True, finalize=_printable,
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    return environment.get_template("page.html")


def _printable(value: Any) -> Any:
    """Text without control characters."""
    if not isinstance(value, str):
        return value
    return type(value)("".join(c if c.isprintable() or c == "\n" else "\N{REPLACEMENT CHARACTER}" for c in value))
