"""The graphical client, without a screen, accepts the simulator (in an environment of its own: CFCLIENT_PYTHON).

Directly, and behind the relay with what unmodified cflib can bear: log data lost, doubled, out of order. A single lost
reply would hang it (crtp.md 7), whoever the drone is.
"""

import contextlib
import os
import subprocess
from pathlib import Path

import pytest
from processes import running

CHECK = Path(__file__).parents[2] / "benchmarks" / "cfclient_check.py"
FAULTS = ["--drop", "0.05", "--burst", "2", "--duplicate", "0.02", "--reorder", "0.02", "--kinds", "log.data"]


@pytest.mark.slow
@pytest.mark.parametrize("behind_the_relay", [False, True])
def test_cfclient_reaches_fully_connected_without_an_exception(behind_the_relay: bool) -> None:
    python = os.environ.get("CFCLIENT_PYTHON")
    if not python:
        pytest.skip("CFCLIENT_PYTHON does not name the interpreter of an environment with cfclient")
    if subprocess.run([python, "-c", "import cfclient, PyQt6.QtWidgets"], capture_output=True, check=False).returncode:
        pytest.skip(f"{python} cannot import cfclient")
    with contextlib.ExitStack() as stack:
        _, uri = stack.enter_context(running("firmware_sim", "--port", "0"))
        if behind_the_relay:
            _, uri = stack.enter_context(running("firmware_sim.relay", uri, *FAULTS))
        result = subprocess.run(
            [python, str(CHECK), uri, "--seconds", "3"], capture_output=True, text=True, timeout=180, check=False
        )
    assert result.returncode == 0, result.stdout + result.stderr
    assert "fully connected" in result.stdout
