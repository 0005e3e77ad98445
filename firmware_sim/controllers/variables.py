"""The log variables that flight control and state estimation provide, in one float64 array, in the firmware's units.

Each constant is the index of the first variable of a group; the order within a group is that of the names here.
"""

_XYZ = ("x", "y", "z")


def _run(group: str, *names: str) -> list[str]:
    return [f"{group}.{name}" for name in names]


COMMON: list[str] = [
    *_run("stateEstimate", "x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "roll", "pitch", "yaw"),
    *_run("stateEstimate", "qx", "qy", "qz", "qw"),
    *_run("stateEstimateZ", "x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "quat"),
    *_run("stateEstimateZ", "rateRoll", "ratePitch", "rateYaw"),
    *_run("gyro", *_XYZ),
    *_run("acc", *_XYZ),
    *_run("motor", "m1", "m2", "m3", "m4", "m1req", "m2req", "m3req", "m4req"),
    *_run("pm", "vbat", "vbatMV", "state", "batteryLevel"),
    *_run("ctrlLee", "KR_x", "KR_y", "KR_z", "Kw_x", "Kw_y", "Kw_z"),
    *_run("ctrlLee", "Kpos_Px", "Kpos_Py", "Kpos_Pz", "Kpos_Dx", "Kpos_Dy", "Kpos_Dz"),
    *_run("ctrlLee", "thrustSi", "torquex", "torquey", "torquez", "rpyx", "rpyy", "rpyz", "rpydx", "rpydy", "rpydz"),
    *_run("ctrlLee", "error_posx", "error_posy", "error_posz", "error_velx", "error_vely", "error_velz"),
    *_run("ctrlLee", "omegax", "omegay", "omegaz", "omegarx", "omegary", "omegarz"),
    *_run("ctrlLqg", "thrustSi", "torquex", "torquey", "torquez", "rpydx", "rpydy", "rpydz"),
    *_run("ctrlLqg", "accx", "accy", "accz", "angaccx", "angaccy", "angaccz"),
    *_run("ctrlMel", "cmd_thrust", "cmd_roll", "cmd_pitch", "cmd_yaw", "r_roll", "r_pitch", "r_yaw", "accelz"),
    *_run("ctrlMel", "zdx", "zdy", "zdz", "i_err_x", "i_err_y", "i_err_z"),
    *_run("ctrlINDI", "cmd_thrust", "cmd_roll", "cmd_pitch", "cmd_yaw", "r_roll", "r_pitch", "r_yaw"),
    *_run("ctrlINDI", "u_act_dyn_p", "u_act_dyn_q", "u_act_dyn_r", "du_p", "du_q", "du_r"),
    *_run("ctrlINDI", "ang_accel_ref_p", "ang_accel_ref_q", "ang_accel_ref_r", "rate_d[0]", "rate_d[1]", "rate_d[2]"),
    *_run("ctrlINDI", "uf_p", "uf_q", "uf_r", "Omega_f_p", "Omega_f_q", "Omega_f_r", "n_p", "n_q", "n_r"),
    *_run("posCtrlIndi", "posRef_x", "posRef_y", "posRef_z", "velS_x", "velS_y", "velS_z"),
    *_run("posCtrlIndi", "velRef_x", "velRef_y", "velRef_z", "angS_roll", "angS_pitch", "angS_yaw"),
    *_run("posCtrlIndi", "angF_roll", "angF_pitch", "angF_yaw", "accRef_x", "accRef_y", "accRef_z"),
    *_run("posCtrlIndi", "accS_x", "accS_y", "accS_z", "accF_x", "accF_y", "accF_z", "accFT_x", "accFT_y", "accFT_z"),
    *_run("posCtrlIndi", "accErr_x", "accErr_y", "accErr_z", "phi_tilde", "theta_tilde", "T_tilde", "T_inner"),
    *_run("posCtrlIndi", "T_inner_f", "T_incremented", "cmd_phi", "cmd_theta"),
    *_run("controller", "cmd_thrust", "cmd_roll", "cmd_pitch", "cmd_yaw", "r_roll", "r_pitch", "r_yaw", "accelz"),
    *_run("controller", "actuatorThrust", "roll", "pitch", "yaw", "rollRate", "pitchRate", "yawRate", "ctr_yaw"),
    # The parts of the twelve PID regulators, in the order of their gains (parameters.py), then targets.
    *[f"pid_attitude.{a}_out{p}" for a in ("roll", "pitch", "yaw") for p in ("P", "I", "D", "FF")],
    *[f"pid_rate.{a}_out{p}" for a in ("roll", "pitch", "yaw") for p in ("P", "I", "D", "FF")],
    *[f"posCtl.{a}{p}" for a in ("X", "Y", "Z", "VX", "VY", "VZ") for p in ("p", "i", "d", "ff")],
    *_run("posCtl", "targetVX", "targetVY", "targetVZ", "targetX", "targetY", "targetZ"),
    *_run("posCtl", "bodyVX", "bodyVY", "bodyX", "bodyY"),
    *_run("stabilizer", "roll", "pitch", "yaw", "thrust"),
    *_run("ctrltarget", "x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "roll", "pitch", "yaw", "thrust"),
    *_run("ctrltarget", "mode_x", "mode_y", "mode_z", "mode_roll", "mode_pitch", "mode_yaw", "mode_quat"),
    *_run("ctrltargetZ", "x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az"),
    *_run("kalman", "stateX", "stateY", "stateZ", "statePX", "statePY", "statePZ", "stateD0", "stateD1", "stateD2"),
    *_run("kalman", "varX", "varY", "varZ", "varPX", "varPY", "varPZ", "varD0", "varD1", "varD2"),
    *_run("kalman", "q0", "q1", "q2", "q3"),
    *_run("locSrv", "x", "y", "z", "qx", "qy", "qz", "qw"),
    *_run("locSrvZ", "tick"),
    *_run("ext_pos", "X", "Y", "Z"),
    *_run("baro", "asl", "temp", "pressure"),
]
BRUSHLESS: list[str] = _run("motor", "m1_rpm", "m2_rpm", "m3_rpm", "m4_rpm")

ALL_VARIABLES = tuple(COMMON + BRUSHLESS)
VARIABLE_INDEX = {name: i for i, name in enumerate(ALL_VARIABLES)}


def names(platform: str) -> tuple[str, ...]:
    """Log variables of a platform; rotor speeds only where the speed controllers report them (cf21bl)."""
    return ALL_VARIABLES if platform == "cf21bl" else tuple(COMMON)


EST = VARIABLE_INDEX["stateEstimate.x"]
EST_RPY = VARIABLE_INDEX["stateEstimate.roll"]
EST_Q = VARIABLE_INDEX["stateEstimate.qx"]
ESTZ = VARIABLE_INDEX["stateEstimateZ.x"]
ESTZ_QUAT = VARIABLE_INDEX["stateEstimateZ.quat"]
ESTZ_RATE = VARIABLE_INDEX["stateEstimateZ.rateRoll"]
GYRO = VARIABLE_INDEX["gyro.x"]
ACC = VARIABLE_INDEX["acc.x"]
MOTOR = VARIABLE_INDEX["motor.m1"]
MOTOR_REQ = VARIABLE_INDEX["motor.m1req"]
PM = VARIABLE_INDEX["pm.vbat"]
LEE_GAINS = VARIABLE_INDEX["ctrlLee.KR_x"]
LEE_OUT = VARIABLE_INDEX["ctrlLee.thrustSi"]
LEE_RPY = VARIABLE_INDEX["ctrlLee.rpyx"]
LEE_ERROR = VARIABLE_INDEX["ctrlLee.error_posx"]
LEE_OMEGA = VARIABLE_INDEX["ctrlLee.omegax"]
LQG_OUT = VARIABLE_INDEX["ctrlLqg.thrustSi"]
LQG_RPYD = VARIABLE_INDEX["ctrlLqg.rpydx"]
LQG_ACC = VARIABLE_INDEX["ctrlLqg.accx"]
MEL = VARIABLE_INDEX["ctrlMel.cmd_thrust"]
INDI = VARIABLE_INDEX["ctrlINDI.cmd_thrust"]
INDI_POS = VARIABLE_INDEX["posCtrlIndi.posRef_x"]
PID = VARIABLE_INDEX["controller.cmd_thrust"]
PID_CTR_YAW = VARIABLE_INDEX["controller.ctr_yaw"]
PID_PARTS = VARIABLE_INDEX["pid_attitude.roll_outP"]
PID_TARGETS = VARIABLE_INDEX["posCtl.targetVX"]
STABILIZER = VARIABLE_INDEX["stabilizer.roll"]
TARGET = VARIABLE_INDEX["ctrltarget.x"]
TARGETZ = VARIABLE_INDEX["ctrltargetZ.x"]
KALMAN = VARIABLE_INDEX["kalman.stateX"]
LOC = VARIABLE_INDEX["locSrv.x"]
LOC_TICK = VARIABLE_INDEX["locSrvZ.tick"]
EXT_POS = VARIABLE_INDEX["ext_pos.X"]
BARO = VARIABLE_INDEX["baro.asl"]
RPM = VARIABLE_INDEX["motor.m1_rpm"]
