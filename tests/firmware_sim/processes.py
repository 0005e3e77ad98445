"""Programs of the simulator as processes of their own."""

import contextlib
import subprocess
import sys

TIMEOUT = 60.0  # s; only for a machine that hangs


@contextlib.contextmanager
def running(*module: str):
    """A program that announces its address: the process and that URI; ended in the end."""
    command = [sys.executable, "-m", *module]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            line = process.stdout.readline()
            assert "udp://127.0.0.1:" in line, line + process.stderr.read()
            yield process, line.split()[1]
        finally:
            process.terminate()
            process.communicate(timeout=TIMEOUT)
