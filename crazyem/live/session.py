"""A running estimation over an open link: packets become samples, go through the pipeline, and are recorded.

Threads: one receives (records, updates clock and telemetry; it is fast, so telemetry is always fresh), one estimates,
one writes parameters. Setpoints have their own thread (clock.py). No thread waits for another. In a process with many
sessions, a scheduler receives and estimates for all of them (scheduler.py).
"""

import math
import queue
import threading
import time
from collections.abc import Callable

from crazyem.errors import CrazyemError, DataError, LinkError
from crazyem.estimation.result import Estimate
from crazyem.links.base import (
    AccountingLink,
    AnotherDroneError,
    ClockedLink,
    HostClockLink,
    HoverThrustLink,
    Link,
    LinkLost,
    Outage,
    ReconnectingLink,
    StreamingLink,
    link_account,
)
from crazyem.live.clock import FirmwareClock
from crazyem.live.flight_monitor import FlightMonitor, event_lines
from crazyem.live.guard import Guard
from crazyem.live.history import FrameRecorder, History, Recorder
from crazyem.live.pipeline import Estimator, Pipeline
from crazyem.live.policy import WriteRules, load_policy
from crazyem.live.push import Pusher, hover_rules, hover_target, nominal_estimates, push_target, read_originals
from crazyem.live.scheduler import Mailbox, Scheduler
from crazyem.live.telemetry import Telemetry
from crazyem.live.write_gate import WriteGate
from crazyem.live.write_supervisor import WriteSupervisor
from crazyem.monitoring.fault import Fault
from crazyem.signals.sample import Block, Packet, Sample
from crazyem.signals.vocabulary import block_plan, decoders
from crazyem.vehicle import Vehicle

# 11 ms, not 10 ms, which is the period of the onboard estimator's prediction: with equal periods, logged commands have
# a constant error of a part of a step for seconds (docs/explanation/estimator.md, In step).
LOG_RATE = 1000.0 / 11.0  # Hz
LINK_RECORD_PERIOD = 1.0  # s between records of the link's statistics
# Without low-level setpoints a drone levels out after 0.5 s and cuts its motors after 2 s; a drone that hovers by
# itself goes on. So a reconnection is useful, but only for a short time.
RECONNECT_WITHIN = 8.0  # s


class Session:
    """Estimates from an open link until closed.

    Args:
        link: connected.
        wrench: log group of the controller whose commanded thrust and torque are recorded.
        on_estimate: called in the estimator's thread with every estimate.
        rate: of the log, Hz; above 100 the firmware must allow block periods in milliseconds.
        reconnect_within: s, longest time to reconnect a lost link, 0 = never. The window is kept: the estimator begins
            a new stretch after the gap in the stamps.
        scheduler: its threads receive and estimate, for many sessions in one process; None: the session's own threads.
        monitor: of faults in flight; on_fault: called in the estimator's thread with its reports.
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
        rate: float = LOG_RATE,
        reconnect_within: float = RECONNECT_WITHIN,
        scheduler: Scheduler | None = None,
        monitor: FlightMonitor | None = None,
        on_fault: Callable[[Fault], None] | None = None,
    ) -> None:
        self.link = link
        self.vehicle = vehicle
        self.recorder = recorder
        self.history = History()
        self.clock = FirmwareClock()
        self.telemetry = Telemetry()
        self.lost: LinkLost | None = None
        self.outages: list[Outage] = []
        self.rate, self.reconnect_within = rate, reconnect_within
        self._linked = threading.Event()
        self._linked.set()
        self.failure: CrazyemError | None = None
        self.pusher: Pusher | None = None
        self.write_supervisor: WriteSupervisor | None = None
        self._wrench = wrench
        self._on_estimate = on_estimate
        self._on_fault = on_fault or (lambda fault: None)
        self.landing_wanted = ""  # why the drone must land at once, by the policy
        if monitor is not None:
            monitor.on_fault = self._found_fault
        self.pipeline = Pipeline(estimator, history=self.history, on_estimate=self._estimated, monitor=monitor)
        self.pipeline.on_step = lambda step: self.record_event(str(step))
        self.blocks: tuple[Block, ...] = ()
        self._samples: queue.SimpleQueue[list[Sample] | None] = queue.SimpleQueue()
        self._scheduler = scheduler
        self._mailbox = Mailbox(scheduler, self._feed, self._estimating_failed) if scheduler is not None else None
        self._receiving_ended = False  # nothing is received any more
        self._reconnection: threading.Thread | None = None  # with a scheduler only: its thread must not wait
        self._link_recorded = -math.inf
        self._end_wanted = self._closed = False
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []

    @property
    def estimate(self) -> Estimate | None:
        """The newest estimate."""
        return self.history.estimates[-1] if self.history.estimates else None

    def start(self) -> None:
        """Subscribe to log blocks and start the threads."""
        blocks: list[Block] = []
        if isinstance(self.link, StreamingLink):
            if isinstance(self.recorder, FrameRecorder):
                self.link.on_frame = self.recorder.frame
            blocks.extend(self.link.start_streams(self.rate))
        else:
            # Each block sends packets from its subscription on.
            for variables in block_plan(tuple(self.link.log_variables), wrench=self._wrench):
                blocks.extend(self.link.subscribe(variables, self.rate))
        self.blocks = tuple(blocks)
        if self.recorder is not None:
            self.recorder.blocks(self.blocks)
        self._decoders = decoders(self.blocks)
        self._names = {b.identifier: tuple(v.name for v in b.variables) for b in self.blocks}
        if self._scheduler is not None:
            self._scheduler.poller.add(self._take_in)
            return
        for target, name in ((self._receive, "crazyem-receive"), (self._estimate, "crazyem-estimate")):
            thread = threading.Thread(target=target, name=name, daemon=True)
            thread.start()
            self._threads.append(thread)

    def push_to_controller(self, rules: WriteRules | None = None) -> str:
        """Let the guard push to the active controller, by the shipped policy without `rules`.

        Returns: a sentence for the user, or "".
        """
        rules = rules or WriteRules(load_policy())
        if isinstance(self.link, HoverThrustLink):
            controller, note = hover_target(self.link, self.vehicle)
            rules = hover_rules(rules, self.link, controller)
        else:
            controller, note = push_target(self.link, self.vehicle)
        self.history.notice(note)
        if controller is None:
            return note
        nominal = nominal_estimates(self.vehicle, controller)
        originals = read_originals(self.link, controller)
        guard = Guard(controller, nominal=nominal, originals=originals, limits=rules.policy.limits)
        on_write = None
        if self.recorder is not None:
            on_write = self.recorder.parameter_write
            self.recorder.metadata("parameters_at_connect", {k: repr(v) for k, v in originals.items()})
            self.recorder.metadata("guard", {"mode": rules.mode, "policy": rules.policy.to_toml()})
        host_clock = self.link.host_clock if isinstance(self.link, HostClockLink) else time.time
        gate = WriteGate(self.telemetry, rules.policy.health, rate=lambda: self.clock.rate, now=host_clock)
        write_supervisor = WriteSupervisor(
            guard,
            rules,
            originals=originals,
            history=self.history,
            gate=gate,
            now=lambda: self.clock.newest,
            residual=lambda: getattr(self.pipeline.estimator, "residual", None),
            enabled=lambda time: self.pipeline.push_from <= time <= self.pipeline.push_until,
            record=self.record_event,
            fault=self.pipeline.fault_objection,
        )
        if not rules.dry_run:
            self.pusher = write_supervisor.pusher = Pusher(
                self.link,
                guard,
                gate=gate,
                history=self.history,
                on_write=on_write,
                wait_for_link=self.wait_for_link,
                outages=lambda: len(self.outages) + self.reconnecting,
                known=originals,
                on_done=write_supervisor.on_written,
            )
            self.pipeline.push = self.pusher.submit
        self.pipeline.guard = self.write_supervisor = write_supervisor
        return note

    def stop_pushing(self, *, motors_cut: bool = False) -> None:
        """Begin no new set of writes, as the first step of every end. motors_cut: do not complete a set either."""
        if self.write_supervisor is not None:
            self.write_supervisor.stop(motors_cut=motors_cut)

    def end_pushing(self, outcome: str) -> None:
        """The flight has ended (`landed`, `interrupted`, `failed`, `link_lost`): keep or restore, by the policy."""
        if self.write_supervisor is not None:
            self.write_supervisor.end(outcome)

    def end_estimates(self) -> None:
        """Leave later samples out of the estimate: a landing excites little and ends near the ground.

        The receiving thread sets the end time between two packets and records it, so that a replay uses the same.
        """
        self._end_wanted = True

    def mark(self, name: str, time: float) -> None:
        """Add a mark at `time` [s] of the drone's clock to history and recording."""
        self.history.marks[name] = time
        self.record_event(f"mark {name} {time!r}")

    def record_event(self, text: str) -> None:
        """Add an event to the recording, if there is one."""
        if self.recorder is not None:
            self.recorder.event(text)

    def raise_if_failed(self) -> None:
        """Raise the error of a thread, or LinkError if the drone is lost."""
        if self.failure is not None:
            raise self.failure
        if self.lost is not None:
            raise LinkError(self.lost_sentence())

    def lost_sentence(self) -> str:
        """One sentence about a lost drone."""
        reason = self.lost.reason.rstrip(".") if self.lost else "no packets arrive"
        if self.link.uri not in reason:
            reason = f"the drone at {self.link.uri} was lost: {reason}"
        tail = ""
        if self.recorder is not None and self.recorder.path:
            tail = f"; the recording {self.recorder.path} is intact up to there"
        return f"{reason[:1].lower()}{reason[1:]}{tail}."

    def close(self) -> None:
        """End the writes, stop receiving, and let the estimator finish the received samples. The link stays open.

        The order matters: the write gate needs telemetry as long as writes are possible, and the estimates at the end
        must not be pushed.
        """
        if self._closed:
            return
        self._closed = True
        self.stop_pushing()
        if self.pusher is not None:
            self.pusher.close()
        self._stop.set()
        for thread in self._threads:
            thread.join(timeout=30.0)
        if self._scheduler is not None and self._mailbox is not None:
            self._scheduler.poller.remove(self._take_in)
            if self._reconnection is not None:
                self._reconnection.join(timeout=30.0)
            self._mailbox.wait(30.0)
        if self.write_supervisor is not None:
            self.write_supervisor.close()
        if self.recorder is not None and self.blocks:
            account = self.link.account() if isinstance(self.link, AccountingLink) else {}
            self.recorder.metadata("link", {**link_account(self.link.statistics(), self.outages), **account})

    def _estimated(self, estimate: Estimate) -> None:
        if self.recorder is not None:
            self.recorder.estimate(estimate)
            residual = getattr(self.pipeline.estimator, "residual", None)
            if residual is not None:
                self.recorder.residual(*residual)
        if self._on_estimate is not None:
            self._on_estimate(estimate)

    def _found_fault(self, fault: Fault) -> None:
        """Report a fault to recording, history and callback; its settled report comes after the first one."""
        for line in event_lines(fault):
            self.record_event(line)
        if fault.settled:
            self.history.notice(f"{fault}.")
        if self.pipeline.monitor is not None and self.pipeline.monitor.wants_landing(fault):
            self.landing_wanted = self.landing_wanted or str(fault)
        self._on_fault(fault)

    def _receive(self) -> None:
        try:
            while not self._stop.is_set():
                try:
                    item = self.link.packets.get(timeout=0.1)
                except queue.Empty:
                    continue
                if isinstance(item, LinkLost):
                    if self._reconnect(item):
                        continue
                    break
                self._packet(item)
        except Exception as error:
            self._receiving_failed(error)
        finally:
            self._samples.put(None)

    def _take_in(self) -> bool:
        """Process received packets in a scheduler's thread, without waiting; returns whether there were any."""
        if self._reconnection is not None:
            if self._reconnection.is_alive():
                return False
            self._reconnection = None
        some = False
        try:
            while not self._receiving_ended and not self._stop.is_set():
                item = self.link.packets.get_nowait()
                some = True
                if isinstance(item, LinkLost):
                    self._linked.clear()
                    self._reconnection = threading.Thread(
                        target=self._reconnect_in_background, args=(item,), name="crazyem-reconnect", daemon=True
                    )
                    self._reconnection.start()
                    break
                self._packet(item)
        except queue.Empty:
            pass
        except Exception as error:
            self._receiving_failed(error)
        return some

    def _reconnect_in_background(self, lost: LinkLost) -> None:
        try:
            self._receiving_ended = not self._reconnect(lost)
        except Exception as error:
            self._receiving_failed(error)
        finally:
            self._linked.set()

    def _receiving_failed(self, error: Exception) -> None:
        """Store an internal error, so that the flight ends with a landing."""
        self._receiving_ended = True
        self.telemetry.heard = -math.inf
        self.stop_pushing()
        self.failure = _known(error, "receiving")

    @property
    def reconnecting(self) -> bool:
        """Whether the link is lost and being brought back."""
        return not self._linked.is_set()

    def wait_for_link(self) -> bool:
        """Wait until the link is back or lost for good; returns whether it works. Returns at once without an outage."""
        self._linked.wait(self.reconnect_within + 5.0)
        return self._linked.is_set() and self.lost is None

    def _reconnect(self, lost: LinkLost) -> bool:
        """Reconnect the link; nothing is received during this time. False: the link is lost for good."""
        self.telemetry.heard = -math.inf
        link = self.link
        if not isinstance(link, ReconnectingLink) or not link.can_reconnect or self.reconnect_within <= 0.0:
            self._give_up(lost)
            return False
        self._linked.clear()
        self.record_event(f"the link was lost, trying again: {lost.reason}")
        try:
            outage = link.reconnect(self.reconnect_within, self._stop)
        except LinkError as error:
            reason = f"{lost.reason.rstrip('.')}; {str(error)[:1].lower()}{str(error)[1:]}"
            self._give_up(LinkLost(reason, lost.host_time, restarted=isinstance(error, AnotherDroneError)))
            return False
        else:
            self.outages.append(outage)
        finally:
            self._linked.set()
        sentence = (
            f"the link was gone for {outage.seconds:.1f} s (no data from {outage.before_ms / 1000:.3f} to "
            f"{outage.after_ms / 1000:.3f} s of the drone's clock) and came back."
        )
        self.history.notice(sentence)
        self.record_event(sentence)
        return True

    def _give_up(self, lost: LinkLost) -> None:
        self.stop_pushing()
        if lost.restarted and self.write_supervisor is not None:
            self.write_supervisor.on_restart()
        self.lost = lost

    def _packet(self, packet: Packet) -> None:
        if self._end_wanted and self.pipeline.estimate_until == math.inf and math.isfinite(self.clock.newest):
            until = self.clock.newest  # of the packets before this one; later packets may still carry older stamps
            self.pipeline.estimate_until = until
            self.mark("estimate_end", until)
        self.clock.observe(packet.firmware_time_ms / 1000.0)
        names = self._names.get(packet.block)
        if names is None:
            return  # a block of another client
        if self.recorder is not None:
            self.recorder.packet(packet)
            if packet.host_time - self._link_recorded >= LINK_RECORD_PERIOD:
                self._link_recorded = packet.host_time
                fit = self.link.clock() if isinstance(self.link, ClockedLink) else None
                # latency against the fastest packets
                late = math.nan if fit is None else packet.host_time - fit.to_host(packet.firmware_time_ms)
                self.recorder.link(self.link.statistics(), late)
        if "supervisor.info" in names:
            info = packet.values[names.index("supervisor.info")]
            self.telemetry.info = int(info) if math.isfinite(info) else None
            self.telemetry.heard = packet.host_time
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
        if self.write_supervisor is not None:
            self.write_supervisor.take(samples)
        (self._samples if self._mailbox is None else self._mailbox).put(samples)

    def _estimate(self) -> None:
        try:
            while (samples := self._samples.get()) is not None:
                self._feed(samples)
        except Exception as error:
            self._estimating_failed(error)

    def _feed(self, samples: list[Sample]) -> None:
        for sample in samples:
            self.pipeline.sample(sample)

    def _estimating_failed(self, error: Exception) -> None:
        self.failure = self.failure or _known(error, "estimating")


def _known(error: Exception, what: str) -> CrazyemError:
    return error if isinstance(error, CrazyemError) else CrazyemError(f"{what} failed: {error!r}")
