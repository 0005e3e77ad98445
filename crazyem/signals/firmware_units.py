"""Units of firmware log variables by name, also of those outside the vocabulary, for viewers and exports.

Sources: the log groups of crazyflie-firmware (HEAD of August 2026). Other names have no unit: "".
"""

import re

# the first match counts; patterns match whole names
_UNIT_PATTERNS: tuple[tuple[str, str], ...] = (
    (r"stateEstimate\.(roll|pitch|yaw)", "deg"),
    (r"stateEstimate\.a[xyz]", "g"),
    (r"stateEstimate\.v[xyz]", "m/s"),
    (r"stateEstimate\.[xyz]", "m"),
    (r"stateEstimateZ\.a[xyz]", "mm/s^2"),
    (r"stateEstimateZ\.v[xyz]", "mm/s"),
    (r"stateEstimateZ\.[xyz]", "mm"),
    (r"stateEstimateZ\.rate\w+", "mrad/s"),
    (r"(stateEstimate|kalman)\.q\w", "1"),
    (r"gyro\.[xyz]|gyro_unfiltered\.[xyz]", "deg/s"),
    (r"acc\.[xyz]|supervisor\.accNorm|controller\.accelz", "g"),
    (r"controller\.r_(roll|pitch|yaw)", "rad/s"),
    (r"controller\.(roll|pitch|yaw)Rate", "deg/s"),
    (r"controller\.(roll|pitch|yaw)", "deg"),
    (r"motor\.m\d_rpm|rpm\.m\d", "rpm"),
    (r"pm\.vbat", "V"),
    (r"pm\.vbatMV", "mV"),
    (r"pm\.batteryLevel", "%"),
    (r"baro\.asl", "m"),
    (r"baro\.temp", "degC"),
    (r"baro\.pressure", "mbar"),
    (r"range\.\w+", "mm"),
    (r"ext_pos\.[XYZ]|locSrv\.[xyz]", "m"),
    (r"ctrltarget\.(roll|pitch)", "deg"),
    (r"ctrltarget\.yaw", "deg/s"),
    (r"ctrltarget\.[xyz]", "m"),
    (r"ctrltarget\.v[xyz]", "m/s"),
    (r"ctrltarget\.a[xyz]", "m/s^2"),
    (r"ctrltargetZ\.[xyz]", "mm"),
    (r"ctrltargetZ\.v[xyz]", "mm/s"),
    (r"ctrltargetZ\.a[xyz]", "mm/s^2"),
    (r"stabilizer\.(roll|pitch|yaw)", "deg"),
    # PWM counts, 65535 is full; stabilizer.thrust is a PWM count only with some controllers
    (r"motor\.m\d(req)?|pwm\.m\d_pwm", "count"),
    (r"(controller|ctrlMel|ctrlINDI)\.cmd_(thrust|roll|pitch|yaw)|controller\.(actuatorThrust|ctr_yaw)", "count"),
    (r"ctrl(Lee|Lqg)\.thrustSi", "N"),
    (r"ctrl(Lee|Lqg)\.torque[xyz]", "N m"),
    (r"ctrlLee\.error_pos[xyz]", "m"),
    (r"ctrlLee\.error_vel[xyz]", "m/s"),
    (r"ctrlLee\.omegar?[xyz]", "rad/s"),
    (r"ctrlLee\.rpyd?[xyz]", "rad"),
    (r"kalman\.state[XYZ]", "m"),
    (r"kalman\.stateP[XYZ]", "m/s"),
    (r"kalman\.var[XYZ]", "m^2"),
    (r"kalman\.varP[XYZ]", "m^2/s^2"),
)


def unit_of(name: str) -> str:
    """Unit of a firmware log variable as logged, "" if unknown."""
    return next((unit for pattern, unit in _UNIT_PATTERNS if re.fullmatch(pattern, name)), "")
