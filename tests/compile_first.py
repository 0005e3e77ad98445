"""Compiles what the tests run, side by side: on a fresh machine each of their workers would compile all of it itself.

python tests/compile_first.py

Kernels to machine code, and the modules of the tests to bytecode. `make test` runs it once. Whatever fails here fails
in the tests, which say why.
"""

import hashlib
import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

REPOSITORY = Path(__file__).resolve().parents[1]
FLIGHT = ("logs/payload_excite.mcap", "--to", "6")
REPLAYED = REPOSITORY / "tests" / "__pycache__" / "replayed_while_compiling.json"

# A replay by kernels that are compiled in its process, all of them; kept for test_kernel_cache.py.
REPLAY = f"""
import json
from crazyem import compiled
from crazyem.cli import main

main(["replay", *{FLIGHT}, "--json", {str(REPLAYED)!r}])
if any(sum(k.stats.cache_hits.values()) for k in compiled._KERNELS if hasattr(k, "stats")):
    raise SystemExit("some kernels came from the disk")
"""

ESTIMATOR = """
from crazyem.live.runner import warm_up
from crazyem.vehicle import load_vehicle
warm_up(load_vehicle("cf2"))
"""

MADE_FLIGHTS = """
import sys
sys.path[:0] = ["tests/crazyem", "benchmarks"]
import closed_loop, flight, synthetic
closed_loop.fly(seconds=1.0)
synthetic.fly(duration=1.0)
flight.simulate(seed=1, seconds=1.0)
"""

# Tests that call kernels which nothing above calls: in one process each.
OF_THE_PAPER = (
    "paper_flight.py", "paper_bound.py::test_bound_is_that_of_a_plain_filter",
    "paper_published.py::test_a_cold_start_with_clamped_estimates_flies", "control_lqg.py",
    "planning.py::test_the_same_seed_gives_the_same_plan",
    "paper_cold_start.py::test_the_same_seed_flies_the_same_flight",
)  # fmt: skip
OF_EFFECTS = (
    "physics_effects_pendulum.py", "physics_lag.py",
    "physics_effects_bodies.py::test_swing_of_a_small_angle_has_the_textbook_period_and_dies_in_twenty_seconds",
    "physics_effects_bodies.py::test_swing_knows_no_later_row_and_starts_anew_after_a_gap",
    "diagnosis_onboard_filter.py::test_what_a_force_changes_in_the_velocity_that_is_shown_is_a_difference_of_likelihoods",
    "estimation_marginal.py::test_nothing_is_integrated_where_the_noise_is",
    "monitoring_detector.py::test_every_column_of_the_body_is_the_derivative_of_the_model",
)  # fmt: skip


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


def tested(names: tuple[str, ...]) -> None:
    """Whether they pass is asked later."""
    paths = (f"tests/crazyem/test_{name}" for name in names)
    python("-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *paths).communicate()


def diagnosed(folder: str) -> None:
    """A shipped flight, asked for one effect."""
    log = "logs/clean_figure8.mcap"
    python("-m", "crazyem", "diagnose", log, "--candidates", "linear_drag", "--json", f"{folder}/d.json").communicate()


def of_what() -> str:
    """What the numbers of a replay follow from: our sources, the flight, numba and the processor."""
    import llvmlite.binding as llvm
    import numba

    digest = hashlib.sha256(f"{numba.__version__} {llvm.get_host_cpu_name()} {FLIGHT}".encode())
    for path in (REPOSITORY / FLIGHT[0], *sorted((REPOSITORY / "crazyem").rglob("*.py"))):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def replayed() -> None:
    REPLAYED.parent.mkdir(exist_ok=True)
    process = python("-c", REPLAY)
    process.communicate()
    if process.returncode == 0:
        said = json.loads(REPLAYED.read_text(encoding="utf-8"))
        REPLAYED.write_text(json.dumps({"of": of_what(), "said": said}), encoding="utf-8")
    else:
        REPLAYED.unlink(missing_ok=True)


def of_the_estimator() -> None:
    replayed()
    python("-c", ESTIMATOR + MADE_FLIGHTS).communicate()
    with TemporaryDirectory() as folder:
        diagnosed(folder)
    tested(OF_EFFECTS)


def of_the_simulator() -> None:
    simulated()
    simulated("--scenario", "firmware_sim/scenarios/payload_drop.toml")
    tested(OF_THE_PAPER)


def main() -> None:
    """Two sequences side by side that call different kernels, each as long as the other."""
    collection = python("-m", "pytest", "-qq", "--collect-only", "-p", "no:cacheprovider")
    with ThreadPoolExecutor(2) as threads:
        for done in [threads.submit(of_the_estimator), threads.submit(of_the_simulator)]:
            done.result()
    collection.communicate()


if __name__ == "__main__":
    main()
