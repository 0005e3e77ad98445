"""Indices into the flat arrays of the compiled plant. World frame z up, body x forward, y left.

Each name is an index (or the first of several). Arrays: `state` (true state), `truth` (constants of the scenario, not
in the firmware's tables), `board` (constants compiled into the firmware), `sensor` (memories of the sensors),
`estimate` (the onboard estimate).
"""

# state
POS = 0  # m, world
VEL = 3  # m/s, world
QUAT = 6  # w, x, y, z; body to world
OMEGA = 10  # rad/s, body
ROTOR = 13  # N, thrust of rotors 1..4 after the lag
ACC = 17  # m/s^2, specific force at the geometric origin over the last step, in the accelerometer's axes
CHARGE = 20  # A s left in the battery
VOLTS = 21  # V at the battery's terminals
FEET = 22  # how many of the four feet touch the floor
ASLEEP = 23  # 1 while resting on the floor
PWM = 24  # 0..65535, ratio at motors 1..4
CLOCK = 28  # ms since boot; this and the following only with effects
AIRBORNE = 29  # ms since the feet first left the floor
GUST = 30  # m/s, world, velocity of the gusts beside the wind
SPIN = 33  # N m s, angular momentum of the rotors about body z over the last step
LOAD = 34  # unit vector from the hook to the suspended load, world
LOAD_RATE = 37  # 1/s, its rate of change
PHASE = 40  # rad, of the hidden vibration
HELD = 41  # 0..65535, command that the hidden sticky rotor follows
COMMANDS = 42  # DELAY_ROWS x 4, past PWM, a ring indexed by CLOCK
DELAY_ROWS = 128  # more than the longest delay in ms
STATE_SIZE = COMMANDS + 4 * DELAY_ROWS

# truth
MASS = 0  # kg
INERTIA = 1  # kg m^2, 3x3 row by row
INERTIA_INV = 10
ARM = 19  # m, rotor offset along body x (along y: ARM_Y)
CURVE = 20  # N, N/V, ... six coefficients, constant first
TORQUE_PER_THRUST = 26  # m
THRUST_MAX = 27  # N per rotor
MOTOR_TAU = 28  # s
ROTOR_CONSTANT = 29  # N/(rad/s)^2, only for the reported rotor speed
NOISE_THRUST = 30  # N sqrt(s)
NOISE_TORQUE = 31  # N m sqrt(s), x y z
CAPACITY = 34  # A s
RESISTANCE = 35  # ohm
POWER_COEFFICIENT = 36  # W/N^1.5 per rotor
ELECTRONICS_POWER = 37  # W
VBAT_NOISE = 38  # V, sd of one measurement
FLOOR = 39  # m
CONTACT_FREQUENCY = 40  # rad/s
CONTACT_DAMPING = 41  # ratio
CONTACT_STICK = 42  # 1/s, viscous friction below the Coulomb limit
FRICTION = 43  # Coulomb coefficient
GYRO_NOISE = 44  # rad/s/sqrt(Hz)
GYRO_BIAS = 45  # rad/s left after the start-up calibration, x y z
GYRO_WALK = 48  # rad/s/sqrt(s)
ACC_NOISE = 49  # m/s^2/sqrt(Hz)
FIX_KIND = 50  # 0 none, 1 position, 2 position and attitude
FIX_PERIOD = 51  # ms
FIX_POSITION = 52  # m, sd
FIX_ATTITUDE = 53  # rad, sd
ARM_Y = 54  # m
STANDING_MASS = 55  # kg, load of the floor: the body and its suspended load
# constants of the effects (described in effects/*.py)
COM = 56  # m, body, centre of mass from the geometric origin
EFFECT_ROTORS = 59  # 1: an effect of effects/drive.py is not neutral
EFFECT_BODY = 60  # the same for effects/motion.py
EFFECT_SENSING = 61  # the same for effects/sensing.py
INPUT_DELAY = 62  # ms
THRUST_SCALE = 63
FAULT_ROTOR = 64  # 0 none, 1..4
FAULT_SCALE = 65
FAULT_ONSET = 66  # ms since boot
SAG_PER_VOLT = 67  # 1/V
SAG_PER_SECOND = 68  # 1/s
SLOPE_ERROR = 69
HOVER_THRUST = 70  # N, of one rotor
GROUND_STRENGTH = 71
GROUND_HEIGHT = 72  # m
TORQUE_SCALE = 73
ROTOR_INERTIA = 74  # kg m^2
LINEAR_DRAG = 75  # N s/m, body x y z
QUADRATIC_DRAG = 78  # N s^2/m^2
ROLL_PER_VY = 81  # N m s/m
PITCH_PER_VX = 82
RATE_DAMPING = 83  # N m s
WIND = 86  # m/s, world
GUST_SD = 89  # m/s
GUST_TIME = 90  # s
WIND_DRAG = 91  # N s/m, force per wind where no drag is set
LOAD_MASS = 92  # kg
LOAD_LENGTH = 93  # m
LOAD_FRICTION = 94  # 1/s
POSE_TURN = 95  # w, x, y, z: attitude of the pose frame in the body
ACC_TURN = 99  # 3x3, from body to accelerometer axes
VELOCITY_SCALE = 108  # world x y z
DELAY_POSE = 111  # ms
DELAY_GYRO = 112
DELAY_ACC = 113
DELAY_STATE = 114
RPM_SCALE = 115  # rotors 1..4
# constants of the hidden effects
VIBRATION_ROTOR = 119  # 0 none, 1..4
VIBRATION_TORQUE = 120  # N m
VIBRATION_RATIO = 121  # of the rotor's frequency
STICKY_ROTOR = 122  # 0 none, 1..4
STICKY_BAND = 123  # 0..65535
YAW_AMPLITUDE = 124  # rad
YAW_WAVELENGTH = 125  # m
CABLE_STIFFNESS = 126  # N/m
CABLE_LENGTH = 127  # m
CABLE_POINT = 128  # m, world
FEET_REACH = 131  # m, no foot touches while the origin is higher than that
TRIM = 132  # m, steady torque of the rotors over their thrust, body x y z (an effect of the catalogue)
RPM_INVALID = 135  # a standard normal number above it makes a report of rotor speed unreadable
INTEGRATION_STEP = 136  # ms, whole: time between two steps of the plant
GYRO_STEP = 137  # rad/s, of the sensor's counts
ACC_STEP = 138  # m/s^2
PREDICT_PERIOD = 139  # ms between predictions of the onboard estimate
PREDICT_SLIP = 140  # a standard normal number above it makes this and all later predictions 1 ms later
FIX_PHASE = 141  # ms after a multiple of FIX_PERIOD at which built-in fixes come
TRUTH_SIZE = 142

# board: compile-time constants of the firmware (platform_defaults_*.h)
B_ARM = 0  # m, rotor offset along x and y: 0.707106781 ARM_LENGTH
B_TORQUE_PER_THRUST = 1
B_THRUST_MIN = 2
B_THRUST_MAX = 3
B_CURVE = 4  # four coefficients
B_REQUIRE_ARMING = 8
B_BRUSHLESS = 9
BOARD_SIZE = 10

# sensor
GYRO = 0  # rad/s, body, filtered
ACCEL = 3  # m/s^2, body, filtered
BIAS = 6  # rad/s, slow part of the gyro's bias
GYRO_FILTER = 9  # 2 memories an axis
ACCEL_FILTER = 15
VBAT = 21  # V, last measurement of the power management task
VBAT_FILTERED = 22  # V, the motor driver's own filter
PAST_POSE = 24  # DELAY_ROWS x 7: position, quaternion; rings for measurement_delay, indexed by the tick
PAST_GYRO = PAST_POSE + 7 * DELAY_ROWS  # DELAY_ROWS x 3
PAST_ACC = PAST_GYRO + 3 * DELAY_ROWS  # DELAY_ROWS x 3
PAST_STATE = PAST_ACC + 3 * DELAY_ROWS  # DELAY_ROWS x 16: position, velocity, quaternion, gyro, accelerometer
KEPT = PAST_STATE + 16 * DELAY_ROWS  # estimate, gyro and accelerometer, saved while delayed or scaled ones replace them
SENSOR_SIZE = KEPT + 16

# estimate
E_POS = 0
E_VEL = 3
E_QUAT = 6
E_EXT = 10  # 0 nothing waiting, 1 external position, 2 external pose
E_EXT_POS = 11
E_EXT_QUAT = 14  # w, x, y, z
E_RESET = 18  # 1: start again at the next step
E_GYRO = 19  # rad/s, mean over the time of the last prediction
E_ACC = 22  # m/s^2, likewise
E_SUM = 25  # gyro and accelerometer added up since then
E_COUNT = 31  # how many of each
E_DUE = 32  # ms of the next prediction
ESTIMATE_SIZE = 33

# columns of one row of standard normal numbers, one row a millisecond
N_THRUST = 0
N_TORQUE = 1
N_GYRO = 4
N_ACC = 7
N_WALK = 10
N_FIX_POSITION = 13
N_FIX_ATTITUDE = 16
N_VBAT = 19
N_GUST = 20
N_SLIP = 26
N_RPM = 27
N_BARO = 31
NOISE_WIDTH = 32  # with reserve, so that a new effect does not change the noise of the others
