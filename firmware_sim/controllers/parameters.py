"""The parameters that flight control reads: names, defaults on cf2, what differs on cf21bl, and their array indices.

Defaults as read back from the firmware of August 2026 (controller_lee.c, controller_mellinger.c, kalman_core.c, ...).
All live in one float64 array that compiled code reads each step. `ctrlLqg` is ours: the out-of-tree controller 6.
"""

_CF2: dict[str, float] = {
    "stabilizer.controller": 5,
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
}

_CF21BL: dict[str, float] = {
    "ctrlLee.mass": 0.0393,
    "ctrlLqg.mass": 0.0393,
    "powerDist.idleThrust": 7000,
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
LQG_MASS = INDEX["ctrlLqg.mass"]
LQG_J = INDEX["ctrlLqg.J_x"]
LQG_TAU = INDEX["ctrlLqg.tau"]
LQG_ACC_LIMIT = INDEX["ctrlLqg.acc_limit"]
LQG_WEIGHTS = ("tau", "q_pos", "q_vel", "r_acc", "q_att", "q_rate", "r_ang", "q_yaw", "q_yawrate", "r_yaw")
