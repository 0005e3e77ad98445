"""The parameters that flight control reads: which they are, their boot values and their array indices.

Names and boot values are the firmware's (contents.py). All live in one float64 array that compiled code reads each
step. `ctrlLqg` is ours: the out-of-tree controller 6.
"""

from firmware_sim import contents

# Groups of the firmware's table that are ours whole, in its order.
_WHOLE = ("stabilizer", "powerDist", "motorPowerSet", "kalman", "locSrv", "ctrlLee", "ctrlMel")
# PID: the gains of the twelve regulators stand together and in this order, then what else these groups hold.
_PID = ("pid_attitude", "pid_rate", "posCtlPid", "velCtlPid")
_GAINS = ("kp", "ki", "kd", "kff")

# The out-of-tree controller: what it believes, and the weights of its cost (lqg_design.py).
_LQG: dict[str, float] = {
    "ctrlLqg.mass": 0.029,
    "ctrlLqg.J_x": 1.657171e-5,
    "ctrlLqg.J_y": 1.6655602e-5,
    "ctrlLqg.J_z": 2.9261652e-5,
    "ctrlLqg.tau": 0.05,
    "ctrlLqg.q_pos": 50.0,
    "ctrlLqg.q_vel": 4.0,
    "ctrlLqg.r_acc": 1.0,
    "ctrlLqg.q_att": 100.0,
    "ctrlLqg.q_rate": 0.1,
    "ctrlLqg.r_ang": 1e-3,
    "ctrlLqg.q_yaw": 25.0,
    "ctrlLqg.q_yawrate": 0.1,
    "ctrlLqg.r_yaw": 1e-3,
    "ctrlLqg.acc_limit": 9.0,
}


def _names(groups: tuple[str, ...]) -> list[str]:
    return [name for group in groups for name in contents.PARAMETERS if name.startswith(f"{group}.")]


def _is_gain(name: str) -> bool:
    return name.lower().endswith(_GAINS)


_FIRMWARE = (
    *_names(_WHOLE),
    *filter(_is_gain, _names(_PID)),
    *(name for name in _names(_PID) if not _is_gain(name)),
)
NAMES = (*_FIRMWARE, *_LQG)
INDEX = {name: i for i, name in enumerate(NAMES)}


def defaults(platform: str) -> dict[str, float]:
    """Parameter values at boot of a platform ("cf2", "cf21bl"), before a scenario changes what is believed."""
    values = contents.defaults(_FIRMWARE, platform)
    return values | _LQG | {"ctrlLqg.mass": values["ctrlLee.mass"]}


CONTROLLER = INDEX["stabilizer.controller"]
STOP = INDEX["stabilizer.stop"]
IDLE_THRUST = INDEX["powerDist.idleThrust"]
POWER_SET = INDEX["motorPowerSet.enable"]  # then m1..m4
PN_ACC_XY = INDEX["kalman.pNAcc_xy"]
PN_ACC_Z = INDEX["kalman.pNAcc_z"]
PN_VEL = INDEX["kalman.pNVel"]
PN_POS = INDEX["kalman.pNPos"]
PN_ATT = INDEX["kalman.pNAtt"]
MN_GYRO_RP = INDEX["kalman.mNGyro_rollpitch"]
MN_GYRO_YAW = INDEX["kalman.mNGyro_yaw"]
DRAG = INDEX["kalman.dragB_x"]  # x y z
COP = INDEX["kalman.cop_x"]  # x y z
MAX_POS = INDEX["kalman.maxPos"]
MAX_VEL = INDEX["kalman.maxVel"]
EXT_POS_SD = INDEX["locSrv.extPosStdDev"]
EXT_QUAT_SD = INDEX["locSrv.extQuatStdDev"]
LEE_MASS = INDEX["ctrlLee.mass"]
LEE_J = INDEX["ctrlLee.J_x"]  # x y z
LEE_KR = INDEX["ctrlLee.KR_x"]
LEE_KI = INDEX["ctrlLee.KI_x"]
LEE_KW = INDEX["ctrlLee.Kw_x"]
LEE_KP = INDEX["ctrlLee.Kpos_Px"]
LEE_KP_LIMIT = INDEX["ctrlLee.Kpos_P_limit"]
LEE_KD = INDEX["ctrlLee.Kpos_Dx"]
LEE_KD_LIMIT = INDEX["ctrlLee.Kpos_D_limit"]
LEE_KPI = INDEX["ctrlLee.Kpos_Ix"]
LEE_KPI_LIMIT = INDEX["ctrlLee.Kpos_I_limit"]
MEL_MASS = INDEX["ctrlMel.mass"]
MEL_MASS_THRUST = INDEX["ctrlMel.massThrust"]
MEL_XY = INDEX["ctrlMel.kp_xy"]  # kp, kd, ki, range
MEL_Z = INDEX["ctrlMel.kp_z"]
MEL_KR = INDEX["ctrlMel.kR_xy"]  # xy, z
MEL_KW = INDEX["ctrlMel.kw_xy"]
MEL_KI_M = INDEX["ctrlMel.ki_m_xy"]
MEL_RANGE_M = INDEX["ctrlMel.i_range_m_xy"]
MEL_KD_OMEGA = INDEX["ctrlMel.kd_omega_rp"]
PID_GAINS = INDEX["pid_attitude.roll_kp"]  # twelve times kp, ki, kd, kff
PID_YAW_LEAD = INDEX["pid_attitude.yawMaxDelta"]
PID_ATT_FILTER = INDEX["pid_attitude.attFiltEn"]  # then the cut-off
PID_RATE_FILTER = INDEX["pid_rate.rateFiltEn"]  # then three cut-offs
PID_THRUST_BASE = INDEX["posCtlPid.thrustBase"]  # then the least thrust
PID_R_LIMIT = INDEX["posCtlPid.rLimit"]  # roll, pitch
PID_VEL_MAX = INDEX["posCtlPid.xVelMax"]  # x, y, z
LQG_MASS = INDEX["ctrlLqg.mass"]
LQG_J = INDEX["ctrlLqg.J_x"]
LQG_TAU = INDEX["ctrlLqg.tau"]
LQG_ACC_LIMIT = INDEX["ctrlLqg.acc_limit"]
LQG_WEIGHTS = ("tau", "q_pos", "q_vel", "r_acc", "q_att", "q_rate", "r_ang", "q_yaw", "q_yawrate", "r_yaw")
