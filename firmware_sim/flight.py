"""The flight: everything between the commander's setpoint and the log variables, one millisecond at a time.

It owns the arrays of the compiled tick and gives access to them by name. It has no packets and no real time.
"""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from firmware_sim.commander import setpoint as sp
from firmware_sim.controllers import layout as mem
from firmware_sim.controllers import lqg, parameters, variables
from firmware_sim.controllers import variables as lv
from firmware_sim.controllers.externalise import RPM_UNREADABLE
from firmware_sim.controllers.tick import tick_step, tick_step_with_effects
from firmware_sim.plant import layout as at
from firmware_sim.plant.effects.drive import present_wrench
from firmware_sim.plant.effects.motion import origin
from firmware_sim.plant.effects.sensing import fix_pose
from firmware_sim.plant.rotors import wrench
from firmware_sim.plant.sensors import ACC_CUTOFF, NoiseSource, settle
from firmware_sim.scenario import Scenario

DEFAULT_CONTROLLER = 1  # PID, as in the firmware
CONTROLLERS = (1, 2, 3, 5, 6)


class Flight:
    """A drone with its flight controller. scenario: the truth; seed: of all noise (same seed, same flight)."""

    truth_header: ClassVar[list[str]] = [
        *("t", "px", "py", "pz", "vx", "vy", "vz", "qw", "qx", "qy", "qz", "wx", "wy", "wz"),
        *("F", "Mx", "My", "Mz", "pwm1", "pwm2", "pwm3", "pwm4", "vbat"),
    ]

    def __init__(self, scenario: Scenario, seed: int) -> None:
        self.tick = 0
        self.setpoint = sp.null_setpoint()
        self.motors_allowed = True
        self.flying = False  # set by the supervisor; while False, the onboard estimate leaves out its model of flight
        self.armed = scenario.platform != "cf21bl"
        self._noise = NoiseSource(seed)
        self._truth = scenario.truth()
        self._payload = scenario.payload_changes()
        self._effects = bool(
            self._truth[at.EFFECT_ROTORS] + self._truth[at.EFFECT_BODY] + self._truth[at.EFFECT_SENSING]
        )
        self._tick_step = tick_step_with_effects if self._effects else tick_step  # compiled when first called
        self._board = scenario.board()
        self.state = scenario.start_state()
        self._sensor = np.zeros(at.SENSOR_SIZE)
        self._estimate = np.zeros(at.ESTIMATE_SIZE)
        self._P = np.zeros((9, 9))
        self._memory = np.zeros(mem.MEMORY_SIZE)
        self._log = np.zeros(len(variables.ALL_VARIABLES))
        self._log[lv.RPM : lv.RPM + 4] = RPM_UNREADABLE  # until the first report
        self._union = np.zeros(1, dtype=np.float32)
        self._union_short = self._union.view(np.int16)
        self.param_defaults = parameters.defaults(scenario.platform)
        self._param = np.array([self.param_defaults[name] for name in parameters.PARAMETER_NAMES])
        self.log = {name: (self._log, variables.VARIABLE_INDEX[name]) for name in variables.names(scenario.platform)}
        self.param = {name: (self._param, i) for name, i in parameters.PARAMETER_INDEX.items()}
        self._controller = float(DEFAULT_CONTROLLER)
        self._design_lqg()
        self._start_up(scenario)
        for name, value in scenario.parameters.items():
            if name in self.param:
                self._param[self.param[name][1]] = value
                self.parameter_written(name)
        self._compile()

    def _start_up(self, scenario: Scenario) -> None:
        """Settle and calibrate the sensors and start the estimate at the true pose: as after a boot on level ground."""
        biases = self._noise.boot(4)
        share = 0.5 * math.erfc(-biases[3] / math.sqrt(2.0))  # a number from 0 to 1: the phase of the position fixes
        self._truth[at.FIX_PHASE] = math.floor(share * self._truth[at.FIX_PERIOD])
        self._sensor[at.BIAS : at.BIAS + 3] = biases[:3] * self._truth[at.GYRO_BIAS : at.GYRO_BIAS + 3]
        if "gyro_bias" in scenario.effects:
            self._sensor[at.BIAS : at.BIAS + 3] += [scenario.effects["gyro_bias"][axis] for axis in "xyz"]
        for i in range(3):
            settle(self._sensor, at.ACCEL_FILTER + 2 * i, self.state[at.ACC + i], ACC_CUTOFF)
        self._sensor[at.VBAT] = self._sensor[at.VBAT_FILTERED] = self.state[at.VOLTS]
        self._estimate[at.E_QUAT] = 1.0
        self._estimate[at.E_RESET] = 1.0

    def _design_lqg(self) -> None:
        """Compute the gains from the weights; without a solution the old gains stay."""
        weights = {n: float(self._param[parameters.PARAMETER_INDEX[f"ctrlLqg.{n}"]]) for n in parameters.LQG_WEIGHTS}
        gains = lqg.design(**weights)
        if gains is not None:
            self._memory[mem.LQG_GAIN_POS : mem.LQG_GAIN_POS + 8] = gains

    def parameter_written(self, name: str) -> None:
        """React to a written parameter: some take effect or are corrected at once."""
        if name == "stabilizer.controller":
            index = parameters.CONTROLLER
            wanted = int(self._param[index])
            if wanted == 0:
                self._controller = float(DEFAULT_CONTROLLER)
            elif wanted in CONTROLLERS:
                self._controller = float(wanted)
            self._param[index] = self._controller
        elif name.startswith("ctrlLqg.") and name.split(".")[1] in parameters.LQG_WEIGHTS:
            self._design_lqg()
        elif name == "stabilizer.estimator":
            self._param[parameters.PARAMETER_INDEX[name]] = 2.0  # the only one there is
        elif name == "kalman.resetEstimation" and self._param[parameters.PARAMETER_INDEX[name]] != 0.0:
            self._estimate[at.E_RESET] = 1.0
            self._param[parameters.PARAMETER_INDEX[name]] = 0.0  # the firmware clears it when the reset is done

    def external_position(self, position: Sequence[float] | np.ndarray) -> None:
        """A position fix from outside: m, world; used at the next step. Values that are not finite are dropped."""
        p = np.asarray(position, dtype=float)
        self._log[lv.LOC_TICK] = self.tick & 0xFFFF
        self._log[lv.EXT_POS : lv.EXT_POS + 3] = p
        self._log[lv.LOC : lv.LOC + 3] = p
        if np.all(np.isfinite(p)):
            self._estimate[at.E_EXT] = 1.0
            self._estimate[at.E_EXT_POS : at.E_EXT_POS + 3] = p

    def external_pose(self, position: Sequence[float] | np.ndarray, quaternion: Sequence[float] | np.ndarray) -> None:
        """A pose from outside: m, world; quaternion x, y, z, w, body to world (normalised here)."""
        self.external_position(position)
        q = np.asarray(quaternion, dtype=float)
        self._log[lv.LOC + 3 : lv.LOC + 7] = q
        norm = float(np.linalg.norm(q))
        if self._estimate[at.E_EXT] > 0.0 and np.isfinite(norm) and norm > 1e-3:
            self._estimate[at.E_EXT] = 2.0
            self._estimate[at.E_EXT_QUAT : at.E_EXT_QUAT + 4] = np.roll(q / norm, 1)

    def seen_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Pose that a positioning system without noise measures now: m, world; quaternion x, y, z, w, body to world."""
        p: Any = np.empty(3)
        q: Any = np.empty(4)
        fix_pose(self._truth, self.state, self._sensor, self.tick, p, q)
        return p, np.roll(q, -1)

    def step(self) -> None:
        """One millisecond."""
        while self._payload is not None and self._payload.due(self.tick, self.state):
            self._payload.apply(self._truth, self.state)
        row = self._noise.prepare(self.tick)
        flags = int(self.motors_allowed) | int(self.armed) << 1 | int(self.flying) << 2
        self._tick_step(*self._arrays(), self._noise.rows[row], self.tick, flags)
        self.tick += 1

    def _arrays(self) -> tuple[np.ndarray, ...]:
        """The arguments of the compiled tick, in its order."""
        return (
            self._truth,
            self._board,
            self.state,
            self._sensor,
            self._estimate,
            self._P,
            self.setpoint,
            self._param,
            self._memory,
            self._log,
            self._union,
            self._union_short,
        )

    def _compile(self) -> None:
        """Compile (or load) the tick on copies, so that the first millisecond takes no longer than the others."""
        self._tick_step(*(array.copy() for array in self._arrays()), np.zeros(at.NOISE_WIDTH), 0, 0)
        self.truth_row()

    def truth_row(self) -> list[float]:
        """The true state now, in the columns of truth_header: s, m, m/s, -, rad/s, N, N m, PWM 0..65535, V.

        Position and velocity of the geometric origin; force and torque (about the centre of mass) of the rotors.
        """
        u: Any = np.empty(4)
        p: Any = self.state[at.POS : at.POS + 3].copy()
        v: Any = self.state[at.VEL : at.VEL + 3].copy()
        if self._effects:
            present_wrench(self._truth, self.state, u)
            origin(self._truth, self.state, p, v)
        else:
            wrench(self._truth, self.state, at.ROTOR, u)
        return [
            self.tick * 1e-3,
            *p.tolist(),
            *v.tolist(),
            *self.state[at.QUAT : at.ROTOR].tolist(),
            *u.tolist(),
            *self.state[at.PWM : at.PWM + 4].tolist(),
            float(self.state[at.VOLTS]),
        ]
