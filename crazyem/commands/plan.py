"""`crazyem plan --for mass,Ixx -o PLAN.toml`: plan the most informative manoeuvre, with its expected intervals."""

import argparse

from crazyem.atomic_file import write_file
from crazyem.commands.output import names_in, put, say
from crazyem.errors import CrazyemError, UsageError
from crazyem.live.summary import check_writable, write_json


class NoManoeuvreError(CrazyemError):
    """No manoeuvre within the limits reaches the goal."""

    exit_code = 5


def run(arguments: argparse.Namespace) -> int:
    """Plan, print the expected result, write the file.

    Raises: NoManoeuvreError: no manoeuvre reaches the goal; the message gives the reason and a measurement that does.
    """
    from crazyem.api.planning import plan

    check_writable(arguments.json)
    check_writable(arguments.output)
    split = names_in(arguments.split)
    if arguments.split is not None and len(split) != 2:
        raise UsageError("--split needs two effects, as in rotor_fault,center_of_mass.")
    found = plan(
        arguments.vehicle,
        parameters=names_in(arguments.parameters),
        split=(split[0], split[1]) if split else None,
        diagnosis=arguments.diagnosis,
        box=tuple(arguments.box),
        tilt=arguments.tilt,
        duration=arguments.time,
        criterion=arguments.criterion,
        noise=arguments.noise,
        seed=arguments.seed,
        progress=say,
    )
    if arguments.json:
        write_json(found.to_dict(), arguments.json)
    if found.manoeuvre is None:
        raise NoManoeuvreError(str(found))
    if arguments.json != "-":
        put(str(found))
    write_file(arguments.output, found.to_toml())
    say(f"plan: {arguments.output}   fly it: crazyem fly --trajectory plan {arguments.output}")
    return 0
