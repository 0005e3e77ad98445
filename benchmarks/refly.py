"""Does the simulator fly like the drone after the diagnosis? A mission flown by a concealed truth, and flown again.

    python benchmarks/refly.py --out refly

1. firmware_sim flies a mission with effects that nobody else is told of (a heavier, slower drone with drag);
2. `crazyem diagnose` gets that recording and the nominal vehicle, and writes the fitted vehicle;
3. firmware_sim flies the same mission twice more: with the nominal vehicle, and with the fitted one;
4. both are compared with the first flight, closed loop, as a user would: since take-off, signal by signal.

Only recordings and vehicle files pass between the steps.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from crazyem.diagnosis.document import compare
from crazyem.recordings import open_recording
from crazyem.vehicle import load_vehicle

TRUTH = """
platform = "cf2"
vehicle_file = "nominal.toml"

[effects.thrust_scale]
scale = 0.93

[effects.linear_drag]
x = 0.012
y = 0.012
z = 0.008

[effects.motor_lag]
time_constant = 0.068
"""


def crazyem(*arguments: str) -> None:
    """Run the command line."""
    subprocess.run([sys.executable, "-m", "crazyem", *arguments], check=True)


def fly(folder: Path, name: str, *, seed: int, duration: float) -> Path:
    """Fly the mission with a scenario, without pushes."""
    recording = folder / f"{name}.mcap"
    if not recording.exists():
        crazyem("fly", "--scenario", str(folder / f"{name}.toml"), "--trajectory", "figure8", "--duration",
                str(duration), "--seed", str(seed), "--no-push", "--record", str(recording),
                "--plot", str(folder / f"{name}.png"))  # fmt: skip
    return recording


def study(folder: Path, *, duration: float) -> dict[str, Any]:
    """All four steps; finished flights are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "nominal.toml").write_text(load_vehicle("cf2").to_toml())
    (folder / "truth.toml").write_text(TRUTH)
    (folder / "before.toml").write_text('platform = "cf2"\nvehicle_file = "nominal.toml"\n')
    (folder / "after.toml").write_text('platform = "cf2"\nvehicle_file = "fitted.toml"\n')
    flown = fly(folder, "truth", seed=1, duration=duration)
    crazyem("diagnose", str(flown), "--vehicle", str(folder / "nominal.toml"), "--write-vehicle",
            str(folder / "fitted.toml"), "--json", str(folder / "diagnosis.json"),
            "--report", str(folder / "diagnosis.html"))  # fmt: skip
    real = open_recording(str(flown))
    found = {}
    for name, seed in (("before", 2), ("after", 3)):
        found[name] = compare(real, open_recording(str(fly(folder, name, seed=seed, duration=duration))))["signals"]
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("refly"))
    parser.add_argument("--duration", type=float, default=16.0, help="s of the mission")
    arguments = parser.parse_args()
    found = study(arguments.out, duration=arguments.duration)
    (arguments.out / "refly.json").write_text(json.dumps(found, indent=1) + "\n")
    print("| signal | unit | rms difference, nominal | fitted | ratio |")
    print("| --- | --- | --- | --- | --- |")
    for name, before in found["before"].items():
        after = found["after"][name]
        ratio = after["rms"] / before["rms"] if before["rms"] else float("nan")
        print(f"| {name} | {before['unit']} | {before['rms']:.4g} | {after['rms']:.4g} | {ratio:.2f} |")


if __name__ == "__main__":
    main()
