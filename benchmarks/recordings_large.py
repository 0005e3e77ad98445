"""Recordings larger than memory: `info`, `doctor` and `export` in parts, where reading the whole is not possible.

    python benchmarks/recordings_large.py [--megabytes 1000] [--limit 1200] [--only usd,mcap,csv,exported] [--json FILE]

The flight of benchmarks/recordings.py, long enough for a file of so many megabytes in each format. Every command runs
in a process whose address space is limited (RLIMIT_AS; libraries take a good part of it, most never touched). Without
`--parts` it must fail there, which shows that the limit bites; with `--parts` it must succeed. Takes half an hour and
a few gigabytes of disk. Linux.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from child import CRAZYEM, measured
from recordings import MAPPING

BYTES_A_ROW = {"usd": 82, "mcap": 140, "csv": 200, "exported": 383}  # about
TITLES = {"usd": "uSD card log", "mcap": "MCAP", "csv": "CSV with --map", "exported": "exported CSV"}


def make(folder: Path, kind: str, *, megabytes: float) -> list[str]:
    """A file of a format, by commands without a limit: arguments of a command on it."""
    rows = str(max(2000, int(megabytes * 1e6 / BYTES_A_ROW[kind])))
    maker = [sys.executable, str(Path(__file__).with_name("recordings.py")), "--rows", rows, "--make"]
    usd, target = str(folder / "log00"), str(folder / {"mcap": "flight.mcap"}.get(kind, f"{kind}.csv"))
    if kind == "csv":
        mapping = folder / "map.toml"
        mapping.write_text(MAPPING)
        measured([*maker, "csv", target])
        return [target, "--map", str(mapping)]
    measured([*maker, "usd", usd])
    if kind == "usd":
        return [usd, "--motor", "duty"]
    command = {"mcap": ["import"], "exported": ["export", "--parts"]}[kind]
    measured([*CRAZYEM, *command, usd, "-o", target, "--motor", "duty"])
    Path(usd).unlink()
    return [target]


def measure(kind: str, *, megabytes: float, limit_mb: float) -> list[dict[str, Any]]:
    """A row for each command: exit, seconds, peak memory."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        arguments = make(folder, kind, megabytes=megabytes)
        size = Path(arguments[0]).stat().st_size
        output = ["-o", str(folder / "out.parquet"), "--force"]
        for what, more in (("info", []), ("doctor", []), ("export", output)):
            for parts in ([], ["--parts"]):
                command = [*CRAZYEM, what, *arguments, *more, *parts]
                used = measured(command, address_space=int(limit_mb * 1e6), check=False)
                rows.append(
                    {
                        "format": TITLES[kind], "bytes": size, "what": " ".join([what, *parts]), "code": used.code,
                        "wall_s": used.wall_s, "processor_s": used.processor_s, "memory_mb": used.memory_mb,
                        "said": (used.output.strip().splitlines() or [""])[-1][:200] if used.code else "",
                    }
                )  # fmt: skip
                print(line(rows[-1]), flush=True)
    return rows


def line(row: dict[str, Any]) -> str:
    """A row as Markdown."""
    ended = "done" if not row["code"] else f"failed ({row['said']})"
    return (
        f"| {row['format']} | {row['bytes'] / 1e6:.0f} | {row['what']} | {ended} | {row['wall_s']:.0f} "
        f"| {row['memory_mb']:.0f} |"
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=float, default=1000.0)
    parser.add_argument("--limit", type=float, default=1200.0, help="of the address space [MB]")
    parser.add_argument("--only", default="usd,mcap,csv,exported")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    print(f"address space of {arguments.limit:.0f} MB\n")
    print("| format | MB | what | ended | s | MB at most |\n|---|---|---|---|---|---|")
    rows = [
        row
        for kind in arguments.only.split(",")
        for row in measure(kind, megabytes=arguments.megabytes, limit_mb=arguments.limit)
    ]
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")
    wrong = [row for row in rows if bool(row["code"]) == row["what"].endswith("--parts")]
    if wrong:
        sys.exit("not as it should be: " + ", ".join(f"{row['format']}: {row['what']}" for row in wrong))


if __name__ == "__main__":
    main()
