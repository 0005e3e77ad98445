"""The firmware as one object: the flight, the commander and the services behind the CRTP ports.

It has no sockets and no real time: `receive` takes a packet, `advance` lets time pass, `outbox` holds packets to send.
"""

from collections import deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from firmware_sim import contents, tables, wire
from firmware_sim.commander.decode import RpytDecoder
from firmware_sim.commander.setpoint import HIGH_LEVEL, Arbiter
from firmware_sim.commander.supervisor import PERIOD as SUPERVISOR_PERIOD
from firmware_sim.commander.supervisor import Supervisor
from firmware_sim.errors import ScenarioError
from firmware_sim.services import ports
from firmware_sim.services.commander import PERIOD as HIGH_LEVEL_PERIOD
from firmware_sim.services.commander import HighLevelService, SetpointService
from firmware_sim.services.localisation import LocalisationService
from firmware_sim.services.log import DATA, LogService
from firmware_sim.services.memory import MemoryService, Storage
from firmware_sim.services.param import ParamService
from firmware_sim.services.ports import FIRMWARE_VERSION, PlatformService

if TYPE_CHECKING:
    from firmware_sim.flight import Flight
    from firmware_sim.scenario import Scenario

# Log variables that are constant here and not 0 for a drone at rest: rates [Hz] of the loops, and the state of the
# complementary estimator, which does not run.
_CONSTANT_LOG = {
    "stabilizer.rtStab": 1000.0,
    "kalman.rtPred": 100.0,
    "kalman.rtUpdate": 1000.0,
    "kalman.rtFinal": 1000.0,
    "estimator.rtApnd": 100.0,
    "sensfusion6.qw": 1.0,
    "sensfusion6.accZbase": 1.0,
    "pm.temp": 25.0,
}


Service = Callable[[int, bytes], list[tuple[int, bytes]]]  # channel, data -> replies: channel, data


class Firmware:
    """A drone that has booted at tick 0.

    Args:
        flight: the simulated drone.
        platform: "cf2" or "cf21bl".
        seed: of the timers' jitter.
        parameters: boot values that replace defaults.
        storage: stored parameters, which survive a reboot and replace boot values. None: empty.

    Raises:
        ScenarioError: a boot value names no parameter.
    """

    def __init__(
        self,
        flight: "Flight",
        *,
        platform: str,
        seed: int,
        parameters: Mapping[str, float] | None = None,
        storage: Storage | None = None,
    ):
        boot_values = contents.defaults(list(contents.PARAMETERS), platform)
        self.flight = flight
        self.outbox: deque[tuple[bytes, bool]] = deque()  # datagram, and whether it may be dropped
        self._console: list[str] = []
        auto_arm = platform != "cf21bl"
        self.supervisor = Supervisor(
            flight.log, flight.param, auto_arm=auto_arm, clock=self._tick, console=self._console.append
        )
        self.high_level = HighLevelService(flight.log, self._tick)
        self.arbiter = Arbiter(low_level=self.high_level.planner.stop, relaxed=self.high_level.set_state)
        own_log = tables.slots(dict.fromkeys(contents.LOG, 0.0) | _CONSTANT_LOG)
        own_param = tables.slots(boot_values | dict.fromkeys(tables.DECKS, 0.0))
        log = {**own_log, **self.supervisor.log, **flight.log}
        param = {**own_param, **self.supervisor.param, **self.high_level.param, **flight.param}
        # A parameter that the flight also has is the one of the flight everywhere.
        self.supervisor.param, self.high_level.param = param, param
        self._rates = (own_log["crtp.rxRate"], own_log["crtp.txRate"])
        self._packets = [0, 0]  # received and sent since the last update of the rates

        defaults = boot_values | flight.param_defaults
        self.log = LogService(tables.log_table(log), seed)
        self.param = ParamService(tables.param_table(param), defaults, self._written, storage or Storage())
        self.memory = MemoryService(self.high_level.memory, own_log["memTst.errCntW"])
        self.platform = PlatformService(platform, self.supervisor)
        self.localisation = LocalisationService(flight.external_position, flight.external_pose, self.supervisor)
        mode = {name.split(".")[1]: slot for name, slot in param.items() if name.startswith("flightmode.")}
        self.setpoints = SetpointService(self.arbiter, RpytDecoder(lambda name: float(mode[name][0][mode[name][1]])))
        self._services = self._by_port()
        for name, value in (parameters or {}).items():
            item = self.param.table.by_name.get(name)
            if item is None:
                raise ScenarioError(f"the scenario sets the parameter {name}, which this firmware does not have")
            self.param.set(item, value)
        self.param.restore()
        first = ("-" * 28, f"{platform} is up and running!", FIRMWARE_VERSION)
        self._console += [f"SYS: {line}\n" for line in (*first, "Crazyflie firmware simulator: no drone here")]

    # Packets.

    def receive(self, packet: wire.Packet) -> None:
        """Handle one packet from the client; its replies are put in the outbox, exactly once and in order."""
        self._packets[0] += 1
        if packet.port in self._services:
            for channel, data in self._services[packet.port](packet.channel, packet.data):
                self._send(wire.encode(packet.port, channel, data))
        self._flush_console()

    def _by_port(self) -> dict[int, Service]:
        flight, supervisor, setpoints = self.flight, self.supervisor, self.setpoints
        return {
            wire.LINK: ports.link,
            wire.PARAM: self.param.handle,
            wire.LOG: lambda channel, data: self.log.handle(channel, data, flight.tick),
            wire.SETPOINT_GENERIC: lambda channel, data: setpoints.handle_generic(
                channel, data, flight.tick, allowed=supervisor.can_fly
            ),
            wire.SETPOINT: lambda channel, data: setpoints.handle_rpyt(
                channel, data, flight.tick, allowed=supervisor.can_fly
            ),
            wire.SETPOINT_HIGH_LEVEL: self.high_level.handle,
            wire.LOCALISATION: self.localisation.handle,
            wire.SUPERVISOR: lambda channel, data: ports.supervise(supervisor, channel, data),
            wire.MEMORY: self.memory.handle,
            wire.PLATFORM: self.platform.handle,
        }

    def _send(self, datagram: bytes, *, droppable: bool = False) -> None:
        self._packets[1] += 1
        self.outbox.append((datagram, droppable))

    def _flush_console(self) -> None:
        """Send console text after the replies, and only when there is a client."""
        for text in self._console:
            for chunk in ports.text_chunks(text):
                self._send(wire.encode(wire.CONSOLE, 0, chunk))
        self._console.clear()

    def _written(self, name: str) -> None:
        if name == "memTst.resetW":
            item = self.log.table.by_name["memTst.errCntW"]
            item.array[item.index] = 0.0
        if name == "system.storageReformat":
            self.param.reformat()
        if name in self.flight.param:
            self.flight.parameter_written(name)

    # Time.

    def _tick(self) -> int:
        return self.flight.tick

    def next_event(self) -> int:
        """The tick [ms] before which the firmware sends nothing of its own accord."""
        tick = self.flight.tick
        event = (tick // HIGH_LEVEL_PERIOD + 1) * HIGH_LEVEL_PERIOD
        due = self.log.next_due()
        return event if due is None else max(min(event, due), tick + 1)

    def advance(self, milliseconds: int) -> None:
        """Let time pass: commander and supervisor at their rates, the flight every millisecond, log blocks when due."""
        flight = self.flight
        end = flight.tick + milliseconds
        while flight.tick < end:
            tick = flight.tick
            if tick % SUPERVISOR_PERIOD == 0:
                self._supervise(tick)
            if tick % HIGH_LEVEL_PERIOD == 0:
                setpoint = self.high_level.setpoint()
                if setpoint is not None:
                    self.arbiter.offer(setpoint, HIGH_LEVEL, tick)
            flight.setpoint[:] = self.supervisor.override(self.arbiter.setpoint)
            flight.motors_allowed, flight.armed = self.supervisor.motors_allowed, self.supervisor.armed
            flight.flying = self.supervisor.flying
            for _ in range(min(end, self.next_event()) - tick):
                flight.step()
            for data in self.log.samples(flight.tick):
                self._send(wire.encode(wire.LOG, DATA, data), droppable=True)

    def _supervise(self, tick: int) -> None:
        self.supervisor.planner_bits = self.high_level.info_bits
        self.supervisor.update(self.arbiter.stamp)
        self.high_level.block(not self.supervisor.can_fly)
        if tick % 1000 == 0:
            for n, (array, index) in enumerate(self._rates):
                array[index] = self._packets[n]
            self._packets = [0, 0]


def boot(scenario: "Scenario", seed: int, storage: Storage | None = None) -> Firmware:
    """A booted drone with all code compiled, so that its clock can start. Raises ScenarioError."""
    from firmware_sim.flight import Flight  # here: compiled code loads slowly

    flight = Flight(scenario, seed)
    firmware = Firmware(flight, platform=scenario.platform, seed=seed, parameters=scenario.parameters, storage=storage)
    firmware.advance(1)
    return firmware
