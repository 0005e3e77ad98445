"""What `fly` and `watch` ask of their link: rate of the log, and how long a lost link is tried again."""

import pytest

from crazyem.cli import main, parser


def test_defaults_and_limits(capsys: pytest.CaptureFixture[str]) -> None:
    fly = parser().parse_args(["fly"])
    watch = parser().parse_args(["watch", "udp://127.0.0.1:1"])
    assert (fly.rate, fly.reconnect) == (1000.0 / 11.0, 8.0)
    assert (watch.rate, watch.reconnect) == (1000.0 / 11.0, 30.0)
    for option in (["--rate", "1001"], ["--rate", "0"], ["--rate", "nan"], ["--reconnect", "-1"]):
        assert main(["fly", *option]) == 2
        assert capsys.readouterr().err.startswith(f"crazyem: argument {option[0]}")
