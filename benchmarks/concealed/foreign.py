"""Flies a case of a foreign world in RotorPy, under that simulator's own controller, and writes its log as a table.

The plant is RotorPy's, with the drawn parameters. Effects without a parameter there (one rotor's thrust, a push) are
added to its sum of forces. Log and mapping: `logs`. The same case gives the same file.
"""

import math
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .courses import STOPPED, Course, course
from .foreign_world import SUPPLY, changed, constants
from .logs import mapping_of, write_table
from .simulate import FARTHEST, LOWEST, STEEPEST, turned

Table = dict[str, Any]
BOOT = 1.0  # s on the floor before the motors start
ROTORS = (4, 1, 2, 3)  # our number of each of RotorPy's rotors: front left, front right, back right, back left


def plant(parameters: Table, start: Table, step: float) -> Any:
    """RotorPy's multirotor with additional gains of single rotors and a push."""
    from rotorpy.vehicles.multirotor import Multirotor

    class Pushed(Multirotor):  # type: ignore[misc]
        """gains: (4,) of the rotors' thrusts; push [N], twist [N m]: held over a step, body; trim [m]."""

        gains, push, twist, trim = np.ones(4), np.zeros(3), np.zeros(3), np.zeros(3)

        def compute_body_wrench(self, body_rates: NDArray, rotor_speeds: NDArray, airspeed: NDArray) -> Any:
            speeds = np.maximum(rotor_speeds, 0.0) * np.sqrt(self.gains)
            force, torque = super().compute_body_wrench(body_rates, speeds, airspeed)
            lift = self.k_eta * float(np.sum(speeds**2))
            return force + self.push, torque + self.twist + self.trim * lift

    # One step of Bogacki and Shampine for each step of the simulator, whose length is drawn.
    once = {"method": "RK23", "first_step": step, "rtol": 1e-2, "atol": 1e-2}
    return Pushed(
        parameters, initial_state=start, control_abstraction="cmd_motor_speeds", enable_ground=True,
        integrator_kwargs=once,
    )  # fmt: skip


class Air:
    """Wind and gusts [m/s, world]: a constant and an Ornstein-Uhlenbeck process."""

    def __init__(self, effects: Table, step: float, random: np.random.Generator) -> None:
        wind, gusts = effects.get("wind", {}), effects.get("gusts", {})
        self._mean = np.array([wind.get(a, 0.0) for a in "xyz"])
        self._sd = gusts.get("standard_deviation", 0.0)
        self._keep = math.exp(-step / gusts.get("correlation_time", 1.0))
        self._random = random
        self._gust = self._sd * random.standard_normal(3)

    def blow(self) -> NDArray:
        fresh = math.sqrt(1.0 - self._keep**2) * self._sd * self._random.standard_normal(3)
        self._gust = self._keep * self._gust + fresh
        return self._mean + self._gust


class Flown:
    """One flight, step by step."""

    def __init__(self, case: Table, flight: str, path: Course) -> None:
        from rotorpy.controllers.quadrotor_control import SE3Control

        self.case, self.path = case, path
        self.drawn, self.effects, self.hidden = case["conditions"], case["effects"], case["hidden"]
        self.noise = self.drawn["noise"]
        seed = int(case["flights"][flight]["seed"])
        np.random.seed(seed % 2**32)  # RotorPy draws its motors' noise from the global generator
        self.random = np.random.default_rng([seed, 9])
        self.step = 1e-3 * self.drawn["step"]
        self.nominal = constants(case["platform"])
        parameters = changed(case, flight)
        self.com = parameters.pop("com")
        self.state: Table = {
            "x": self.com.copy(), "v": np.zeros(3), "q": np.array([0.0, 0.0, 0.0, 1.0]),
            "w": np.zeros(3), "wind": np.zeros(3), "rotor_speeds": np.zeros(4),
        }  # fmt: skip
        self.body = plant(parameters, self.state, self.step)
        own, today = case["own"].get("trim", {}), case["flights"][flight]["day"].get("trim", {})
        self.body.trim = np.array([own.get(a, 0.0) + today.get(a, 0.0) for a in "xyz"])
        self.pilot = SE3Control(self.nominal)
        for name, by in self.drawn["gains"].items():
            setattr(self.pilot, name, getattr(self.pilot, name) * by)
        self.air = Air(self.effects, self.step, self.random)
        self.offset = self.noise["gyro_offset"] * self.random.standard_normal(3)
        self.offset += np.array([self.effects.get("gyro_bias", {}).get(a, 0.0) for a in "xyz"])
        self.drift = np.zeros(9)
        self.velocity_scale = np.array([self.effects.get("velocity_scale", {}).get(a, 1.0) for a in "xyz"])
        self.pose_axes = _angles(self.effects.get("attitude_misalignment", {})).as_quat()
        self.sensor_axes = _angles(self.effects.get("accelerometer_misalignment", {})).as_matrix()
        self.late: deque[NDArray] = deque(maxlen=64)
        self.held = self.phase = 0.0

    def origin(self) -> tuple[NDArray, NDArray]:
        """Position and velocity of the middle of the rotors."""
        if not self.com.any():
            return self.state["x"], self.state["v"]
        turn, (p, q, r), (x, y, z) = matrix(self.state["q"]), self.state["w"], -self.com
        swing = np.array([q * z - r * y, r * x - p * z, p * y - q * x])
        return self.state["x"] + turn @ -self.com, self.state["v"] + turn @ swing

    def seen(self) -> Table:
        """Present measurements: position, velocity, attitude (x y z w), body_rate."""
        n, white = self.noise, self.random.standard_normal(12)
        keep = math.exp(-self.step / n["time"])
        self.drift = keep * self.drift + math.sqrt(1.0 - keep**2) * n["share"] * self.random.standard_normal(9)
        place, velocity = self.origin()
        turn = product(self.state["q"], self.pose_axes)
        magnet = self.hidden.get("magnetic_yaw")
        if magnet:
            yaw = magnet["amplitude"] * math.sin(2 * math.pi * place[0] / magnet["wavelength"])
            turn = product(np.array([0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)]), turn)
        return {
            "position": place + n["position"] * (white[:3] + self.drift[:3]),
            "velocity": self.velocity_scale * velocity + n["velocity"] * (white[3:6] + self.drift[3:6]),
            "attitude": turned(turn, n["attitude"] * (white[6:9] + self.drift[6:9])),
            "body_rate": self.state["w"] + self.offset + n["body_rate"] * white[9:],
        }

    def wanted(self, time: float, seen: Table) -> NDArray:
        """Rotor speeds commanded by the controller; 0 before and after the flight."""
        since = time - BOOT
        if not 0.0 <= since < self.path.time[-1]:
            return np.zeros(4)
        state = {"x": seen["position"], "v": seen["velocity"], "q": seen["attitude"], "w": seen["body_rate"]}
        p, k = self.path, int(since * 100.0)
        flat = {
            "x": p.position[k], "x_dot": p.velocity[k], "x_ddot": p.acceleration[k], "x_dddot": np.zeros(3),
            "x_ddddot": np.zeros(3), "yaw": p.yaw[k], "yaw_dot": p.yaw_rate[k], "yaw_ddot": 0.0,
        }  # fmt: skip
        speeds = np.asarray(self.pilot.update(since, state, flat)["cmd_motor_speeds"], float)
        return np.clip(np.nan_to_num(speeds), 0.0, self.nominal["rotor_speed_max"])

    def acting(self, speeds: NDArray) -> NDArray:
        """Commands that act on the rotors: after a wrong thrust curve, a sticky rotor, a delay."""
        curve = self.effects.get("thrust_curve")
        if curve:
            thrust, hover = self.nominal["k_eta"] * speeds**2, self.nominal["mass"] * 9.81 / 4.0
            bent = np.where(speeds > 0.0, thrust + curve["slope_error"] * (thrust - hover), 0.0)
            speeds = np.sqrt(np.maximum(bent, 0.0) / self.nominal["k_eta"])
        sticky = self.hidden.get("sticky_rotor")
        if sticky:
            i = ROTORS.index(int(sticky["rotor"]))
            if abs(speeds[i] - self.held) > sticky["deadband"] * self.nominal["rotor_speed_max"] or speeds[i] == 0.0:
                self.held = speeds[i]
            speeds = speeds.copy()
            speeds[i] = self.held
        self.late.append(speeds)
        back = self.effects.get("input_delay", {}).get("delay", 0.0) / self.step
        whole = int(back)
        rows = [self.late[max(-1 - whole - j, -len(self.late))] for j in (0, 1)]
        return rows[0] + (back - whole) * (rows[1] - rows[0])

    def push(self, time: float) -> None:
        """Set gains of the rotors, forces and torques of this step."""
        gains, flown = np.ones(4), max(time - BOOT, 0.0)
        fault = self.effects.get("rotor_fault")
        if fault and time >= fault.get("onset_time", 0.0):
            gains[ROTORS.index(int(fault["rotor"]))] = fault["scale"]
        sag = self.effects.get("battery_sag", {}).get("gain_per_second", 0.0)
        self.body.gains = gains * max(0.0, 1.0 + sag * flown)
        shake = self.hidden.get("vibration")
        if shake:
            i = ROTORS.index(int(shake["rotor"]))
            self.phase += shake["ratio"] * self.state["rotor_speeds"][i] * self.step
            self.body.twist = shake["torque"] * np.array([math.cos(self.phase), math.sin(self.phase), 0.0])
        cable = self.hidden.get("cable_spring")
        if cable:
            away = np.array([cable[a] for a in "xyz"]) - self.origin()[0]
            length = float(np.linalg.norm(away))
            pull = cable["stiffness"] * max(length - cable["length"], 0.0) * away / max(length, 1e-6)
            self.body.push = matrix(self.state["q"]).T @ pull

    def advance(self, time: float, speeds: NDArray) -> NDArray:
        """One step of the plant; returns the specific force at the origin over it, in the accelerometer's axes."""
        self.push(time)
        self.state["wind"] = self.air.blow()
        _, before = self.origin()
        self.state = self.body.step(self.state, {"cmd_motor_speeds": self.acting(speeds)}, self.step)
        _, after = self.origin()
        pulled = (after - before) / self.step + np.array([0.0, 0.0, 9.81])
        return self.sensor_axes.T @ (matrix(self.state["q"]).T @ pulled)

    def astray(self, time: float) -> str:
        """The reason why the flight has failed; empty while it has not."""
        since = time - BOOT
        if not self.path.start <= since <= self.path.end:
            return ""
        x, y = self.state["q"][:2]
        tilt = math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * float(x * x + y * y))))
        off = float(np.linalg.norm(self.state["x"] - self.path.position[int(since * 100.0)]))
        if self.state["x"][2] < LOWEST:
            return f"came down to {self.state['x'][2]:.2f} m"
        if tilt > STEEPEST:
            return f"tilted by {math.degrees(tilt):.0f} degrees"
        return f"{off:.1f} m off its course" if off > FARTHEST else ""


def matrix(q: NDArray) -> NDArray:
    """Body to world, of a unit quaternion x y z w."""
    x, y, z, w = q.tolist()
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def product(p: NDArray, q: NDArray) -> NDArray:
    """The quaternion (x y z w) that turns by q first, then by p."""
    (a, b, c, d), (x, y, z, w) = p.tolist(), q.tolist()
    return np.array([
        d * x + a * w + b * z - c * y, d * y + b * w + c * x - a * z, d * z + c * w + a * y - b * x,
        d * w - a * x - b * y - c * z,
    ])  # fmt: skip


def _angles(table: Table) -> Rotation:
    """Rz(yaw) Ry(pitch) Rx(roll)."""
    return Rotation.from_euler("ZYX", [table.get(a, 0.0) for a in ("yaw", "pitch", "roll")])


def fly(case: Table, flight: str, folder: Path, *, duration: float) -> Table:
    """One flight into `folder`/{flight}.csv with mapping.toml; as `simulate.fly`."""
    path = course(case["flights"][flight], duration)
    drone = Flown(case, flight, path)
    time, felt = 0.0, np.array([0.0, 0.0, 9.81])
    rows: dict[str, list[Any]] = {n: [] for n in ("time", *SIZES)}
    full = drone.nominal["rotor_speed_max"]
    for _ in range(round((BOOT + path.time[-1] + STOPPED) / drone.step)):
        seen = drone.seen()
        speeds = drone.wanted(time, seen)
        noise = drone.random.standard_normal(8)
        rows["time"].append(time)
        for name, value in seen.items():
            rows[name].append(value)
        rows["specific_force"].append(felt + drone.noise["specific_force"] * noise[:3])
        rows["motor_command"].append(speeds / full)
        rows["rotor_speed"].append(drone.state["rotor_speeds"] + noise[3:7])
        rows["voltage"].append([SUPPLY + 0.003 * noise[7]])
        felt = drone.advance(time, speeds)
        time += drone.step
        reason = drone.astray(time)
        if reason:
            return {"flown": False, "reason": reason}
    arrays = {name: np.array(values, float) for name, values in rows.items()}
    return _write(drone, arrays, folder / f"{flight}.csv")


SIZES = {"position": 3, "velocity": 3, "attitude": 4, "body_rate": 3, "specific_force": 3, "motor_command": 4,
         "rotor_speed": 4, "voltage": 1}  # fmt: skip


def _write(drone: Flown, arrays: dict[str, NDArray], file: Path) -> Table:
    """Write the log: with hidden delays, at its rate, without lost rows and signals that are not logged."""
    log, effects = drone.drawn["log"], drone.effects
    time = arrays.pop("time")
    late = effects.get("measurement_delay")
    if late:
        streams = {"state": ("position", "velocity", "attitude"), "gyro": ("body_rate",)}
        for name in (n for stream in late["streams"] for n in streams[stream]):
            arrays[name] = np.column_stack([
                np.interp(time - late["delay"], time, column) for column in arrays[name].T
            ])  # fmt: skip
    sensor = effects.get("rotor_sensor")
    if sensor:
        arrays["rotor_speed"][:, ROTORS.index(int(sensor["rotor"]))] *= sensor["scale"]
    every = int(log["period"]) // int(drone.drawn["step"])
    kept = np.arange(int(drone.random.integers(every)), time.size, every)
    arrived = kept[drone.random.random(kept.size) >= log["loss"]]
    optional = ("velocity", "attitude", "specific_force", "rotor_speed", "voltage")
    names = [n for n in SIZES if n not in optional or log[n]]
    file.parent.mkdir(parents=True, exist_ok=True)
    write_table(file, time[arrived].tolist(), {n: arrays[n][arrived] for n in names})
    text = mapping_of(names, onboard=bool(log["onboard"]), rotors=ROTORS)
    file.with_name("mapping.toml").write_text(text)
    path = drone.path
    marks = {"trajectory_start": BOOT + path.start, "trajectory_end": BOOT + path.end}
    return {"flown": True, "received": int(arrived.size), "lost": int(kept.size - arrived.size), "marks": marks}
