"""Starts the simulated drone behind MAVLink: what `python -m firmware_sim --mavlink ...` does."""

import argparse
import contextlib
import signal

from firmware_sim.errors import FirmwareSimError, ServerError
from firmware_sim.mavlink.server import MavlinkServer, wire_of


def run(arguments: argparse.Namespace) -> None:
    """Serve until SIGINT or SIGTERM. Raises FirmwareSimError in one sentence."""
    if arguments.seed < 0:
        raise FirmwareSimError(f"--seed must not be negative, it is {arguments.seed}")
    if arguments.swarm is not None:
        raise FirmwareSimError("--mavlink is for one drone: leave out --swarm")
    with contextlib.ExitStack() as stack:
        wires = [stack.enter_context(contextlib.closing(wire_of(text))) for text in arguments.mavlink]
        from firmware_sim.firmware import Firmware  # here: compiled code takes a while to load
        from firmware_sim.flight import Flight
        from firmware_sim.mavlink.autopilot import Autopilot
        from firmware_sim.plant import layout
        from firmware_sim.scenario import load_scenario

        scenario = load_scenario(arguments.scenario)
        truth = None
        if arguments.truth:
            try:
                truth = stack.enter_context(arguments.truth.open("w", encoding="utf-8"))
            except OSError as error:
                raise ServerError(f"cannot write {arguments.truth}: {error.strerror}") from None
        flight = Flight(scenario, arguments.seed)
        firmware = Firmware(flight, platform=scenario.platform, seed=arguments.seed, parameters=scenario.parameters)
        firmware.advance(1)
        autopilot = Autopilot(firmware, thrust=4.0 * float(scenario.board()[layout.B_THRUST_MAX]))
        server = MavlinkServer(autopilot, wires, speed=arguments.speed, truth=truth)

        def stop(_signal: int, _frame: object) -> None:
            server.stopping = True

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        where = " ".join(wire.where for wire in wires)
        print(f"firmware_sim: {where} platform {scenario.platform} seed {arguments.seed}", flush=True)
        server.run()
