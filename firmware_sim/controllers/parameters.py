"""The parameters of flight control: names, boot values and array indices.

Names and boot values are the firmware's (contents.py). All live in one float64 array that compiled code reads each
step. `ctrlLqg` is ours: the out-of-tree controller 6.
"""

from firmware_sim import contents

# Groups of the firmware's table that are complete here, in its order.
_WHOLE_GROUPS = (
    *("stabilizer", "powerDist", "motorPowerSet", "kalman", "locSrv"),
    *("ctrlLee", "ctrlMel", "ctrlINDI", "posCtrlIndi"),
)
# PID: first the gains of the twelve regulators in this order, then the other parameters of these groups.
_PID = ("pid_attitude", "pid_rate", "posCtlPid", "velCtlPid")
_GAINS = ("kp", "ki", "kd", "kff")

# The out-of-tree controller: its model parameters and the weights of its cost (lqg.py).
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
    *_names(_WHOLE_GROUPS),
    *filter(_is_gain, _names(_PID)),
    *(name for name in _names(_PID) if not _is_gain(name)),
)
PARAMETER_NAMES = (*_FIRMWARE, *_LQG)
PARAMETER_INDEX = {name: i for i, name in enumerate(PARAMETER_NAMES)}


def defaults(platform: str) -> dict[str, float]:
    """Parameter values at boot of a platform ("cf2", "cf21bl"), before a scenario changes them."""
    values = contents.defaults(_FIRMWARE, platform)
    return values | _LQG | {"ctrlLqg.mass": values["ctrlLee.mass"]}


CONTROLLER = PARAMETER_INDEX["stabilizer.controller"]
STOP = PARAMETER_INDEX["stabilizer.stop"]
IDLE_THRUST = PARAMETER_INDEX["powerDist.idleThrust"]
POWER_SET = PARAMETER_INDEX["motorPowerSet.enable"]  # then m1..m4
PN_ACC_XY = PARAMETER_INDEX["kalman.pNAcc_xy"]
PN_ACC_Z = PARAMETER_INDEX["kalman.pNAcc_z"]
PN_VEL = PARAMETER_INDEX["kalman.pNVel"]
PN_POS = PARAMETER_INDEX["kalman.pNPos"]
PN_ATT = PARAMETER_INDEX["kalman.pNAtt"]
MN_GYRO_RP = PARAMETER_INDEX["kalman.mNGyro_rollpitch"]
MN_GYRO_YAW = PARAMETER_INDEX["kalman.mNGyro_yaw"]
DRAG = PARAMETER_INDEX["kalman.dragB_x"]  # x y z
COP = PARAMETER_INDEX["kalman.cop_x"]  # x y z
MAX_POS = PARAMETER_INDEX["kalman.maxPos"]
MAX_VEL = PARAMETER_INDEX["kalman.maxVel"]
EXT_POS_SD = PARAMETER_INDEX["locSrv.extPosStdDev"]
EXT_QUAT_SD = PARAMETER_INDEX["locSrv.extQuatStdDev"]
LEE_MASS = PARAMETER_INDEX["ctrlLee.mass"]
LEE_J = PARAMETER_INDEX["ctrlLee.J_x"]  # x y z
LEE_KR = PARAMETER_INDEX["ctrlLee.KR_x"]
LEE_KI = PARAMETER_INDEX["ctrlLee.KI_x"]
LEE_KW = PARAMETER_INDEX["ctrlLee.Kw_x"]
LEE_KP = PARAMETER_INDEX["ctrlLee.Kpos_Px"]
LEE_KP_LIMIT = PARAMETER_INDEX["ctrlLee.Kpos_P_limit"]
LEE_KD = PARAMETER_INDEX["ctrlLee.Kpos_Dx"]
LEE_KD_LIMIT = PARAMETER_INDEX["ctrlLee.Kpos_D_limit"]
LEE_KPI = PARAMETER_INDEX["ctrlLee.Kpos_Ix"]
LEE_KPI_LIMIT = PARAMETER_INDEX["ctrlLee.Kpos_I_limit"]
MEL_MASS = PARAMETER_INDEX["ctrlMel.mass"]
MEL_MASS_THRUST = PARAMETER_INDEX["ctrlMel.massThrust"]
MEL_XY = PARAMETER_INDEX["ctrlMel.kp_xy"]  # kp, kd, ki, range
MEL_Z = PARAMETER_INDEX["ctrlMel.kp_z"]
MEL_KR = PARAMETER_INDEX["ctrlMel.kR_xy"]  # xy, z
MEL_KW = PARAMETER_INDEX["ctrlMel.kw_xy"]
MEL_KI_M = PARAMETER_INDEX["ctrlMel.ki_m_xy"]
MEL_RANGE_M = PARAMETER_INDEX["ctrlMel.i_range_m_xy"]
MEL_KD_OMEGA = PARAMETER_INDEX["ctrlMel.kd_omega_rp"]
INDI_THRESHOLD = PARAMETER_INDEX["ctrlINDI.thrust_threshold"]
INDI_BOUND = PARAMETER_INDEX["ctrlINDI.bound_ctrl_input"]
INDI_G1 = PARAMETER_INDEX["ctrlINDI.g1_p"]  # p, q, r, then g2
INDI_ERR = PARAMETER_INDEX["ctrlINDI.ref_err_p"]  # p, q, r, then those of the rates
INDI_ACT_DYN = PARAMETER_INDEX["ctrlINDI.act_dyn_p"]  # p, q, r
INDI_CUTOFF = PARAMETER_INDEX["ctrlINDI.filt_cutoff"]  # roll and pitch, yaw
INDI_OUTER = PARAMETER_INDEX["ctrlINDI.outerLoopActive"]
INDI_XI = PARAMETER_INDEX["posCtrlIndi.K_xi_x"]  # x, y, z, then K_dxi
INDI_TILT_LIMIT = PARAMETER_INDEX["posCtrlIndi.pq_clamping"]
PID_GAINS = PARAMETER_INDEX["pid_attitude.roll_kp"]  # twelve times kp, ki, kd, kff
PID_YAW_LEAD = PARAMETER_INDEX["pid_attitude.yawMaxDelta"]
PID_ATT_FILTER = PARAMETER_INDEX["pid_attitude.attFiltEn"]  # then the cut-off
PID_RATE_FILTER = PARAMETER_INDEX["pid_rate.rateFiltEn"]  # then three cut-offs
PID_THRUST_BASE = PARAMETER_INDEX["posCtlPid.thrustBase"]  # then the least thrust
PID_R_LIMIT = PARAMETER_INDEX["posCtlPid.rLimit"]  # roll, pitch
PID_VEL_MAX = PARAMETER_INDEX["posCtlPid.xVelMax"]  # x, y, z
LQG_MASS = PARAMETER_INDEX["ctrlLqg.mass"]
LQG_J = PARAMETER_INDEX["ctrlLqg.J_x"]
LQG_TAU = PARAMETER_INDEX["ctrlLqg.tau"]
LQG_ACC_LIMIT = PARAMETER_INDEX["ctrlLqg.acc_limit"]
LQG_WEIGHTS = ("tau", "q_pos", "q_vel", "r_acc", "q_att", "q_rate", "r_ang", "q_yaw", "q_yawrate", "r_yaw")
