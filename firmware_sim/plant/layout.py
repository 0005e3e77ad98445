"""Where everything lives in the flat arrays that the compiled plant works on. World frame z up, body x forward, y left.

Each name is an index (or the first of several). Arrays: `state` (what is true now), `truth` (the constants of the
scenario, never visible to the firmware's tables), `board` (constants compiled into the firmware), `sensor` (memories of
the sensors), `estimate` (the onboard estimate).
"""

# state
POS = 0  # m, world
VEL = 3  # m/s, world
QUAT = 6  # w, x, y, z; body to world
OMEGA = 10  # rad/s, body
ROTOR = 13  # N, thrust of rotors 1..4 after the lag
ACC = 17  # m/s^2, body, specific force over the last step
CHARGE = 20  # A s left in the battery
VOLTS = 21  # V at the battery's terminals
FEET = 22  # how many of the four feet touch the floor
ASLEEP = 23  # 1 while resting on the floor
PWM = 24  # 0..65535, ratio at motors 1..4
STATE_SIZE = 28

# truth
MASS = 0  # kg
INERTIA = 1  # kg m^2, 3x3 row by row
INERTIA_INV = 10
ARM = 19  # m, rotor offset along body x and along body y
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
TRUTH_SIZE = 54

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
SENSOR_SIZE = 24

# estimate
E_POS = 0
E_VEL = 3
E_QUAT = 6
E_EXT = 10  # 0 nothing waiting, 1 external position, 2 external pose
E_EXT_POS = 11
E_EXT_QUAT = 14  # w, x, y, z
E_RESET = 18  # 1: start again at the next step
E_GYRO = 19  # rad/s used last
E_ACC = 22  # m/s^2 used last
ESTIMATE_SIZE = 25

# columns of one row of standard normal numbers, one row a millisecond
N_THRUST = 0
N_TORQUE = 1
N_GYRO = 4
N_ACC = 7
N_WALK = 10
N_FIX_POSITION = 13
N_FIX_ATTITUDE = 16
N_VBAT = 19
NOISE_WIDTH = 32  # the rest is kept for effects, so that adding one does not change the others' noise
