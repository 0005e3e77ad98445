"""`crazyem policy [FILE]`: the rules of the guard on writes, shown and checked."""

import argparse

from crazyem.commands.output import put
from crazyem.live.policy import default_text, load_policy
from crazyem.live.summary import check_writable, write_json


def run(arguments: argparse.Namespace) -> int:
    """Show the shipped policy with its comments, or the policy of a file with its differences from the default.

    Raises: UsageError: no such file. FileFormatError: the file cannot be used; the message names the key.
    """
    check_writable(arguments.json)
    policy = load_policy(arguments.file)
    if arguments.json != "-":
        text = default_text() if arguments.file is None else policy.to_toml(against=load_policy())
        put(text.rstrip("\n"))
    if arguments.json:
        write_json(policy.to_json(), arguments.json)
    return 0
