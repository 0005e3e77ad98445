"""The controllers' working memory: one flat array, `memory`; each name is an index or the first of several."""

# Output of the running controller (control_t of the firmware)
MODE = 0  # 0 legacy (PWM units), 1 force and torque (N, N m)
WRENCH = 1  # thrust N, torque x y z N m
LEGACY = 5  # thrust, roll, pitch, yaw in PWM units
RUNNING = 9  # the controller that ran last, to reset integrals on a switch
REQUEST = 10  # motors 1..4 after battery compensation, before capping
# Lee
LEE_I_POS = 16
LEE_I_ATT = 19
# LQG
LQG_ALPHA = 24  # rad/s^2, expected angular acceleration after the rotors' lag
LQG_GAIN_POS = 28  # K of [p, v]
LQG_GAIN_ATT = 30  # roll and pitch: K of [angle, rate, angular acceleration]
LQG_GAIN_YAW = 33
# Mellinger
MEL_I_POS = 36
MEL_I_ATT = 39
MEL_PREV = 42  # rate error of the last step
# PID
PID_STATE = 48  # twelve regulators of four
PID_ATTITUDE = 96  # wanted roll, pitch, yaw, deg
PID_THRUST = 99
PID_MODES = 100  # the setpoint's seven modes at the last step
# INDI: first the part that controllerINDIInit clears
INDI_FILTERS = 108
INDI_RATE = 108  # three filters of four: rates
INDI_PASSED = 120  # commands after the rotors' lag
INDI_ACC = 132  # specific force
INDI_ANGLE = 144
INDI_LIFTED = 156  # one filter: thrust
INDI_FILTERS_END = 160
INDI_TILT = 160  # three coefficients: of roll and pitch, of yaw, of the outer loop
INDI_TURN = 163
INDI_PLACE = 166
INDI_ACT = 169  # u_act_dyn: roll, pitch, yaw in PWM units after the rotors' lag
INDI_U = 172  # u_in
INDI_DU = 175
INDI_ATTITUDE = 178  # wanted roll, pitch, yaw, rad
INDI_THRUST = 181
INDI_TILTS = 182  # output of the outer loop: roll, pitch, rad
INDI_LIFT = 184  # T_incremented
INDI_LIFT_ACT = 185  # T_inner
MEMORY_SIZE = 186

LEGACY_MODE, FORCE_TORQUE_MODE = 0.0, 1.0
