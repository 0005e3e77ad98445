"""The graphical client, without a screen, accepts the simulator (in an environment of its own: CFCLIENT_PYTHON)."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CHECK = Path(__file__).parents[2] / "benchmarks" / "cfclient_check.py"


@pytest.mark.slow
def test_cfclient_reaches_fully_connected_without_an_exception():
    python = os.environ.get("CFCLIENT_PYTHON")
    if not python:
        pytest.skip("CFCLIENT_PYTHON does not name the interpreter of an environment with cfclient")
    if subprocess.run([python, "-c", "import cfclient, PyQt6.QtWidgets"], capture_output=True, check=False).returncode:
        pytest.skip(f"{python} cannot import cfclient")
    command = [sys.executable, "-m", "firmware_sim", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as simulator:
        try:
            uri = simulator.stdout.readline().split()[1]
            result = subprocess.run(
                [python, str(CHECK), uri, "--seconds", "3"], capture_output=True, text=True, timeout=180, check=False
            )
        finally:
            simulator.terminate()
    assert result.returncode == 0, result.stdout + result.stderr
    assert "fully connected" in result.stdout
