"""Writes the guard's decisions to the drone in a thread of its own, and keeps account of every echo."""

import queue
import threading
from collections.abc import Callable

from crazyem.errors import CrazyemError
from crazyem.links.base import Link, ParameterWrite
from crazyem.live.controllers import CONTROLLERS, Controller, without_target
from crazyem.live.guard import Decision, Guard
from crazyem.live.history import History, Push

WRITE_TIMEOUT = 1.0  # s; an echo takes 2 to 30 ms on a working link


def running_controller(link: Link) -> int:
    """Number of the controller that really runs (stabilizer.controller, freshly read; the firmware may overrule)."""
    return int(link.read_parameter("stabilizer.controller"))


def push_target(link: Link) -> tuple[Controller | None, str]:
    """Where estimates can be pushed to on this drone now, or None and one sentence why not."""
    number = running_controller(link)
    controller = CONTROLLERS.get(number)
    if controller is None:
        return None, without_target(number)
    missing = [p for p in controller.parameters if p not in link.parameters]
    if missing:
        return None, f"the drone has no parameter {missing[0]}: estimates are not pushed."
    return controller, controller.note


def read_originals(link: Link, controller: Controller) -> dict[str, float]:
    """The values of every parameter a push may write, as the drone has them now."""
    return {name: link.read_parameter(name) for name in controller.parameters}


class Pusher:
    """One thread, one write at a time, in the order decided. An unconfirmed write ends all pushing.

    Args:
        link: to the drone.
        guard: told to stop when a write is not confirmed.
        history: keeps every write.
        on_write: called with every write (recording).
    """

    def __init__(
        self,
        link: Link,
        guard: Guard,
        *,
        history: History,
        on_write: Callable[[ParameterWrite], None] | None = None,
        timeout: float = WRITE_TIMEOUT,
    ) -> None:
        self.link = link
        self.guard = guard
        self.history = history
        self.on_write = on_write
        self.timeout = timeout
        self._queue: queue.SimpleQueue[Decision | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="crazyem-push", daemon=True)
        self._thread.start()

    def submit(self, decision: Decision) -> None:
        """Queue a decision's writes; returns at once."""
        self._queue.put(decision)

    def close(self) -> None:
        """Finish what is queued, then end (bounded by the write timeout)."""
        self._queue.put(None)
        self._thread.join(timeout=2 * self.timeout + 1.0)

    def _run(self) -> None:
        while (decision := self._queue.get()) is not None:
            for name, value in decision.writes:
                if self.guard.stopped:
                    break
                self._write(decision.time, name, value)

    def _write(self, time: float, name: str, value: float) -> None:
        verified, why = False, "no echo came"
        try:
            write = self.link.write_parameter(name, value, timeout=self.timeout)
            if write.echoed is not None:
                why = f"the drone echoed {write.echoed:.6g}"
            if self.on_write is not None:
                self.on_write(write)
            verified = write.verified
        except CrazyemError as error:
            why = str(error)
        except Exception as error:  # a fault of ours ends the pushing, not the flight; the sentence below names it
            why = repr(error)
        self.history.pushes.append(Push(time, name, value, verified))
        if not verified:
            sentence = f"the write of {name} = {value:.6g} was not confirmed ({why}): nothing more is pushed."
            self.guard.stop(sentence)
            self.history.notice(sentence)
