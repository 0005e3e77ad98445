"""What `fly` and `watch` ask of their link: rate of the log, and how long a lost link is tried again."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crazyem.cli import main, parser
from crazyem.recordings import open_recording


def test_defaults_and_limits(capsys: pytest.CaptureFixture[str]) -> None:
    fly = parser().parse_args(["fly"])
    watch = parser().parse_args(["watch", "udp://127.0.0.1:1"])
    assert (fly.rate, fly.reconnect) == (1000.0 / 11.0, 8.0)
    assert (watch.rate, watch.reconnect) == (1000.0 / 11.0, 30.0)
    for option in (["--rate", "1001"], ["--rate", "0"], ["--rate", "nan"], ["--reconnect", "-1"]):
        assert main(["fly", *option]) == 2
        assert capsys.readouterr().err.startswith(f"crazyem: argument {option[0]}")


def test_a_faster_log_is_recorded_as_such(simulator: Callable[..., Any], tmp_path: Path) -> None:
    drone = simulator("--seed", "1")
    out = tmp_path / "fast.mcap"
    options = ["--duration", "1.5", "--rate", "200", "--reconnect", "0", "--record", str(out), "--json"]
    assert main(["watch", drone.uri, *options, str(tmp_path / "fast.json")]) == 0
    recording = open_recording(out)
    assert np.median(np.diff(recording.signals["position"].time)) == pytest.approx(0.005)
