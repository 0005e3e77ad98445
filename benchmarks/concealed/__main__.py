"""python -m benchmarks.concealed draw|fly|diagnose|score|nuisances --cases N --seed S --out DIR"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from .paths import Study


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.concealed", description=__doc__)
    parser.add_argument("step", choices=("draw", "fly", "diagnose", "score", "nuisances"))
    parser.add_argument("--cases", type=int, default=320, help="to draw (default %(default)s)")
    parser.add_argument("--seed", type=int, default=2048, help="of the draw (default %(default)s)")
    parser.add_argument(
        "--world", choices=("home", "random", "foreign"), default="home",
        help="to draw: what differs beside what is hidden: nothing, everything, or the simulator (default %(default)s)",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, required=True, help="folder of the study")
    parser.add_argument(
        "--speed", type=float, default=10.0, help="of the flights at most, times real time (default %(default)s)"
    )
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after that; run again to go on")
    parser.add_argument(
        "--part", type=int, nargs=2, default=(0, 1), metavar=("K", "N"), help="fly, diagnose, nuisances: share K of N"
    )
    parser.add_argument("--command", nargs="+", help="diagnose: instead of `crazyem diagnose`")
    parser.add_argument("--limit", type=float, default=900.0, help="diagnose: s after which an answer counts as none")
    parser.add_argument("--alone", action="store_true", help="diagnose, score: by one flight, with none held out")
    parser.add_argument(
        "--write-docs", action="store_true", help="score: docs/results/concealed.md and docs/results/concealed.json"
    )
    parser.add_argument(
        "--ideal", choices=("all", "failures", "kept"), default="all",
        help="score: of which cases to ask what an ideal observer sees, half a minute each (default %(default)s)",
    )  # fmt: skip
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one step of a study."""
    parser = _parser()
    arguments = parser.parse_args(argv)
    if arguments.alone and arguments.write_docs:
        parser.error("the table of the documents is that with a flight held out: --write-docs goes without --alone.")
    study, part = Study(arguments.out.resolve(), arguments.alone), (arguments.part[0], arguments.part[1])
    if arguments.step == "draw":
        from .draw import write_cases

        written = write_cases(study, cases=arguments.cases, seed=arguments.seed, world=arguments.world)
        print(f"{written} cases written to {study.folder}")
    elif arguments.step == "fly":
        from .fly import fly_all

        fly_all(study, speed=arguments.speed, minutes=arguments.minutes, part=part)
    elif arguments.step == "diagnose":
        from .diagnose import diagnose_all

        diagnose_all(study, command=arguments.command, minutes=arguments.minutes, part=part, limit=arguments.limit)
    elif arguments.step == "nuisances":
        from .nuisances import fit_all, table

        fit_all(study, part=part)
        print(table(study))
    else:
        from .report import report

        print(report(study, write_docs=arguments.write_docs, ideal=arguments.ideal))
    return 0


if __name__ == "__main__":
    sys.exit(main())
