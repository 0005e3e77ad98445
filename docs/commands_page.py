"""docs/reference/commands.md from the parser of the command line: `python docs/commands_page.py` writes it."""

import argparse
import textwrap
from pathlib import Path

from crazyem.cli import parser

PAGE = Path(__file__).parent / "reference" / "commands.md"
HEAD = """# Commands

This page comes from the parser of the command line (`python docs/commands_page.py`). Every command is a function of
the [API](api.md) as well, or works on files. JSON keys, outputs and exit codes: [JSON](json.md).
"""
WIDTH, COLUMN = 118, 30  # characters of a line, and of the names before the text


def page() -> str:
    """The whole page."""
    subcommands = _subcommands(parser())
    parts = [HEAD, *(_section(f"crazyem {name}", one) for name, one in subcommands.items())]
    return "\n".join(parts)


def _subcommands(whole: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    found = {}
    for action in whole._actions:
        if isinstance(action, argparse._SubParsersAction):
            found.update(action.choices)
    return found


def _section(name: str, command: argparse.ArgumentParser) -> str:
    inner = _subcommands(command)
    if inner:
        return "\n".join(_section(f"{name} {word}", one) for word, one in inner.items())
    lines = []
    for action in command._actions:
        if not isinstance(action, argparse._HelpAction) and action.help != argparse.SUPPRESS:
            lines += _entry(action)
    said = command.description or ""
    about = textwrap.fill(f"{said[:1].upper()}{said[1:]}.", WIDTH)
    return f"## {name}\n\n{about}\n\n```text\n" + "\n".join(lines) + "\n```\n"


def _entry(action: argparse.Action) -> list[str]:
    value = action.metavar or ("|".join(map(str, action.choices)) if action.choices else "")
    value = " ".join(value) if isinstance(value, tuple) else str(value)
    if action.nargs == 0:
        value = ""
    elif action.nargs == "?":
        value = f"[{value}]"
    elif action.nargs in ("+", "*"):
        value += "..."
    head = " ".join(filter(None, [", ".join(action.option_strings), value]))
    text = textwrap.wrap((action.help or "").replace("%%", "%"), WIDTH - COLUMN - 2) or [""]
    lines = [f"{head:<{COLUMN}}  {text[0]}"] if len(head) <= COLUMN else [head, " " * (COLUMN + 2) + text[0]]
    return [line.rstrip() for line in (*lines, *(" " * (COLUMN + 2) + line for line in text[1:])) if line.strip()]


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
