"""Compiles what the tests run, side by side: on a fresh machine each of their workers would compile all of it itself.

python tests/compile_first.py

Kernels to machine code, and the modules of the tests to bytecode. `make test` runs it once. Whatever fails here fails
in the tests, which say why.
"""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

REPOSITORY = Path(__file__).resolve().parents[1]
ESTIMATOR = """
from crazyem.live.warm_up import warm_up
from crazyem.vehicle import load_vehicle
warm_up(load_vehicle("cf2"))
"""

MADE_FLIGHTS = """
import sys
sys.path.insert(0, "tests/crazyem")
import closed_loop, synthetic
closed_loop.fly(seconds=1.0)
synthetic.fly(duration=1.0)
"""


def python(*arguments: str) -> subprocess.Popen[str]:
    """A child process that says nothing but what it prints."""
    return subprocess.Popen(
        [sys.executable, *arguments], cwd=REPOSITORY, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )


def simulated(*arguments: str) -> None:
    """Once the simulator says where it listens, it is compiled."""
    simulator = python("-m", "firmware_sim", "--port", "0", *arguments)
    assert simulator.stdout is not None
    while (line := simulator.stdout.readline()) and "udp://" not in line:
        pass
    simulator.terminate()
    simulator.wait()


def diagnosed(folder: str) -> None:
    """A shipped flight, asked for one effect."""
    log = "logs/clean_figure8.mcap"
    python("-m", "crazyem", "diagnose", log, "--candidates", "linear_drag", "--json", f"{folder}/d.json").communicate()


def main() -> None:
    """The estimator, then the tests' flights, beside the simulator and the diagnosis, which take as long."""
    collection = python("-m", "pytest", "-qq", "--collect-only", "-p", "no:cacheprovider")
    estimator = python("-c", ESTIMATOR + MADE_FLIGHTS)
    with TemporaryDirectory() as folder:
        simulated()
        simulated("--scenario", "firmware_sim/scenarios/payload_drop.toml")
        diagnosed(folder)
    for one in (estimator, collection):
        one.communicate()


if __name__ == "__main__":
    main()
