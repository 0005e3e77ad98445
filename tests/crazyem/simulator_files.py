"""Files of simulators with the constants that they publish for a Crazyflie, written from their field tables."""

CRAZYFLOW = """\
# drones of a lab
[cf2x_L250]
mass = 0.0328   # with a marker deck
J = [  # TODO
    [16.8e-6, 0.0, 0.0],
    [0.0, 16.8e-6, 0.0],
    [0.0, 0.0, 29.8e-6]
]
thrust_min = 0.0128
thrust_max = 0.12  # in N per motor
L = 0.03253
prop_inertia = 34.52e-9
rpm2thrust = [0.0, -5.382196214637237e-7, 2.4582929831265485e-10]
rpm2torque = [0.0, 1.410454111996297e-9, 1.4592584373980652e-12] # Index is order
rotor_dyn_coef = [ 7.355623702172756, 0.0, 0.0, 0.00024443862952110715,]
mixing_matrix = [
    [-1.0, -1.0,  1.0,  1.0],
    [-1.0,  1.0,  1.0, -1.0],
    [-1.0,  1.0, -1.0,  1.0]
]
drag_matrix = [  # from flights
    [-0.0149, 0.0, 0.0],
    [0.0, -0.0149, 0.0],
    [0.0, 0.0, -0.0139]
]

[my_drone]
mass = 0.05
J = [[2e-5, 0.0, 0.0], [0.0, 2e-5, 0.0], [0.0, 0.0, 3e-5]]
thrust_min = 0.0
thrust_max = 0.3
L = 0.04
prop_inertia = 0.0
rpm2thrust = [0.0, 0.0, 4.0e-10]
rpm2torque = [0.0, 0.0, 2.4e-12]
rotor_dyn_coef = [20.0, 0.0, 20.0, 0.0]
mixing_matrix = [[-1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, 1.0, -1.0], [-1.0, 1.0, -1.0, 1.0]]
drag_matrix = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
"""


def _prop(k: int, x: float, y: float) -> str:
    return f"""\
  <link name="prop{k}_link">
    <inertial><origin rpy="0 0 0" xyz="{x} {y} 0"/><mass value="0"/></inertial>
  </link>
"""


URDF = f"""\
<?xml version="1.0" ?>
<robot name="cf2">
  <properties arm="0.0397" kf="3.16e-10"  km='7.94e-12' thrust2weight="2.25" max_speed_kmh="30"
    gnd_eff_coeff="11.36859" drag_coeff_xy="9.1785e-7" drag_coeff_z="10.311e-7" />  <!-- per RPM -->
  <link name="base_link">
    <inertial>
      <origin rpy="0 0 0" xyz="0 0 0"/>
      <mass value="0.027"/>
      <inertia ixx="1.4e-5" ixy="0.0" ixz="0.0" iyy="1.4e-5" iyz="0.0" izz="2.17e-5"/>
    </inertial>
    <visual><origin rpy="0 0 55" xyz="0 0 0"/></visual>
  </link>
{_prop(0, 0.028, -0.028)}{_prop(1, -0.028, -0.028)}{_prop(2, -0.028, 0.028)}{_prop(3, 0.028, 0.028)}\
  <link name="center_of_mass_link">
    <inertial><origin rpy="0 0 0" xyz="0 0 0"/><mass value="0"/></inertial>
  </link>
</robot>
"""

MJCF = """\
<mujoco model="cf2">
  <option integrator="RK4" density="1.225"/>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 0.05"/>
    <body name="cf2" pos="0 0 0.1">
      <freejoint/>
      <inertial pos="0 0 0" mass="0.027" diaginertia="2.3951e-5 2.3951e-5 3.2347e-5"/>
      <site name="actuation" pos="0 0 0"/>
    </body>
  </worldbody>
  <actuator>
    <motor ctrlrange="0 0.35" gear="0 0 1 0 0 0" site="actuation" name="body_thrust"/>
    <motor ctrlrange="-0.00001 0.00001" gear="0 0 0 -1 0 0" site="actuation" name="x_moment"/>
  </actuator>
  <keyframe> <!-- the drone hovers -->
    <key name="hover" qpos="0 0 0.3 1 0 0 0" ctrl="0.26487 0.0"/>
  </keyframe>
</mujoco>
"""


def _sdf() -> str:
    links, motors, rotors = "", "", ""
    for k, (x, y) in enumerate(((1, -1), (-1, -1), (-1, 1), (1, 1)), start=1):
        links += f"""\
    <link name="cf/m{k}_prop">
      <pose>{0.031 * x:g} {0.031 * y:g} 0.021 0 0 0</pose>
      <inertial><mass>0.0008</mass>
        <inertia><ixx>8.33333E-09</ixx><iyy>1.08333E-07</iyy><izz>1.13333E-07</izz></inertia></inertial>
    </link>
"""
        motors += f"""\
    <plugin filename="gz-sim-multicopter-motor-model-system" name="gz::sim::systems::MulticopterMotorModel">
      <jointName>cf/m{k}_joint</jointName> <linkName>cf/m{k}_prop</linkName>
      <maxRotVelocity>2618</maxRotVelocity>
      <motorConstant>1.28192e-08</motorConstant>
      <momentConstant>0.005964552</momentConstant>
      <rotorDragCoefficient>8.06428e-07</rotorDragCoefficient>
    </plugin>
"""
        rotors += (
            "<rotor><forceConstant>1.28192e-08</forceConstant><momentConstant>0.005964552</momentConstant></rotor>\n"
        )
    return f"""\
<?xml version="1.0" ?>
<!-- ´ a comment with a letter of two bytes -->
<sdf version="1.8">
  <model name="cf">
    <pose>0 0 0 0 0 3.14</pose>
    <link name="cf/body">
      <inertial>
        <mass>0.025</mass>
        <inertia>
          <ixx>0.000016572</ixx>
          <iyy>0.000016656</iyy>
          <izz>0.000029262</izz>
        </inertia>
      </inertial>
    </link>
{links}{motors}\
    <plugin filename="gz-sim-multicopter-control-system" name="gz::sim::systems::MulticopterVelocityControl">
      <velocityGain>1.25 1.25 0.2425</velocityGain>
      <rotorConfiguration>
{rotors}      </rotorConfiguration>
    </plugin>
  </model>
</sdf>
"""


SDF = _sdf()

ROTORPY = """\
\"\"\" Parameters; k_d is mostly made up. \"\"\"
import numpy as np

d = 0.043  # arm length
s = np.sqrt(0.5)

quad_params = {
    # Inertial properties
    'mass': 0.03,       # kg
    'Ixx':  1.45e-5,
    'Iyy':  1.45e-5,
    'Izz':  2.89e-5,
    'Ixy':  0.0, 'Iyz':  0.0, 'Ixz':  0.0,
    'num_rotors': 4,
    'rotor_pos': {
        'r1': d*np.array([ s, s, 0]),    # m
        'r2': d*np.array([ s,-s, 0]),
        'r3': d*np.array([-s,-s, 0]),
        'r4': d*np.array([-s, s, 0]),
    },
    'rotor_directions': np.array([1,-1,1,-1]),
    'rI': np.array([0,0,0]),
    'c_Dx': 0.0, 'c_Dy': 0.0, 'c_Dz': 0.0,
    'k_eta': 2.3e-08,
    'k_m':   7.8e-11,
    'k_d':   10.2506e-07,
    'k_z':   7.553e-07,
    'k_h':   0.0,
    'k_flap': 0.0,
    'tau_m': 0.072,
    'rotor_speed_min': 0,
    'rotor_speed_max': 2500,    # rad/s
    'k_w': 200,
}
"""

OMNIDRONES = """\
name: crazyflie
inertia:
  xx: 1.4e-5
  xy: 0.0
  xz: 0.0
  yy: 1.4e-5
  yz: 0.0
  zz: 2.17e-5
mass: 0.028   # kg
l: 0.096
drag_coef: 0.2
rotor_configuration:
  arm_lengths: [0.048, 0.048, 0.048, 0.048]
  directions: [-1.0, 1.0, -1.0, 1.0]
  force_constants:
  - 2.88e-8
  - 2.88e-8
  - 2.88e-8
  - 2.88e-8
  max_rotation_velocities:
  - 2315
  - 2315
  - 2315
  - 2315
  moment_constants: [7.24e-10, 7.24e-10, 7.24e-10, 7.24e-10]
  num_rotors: 4
  rotor_angles: [0, 1.57079632679, 3.14159265359, -1.57079632679]
"""

CRAZYSWARM2 = """\
# all drones of the lab
robots:
  cf231:
    enabled: true
    uri: radio://0/80/2M/E7E7E7E7E7
    initial_position: [0, 0, 0]
    type: cf21  # see robot_types
    firmware_params:
      ctrlLee:
        mass: 0.032
        J_x: 16.57e-6
        J_y: 16.66e-6
        J_z: 29.26e-6
        Kpos_Px: 7.0

  cf5:
    enabled: false
    uri: radio://0/80/2M/E7E7E7E705
    firmware_params:
      stabilizer:
        controller: 6
robot_types:
  cf21:
    big_quad: false
"""

SIH = """\
#!/bin/sh
# @name A small quadrotor
. ${R}etc/init.d/rc.mc_defaults

param set-default SIH_MASS 1.0
param set-default SIH_IXX 0.025   # kg m^2
param set-default SIH_IYY 0.025
param set-default SIH_IZZ 0.030
param set-default SIH_IXY 0.0
param set-default SIH_IXZ 0.0
param set-default SIH_IYZ 0.0
param set-default SIH_T_MAX 5.0
param set-default SIH_Q_MAX 0.1
param set-default SIH_L_ROLL 0.2
param set-default SIH_L_PITCH 0.2
param set-default SIH_KDV 1.0
param set-default SIH_KDW 0.025
param set-default SIH_T_TAU 0.05
param set-default MPC_THR_HOVER 0.49
param set-default CA_ROTOR_COUNT 4
param set-default CA_ROTOR0_PX 1
param set-default CA_ROTOR2_KM -0.05
param set SIH_VEHICLE_TYPE 0
"""

L2F = """\
{
  "dynamics": {
    "rotor_positions": [[0.028, -0.028, 0.0], [-0.028, -0.028, 0.0], [-0.028, 0.028, 0.0], [0.028, 0.028, 0.0]],
    "rotor_thrust_directions": [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]],
    "rotor_thrust_coefficients": [[0.0, 0.0, 0.149], [0.0, 0.0, 0.149], [0.0, 0.0, 0.149], [0.0, 0.0, 0.149]],
    "rotor_torque_constants": [0.0251, 0.0251, 0.0251, 0.0251],
    "rotor_time_constants_rising": [0.05, 0.05, 0.05, 0.05],
    "rotor_time_constants_falling": [0.08, 0.08, 0.08, 0.08],
    "mass": 0.027,
    "gravity": [0, 0, -9.81],
    "J": [[3.85e-6, 0, 0], [0, 3.85e-6, 0], [0, 0, 5.9675e-6]],
    "J_inv": [[259740.26, 0, 0], [0, 259740.26, 0], [0, 0, 167574.36]],
    "hovering_throttle_relative": 0.6666,
    "action_limit": {"min": 0.0, "max": 1.0}
  },
  "integration": {"dt": 0.01}, "mdp": {"relative_rpm": true, "note": null}
}
"""

PUBLISHED = {
    "crazyflow": CRAZYFLOW, "gym-pybullet-drones": URDF, "mujoco": MJCF, "gazebo": SDF, "rotorpy": ROTORPY,
    "crazyswarm2": CRAZYSWARM2, "px4-sih": SIH, "omnidrones": OMNIDRONES, "l2f": L2F,
}  # fmt: skip
DRONE = {"crazyflow": "cf2x_L250", "crazyswarm2": "cf231"}  # where a file has several
