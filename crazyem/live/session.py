"""A running estimate over an open link: packets in, samples through the pipeline, everything recorded on the way.

Threads: one receives (records, keeps clock and telemetry; cheap, so flying is never blind), one estimates, one writes
parameters. Setpoints have a thread of their own (stream.py). None of them waits for another.
"""

import math
import queue
import threading
from collections.abc import Callable, Sequence

from crazyem.errors import CrazyemError, DataError, LinkError, UsageError
from crazyem.estimation.result import Estimate
from crazyem.links.base import Block, Link, LinkLost, Packet
from crazyem.live.clock import FirmwareClock
from crazyem.live.guard import Guard, Limits
from crazyem.live.history import History
from crazyem.live.pipeline import Estimator, Pipeline
from crazyem.live.push import Pusher, push_target, read_originals
from crazyem.live.recorder import Recorder
from crazyem.live.telemetry import Telemetry
from crazyem.signals.sample import Sample
from crazyem.signals.vocabulary import MOTOR_BLOCK, ROTOR_SPEED_BLOCK, STATE_BLOCK, decoders
from crazyem.vehicle import Vehicle

RATE = 100.0  # Hz
LINK_EVERY = 1.0  # s between notes on the link's health
STATE = STATE_BLOCK + tuple(f"stateEstimateZ.rate{a}" for a in ("Roll", "Pitch", "Yaw"))
EXTRA = tuple(f"acc.{a}" for a in "xyz") + tuple(f"ctrltargetZ.{a}" for a in "xyz")
WRENCH = ("thrustSi", "torquex", "torquey", "torquez")


def block_plan(available: Sequence[str], *, wrench: str = "ctrlLee") -> list[tuple[str, ...]]:
    """Blocks to log, of what the drone offers, each within 26 bytes; the estimator's needs first.

    The whole rigid state of one instant (22 bytes), motors with voltage and flight state (12, or 20 with rotor
    speeds), accelerometer and active setpoint (18), commanded wrench (16). Body rates come in the state block, in
    steps of 1 mrad/s, rather than as gyro.* in a packet of another instant: blocks are not sampled together, and one
    sample of everything is worth more to the estimator than two halves.

    Raises:
        UsageError: naming a variable the estimator cannot do without.
    """
    names = set(available)
    for needed in (*STATE, *MOTOR_BLOCK):
        if needed not in names:
            raise UsageError(f"the drone has no log variable {needed}, which the estimator needs.")
    motors = MOTOR_BLOCK + (ROTOR_SPEED_BLOCK if names.issuperset(ROTOR_SPEED_BLOCK) else ())
    commanded = tuple(f"{wrench}.{n}" for n in WRENCH)
    optional = (tuple(v for v in extra if v in names) for extra in (EXTRA, commanded))
    return [STATE, motors, *(extra for extra in optional if extra)]


class Session:
    """Estimates from an open link until closed.

    Args:
        link: connected.
        vehicle: nominal constants.
        estimator: fed from one thread.
        recorder: or None.
        wrench: log group of the controller whose commanded thrust and torque are recorded.
        on_estimate: called in the estimator's thread with every estimate.
    """

    def __init__(
        self,
        link: Link,
        *,
        vehicle: Vehicle,
        estimator: Estimator,
        recorder: Recorder | None = None,
        wrench: str = "ctrlLee",
        on_estimate: Callable[[Estimate], None] | None = None,
    ) -> None:
        self.link = link
        self.vehicle = vehicle
        self.recorder = recorder
        self.history = History()
        self.clock = FirmwareClock()
        self.telemetry = Telemetry()
        self.lost: LinkLost | None = None
        self.failure: CrazyemError | None = None
        self.pusher: Pusher | None = None
        self._wrench = wrench
        self._on_estimate = on_estimate
        self.pipeline = Pipeline(estimator, history=self.history, on_estimate=self._estimated)
        self.blocks: tuple[Block, ...] = ()
        self._samples: queue.SimpleQueue[list[Sample] | None] = queue.SimpleQueue()
        self._link_told = -math.inf
        self._end_wanted = False
        self._stop = threading.Event()
        self._closed = False
        self._threads: list[threading.Thread] = []

    @property
    def estimate(self) -> Estimate | None:
        """The newest estimate."""
        return self.history.estimates[-1] if self.history.estimates else None

    def start(self) -> None:
        """Subscribe and let packets flow."""
        plan = block_plan(tuple(self.link.log_variables), wrench=self._wrench)
        blocks: list[Block] = []
        # Threads first: packets of the first block must not pile up behind the set-up of the last.
        for variables in plan:
            blocks.extend(self.link.subscribe(variables, RATE))
        self.blocks = tuple(blocks)
        if self.recorder is not None:
            self.recorder.blocks(self.blocks)
        self._decoders = decoders(self.blocks)
        self._names = {b.identifier: tuple(v.name for v in b.variables) for b in self.blocks}
        for target, name in ((self._receive, "crazyem-receive"), (self._estimate, "crazyem-estimate")):
            thread = threading.Thread(target=target, name=name, daemon=True)
            thread.start()
            self._threads.append(thread)

    def push_to_controller(self, limits: Limits | None = None) -> str:
        """Let the guard push to the controller that runs now; returns a sentence if there is anything to say."""
        controller, note = push_target(self.link)
        self.history.notice(note)
        if controller is None:
            return note
        nominal = dict(zip(("mass", "Ixx", "Iyy", "Izz"), (self.vehicle.mass, *self.vehicle.inertia)))
        originals = read_originals(self.link, controller)
        guard = Guard(controller, nominal=nominal, originals=originals, limits=limits)
        on_write = None
        if self.recorder is not None:
            on_write = self.recorder.parameter_write
            self.recorder.metadata("parameters_at_connect", {k: repr(v) for k, v in originals.items()})
        self.pusher = Pusher(self.link, guard, history=self.history, on_write=on_write)
        self.pipeline.push = self.pusher.submit
        self.pipeline.guard = guard
        return note

    def end_estimates(self) -> None:
        """Keep what comes from now on out of the estimate: a landing excites little and ends near the ground.

        The receiving thread draws the line between two packets and records it, so that a replay draws the same.
        """
        self._end_wanted = True

    def _draw_end(self) -> None:
        until = self.clock.newest  # of the packets before this one; later packets may still carry older stamps
        self.pipeline.estimate_until = until
        self.history.marks["estimate_end"] = until
        if self.recorder is not None:
            self.recorder.event(f"mark estimate_end {until!r}")

    def raise_if_failed(self) -> None:
        """Raise what went wrong in a thread, or that the drone is lost."""
        if self.failure is not None:
            raise self.failure
        if self.lost is not None:
            raise LinkError(self.lost_sentence())

    def lost_sentence(self) -> str:
        """One sentence about a lost drone."""
        reason = self.lost.reason.rstrip(".") if self.lost else "no packets arrive"
        if self.link.uri not in reason:
            reason = f"the drone at {self.link.uri} was lost: {reason}"
        tail = f"; the recording {self.recorder.path} is intact up to there" if self.recorder is not None else ""
        return f"{reason[:1].lower()}{reason[1:]}{tail}."

    def close(self) -> None:
        """Stop receiving, let the estimator finish what has arrived, end the writes. Does not close the link."""
        if self._closed:
            return
        self._closed = True
        self._stop.set()
        for thread in self._threads:
            thread.join(timeout=30.0)
        if self.pusher is not None:
            self.pusher.close()

    def _estimated(self, estimate: Estimate) -> None:
        if self.recorder is not None:
            self.recorder.estimate(estimate)
            residual = getattr(self.pipeline.estimator, "residual", None)
            if residual is not None:
                self.recorder.residual(*residual)
        if self._on_estimate is not None:
            self._on_estimate(estimate)

    def _receive(self) -> None:
        try:
            while not self._stop.is_set():
                try:
                    item = self.link.packets.get(timeout=0.1)
                except queue.Empty:
                    continue
                if isinstance(item, LinkLost):
                    self.lost = item
                    break
                self._packet(item)
        except CrazyemError as error:
            self.failure = error
        except Exception as error:  # a fault of ours must reach the flight as well: it has to land
            self.failure = CrazyemError(f"receiving failed: {error!r}")
        finally:
            self._samples.put(None)

    def _packet(self, packet: Packet) -> None:
        if self._end_wanted and self.pipeline.estimate_until == math.inf and math.isfinite(self.clock.newest):
            self._draw_end()
        self.clock.observe(packet.firmware_time_ms / 1000.0)
        names = self._names.get(packet.block)
        if names is None:
            return  # a block of somebody else's
        if self.recorder is not None:
            self.recorder.packet(packet)
            if packet.host_time - self._link_told >= LINK_EVERY:
                self._link_told = packet.host_time
                self._tell_link(packet)
        if "supervisor.info" in names:
            info = packet.values[names.index("supervisor.info")]
            self.telemetry.info = int(info) if math.isfinite(info) else None
        for name, value in zip(names, packet.values):
            if not math.isfinite(value):
                if self.failure is None:
                    self.failure = DataError(
                        f"log variable {name} is {value} at t = {packet.firmware_time_ms / 1000:.3f} s; "
                        "the estimator stopped."
                    )
                return
        samples = self._decoders[packet.block].decode(packet)
        for sample in samples:
            self.telemetry.take(sample)
        self._samples.put(samples)

    def _tell_link(self, packet: Packet) -> None:
        """The link's health, into the recording; latency against the promptest packets, where the link knows them."""
        assert self.recorder is not None
        clock = getattr(self.link, "clock", None)
        fit = clock() if clock is not None else None
        late = math.nan if fit is None else packet.host_time - fit.to_host(packet.firmware_time_ms)
        self.recorder.link(self.link.statistics(), late)

    def _estimate(self) -> None:
        try:
            while (samples := self._samples.get()) is not None:
                for sample in samples:
                    self.pipeline.sample(sample)
        except CrazyemError as error:
            self.failure = self.failure or error
        except Exception as error:
            self.failure = self.failure or CrazyemError(f"estimating failed: {error!r}")
