"""Cost of a command as a separate process: wall time, processor time, peak memory, by the kernel's counts."""

import json
import subprocess
import sys
from dataclasses import dataclass

CRAZYEM = [sys.executable, "-m", "crazyem"]

# The peak memory of a process starts with that of its parent, so a small process is put between.
_BETWEEN = """
import json, os, resource, subprocess, sys, time
limit, *command = json.load(sys.stdin)
def before():
    if limit:
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
begin = time.perf_counter()
child = subprocess.Popen(
    command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    preexec_fn=before if limit else None,
)
output = child.stdout.read()
_, status, usage = os.wait4(child.pid, 0)
wall = time.perf_counter() - begin
memory = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
code = os.waitstatus_to_exitcode(status)
print(json.dumps([code, wall, usage.ru_utime + usage.ru_stime, memory, output.decode(errors="replace")]))
"""


@dataclass(frozen=True, slots=True)
class Usage:
    """Cost of one run; `output` is what it printed, standard error included."""

    wall_s: float
    processor_s: float
    memory_mb: float
    output: str
    code: int = 0


def measured(command: list[str], *, address_space: int = 0, check: bool = True) -> Usage:
    """Run a command to its end.

    Args:
        command: program and arguments.
        address_space: limit in bytes (RLIMIT_AS); 0: none.
        check: raise RuntimeError with the output if the command fails.
    """
    between = [sys.executable, "-S", "-E", "-c", _BETWEEN]
    done = subprocess.run(
        between, input=json.dumps([address_space, *command]), capture_output=True, text=True, check=True
    )
    code, wall, processor, memory, output = json.loads(done.stdout)
    if check and code:
        raise RuntimeError(f"{' '.join(command)} ended with {code}:\n{output}")
    return Usage(wall, processor, memory / 1e6, output, code)


def python(text: str, *arguments: str) -> list[str]:
    """The command that runs a piece of Python."""
    return [sys.executable, "-c", text, *arguments]
