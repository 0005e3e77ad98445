"""A second look at the shared recordings: the main facts of each from its bytes, plainly and without crazyem."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

G = 9.80665
# thrust [N] of one rotor with 2.1+ propellers over the voltage it sees: platform_defaults_cf2.h
CURVE = (-0.02476537915958403, 0.06523793527519485, -0.026792504967750107, 0.006776789303971145)
Facts = dict[str, float]


def uncovered(flags: np.ndarray, time: np.ndarray, most: float) -> np.ndarray:
    """Runs of True that last longer than `most` seconds."""
    out = np.zeros(flags.size, bool)
    for first, last in stretches(flags):
        if time[last] - time[first] > most:
            out[first : last + 1] = True
    return out


def stretches(flags: np.ndarray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.r_[0, flags.astype(int), 0]))
    return list(zip(edges[::2].tolist(), (edges[1::2] - 1).tolist(), strict=True))


def longest(flags: np.ndarray, time: np.ndarray) -> float:
    return max((float(time[b] - time[a]) for a, b in stretches(flags)), default=0.0)


def same(value: np.ndarray) -> np.ndarray:
    """Rows that equal the one before."""
    return np.r_[False, (value[1:] == value[:-1]).all(axis=1)]


def straight(time: np.ndarray, value: np.ndarray, rounding: float = 5e-9) -> np.ndarray:
    """Rows in runs of three or more on one line through time, in all columns at once; constants do not count."""
    share = ((time[1:-1] - time[:-2]) / (time[2:] - time[:-2]))[:, None]
    change = value[2:] - value[:-2]
    off = np.abs(value[1:-1] - value[:-2] - share * change)
    middle = (off <= rounding + 5e-5 * np.abs(change)).all(axis=1) & (np.abs(change) > 5e-6).any(axis=1)
    out = np.zeros(time.size, bool)
    for shift in (0, 1, 2):
        out[shift : shift + middle.size] |= middle
    return out


def stream(time: np.ndarray) -> Facts:
    """Count, span, rate and gaps of (n,) stamps; a record that is late, not lost, is followed by short intervals."""
    step = np.diff(time)
    period = float(np.median(step))
    lost, places = 0, 0
    for i in np.flatnonzero(step > 1.5 * period):
        around = step[max(i - 3, 0) : i + 4]
        others = np.delete(around, min(i, 3))
        spare = float(np.maximum(period - others[np.abs(others - period) < period], 0.0).sum())
        missing = round(min(step[i], step[i] - (spare if step[i] < 2.5 * period else 0.0)) / period) - 1
        lost, places = lost + max(missing, 0), places + (missing > 0)
    span = float(time[-1] - time[0])
    return {
        "rows": float(time.size), "duration_s": span, "rate_hz": (time.size - 1) / span,
        "longest_gap_s": float(step.max()), "lost": float(lost), "gaps": float(places),
        "real_hz": (time.size - 1 + lost) / span,
    }  # fmt: skip


def scale(time: np.ndarray, value: np.ndarray, rate: np.ndarray, good: np.ndarray, span: float = 0.3) -> float:
    """Factor of `rate` against the derivative of `value` (n,): integrals over `span`, at the lag that fits best.

    The geometric mean of the two regressions, so that noise on either side does not pull it down.
    """
    k = round(span / float(np.median(np.diff(time))))
    total = np.r_[0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))]
    bad = np.r_[0, np.cumsum(~good)]
    use = bad[k + 1 :] - bad[: -k - 1] == 0
    use[:20] = use[-20:] = False
    x = (value[k:] - value[:-k])[use]
    x = x - x.mean()
    best = (-1.0, 0.0)
    for lag in np.arange(-0.15, 0.151, 0.005):
        moved = np.interp(time + lag, time, total)
        y = (moved[k:] - moved[:-k])[use]
        y = y - y.mean()
        fit = float((x @ y) ** 2 / ((x @ x) * (y @ y)))
        best = max(best, (fit, float(np.sqrt((y @ y) / (x @ x)))))
    return best[1] if best[0] > 0.8 else float("nan")


def late(time: np.ndarray, first: np.ndarray, second: np.ndarray, good: np.ndarray) -> float:
    """By how much `second` (n, c) is late [ms]: least squares of integrals over 0.12 s, over lags to 0.2 s."""
    k = round(0.12 / float(np.median(np.diff(time))))

    def integral(x: np.ndarray) -> np.ndarray:
        step = np.diff(time)[:, None]
        return np.vstack([np.zeros(x.shape[1]), np.cumsum(0.5 * (x[1:] + x[:-1]) * step, axis=0)])

    one, two, bad = integral(first), integral(second), np.r_[0, np.cumsum(~good)]
    squares = []
    for lag in np.arange(-0.2, 0.2, 0.002):
        moved = np.column_stack([np.interp(time + lag, time, two[:, i]) for i in range(two.shape[1])])
        error = (((moved[k:] - moved[:-k]) - (one[k:] - one[:-k])) ** 2).sum(axis=1)
        at = np.clip(np.searchsorted(time, time + lag), 0, time.size - 1)
        error[bad[np.minimum(at[k:] + 2, time.size)] > bad[np.maximum(at[:-k] - 1, 0)]] = np.nan
        squares.append(error)
    table = np.array(squares)
    whole = np.isfinite(table).all(axis=0)
    return float(-200.0 + 2.0 * table[:, whole].mean(axis=1).argmin()) if whole.sum() > 300 else float("nan")


def drift(time: np.ndarray, first: np.ndarray, second: np.ndarray, good: np.ndarray) -> float:
    """Change of the lag over the whole recording [ms], from that of its first and its last third."""
    a, b = time[0] + np.ptp(time) / 3.0, time[-1] - np.ptp(time) / 3.0
    return 1.5 * (late(time, first, second, good & (time > b)) - late(time, first, second, good & (time < a)))


def turning(time: np.ndarray, q: Rotation) -> np.ndarray:
    """Body rate of an attitude by central differences."""
    out = np.zeros((time.size, 3))
    out[1:-1] = (q[:-2].inv() * q[2:]).as_rotvec() / (time[2:] - time[:-2])[:, None]
    return out


def leaning(time: np.ndarray, felt: np.ndarray, velocity: np.ndarray, good: np.ndarray) -> float:
    """Angle [deg] between the vertical and the mean specific force in the world (n, 3), less the acceleration."""
    rest = (felt - np.gradient(velocity, time, axis=0))[good].mean(axis=0)
    return float(np.degrees(np.arctan2(np.hypot(rest[0], rest[1]), rest[2])))


def limits(duty: np.ndarray, rows: np.ndarray, prefix: str = "full") -> Facts:
    """Share of the flight in which a rotor is at full duty."""
    flags = duty[rows] >= 0.999
    return {f"{prefix}_share": float(flags.any(axis=1).mean()), f"{prefix}_m4": float(flags[:, 3].mean())}


def columns(table: pd.DataFrame, names: str) -> np.ndarray:
    return table[names.split()].to_numpy(float)


def usd_table(path: Path) -> pd.DataFrame:
    """The fixed-frequency records of a uSD log, "t" in us: header, records, checksum, one by one with struct."""
    data = path.read_bytes()
    count = struct.unpack_from("<H", data, 3)[0]
    at, events = 5, {}
    for _ in range(count):
        number, at = struct.unpack_from("<H", data, at)[0], data.index(0, at + 2) + 1
        width, at = struct.unpack_from("<H", data, at)[0], at + 2
        names = []
        for _ in range(width):
            end = data.index(0, at)
            names.append(data[at:end].decode())
            at = end + 1
        events[number] = (names, [])
    while at < len(data) - 4:
        names, rows = events[struct.unpack_from("<H", data, at)[0]]
        layout = "<HQ" + "".join(name[-2] for name in names)
        rows.append(struct.unpack_from(layout, data, at)[1:])
        at += struct.calcsize(layout)
    assert at == len(data) - 4
    assert zlib.crc32(data[:-4]) == struct.unpack("<I", data[-4:])[0]
    names, rows = events[0xFFFF]
    return pd.DataFrame(rows, columns=["t", *(name[:-3] for name in names)], dtype=float)


def usd(path: Path) -> Facts:
    table = usd_table(path)
    time = table["t"].to_numpy() / 1e6
    facts = stream(time)
    nominal = 10.0 ** round(np.log10(facts["real_hz"]))
    facts["fast_percent"] = 100.0 * (facts["real_hz"] / nominal - 1.0)
    look = lighthouse if "stateEstimate.z" in table or "controller.cmd_thrust" in table else imu
    return facts | look(table, time)


def lighthouse(table: pd.DataFrame, time: np.ndarray) -> Facts:
    """A CrazyPAD flight: two hops from the floor."""
    place = columns(table, "stateEstimate.x stateEstimate.y stateEstimate.z")
    z = place[:, 2]
    if "motor.m1" in table:
        request = columns(table, "motor.m1 motor.m2 motor.m3 motor.m4")
        effort = request.mean(axis=1)
    else:
        request, effort = None, table["controller.cmd_thrust"].to_numpy()
    on = effort > 0.5 * np.quantile(effort[effort > 0.05 * effort.max()], 0.8)
    hops = [(a, b) for a, b in stretches(on) if time[b] - time[a] > 2.0]
    air, lifted = np.zeros(time.size, bool), np.zeros(time.size, bool)
    for a, b in hops:  # the estimated height of the floor drifts: it is what it was just before each hop
        climb = z[a : b + 1] - float(np.median(z[max(a - 20, 0) : a]))
        air[a : b + 1], lifted[a : b + 1] = climb > 0.05, climb > 0.02
    facts = {"flights": float(len(hops)), "airborne_s": float(air.sum()) * float(np.median(np.diff(time)))}
    facts |= {"take_off_s": float(time[air.argmax()]), "altitude_max_m": float(z[air].max())}
    facts["same_position"] = float(same(place)[air].mean())
    later = time.searchsorted(time + 0.1)
    use = air & (later < time.size) & air[np.minimum(later, time.size - 1)]
    moved = (place[later[use]] - place[use]) / (time[later[use]] - time[use])[:, None]
    facts["speed_max_m_s"] = float(np.linalg.norm(moved, axis=1).max())
    if request is not None:
        sent, volts = columns(table, "pwm.m1_pwm pwm.m2_pwm pwm.m3_pwm pwm.m4_pwm"), table["pm.vbatMV"].to_numpy() / 1e3
        facts["voltage_min_V"] = float(volts[air].min())
        facts["request_full_share"] = limits(request / 65535.0, lifted)["full_share"]
        facts["pwm_equal_share"] = float((request == sent)[request > 0].mean())
        # the old compensation: thrust in grams of a linear scale, volts by the quadratic fit of the propeller
        thrust = request / 65536.0 * 60.0
        wanted = -0.0006239 * thrust**2 + 0.088 * thrust
        error = np.abs(wanted / volts[:, None] * 65535.0 - sent)
        facts["compensation_error_counts"] = float(np.median(error[(request > 0) & (sent < 65000)]))
        moved = columns(table, "stateEstimate.vx stateEstimate.vy stateEstimate.vz")
        facts["speed_max_m_s"] = float(np.linalg.norm(moved[air], axis=1).max())
        facts["same_state"] = float(same(np.c_[place, moved])[air].mean())
        facts["mixer_share"] = on_grid(request)
    return facts


def on_grid(motors: np.ndarray) -> float:
    """Share of rows (n, 4) that whole-number thrust, roll, pitch and yaw can give: m1 = T - r + p + y and so on."""
    idle = 1.001 * motors[motors > 0].min()
    m = motors[(motors > idle).all(axis=1) & (motors < 65535).all(axis=1)]
    signs = np.array([[1, 1, 1, 1], [-1, -1, 1, 1], [1, -1, -1, 1], [1, -1, 1, -1]])
    return float(((m @ signs.T) % 4 == 0).all(axis=1).mean())


def imu(table: pd.DataFrame, time: np.ndarray) -> Facts:
    """A sysid flight: inertial sensors and duty at 1 kHz."""
    duty, force = columns(table, "motor.m1 motor.m2 motor.m3 motor.m4"), columns(table, "acc.x acc.y acc.z")
    rows = np.flatnonzero(duty.max(axis=1) > 0)
    flying = np.zeros(time.size, bool)
    flying[rows[0] : rows[-1] + 1] = True
    end = force[-500:].mean(axis=0)
    return {
        "rest_tilt_deg": float(np.degrees(np.arccos(end[2] / np.linalg.norm(end)))),
        "peak_m_s2": float(G * np.linalg.norm(force, axis=1).max()),
        "peak_rad_s": float(np.radians(np.linalg.norm(columns(table, "gyro.x gyro.y gyro.z"), axis=1).max())),
        "rotors_stop_s": float(time[rows[-1]]),
        "idle_share": float((duty[flying] == 0).any(axis=1).mean()),
        "held_share": float(same(duty)[flying].mean()),
        "mixer_share": on_grid(duty),
        "airborne_s": float(flying.sum()) * float(np.median(np.diff(time))),
    }


def nanobench(path: Path) -> Facts:
    """A NanoBench flight: what was drawn, what saturates, what is late, what is scaled, what it weighs."""
    d = pd.read_csv(path)
    time = d["t"].to_numpy() - d["t"].to_numpy()[0]
    packets = {
        "imu": "imu_acc_x imu_acc_y imu_acc_z imu_gyro_x imu_gyro_y imu_gyro_z",
        "motor": " ".join(f"motor_motor_m{i}" for i in (1, 2, 3, 4)),
        "state": " ".join(f"est_stateEstimate_{c}" for c in ("x", "y", "z", "vx", "vy", "vz")),
        "acceleration": " ".join(f"est_stateEstimate_{c}" for c in ("ax", "ay", "az")),
        "quaternion": " ".join(f"att_stateEstimate_{c}" for c in ("qx", "qy", "qz", "qw")),
        "angles": " ".join(f"att_stateEstimate_{c}" for c in ("roll", "pitch", "yaw")),
        "controller": " ".join(f"pid_controller_{c}" for c in ("roll", "pitch", "yaw", "cmd_thrust")),
    }
    value = {name: columns(d, names) for name, names in packets.items()}
    drawn = {name: straight(time, value[name]) for name in packets}
    facts = stream(time)
    for name, flags in drawn.items():
        facts |= {f"straight_{name}": float(flags.mean()), f"straight_{name}_longest_s": longest(flags, time)}
    facts["silent_s"] = float(time[-1] - time[~drawn["imu"]].max())
    duty = value["motor"] / 65535.0
    z, real = d["pz"].to_numpy(), ~drawn["motor"]
    working = duty.mean(axis=1)
    on = working > 0.5 * np.quantile(working[real & (working > 0.05)], 0.8)
    air = on & ((z > z[0] + 0.02) if working[0] < 0.05 else True) & (time < time[-1] - facts["silent_s"] + 0.1)
    volts = d["pwr_pm_vbat"].to_numpy()
    facts |= limits(duty, air & real)
    off = air & (z > z.min() + 0.03)
    for a, b in stretches(off):  # a hard landing throws it up once more; that is no flight
        off[a : b + 1] &= z[a : b + 1].max() > z.min() + 0.25 * np.ptp(z)
    facts["voltage_min_V"] = float(volts[off].min())
    facts["airborne_s"] = float(off.sum()) * float(np.median(np.diff(time)))
    facts["still_columns"] = float((np.ptp(value["controller"], axis=0) == 0).sum())
    facts |= polygon(time, volts)
    quaternion = Rotation.from_quat(columns(d, "qx qy qz qw"))
    moved = columns(d, "vx vy vz")
    high = z > z.min() + 0.08
    facts["high_s"] = float(high.sum()) * float(np.median(np.diff(time)))
    high &= on | (time > time[-1] - facts["silent_s"] - 0.1)
    facts["speed_max_m_s"] = float(np.linalg.norm(moved[high], axis=1).max())
    facts["tilt_max_deg"] = float(np.degrees(np.arccos(np.clip(quaternion.as_matrix()[high, 2, 2], -1, 1))).max())
    facts["altitude_max_m"] = float(z[high].max())
    facts["landing_speed_m_s"] = float(-moved[(time > time[air].max() - 0.6) & (time < time[air].max() + 0.6), 2].min())
    seen = duty * volts[:, None]
    lift = sum(c * seen**k for k, c in enumerate(CURVE)).sum(axis=1)  # type: ignore[union-attr]
    force = value["imu"][:, :3] * G
    known = air & real & ~drawn["imu"] & (z > z.min() + 0.1)
    facts["weight_ratio"] = float(lift[known].sum() / force[known, 2].sum() / 0.027)
    facts["leaning_deg"] = leaning(time, quaternion.apply(force), moved, known)
    # kinematics: stretches drawn for more than 50 ms are left out
    spin, up = turning(time, quaternion), (z > z.min() + 0.1)
    good = {name: up & ~uncovered(flags, time, 0.05) for name, flags in drawn.items()}
    onboard = Rotation.from_quat(value["quaternion"])
    place = columns(d, "px py pz")
    facts["late_imu_ms"] = late(time, spin[:, :2], value["imu"][:, 3:5], good["imu"])
    facts["late_quaternion_ms"] = late(time, spin[:, :2], turning(time, onboard)[:, :2], good["quaternion"])
    facts["late_state_ms"] = late(
        time, np.gradient(place, time, axis=0), np.gradient(value["state"][:, :3], time, axis=0), good["state"]
    )
    facts["drift_imu_ms"] = drift(time, spin[:, :2], value["imu"][:, 3:5], good["imu"])
    for i, axis in enumerate("xyz"):
        facts[f"velocity_{axis}"] = scale(time, place[:, i], value["state"][:, 3 + i], good["state"])
        facts[f"acceleration_{axis}"] = scale(time, moved[:, i], G * value["acceleration"][:, i], good["acceleration"])
    facts["acceleration_in_g"] = float(np.nanmean([facts[f"acceleration_{axis}"] for axis in "xyz"])) / G
    return facts | published(d, quaternion, onboard, spin, up)


def polygon(time: np.ndarray, value: np.ndarray) -> Facts:
    """How long there was no corner of a slow stream that was drawn onto the rows."""
    share = (time[1:-1] - time[:-2]) / (time[2:] - time[:-2])
    bent = np.abs(value[1:-1] - value[:-2] - share * (value[2:] - value[:-2])) > 5e-9
    at = np.array([0.5 * (time[a + 1] + time[b + 1]) for a, b in stretches(bent)])
    return {"corner_gap_s": float(np.diff(at).max())}


def published(d: pd.DataFrame, quaternion: Rotation, onboard: Rotation, spin: np.ndarray, up: np.ndarray) -> Facts:
    """The publisher's claims against the numbers: 1 where the column is what the table of corrections says."""
    packet = " ".join(f"att_stateEstimate_{c}" for c in ("qx", "qy", "qz", "qw"))
    # in one flight the onboard columns were drawn on beyond their last packet, into quaternions longer than one
    up = up & (np.abs(np.linalg.norm(columns(d, packet), axis=1) - 1.0) < 0.002)
    true, own = quaternion.as_euler("ZYX")[:, ::-1], np.degrees(onboard.as_euler("ZYX")[:, ::-1])
    told = columns(d, "att_stateEstimate_roll att_stateEstimate_pitch att_stateEstimate_yaw")
    rate = columns(d, "wx_vicon wy_vicon wz_vicon")

    def fit(x: np.ndarray, y: np.ndarray) -> float:
        return float(np.polyfit(x[up], y[up], 1)[0])

    def missed(model: np.ndarray) -> float:
        smooth = np.apply_along_axis(lambda c: np.convolve(c, np.ones(15) / 15, "same"), 0, rate - model)
        return float((smooth[up] ** 2).sum())

    return {
        "euler_unit": fit(true[:, 0], np.radians(d["roll"].to_numpy())),
        "pitch_sign": fit(own[:, 1], told[:, 1]),
        "world_over_body": missed(quaternion.apply(spin)) / missed(spin),
    }


def nanodrone(path: Path) -> Facts:
    """A nano-drone run, raw or processed."""
    d = pd.read_csv(path)
    time = d["t"].to_numpy()
    place, moved, q = columns(d, "x y z"), columns(d, "vx vy vz"), columns(d, "qx qy qz qw")
    facts = stream(time)
    up = place[:, 2] > 0.15
    q_norm = Rotation.from_quat(np.where(np.isfinite(q).all(axis=1)[:, None], q, [0.0, 0.0, 0.0, 1.0]))
    for i, axis in enumerate("xyz"):
        facts[f"velocity_{axis}"] = scale(time, place[:, i], moved[:, i], up)
    facts["speed_max_m_s"] = float(np.linalg.norm(moved[up], axis=1).max())
    facts["altitude_max_m"] = float(place[up, 2].max())
    facts["tilt_max_deg"] = float(np.degrees(np.arccos(np.clip(q_norm.as_matrix()[up, 2, 2], -1, 1))).max())
    if "ax_body" in d:
        felt = columns(d, "ax_body ay_body az_body")
        facts["same_force"] = float(same(felt).mean())
        facts["leaning_deg"] = leaning(time, q_norm.apply(felt), moved, up)
        speed = columns(d, "m1_rads m2_rads m3_rads m4_rads").mean(axis=1)
        facts["airborne_s"] = float((speed > 0.5 * np.quantile(speed, 0.8)).sum()) * 0.01
        return facts
    lens, duty, erpm = (
        columns(d, "x_poses y_poses z_poses"),
        columns(d, "m1_thrust m2_thrust m3_thrust m4_thrust"),
        columns(d, "m1_erpm m2_erpm m3_erpm m4_erpm"),
    )
    on = duty.mean(axis=1) > 0.3
    rows = np.flatnonzero(up)
    air = np.zeros(time.size, bool)
    for a, b in stretches(up):
        if time[b] - time[a] > 1.0:
            air[a : b + 1] = True
    whole = same(columns(d, "x y z vx vy vz qx qy qz qw wx wy wz ax ay az"))
    facts |= {"same_rows": float(whole[air].mean()), "same_rows_most": float(longest(whole, np.arange(time.size)) + 1)}
    facts["same_lens"] = float((same(lens) & ~whole)[air].mean())
    facts["same_motors"] = float((same(np.c_[duty, np.nan_to_num(erpm)]) & ~whole)[air].mean())
    facts["same_force"] = float((same(columns(d, "qx qy qz qw ax ay az")) & ~whole)[air].mean())
    facts["voltage_min_V"] = float(np.nanmin(columns(d, "Vbat")[air]))
    facts["same_voltage"] = float(same(columns(d, "Vbat"))[air].mean())
    facts |= limits(duty, air)
    facts["idle_share"] = float((duty[air] <= 0.15260).any(axis=1).mean())
    facts["missing"] = float(((erpm == 65535) | np.isnan(erpm))[air].any(axis=1).sum())
    speed = np.where(erpm == 65535, np.nan, erpm) * 2.0 * np.pi / 360.0
    facts["impossible"] = float((speed > 8000.0).any(axis=1).sum())
    facts["worst_rad_s"] = float(np.nanmax(speed))
    facts["leaning_deg"] = leaning(time, columns(d, "ax ay az"), moved, air)
    facts["late_lens_ms"] = late(time, np.gradient(place, time, axis=0), np.gradient(lens, time, axis=0), air)
    facts["drift_lens_ms"] = drift(time, np.gradient(place, time, axis=0), np.gradient(lens, time, axis=0), air)
    last = rows[-1]
    facts["landing_speed_m_s"] = float(-moved[max(last - 60, 0) : last + 60, 2].min())
    facts["airborne_s"] = float((on & (place[:, 2] > 0.06)).sum()) * 0.01
    return facts


def tilt_of_code(code: int) -> float:
    """Tilt [deg] of a quaternion as the firmware packs it: index of the largest part, then sign and 9 bits of each."""
    q, largest = [0.0] * 4, code >> 30
    for i in (3, 2, 1, 0):
        if i != largest:
            q[i] = (-1.0 if code & 512 else 1.0) * (code & 511) / 511.0 / 2.0**0.5
            code >>= 10
    q[largest] = max(0.0, 1.0 - sum(x * x for x in q)) ** 0.5
    return float(np.degrees(np.arccos(max(-1.0, min(1.0, 1.0 - 2.0 * (q[0] ** 2 + q[1] ** 2))))))


def real_firmware(path: Path) -> Facts:
    """The real firmware as a process: blocks in long form."""
    d = pd.read_csv(path)
    facts: Facts = {}
    for block in ("pos", "imu", "mot", "lee"):
        part = d[d["block"] == block]
        part = part[part["name"] == part["name"].iloc[0]]
        time = part["fw_ms"].to_numpy() / 1e3
        span = float(time[-1] - time[0])
        facts |= {f"{block}_rows": float(time.size), f"{block}_duration_s": span}
        facts |= {f"{block}_twice": float((np.diff(time) == 0).sum()), f"{block}_longest_s": float(np.diff(time).max())}
        facts[f"{block}_lost"] = float(round(span / 0.01) - (time.size - 1))  # nobody samples early, so spans count
        facts[f"{block}_rate_hz"] = (time.size - 1) / span
        facts[f"{block}_behind_s"] = float(np.ptp(part["host_t"].to_numpy()) - span)
    spans = [d[d["block"] == b]["fw_ms"] for b in ("pos", "imu", "mot", "lee")]
    facts["duration_s"] = float(max(x.max() for x in spans) - min(x.min() for x in spans)) / 1e3
    duty = np.column_stack([d[d["name"] == f"motor.m{i}"]["value"].to_numpy() for i in (1, 2, 3, 4)])
    facts["mixer_share"] = on_grid(duty)
    code = d[d["name"] == "stateEstimateZ.quat"]["value"].to_numpy().astype(np.int64)
    facts["tilt_max_deg"] = max(tilt_of_code(int(c)) for c in code)
    volts = (d[d["name"] == "pm.vbatMV"]["value"].to_numpy() + 0.5) / 1e3  # whole mV, cut off
    facts["voltage_min_V"] = float(volts.min())
    state = {k: d[d["name"] == f"stateEstimateZ.{k}"]["value"].to_numpy() / 1e3 for k in ("z", "vx", "vy", "vz")}
    facts["altitude_max_m"] = float(state["z"].max())
    facts["airborne_s"] = float((state["z"] > 0.05).sum()) * 0.01
    facts["speed_max_m_s"] = float(np.sqrt(state["vx"] ** 2 + state["vy"] ** 2 + state["vz"] ** 2).max())
    return facts


def second_look(path: Path) -> Facts:
    """Facts of a recording, from its bytes."""
    folder = path.parent.name
    if folder in ("crazypad", "sysid"):
        return usd(path)
    return {"nanobench": nanobench, "real_firmware": real_firmware}.get(folder, nanodrone)(path)
