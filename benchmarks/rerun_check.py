"""Whether Rerun's converter decodes every channel of our MCAP files, so that none is left as raw bytes.

    python benchmarks/rerun_check.py [FILE...] [--rerun PATH]

Needs the `rerun` program (`pip install rerun-sdk`, in an environment of its own: it is large). Without files it checks
the shipped flight and an imported copy of it. Exit code 1 if a channel is missing or raw.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

SHIPPED = Path(__file__).resolve().parents[1] / "logs" / "payload_excite.mcap"
RAW = "McapMessage:data"  # the component in which Rerun keeps what it cannot decode
DATA = re.compile(r"rows \([^)]*\) - (?P<entity>/\S+) - data columns: \[(?P<columns>[^\]]*)\]")


def topics(path: Path) -> dict[str, str]:
    """Topic -> schema name of the channels that have messages."""
    from mcap.reader import make_reader

    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    if summary is None or summary.statistics is None:
        raise SystemExit(f"{path}: no summary")
    counts = summary.statistics.channel_message_counts
    return {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values() if counts.get(c.id)}


def components(rerun: str, path: Path, folder: Path) -> dict[str, set[str]]:
    """Entity -> names of its components in the converted recording."""
    target = folder / "converted.rrd"
    target.unlink(missing_ok=True)
    run(rerun, "mcap", "convert", str(path), "-o", str(target))
    found: dict[str, set[str]] = {}
    for match in DATA.finditer(run(rerun, "rrd", "print", "-v", str(target))):
        names = {column.rsplit("@", 1)[-1] for column in match["columns"].split()}
        found.setdefault(match["entity"], set()).update(names)
    return found


def run(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command[:3])}: {done.stderr.strip()[-500:]}")
    return done.stdout


def check(rerun: str, path: Path, folder: Path) -> list[str]:
    """What is wrong, one line a channel; prints how each channel came out."""
    found = components(rerun, path, folder)
    wrong = []
    for topic, schema in sorted(topics(path).items()):
        about = ("McapChannel:", "McapSchema:", "McapStatistics:")
        decoded = {c for c in found.get(topic, set()) if not c.startswith(about)}
        raw = RAW in decoded or not decoded
        print(f"  {topic:<28} {schema:<28} {'RAW' if raw else ', '.join(sorted(decoded))}")
        if raw:
            wrong.append(f"{path}: {topic} ({schema}) is not decoded")
    return wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--rerun", default=shutil.which("rerun"), help="the rerun program")
    arguments = parser.parse_args()
    if not arguments.rerun:
        print("there is no rerun program: pip install rerun-sdk, or --rerun PATH", file=sys.stderr)
        return 2
    print(run(arguments.rerun, "--version").strip())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = list(arguments.files)
        if not files:
            from crazyem.recordings import open_recording
            from crazyem.recordings.mcap.signals import write_recording

            write_recording(open_recording(SHIPPED), folder / "imported.mcap")
            files = [SHIPPED, folder / "imported.mcap"]
        wrong = []
        for path in files:
            print(path.name)
            wrong += check(arguments.rerun, path, folder)
    print("\n".join(wrong) or "every channel is decoded")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
