"""Port 6, localisation: external positions and poses for the onboard estimator, old emergency stop. No replies."""

import struct
from collections.abc import Callable

import numpy as np

from firmware_sim.commander.decode import decompress_quaternion
from firmware_sim.commander.supervisor import Supervisor

POSITION, GENERIC, POSITIONS_PACKED = 0, 1, 2
EMERGENCY_STOP, EMERGENCY_STOP_WATCHDOG, POSE, POSE_PACKED = 3, 4, 8, 9
OWN_ID = 0xE7  # last byte of the default radio address: marks this drone's entry in a packed packet


class LocalisationService:
    """Hands positions [m, world] and poses (quaternion x, y, z, w, body to world) on to the flight."""

    def __init__(
        self,
        position: Callable[[np.ndarray], None],
        pose: Callable[[np.ndarray, np.ndarray], None],
        supervisor: Supervisor,
    ):
        self._accept_position, self._accept_pose, self._supervisor = position, pose, supervisor

    def handle(self, channel: int, data: bytes) -> list[tuple[int, bytes]]:
        """Consume a packet on the localisation port; a packet of the wrong length is ignored."""
        if channel == POSITION and len(data) >= 12:
            self._position(np.array(struct.unpack_from("<fff", data), dtype=float))
        elif channel == POSITIONS_PACKED:
            for start in range(0, len(data) - 6, 7):
                number, *millimetres = struct.unpack_from("<Bhhh", data, start)
                if number == OWN_ID:
                    self._position(np.array(millimetres, dtype=float) / 1000.0)
        elif channel == GENERIC and data:
            self._generic(data[0], data[1:])
        return []

    def _position(self, position: np.ndarray) -> None:
        if np.isfinite(position).all():
            self._accept_position(position)

    def _pose(self, position: np.ndarray, quaternion: np.ndarray) -> None:
        norm = float(np.linalg.norm(quaternion))
        if np.isfinite(position).all() and np.isfinite(norm) and norm > 0.5:
            self._accept_pose(position, quaternion / norm)

    def _generic(self, kind: int, data: bytes) -> None:
        if kind == POSE and len(data) >= 28:
            values = np.array(struct.unpack_from("<7f", data), dtype=float)
            self._pose(values[:3], values[3:])
        elif kind == POSE_PACKED:
            for start in range(0, len(data) - 10, 11):
                number, x, y, z, packed = struct.unpack_from("<BhhhI", data, start)
                if number == OWN_ID:
                    self._pose(np.array((x, y, z), dtype=float) / 1000.0, np.array(decompress_quaternion(packed)))
        elif kind == EMERGENCY_STOP:
            self._supervisor.emergency_stop()
        elif kind == EMERGENCY_STOP_WATCHDOG:
            self._supervisor.emergency_stop_watchdog()
