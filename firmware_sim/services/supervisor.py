"""Port 9, the supervisor: information bits (channel 0), arming, recovery and emergency stop (channel 1)."""

from firmware_sim.commander.supervisor import Supervisor

INFO, COMMAND = 0, 1
REPLY = 0x80
BITFIELD = 0x0C
ARM, RECOVER, EMERGENCY_STOP, EMERGENCY_STOP_WATCHDOG = 1, 2, 3, 4
_NUMBER_OF_BITS = 11  # commands 1..11 ask for bit 0..10


def handle(supervisor: Supervisor, channel: int, data: bytes) -> list[tuple[int, bytes]]:
    """Replies (channel, data) to a packet on the supervisor port."""
    if not data:
        return []
    command = data[0]
    if channel == INFO:
        if command == BITFIELD:
            return [(INFO, bytes((REPLY | BITFIELD,)) + supervisor.info.to_bytes(2, "little"))]
        if 1 <= command <= _NUMBER_OF_BITS:
            return [(INFO, bytes((REPLY | command, supervisor.info >> (command - 1) & 1)))]
    elif channel == COMMAND:
        if command == ARM and len(data) >= 2:
            done = supervisor.request_arming(bool(data[1]))
            return [(COMMAND, bytes((REPLY | ARM, done, supervisor.armed)))]
        if command == RECOVER:
            done = supervisor.request_recovery()
            return [(COMMAND, bytes((REPLY | RECOVER, done, not supervisor.crashed)))]
        if command == EMERGENCY_STOP:
            supervisor.emergency_stop()
        elif command == EMERGENCY_STOP_WATCHDOG:
            supervisor.emergency_stop_watchdog()
    return []
