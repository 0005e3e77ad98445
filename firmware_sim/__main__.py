"""Command line of the simulator: `python -m firmware_sim`, or the console script `firmware-sim`."""

import argparse
import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path

from firmware_sim.errors import FirmwareSimError
from firmware_sim.firmware import boot
from firmware_sim.server import Server
from firmware_sim.start import bind, open_truth, stop_on_signals
from firmware_sim.wire import Air


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < 1000.0:
        raise argparse.ArgumentTypeError(f"{text} is not between 0 and 1000")
    return value


def _port(text: str) -> int:
    value = int(text)
    if not 0 <= value <= 65535:
        raise argparse.ArgumentTypeError(f"{text} is not a UDP port")
    return value


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="firmware_sim", description="A simulated Crazyflie that answers on udp://.")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default %(default)s)")
    parser.add_argument("--port", type=_port, default=19850, help="UDP port, 0 for any free one (default %(default)s)")
    parser.add_argument("--scenario", type=Path, help="TOML file: the true drone, and what its firmware believes")
    parser.add_argument("--seed", type=int, default=0, help="of every random number (default %(default)s)")
    parser.add_argument(
        "--speed", type=_positive, default=1.0, help="firmware seconds per second (default %(default)s)"
    )
    parser.add_argument(
        "--swarm", metavar="N|FILE.toml", help="many drones in one process: so many on ports --port and up, or a file's"
    )
    parser.add_argument(
        "--mavlink",
        action="append",
        metavar="udpout:HOST:PORT|udpin:HOST:PORT|serial",
        help="speak MAVLink as a PX4 would, instead of CRTP: to a ground station, to whoever calls, or at a "
        "pseudo-terminal whose name is printed (repeatable: all hear the same, all may command)",
    )
    parser.add_argument(
        "--storage", type=Path, help="JSON file of the stored (persistent) parameters: they survive a restart in it"
    )
    parser.add_argument("--truth", type=Path, help="write the true motion to this CSV file, 100 rows per second")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the simulator until SIGINT or SIGTERM. Returns 0 then, 2 after an error of the user (one sentence)."""
    arguments = _parser().parse_args(argv)
    try:
        if arguments.storage and (arguments.swarm is not None or arguments.mavlink is not None):
            other = "--mavlink" if arguments.mavlink is not None else "--swarm"
            raise FirmwareSimError(f"--storage is for one Crazyflie: leave it out with {other}")
        if arguments.seed < 0:
            raise FirmwareSimError(f"--seed must not be negative, it is {arguments.seed}")
        if arguments.mavlink is not None:
            from firmware_sim.mavlink.server import run as run_mavlink

            run_mavlink(arguments)
        elif arguments.swarm is not None:
            _run_swarm(arguments)
        else:
            _run(arguments)
    except FirmwareSimError as error:
        print(f"firmware_sim: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:  # before the server runs
        return 130
    return 0


def _run(arguments: argparse.Namespace) -> None:
    with contextlib.ExitStack() as stack:
        sock = stack.enter_context(contextlib.closing(bind(arguments.host, arguments.port)))
        from firmware_sim.scenario import load_scenario  # late: compiled code loads slowly, a port in use is told first
        from firmware_sim.services.memory import Storage

        scenario = load_scenario(arguments.scenario)
        storage = Storage(arguments.storage)
        truth = open_truth(arguments.truth, stack)
        firmware = boot(scenario, arguments.seed, storage)
        air = Air(scenario.link.loss, scenario.link.burst, arguments.seed)
        server = Server(firmware, sock, speed=arguments.speed, truth=truth, air=air)
        stop_on_signals(server)
        host, port = sock.getsockname()
        print(f"firmware_sim: udp://{host}:{port} platform {scenario.platform} seed {arguments.seed}", flush=True)
        server.run()


def _run_swarm(arguments: argparse.Namespace) -> None:
    from firmware_sim import swarm

    if arguments.truth:
        raise FirmwareSimError("--truth is for one drone: leave it out with --swarm")
    options = {"port": arguments.port, "seed": arguments.seed, "scenario": arguments.scenario}
    text = arguments.swarm
    digits = text.isascii() and text.isdigit() and len(text) < 10
    drones = swarm.of_number(int(text), **options) if digits else swarm.of_file(Path(text), **options)
    with contextlib.ExitStack() as stack:
        running = swarm.open_swarm(drones, stack, host=arguments.host, speed=arguments.speed)
        stop_on_signals(running)
        print(f"firmware_sim: {len(drones)} drones are ready", flush=True)
        running.run()


if __name__ == "__main__":
    sys.exit(main())
