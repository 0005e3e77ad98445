"""Whether something was compiled is counted, not told by the clock: a slow start is no compilation."""

from types import SimpleNamespace

from crazyem.commands.common import compile_kernels
from crazyem.live import warm_up
from crazyem.vehicle import load_vehicle


def test_a_start_from_the_disk_says_nothing_however_slow(monkeypatch, capsys) -> None:
    vehicle = load_vehicle("cf2")
    warm_up.warm_up(vehicle)
    clock = iter((0.0, 60.0))
    monkeypatch.setattr(warm_up, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    compile_kernels(vehicle)
    assert "compiled" not in "".join(capsys.readouterr())


def test_a_compilation_is_told(monkeypatch, capsys) -> None:
    counts = iter((0, 3))
    monkeypatch.setattr(warm_up, "compilations", lambda: next(counts))
    compile_kernels(load_vehicle("cf2"))
    assert "compiled the estimator in" in "".join(capsys.readouterr())
