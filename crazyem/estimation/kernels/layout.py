"""Layout of the kernels' arrays: rows of statistics, and the vector of parameters.

Statistics of one step are sums of products weighted by dt, so that they do not depend on the sampling rate.
"""

MASS = 0  # 10: upper triangle of z z', z = (a, F0, dF/dtau, dF/ddelay)
AXIS = 10  # 3 x 21: upper triangle of z z', z = (alpha_i, gyroscopic product, M0_i, dM_i/dtau, dM_i/ddelay, 1)
AXIS_SIZE = 21
COUNT = 73  # 1: steps
IMPULSE = 74  # 6: squared impulses over dt, by body axis: specific force, angular acceleration
RESIDUAL = 80  # 5: squared measurement residuals of position, velocity, attitude, body rate, specific force
MEASURED = 85  # 5: number of scalars in each sum of RESIDUAL
BRIDGE = 90  # 6: squared noise within the step over dt^3 / 12, less its intensity; 0 except for the midpoint rule
IMPULSE_SEEN = 96  # 6: squared share of each impulse's variance that the data determine
RESIDUAL_SEEN = 102  # 5: IMPULSE_SEEN for the measurement noise
SIZE = 107

# Parameters: mass, Ixx, Iyy, Izz, time constant (logarithms); delay, torque offset x y z (linear, in units).
PARAMETERS = 9
LAG = 4
DELAY = 5
OFFSET = 6
