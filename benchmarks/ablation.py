"""A diagnosis with other settings: what is one number of `crazyem/diagnosis/settings.py` worth?

    python -m benchmarks.ablation selection.gain_share=0.3 diagnose FLIGHT --vehicle cf2

As `--command` of `benchmarks.concealed diagnose`, with `diagnose` as its last word, it needs the project's folder in
PYTHONPATH.
"""

import sys
from collections.abc import Sequence

from crazyem.diagnosis import settings
from crazyem.errors import UsageError


def change(assignment: str) -> None:
    """Set a number: `section.field=value`. Before the modules of the diagnosis are imported: some hold it as a default.

    Raises: UsageError: no such number, or another kind of value.
    """
    name, _, text = assignment.partition("=")
    section, _, field = name.partition(".")
    table = getattr(settings, section.upper(), None)
    before = getattr(table, field, None)
    if type(before) not in (int, float):
        raise UsageError(f"{name} is no number of crazyem/diagnosis/settings.py")
    try:
        object.__setattr__(table, field, type(before)(text))  # the table is frozen for everybody else
    except ValueError as error:
        raise UsageError(f"{assignment}: {text!r} is no {type(before).__name__}") from error


def main(argv: Sequence[str] | None = None) -> int:
    """Change the numbers of the first arguments and run the rest as `crazyem`."""
    rest = list(sys.argv[1:] if argv is None else argv)
    try:
        while rest and "=" in rest[0]:
            change(rest.pop(0))
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    from crazyem.cli import main as run

    return run(rest)


if __name__ == "__main__":
    sys.exit(main())
