"""Receiving and estimating for many drones at once with a few threads; late estimators skip updates.

One thread receives packets for all drones, because waking one thread for each drone costs more than the work itself. A
worker takes the drone that has waited longest and gives its samples to its estimator. Kernels release the interpreter
lock, so each worker can run an update at the same time. If this is too slow, updates are skipped, but never samples:
the next update uses all of them.
"""

import math
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from crazyem.estimation.result import Estimate
from crazyem.signals.sample import Sample

POLL_PAUSE = 0.002  # s between two rounds of receiving: a twentieth of an update's budget
TIME_SLICE = 0.01  # s, longest work for one drone while others wait
LONGEST_DEFERRAL = 1.0  # s of the drone's clock, longest time without an update
NO_UPDATE = 1 << 30  # samples between updates that mean no update
FULL_PASSES_EVERY = 12  # updates between costly full passes, which are spread over the drones
MANY_DRONES = 5  # with more drones, full passes are less frequent
MANY_DRONES_FULL_PASSES_EVERY = 100  # updates between full passes then


class Mailbox:
    """Queue of received items of one drone; one worker at a time processes them in order.

    Args:
        work: processes an item; an exception ends the mailbox and goes to `failed`.
    """

    def __init__(
        self, scheduler: "Scheduler", work: Callable[[Any], None], failed: Callable[[Exception], None]
    ) -> None:
        self._scheduler, self._work, self._failed = scheduler, work, failed
        self._items: deque[Any] = deque()
        self._lock = threading.Lock()
        self._queued = False
        self._ended = False
        self._idle = threading.Event()
        self._idle.set()

    def put(self, item: Any) -> None:
        """Add an item; returns at once."""
        with self._lock:
            if self._ended:
                return
            self._items.append(item)
            self._idle.clear()
            if self._queued:
                return
            self._queued = True
        self._scheduler.enqueue(self)

    def wait(self, timeout: float) -> bool:
        """Wait at most `timeout` [s] until all items are processed; returns whether they are."""
        return self._idle.wait(timeout)

    def run_slice(self) -> None:
        """Process items for at most `TIME_SLICE` (in a worker's thread)."""
        until = time.monotonic() + TIME_SLICE
        while True:
            with self._lock:
                if not self._items:
                    self._queued = False
                    self._idle.set()
                    return
                item = self._items.popleft()
            try:
                self._work(item)
            except Exception as error:
                with self._lock:
                    self._ended, self._queued = True, False
                    self._items.clear()
                self._idle.set()
                self._failed(error)
                return
            if time.monotonic() >= until:
                break
        self._scheduler.enqueue(self)  # behind the other waiting mailboxes


class PacketPoller:
    """One thread that receives packets of all drones in turn."""

    def __init__(self) -> None:
        self._sources: tuple[Callable[[], bool], ...] = ()
        self._lock = threading.Lock()  # held during a round
        self._wanted = threading.Event()
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="crazyem-receive", daemon=True)
        self._thread.start()

    def add(self, take_in: Callable[[], bool]) -> None:
        """Call `take_in` repeatedly from now on; it must not block, and returns whether it received something."""
        with self._lock:
            self._sources = (*self._sources, take_in)
        self._wanted.set()

    def remove(self, take_in: Callable[[], bool]) -> None:
        """Stop the calls of `take_in`; waits for a running call."""
        with self._lock:
            self._sources = tuple(s for s in self._sources if s != take_in)

    def close(self) -> None:
        """End the thread."""
        self._ended = True
        self._wanted.set()
        self._thread.join(timeout=10.0)

    def _run(self) -> None:
        while not self._ended:
            if not self._sources:
                self._wanted.wait()
                self._wanted.clear()
            with self._lock:
                some = [take_in() for take_in in self._sources]
            # a pause in any case: without it, each single packet would cost a round
            time.sleep(POLL_PAUSE if any(some) else 2 * POLL_PAUSE)


class Scheduler:
    """Worker threads for all mailboxes (one for each core), first come, first served, and the thread `poller`."""

    def __init__(self, workers: int | None = None) -> None:
        self.workers = workers or max(1, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 2)
        self._ready: queue.SimpleQueue[Mailbox | None] = queue.SimpleQueue()
        self._threads = [
            threading.Thread(target=self._run, name=f"crazyem-estimate-{i}", daemon=True) for i in range(self.workers)
        ]
        for thread in self._threads:
            thread.start()
        self.poller = PacketPoller()

    def enqueue(self, mailbox: Mailbox) -> None:
        """Queue a mailbox for a worker (called by mailboxes)."""
        self._ready.put(mailbox)

    def close(self) -> None:
        """End the threads; remaining items in mailboxes are not processed."""
        self.poller.close()
        for _ in self._threads:
            self._ready.put(None)
        for thread in self._threads:
            thread.join(timeout=10.0)

    def _run(self) -> None:
        while (mailbox := self._ready.get()) is not None:
            mailbox.run_slice()


class UpdateThrottle:
    """An estimator that skips updates while it is late, and that updates at other times than those of other drones.

    Args:
        inner: an OnlineEstimator, or one with its `feed`, `finish`, `share_computer` and the attribute `every`.
        number, of: number of this drone and number of drones; they shift its first update.
        late: s behind the newest packet from which updates are skipped; None: the time between updates at 100 Hz.

    Attributes:
        skipped: number of skipped updates.
        behind: s from the newest processed sample to the newest received packet.
    """

    def __init__(self, inner: Any, *, number: int = 0, of: int = 1, late: float | None = None) -> None:
        self.inner = inner
        self.newest: Callable[[], float] = lambda: math.nan  # s, the drone's clock as received; set by the session
        self.skipped = 0
        self._every = int(inner.every)
        self._late = late if late is not None else 0.01 * self._every
        if of > MANY_DRONES:
            inner.share_computer(MANY_DRONES_FULL_PASSES_EVERY)
        self._phase = round(
            number * self._every * (MANY_DRONES_FULL_PASSES_EVERY if of > MANY_DRONES else FULL_PASSES_EVERY) / of
        )
        self._held = 0  # samples of position since updates are skipped
        self._last = math.nan
        self._time = math.nan
        self._hold = False
        self.behind = 0.0

    @property
    def airborne(self) -> bool:
        """Of the inner estimator."""
        return bool(self.inner.airborne)

    @property
    def update_seconds(self) -> Sequence[float]:
        """Of the inner estimator."""
        seconds: Sequence[float] = self.inner.update_seconds
        return seconds

    @property
    def residual(self) -> Any:
        """Of the inner estimator, None if it has none."""
        return getattr(self.inner, "residual", None)

    def feed(self, sample: Sample) -> Estimate | None:
        """One sample; see `OnlineEstimator.feed`."""
        if sample.time != self._time:  # an instant has several samples; its first one may cause an update
            self._begin(sample.time)
        estimate: Estimate | None = self.inner.feed(sample)
        if self._hold and sample.signal == "position":
            self._held += 1
        if estimate is not None:
            self.skipped += self._held // self._every
            self._held = self._phase = 0
            self._last = sample.time
        return estimate

    def _begin(self, time: float) -> None:
        """Decide whether an update may be made at the samples of `time` [s]."""
        self._time = time
        if math.isnan(self._last):
            self._last = time
        self.behind = self.newest() - time
        self._hold = self.behind > self._late and time - self._last <= LONGEST_DEFERRAL
        self.inner.every = NO_UPDATE if self._hold else self._every + self._phase

    def finish(self) -> Estimate:
        """The final estimate, without skipping."""
        self.inner.every = self._every
        estimate: Estimate = self.inner.finish()
        return estimate
