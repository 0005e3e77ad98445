"""What a person may do to a running drone: switch pushing, take values back, leave a mark, land."""

import math
from collections.abc import Callable

from crazyem.live.session import Session
from crazyem.live.views import USER_MARK


class SessionControls:
    """Of one drone; every method returns at once, with one sentence on what is done. Called from one thread.

    Args:
        session: running.
        land: makes its flight land; None where the flight is somebody else's.
        name: of the drone, for the sentences.
    """

    def __init__(self, session: Session, *, name: str, land: Callable[[], None] | None = None) -> None:
        self.session, self.name = session, name
        self._land = land

    def toggle_push(self) -> str:
        """Nothing new is written from now on, or again; what was written is still watched."""
        pipeline = self.session.pipeline
        if self.session.write_supervisor is None:
            return f"{self.name}: nothing is pushed in this session."
        pipeline.paused = not pipeline.paused
        state = "off" if pipeline.paused else "on"
        self._record_event(f"guard: pushing switched {state} by the user")
        return f"{self.name}: pushing is {state}."

    def revert(self) -> str:
        """See `WriteSupervisor.take_back`."""
        if self.session.write_supervisor is None:
            return f"{self.name}: nothing was written in this session."
        return f"{self.name}: {self.session.write_supervisor.revert_on_request()}"

    def mark(self) -> str:
        """An event in the recording, and a mark in the summary."""
        time, marks = self.session.clock.newest, self.session.history.marks
        if not math.isfinite(time):
            return f"{self.name}: nothing was received yet."
        number = 1 + sum(name.startswith(USER_MARK) for name in tuple(marks))
        marks[f"{USER_MARK}{number}"] = time
        self._record_event(f"mark {USER_MARK}{number} {time!r}")
        where = "" if self.session.recorder is not None else " (there is no recording)"
        return f"{self.name}: mark {number} at {time:.2f} s{where}."

    def land(self) -> str:
        """Land this drone, as a first Ctrl-C would all of them."""
        if self._land is None:
            return f"{self.name}: somebody else flies it."
        self._land()
        return f"{self.name}: landing."

    def _record_event(self, text: str) -> None:
        if self.session.recorder is not None:
            self.session.recorder.event(text)
