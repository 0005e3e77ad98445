"""The online estimator: samples in, estimates out; deterministic, so a replay gives the numbers of the flight.

Samples of one instant form a node. A node waits until the inputs up to its time are known. Then it passes the contact
gate and goes onto the tape. Every `every` nodes, the newest `window` nodes give an update. An update is an incremental
pass, or full passes while the parameters still move. Every 12th update (half a second at 100 Hz) is full passes, too,
which renew the uncertainty."""

import math
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from crazyem.errors import DataError, UsageError
from crazyem.estimation.contact import ContactGate
from crazyem.estimation.em import Information, WindowEM, offset
from crazyem.estimation.in_step import corrected, in_step
from crazyem.estimation.inputs import LARGEST_VALUE, MAX_GAP, SETTLED_TIME_CONSTANTS, InputHistory, is_plausible
from crazyem.estimation.marginal import Marginal, MarginalRefresh
from crazyem.estimation.maximum import PASSED_SCORE_TEST, Maximum, maximise_posterior
from crazyem.estimation.model import INTEGRATION, KnownNoise, Parameters, Setup, setup_for
from crazyem.estimation.result import Estimate
from crazyem.estimation.tape import Tape
from crazyem.estimation.verdict import estimate_of, nothing_known
from crazyem.physics.lag import CAUSAL, HOLD, LINEAR
from crazyem.physics.rotors import wrench_from_one_command, wrench_from_speed
from crazyem.signals.sample import Sample
from crazyem.vehicle import Vehicle

SAME_NODE = 0.0015  # s; measurements closer than this belong to one node
PATIENCE = 0.06  # s that a node waits for inputs; then the last input is held
LOOKBACK = 20  # samples smoothed again in an incremental pass
REFRESH = 12  # updates between two full passes with information
YOUNG = 200  # samples; in a smaller window every update is full passes
NEWBORN = 24  # samples; a smaller window gets more passes (12), since a cold start uses these first estimates
CLOSE = 0.1  # standard deviations from the maximum at which full passes end
PASSED_NOISE = 2.0  # standard deviations; longest scoring step of a noise scale at convergence: some 5 % of an interval
# Change of a parameter's logarithm that leads to full passes: a share of its standard deviation, between two limits.
MOVED_SD, MOVED, MOVED_FAR = 0.5, 0.02, 0.1

# s between attitudes of an onboard filter that are used. The filter integrates its gyro between fixes, so errors of its
# attitude follow from errors of its rates and last far longer than a sample. Taken as ten independent attitudes in
# 0.1 s, they contradict the rates, and inertia in hover comes out too high (docs: estimator.md, docs: mavlink.md).
ATTITUDE_PERIOD = 0.05

Filtered = Callable[[WindowEM, Parameters, int, int, "NDArray[np.float64] | None"], None]

STATE_COLUMNS = {"position": slice(0, 3), "velocity": slice(3, 6), "attitude": slice(6, 10), "body_rate": slice(10, 13)}
_INPUTS = ("motor_command", "rotor_speed", "wrench_command")


@dataclass
class Counters:
    """Numbers of nodes, and of samples that were not used."""

    nodes: int = 0
    grounded: int = 0
    late: int = 0
    missing: int = 0  # samples with NaN or impossible values
    breaks: int = 0
    unpowered: int = 0  # motor commands before any battery voltage was known


@dataclass
class _Node:
    time: float
    y: NDArray[np.float64] = field(default_factory=lambda: np.full(16, np.nan))  # 13 of the tape, specific force


class OnlineEstimator:
    """Windowed online EM for mass, inertia, rotor time constant and noise scales.

    Args:
        vehicle: nominal constants: rotors, start, centre of the weak prior.
        window: number of newest samples in an update.
        every: samples between updates.
        input_signal: motor_command, rotor_speed or wrench_command; None takes the first of these the vehicle can use.
        mass, inertia: start values of a cold start [kg], [kg m^2].
        integration: midpoint, euler or semi-implicit: the rule of integration of the data. Real flights follow the
            first, a simulator its own.
        accelerometer: whether to use specific_force, the mean over the step that ends at its stamp. Off by default: a
            real accelerometer measures the vibration of its frame.
        known_noise: noise that is known and not estimated.
        attitude_period: s between attitudes that are used where body rates are measured, too; 0 uses all (see above).
        prediction_period: s between predictions of an onboard estimate, constant in between; 0: unknown (in_step.py).

    Attributes:
        every: samples between updates; may be changed in flight.
        airborne: verdict of the contact gate on the newest node.
        update_seconds: wall-clock cost of each update [s].
        full_updates: number of updates with full passes.
        settled: path to the maximum in the last `finish`.
        counters: numbers of samples.
        on_filtered: called with rows filtered for the first time: (em, parameters used, first, last, sds or None).
    """

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        window: int = 800,
        every: int = 4,
        input_signal: str | None = None,
        mass: float | None = None,
        inertia: tuple[float, float, float] | None = None,
        integration: str = "midpoint",
        accelerometer: bool = False,
        known_noise: KnownNoise | None = None,
        attitude_period: float = 0.0,
        prediction_period: float = 0.0,
    ) -> None:
        if window < 20:
            raise UsageError(f"a window of {window} samples is too short to estimate from (at least 20)")
        if every < 1:
            raise UsageError(f"an update every {every} samples is not possible (at least 1)")
        if input_signal is not None and input_signal not in _INPUTS:
            raise UsageError(f"unknown input signal '{input_signal}' (known: {', '.join(_INPUTS)})")
        if integration not in INTEGRATION:
            raise UsageError(f"unknown integration '{integration}' (known: {', '.join(INTEGRATION)})")
        self.vehicle = vehicle
        self.window = window
        self.every = every
        self._refresh, self._deferring, self._owed = REFRESH, False, False
        self._input = input_signal
        self._make_setup = partial(
            setup_for, vehicle, mass=mass, inertia=inertia, integration=integration, known_noise=known_noise
        )
        self._measured = {**STATE_COLUMNS, "specific_force": slice(13, 16)} if accelerometer else STATE_COLUMNS
        self._attitude_period, self._prediction_period = attitude_period, prediction_period
        self._attitude_time = self._rate_time = -math.inf  # s, newest attitude that is used, newest rates
        self._setup: Setup | None = None
        self._em: WindowEM | None = None
        self._tape = Tape(3 * window + 64)
        self._inputs = InputHistory(CAUSAL)
        self._gate = ContactGate(4 * vehicle.thrust_max)
        self._group: dict[str, tuple[float, ...]] = {}
        self._group_time = -math.inf
        self._pending: list[_Node] = []
        self._voltage = math.nan
        self._flying: bool | None = None
        self._starts = True
        self._fresh = 0  # first row not yet filtered
        self._since = 0
        self._updates = 0
        self._information: Information | None = None
        self._reference: Parameters | None = None  # parameters of the last full pass
        self._refreshed = MarginalRefresh()
        self._marginal: Marginal | None = None
        self._converged = False
        self._unconverged, self._refined = 0, 0  # full passes in a row that did not converge; update of the last one
        self._last_time = math.nan
        self.settled: Maximum | None = None
        self.counters = Counters()
        self.update_seconds: list[float] = []
        self.full_updates = 0
        self.on_filtered: Filtered | None = None

    # input ---------------------------------------------------------------------------------------------------

    @property
    def airborne(self) -> bool:
        """Whether the newest node was in free flight."""
        return self._gate.airborne

    @property
    def trace(self) -> list[NDArray[np.float64]]:
        """Parameters (9,) at every point on the path to the maximum in the last `finish`; empty before."""
        return [] if self.settled is None else [stop.theta for stop in self.settled.path]

    @property
    def residual(self) -> tuple[float, NDArray[np.float64], NDArray[np.float64]] | None:
        """Innovation of the newest filtered sample; None if there is none, or at a break.

        Returns: its time [s]; (12,) innovations of position [m], velocity [m/s], attitude [rad, body] and body rate
        [rad/s]; (12,) their expected standard deviations. Each component is predicted with the help of the components
        before it. NaN where nothing was measured.
        """
        k = self._fresh - 1
        if self._em is None or k < 0 or k >= self._tape.size or self._tape.kind[k]:
            return None
        sd = np.sqrt(np.where((variance := self._tape.s[k]) > 0, variance, np.nan))
        return float(self._tape.time[k]), np.where(variance > 0, self._tape.e[k], np.nan), sd

    def feed(self, sample: Sample) -> Estimate | None:
        """Take one sample; returns an estimate if there was an update. Samples of unknown signals are ignored."""
        result = None
        if self._owed:
            begin = clock.perf_counter()
            self._full_passes()
            self.update_seconds[-1] += clock.perf_counter() - begin
        if sample.time != self._group_time:
            result = self._close_group()
            self._group_time = sample.time
        self._group[sample.signal] = sample.value
        return result

    def share_computer(self, refresh: int) -> None:
        """Answer fast where many estimators share a computer: full passes are made after the estimate, and less often.

        Full passes cost as much as twenty updates, and other estimators wait meanwhile. Their result is in the next
        estimate. With a full window they come every `refresh` updates (at least twice a window), or when a parameter
        has moved by a standard deviation.
        """
        self._refresh, self._deferring = min(refresh, max(REFRESH, self.window // (2 * self.every))), True

    def finish(self) -> Estimate:
        """The estimate of the newest window, converged, with fresh uncertainty.

        Raises:
            DataError: there were no inputs that this vehicle can use.
        """
        self._close_group()
        self._admit(flush=True)
        self._owed = False
        if self._inputs.size == 0:
            raise DataError(
                f"nothing to estimate from: vehicle '{self.vehicle.name}' needs "
                + ("motor commands with battery voltage" if self.vehicle.thrust_curve else "a thrust and torque signal")
                + ", and the data have none"
            )
        if self._em is not None and self._tape.size > 5:
            first = max(0, self._tape.size - self.window)
            if self._fresh < self._tape.size:
                self._em.incremental(first, self._fresh, self._tape.size, lookback=LOOKBACK)
                self._fresh = self._tape.size
            self.settled = maximise_posterior(self._em, first, self._tape.size)
            self._information = self._with_ages(self._em, first, self._tape.size, self.settled.information)
            self._marginal = self.settled.marginal
            self._converged = self.settled.converged
            self._updates += 1
        return self._estimate()

    def _close_group(self) -> Estimate | None:
        group, time = self._group, self._group_time
        if not group:
            return None
        self._group = {}
        if "voltage" in group and math.isfinite(group["voltage"][0]):
            self._voltage = group["voltage"][0]
        if "flying" in group and math.isfinite(group["flying"][0]):
            self._flying = group["flying"][0] > 0.5
        self._take_input(group, time)
        if any(name in group for name in self._measured):
            self._take_measurement(group, time)
        return self._admit(flush=False)

    def _take_input(self, group: dict[str, tuple[float, ...]], time: float) -> None:
        if self._input is None:
            usable = {
                "rotor_speed": self.vehicle.rotor_constant is not None,
                "motor_command": bool(self.vehicle.thrust_curve),
                "wrench_command": not self.vehicle.thrust_curve,
            }
            seen = [n for n in ("rotor_speed", "motor_command", "wrench_command") if usable[n] and n in group]
            seen = [n for n in seen if n != "rotor_speed" or np.all(np.isfinite(group[n]))]
            if not seen:
                return
            self._input = seen[0]
        if self._input not in group:
            return
        if not is_plausible(self._input, group[self._input]):
            self.counters.missing += 1
            return
        value = group[self._input]
        if self._input == "motor_command":
            if math.isnan(self._voltage):
                self.counters.unpowered += 1
                return
            wrench = wrench_from_one_command(value, self._voltage, self.vehicle)
        elif self._input == "rotor_speed":
            wrench = wrench_from_speed(value, self.vehicle)
        else:
            wrench = np.asarray(value, float)
        if self._setup is None:
            self._setup = self._make_setup(lag=self._input != "rotor_speed")
            if not self._setup.free[4]:
                self._inputs.mode = LINEAR if self._input == "rotor_speed" else HOLD
            self._em = WindowEM(self._setup, self._tape, self._inputs)
        oldest = self._tape.time[max(0, self._tape.size - self.window)] if self._tape.size else time
        if not self._inputs.append(time, wrench, needed_from=oldest - 2.0):
            self.counters.late += 1

    def _take_measurement(self, group: dict[str, tuple[float, ...]], time: float) -> None:
        newest = self._pending[-1].time if self._pending else self._last_time
        if time <= newest + 1e-9:
            self.counters.late += 1
            return
        joins = bool(self._pending) and time - self._pending[-1].time < SAME_NODE
        node = self._pending[-1] if joins else _Node(time)
        known = joins  # a waiting node has measurements already
        for name, columns in self._measured.items():
            if name in group:
                value = group[name]
                if is_plausible(name, value):
                    node.y[columns] = value
                    known = True
                    continue
                self.counters.missing += 1
                if name != "attitude":  # an attitude with missing components is not used
                    node.y[columns] = part = [v if abs(v) < LARGEST_VALUE[name] else math.nan for v in value]
                    known = known or not all(math.isnan(v) for v in part)
        if known and not joins:
            self._pending.append(node)

    # nodes onto the tape ------------------------------------------------------------------------------------

    def _admit(self, *, flush: bool) -> Estimate | None:
        result = None
        if self._em is None:
            if len(self._pending) > 3:  # no inputs yet: these nodes cannot be used
                del self._pending[:-3]
            return None
        while self._pending:
            node = self._pending[0]
            newest = max(self._pending[-1].time, self._inputs.newest)
            if not flush and self._inputs.newest < node.time and newest - node.time < PATIENCE:
                break
            if not flush and len(self._pending) == 1 and newest - node.time < SAME_NODE:
                break  # another block may still bring measurements of this instant
            self._pending.pop(0)
            result = self._place(node) or result
        return result

    def _place(self, node: _Node) -> Estimate | None:
        assert self._em is not None
        self._last_time = node.time
        self.counters.nodes += 1
        inputs, tape = self._inputs, self._tape
        tau, delay = self._em.parameters.theta[4:6].tolist()
        if node.time < inputs.times[0]:
            return None
        thrust = float(inputs.wrenches[inputs.at(node.time), 0])
        airborne = self._gate.update(height=float(node.y[2]), thrust=thrust, flying=self._flying)
        if not airborne:
            self.counters.grounded += 1
            self._starts = True
            if self._fresh == tape.size:
                inputs.skip_to(node.time, tau, delay)
            return None
        previous = tape.time[tape.size - 1] if tape.size else -math.inf
        starts = self._starts or node.time - previous > MAX_GAP or not inputs.covers(previous, node.time)
        if starts:
            self.counters.breaks += 1
        self._starts = False
        self._thin_attitude(node, starts=starts)
        if tape.size == tape.capacity and self._fresh < tape.size:
            # long time between updates: rows must be filtered before they are dropped from the tape
            self._filter_fresh(self._em, max(0, tape.size - self.window))
        keep = self.window + LOOKBACK + 2 * min(self.every, self.window) + 8
        dropped = tape.append(node.time, node.y[:13], starts=starts, keep=keep)
        tape.force[tape.size - 1] = node.y[13:]
        self._fresh -= dropped
        if (
            node.time - inputs.gap_end < SETTLED_TIME_CONSTANTS * max(tau, 0.02)
            and self._setup is not None
            and self._setup.free[4]
        ):
            tape.usable[tape.size - 1] = False
        self._since += 1
        if self._since < self.every:
            return None
        self._since = 0
        begin = clock.perf_counter()
        self._update()
        self.update_seconds.append(clock.perf_counter() - begin)
        return self._estimate()

    def _thin_attitude(self, node: _Node, *, starts: bool) -> None:
        """Remove an attitude that comes too soon after the last one, if body rates are measured meanwhile."""
        if not math.isnan(node.y[10]):
            self._rate_time = node.time
        soon = node.time - self._attitude_time < self._attitude_period - SAME_NODE
        if soon and not starts and node.time - self._rate_time < self._attitude_period:
            node.y[6:10] = math.nan
        elif not math.isnan(node.y[6]):
            self._attitude_time = node.time

    # updates ------------------------------------------------------------------------------------------------

    def _update(self) -> None:
        em, tape = self._em, self._tape
        assert em is not None
        self._updates += 1
        first, last = max(0, tape.size - self.window), tape.size
        self._filter_fresh(em, first)
        young = last - first < min(YOUNG, self.window)
        refresh = self._refresh if last - first == self.window else REFRESH  # information grows with the window
        # without convergence, full passes after 1, 2, 4, ... updates: at a flat maximum they may never converge
        due = self._unconverged > 0 and self._updates - self._refined >= 2 ** (self._unconverged - 1)
        if young or due or self._moved(em) or self._updates % refresh == 0:
            self._owed = self._deferring and not young and self._information is not None
            if not self._owed:
                self._full_passes()

    def _filter_fresh(self, em: WindowEM, first: int) -> None:
        """Make an incremental pass over a window that begins at row `first`."""
        fresh, last, used = self._fresh, self._tape.size, em.parameters
        em.incremental(first, fresh, last, lookback=LOOKBACK)
        self._fresh = last
        if self.on_filtered is not None:
            self.on_filtered(em, used, fresh, last, self._information.sd if self._information else None)

    def _full_passes(self) -> None:
        em, last = self._em, self._tape.size
        assert em is not None
        self._owed = False
        first = max(0, last - self.window)
        passes = 12 if last - first < NEWBORN else 4 if last - first < min(YOUNG, self.window) else 2
        self.full_updates += 1
        self._information = self._with_ages(em, first, last, em.converge(first, last, passes=passes, tolerance=CLOSE))
        self._reference = em.parameters
        found = self._information
        self._converged = found.decrement < PASSED_SCORE_TEST and found.noise_length < PASSED_NOISE
        self._unconverged, self._refined = 0 if self._converged else self._unconverged + 1, self._updates
        self._marginal = self._refreshed.refresh(em, first, last, self._information)

    def _with_ages(self, em: WindowEM, first: int, last: int, information: Information) -> Information:
        """The information, corrected if commands are sampled with the period of an onboard estimate (`in_step.py`)."""
        stamps, _ = self._inputs.between(self._tape.time[first], self._tape.time[last - 1])
        period = self._prediction_period if em.setup.free[4] else 0.0
        return corrected(em, first, last, information) if in_step(stamps, period) else information

    def _moved(self, em: WindowEM) -> bool:
        """Whether a parameter has moved so far since the last full passes that expectations of older rows are wrong."""
        if self._reference is None or self._information is None:
            return True
        change = np.abs(offset(em.parameters.theta, self._reference.theta, em.setup.unit))[:5]
        bearable = 2.0 * MOVED_SD if self._deferring else MOVED_SD
        limit = np.minimum(np.maximum(bearable * self._information.sd[:5], MOVED), MOVED_FAR)
        return bool((change > limit).any())

    # output -------------------------------------------------------------------------------------------------

    def _estimate(self) -> Estimate:
        if self._em is None or self._setup is None or self._information is None:
            return nothing_known(self.vehicle, reason=self._gate.reason, time=self._last_time, updates=self._updates)
        return estimate_of(
            self._em.parameters,
            self._setup,
            self._information,
            time=float(self._tape.time[self._tape.size - 1]),
            samples=int(min(self._tape.size, self.window)),
            updates=self._updates,
            converged=self._converged,
            marginal=self._marginal,
        )
