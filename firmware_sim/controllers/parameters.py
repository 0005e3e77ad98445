"""The parameters that flight control reads: names, defaults on cf2, what differs on cf21bl, and their array indices.

Defaults as read back from the firmware of August 2026 (controller_lee.c, controller_mellinger.c, kalman_core.c, ...).
All live in one float64 array that compiled code reads each step. `ctrlLqg` is ours: the out-of-tree controller 6.
"""

_CF2: dict[str, float] = {
    "stabilizer.controller": 1,
    "stabilizer.estimator": 2,
    "stabilizer.stop": 0,
    "powerDist.idleThrust": 0,
    "motorPowerSet.enable": 0,
    "motorPowerSet.m1": 0,
    "motorPowerSet.m2": 0,
    "motorPowerSet.m3": 0,
    "motorPowerSet.m4": 0,
    # Kalman filter
    "kalman.resetEstimation": 0,
    "kalman.robustTdoa": 0,
    "kalman.robustTwr": 0,
    "kalman.pNAcc_xy": 0.5,
    "kalman.pNAcc_z": 1.0,
    "kalman.pNVel": 0.0,
    "kalman.pNPos": 0.0,
    "kalman.pNAtt": 0.0,
    "kalman.mNBaro": 2.0,
    "kalman.mNGyro_rollpitch": 0.1,
    "kalman.mNGyro_yaw": 0.1,
    "kalman.initialX": 0.0,
    "kalman.initialY": 0.0,
    "kalman.initialZ": 0.0,
    "kalman.initialYaw": 0.0,
    "kalman.maxPos": 100.0,
    "kalman.maxVel": 10.0,
    "locSrv.extPosStdDev": 0.01,
    "locSrv.extQuatStdDev": 4.5e-3,
    # Lee
    "ctrlLee.mass": 0.029,
    "ctrlLee.J_x": 1.657171e-5,
    "ctrlLee.J_y": 1.6655602e-5,
    "ctrlLee.J_z": 2.9261652e-5,
    "ctrlLee.KR_x": 0.007,
    "ctrlLee.KR_y": 0.007,
    "ctrlLee.KR_z": 0.008,
    "ctrlLee.KI_x": 0.03,
    "ctrlLee.KI_y": 0.03,
    "ctrlLee.KI_z": 0.03,
    "ctrlLee.Kw_x": 0.00115,
    "ctrlLee.Kw_y": 0.00115,
    "ctrlLee.Kw_z": 0.002,
    "ctrlLee.Kpos_Px": 7.0,
    "ctrlLee.Kpos_Py": 7.0,
    "ctrlLee.Kpos_Pz": 7.0,
    "ctrlLee.Kpos_P_limit": 100.0,
    "ctrlLee.Kpos_Dx": 4.0,
    "ctrlLee.Kpos_Dy": 4.0,
    "ctrlLee.Kpos_Dz": 4.0,
    "ctrlLee.Kpos_D_limit": 100.0,
    "ctrlLee.Kpos_Ix": 0.0,
    "ctrlLee.Kpos_Iy": 0.0,
    "ctrlLee.Kpos_Iz": 0.0,
    "ctrlLee.Kpos_I_limit": 2.0,
    # LQG: what it believes, and the weights of its cost (lqg_design.py)
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
    # Mellinger
    "ctrlMel.mass": 0.029,
    "ctrlMel.massThrust": 132000.0,
    "ctrlMel.kp_xy": 0.4,
    "ctrlMel.kd_xy": 0.2,
    "ctrlMel.ki_xy": 0.05,
    "ctrlMel.i_range_xy": 2.0,
    "ctrlMel.kp_z": 1.25,
    "ctrlMel.kd_z": 0.4,
    "ctrlMel.ki_z": 0.05,
    "ctrlMel.i_range_z": 0.4,
    "ctrlMel.kR_xy": 70000.0,
    "ctrlMel.kR_z": 60000.0,
    "ctrlMel.kw_xy": 20000.0,
    "ctrlMel.kw_z": 12000.0,
    "ctrlMel.ki_m_xy": 0.0,
    "ctrlMel.ki_m_z": 500.0,
    "ctrlMel.i_range_m_xy": 1.0,
    "ctrlMel.i_range_m_z": 1500.0,
    "ctrlMel.kd_omega_rp": 200.0,
    # PID: the gains of its twelve regulators stand together and in this order
    "pid_attitude.roll_kp": 6.0,
    "pid_attitude.roll_ki": 3.0,
    "pid_attitude.roll_kd": 0.0,
    "pid_attitude.roll_kff": 0.0,
    "pid_attitude.pitch_kp": 6.0,
    "pid_attitude.pitch_ki": 3.0,
    "pid_attitude.pitch_kd": 0.0,
    "pid_attitude.pitch_kff": 0.0,
    "pid_attitude.yaw_kp": 6.0,
    "pid_attitude.yaw_ki": 1.0,
    "pid_attitude.yaw_kd": 0.35,
    "pid_attitude.yaw_kff": 0.0,
    "pid_rate.roll_kp": 250.0,
    "pid_rate.roll_ki": 500.0,
    "pid_rate.roll_kd": 2.5,
    "pid_rate.roll_kff": 0.0,
    "pid_rate.pitch_kp": 250.0,
    "pid_rate.pitch_ki": 500.0,
    "pid_rate.pitch_kd": 2.5,
    "pid_rate.pitch_kff": 0.0,
    "pid_rate.yaw_kp": 120.0,
    "pid_rate.yaw_ki": 16.7,
    "pid_rate.yaw_kd": 0.0,
    "pid_rate.yaw_kff": 0.0,
    "posCtlPid.xKp": 2.0,
    "posCtlPid.xKi": 0.0,
    "posCtlPid.xKd": 0.0,
    "posCtlPid.xKff": 0.0,
    "posCtlPid.yKp": 2.0,
    "posCtlPid.yKi": 0.0,
    "posCtlPid.yKd": 0.0,
    "posCtlPid.yKff": 0.0,
    "posCtlPid.zKp": 2.0,
    "posCtlPid.zKi": 0.5,
    "posCtlPid.zKd": 0.0,
    "posCtlPid.zKff": 0.0,
    "velCtlPid.vxKp": 25.0,
    "velCtlPid.vxKi": 1.0,
    "velCtlPid.vxKd": 0.0,
    "velCtlPid.vxKFF": 0.0,
    "velCtlPid.vyKp": 25.0,
    "velCtlPid.vyKi": 1.0,
    "velCtlPid.vyKd": 0.0,
    "velCtlPid.vyKFF": 0.0,
    "velCtlPid.vzKp": 25.0,
    "velCtlPid.vzKi": 15.0,
    "velCtlPid.vzKd": 0.0,
    "velCtlPid.vzKFF": 0.0,
    "pid_attitude.yawMaxDelta": 0.0,
    "pid_attitude.attFiltEn": 0,
    "pid_attitude.attFiltCut": 15.0,
    "pid_rate.rateFiltEn": 0,
    "pid_rate.omxFiltCut": 30.0,
    "pid_rate.omyFiltCut": 30.0,
    "pid_rate.omzFiltCut": 30.0,
    "posCtlPid.thrustBase": 36000,
    "posCtlPid.thrustMin": 20000,
    "posCtlPid.rLimit": 20.0,
    "posCtlPid.pLimit": 20.0,
    "posCtlPid.xVelMax": 1.0,
    "posCtlPid.yVelMax": 1.0,
    "posCtlPid.zVelMax": 1.0,
}

_CF21BL: dict[str, float] = {
    "ctrlLee.mass": 0.0393,
    "ctrlLqg.mass": 0.0393,
    "powerDist.idleThrust": 7000,
    "ctrlMel.mass": 0.0393,
    "pid_rate.roll_kp": 200.0,
    "pid_rate.pitch_kp": 200.0,
    "pid_rate.roll_ki": 400.0,
    "pid_rate.pitch_ki": 400.0,
    "posCtlPid.thrustBase": 30000,
}

NAMES = tuple(_CF2)
INDEX = {name: i for i, name in enumerate(NAMES)}


def defaults(platform: str) -> dict[str, float]:
    """Parameter values at boot of a platform ("cf2", "cf21bl"), before a scenario changes what is believed."""
    return _CF2 | (_CF21BL if platform == "cf21bl" else {})


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
