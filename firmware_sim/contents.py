"""The tables of contents of the firmware of August 2026, in its order: names, types, flags, defaults of parameters.

As read over the link from crazyflie-firmware 2a18fc29 (protocol 12, 354 log variables, 245 parameters) by cflib, on a
build for a PC; flags as in its source (PARAM_ADD of each module). What a build for a drone has besides (rotor speeds of
a brushless drone, decks, an application's own groups) is in no line here: tables.py sorts it in.
"""

from dataclasses import dataclass

# "group type names", one run a line.
_LOG = """
crtp u16 rxRate txRate
sys i8 testLogParam
sys u8 canfly isFlying isTumbled
memTst u32 errCntW
supervisor u16 info
supervisor float accNorm
colAv u32 latency
locSrvZ u16 tick
locSrv float x y z qx qy qz qw
ext_pos float X Y Z
sensfusion6 float qw qx qy qz gravityX gravityY gravityZ accZbase
sensfusion6 u8 isInit isCalibrated
motor i32 m1req m2req m3req m4req
motor u16 m1 m2 m3 m4
stateEstimateZ i16 x y z vx vy vz ax ay az
stateEstimateZ u32 quat
stateEstimateZ i16 rateRoll ratePitch rateYaw
stateEstimate float x y z vx vy vz ax ay az roll pitch yaw qx qy qz qw
controller i16 ctr_yaw
controller float cmd_thrust cmd_roll cmd_pitch cmd_yaw r_roll r_pitch r_yaw accelz actuatorThrust roll pitch yaw
controller float rollRate pitchRate yawRate
mag float x y z
gyro float x y z
baro float asl temp pressure
acc float x y z
stabilizer float roll pitch yaw thrust rtStab
stabilizer u32 intToOut
ctrltargetZ i16 x y z vx vy vz ax ay az
ctrltarget float x y z vx vy vz ax ay az roll pitch yaw thrust
ctrltarget u8 mode_x mode_y mode_z mode_roll mode_pitch mode_yaw mode_quat
posEstAlt float estimatedZ estVZ velocityZ
estimator float rtApnd rtRej
outlierf i32 lhWin bucket0 bucket1 bucket2 bucket3 bucket4
outlierf float accLev errD
kalman float stateX stateY stateZ statePX statePY statePZ stateD0 stateD1 stateD2 varX varY varZ varPX varPY varPZ
kalman float varD0 varD1 varD2 q0 q1 q2 q3 rtUpdate rtPred rtFinal
kalman_pred float predNX predNY measNX measNY
pid_rate float roll_outP roll_outI roll_outD roll_outFF pitch_outP pitch_outI pitch_outD pitch_outFF yaw_outP yaw_outI
pid_rate float yaw_outD yaw_outFF
pid_attitude float roll_outP roll_outI roll_outD roll_outFF pitch_outP pitch_outI pitch_outD pitch_outFF yaw_outP
pid_attitude float yaw_outI yaw_outD yaw_outFF
posCtl float targetVX targetVY targetVZ targetX targetY targetZ bodyVX bodyVY bodyX bodyY Xp Xi Xd Xff Yp Yi Yd Yff Zp
posCtl float Zi Zd Zff VXp VXi VXd VXff VYp VYi VYd VYff VZp VZi VZd VZff
ctrlMel float cmd_thrust cmd_roll cmd_pitch cmd_yaw r_roll r_pitch r_yaw accelz zdx zdy zdz i_err_x i_err_y i_err_z
ctrlINDI float cmd_thrust cmd_roll cmd_pitch cmd_yaw r_roll r_pitch r_yaw u_act_dyn_p u_act_dyn_q u_act_dyn_r du_p
ctrlINDI float du_q du_r ang_accel_ref_p ang_accel_ref_q ang_accel_ref_r rate_d[0] rate_d[1] rate_d[2] uf_p uf_q uf_r
ctrlINDI float Omega_f_p Omega_f_q Omega_f_r n_p n_q n_r
posCtrlIndi float posRef_x posRef_y posRef_z velS_x velS_y velS_z velRef_x velRef_y velRef_z angS_roll angS_pitch
posCtrlIndi float angS_yaw angF_roll angF_pitch angF_yaw accRef_x accRef_y accRef_z accS_x accS_y accS_z accF_x accF_y
posCtrlIndi float accF_z accFT_x accFT_y accFT_z accErr_x accErr_y accErr_z phi_tilde theta_tilde T_tilde T_inner
posCtrlIndi float T_inner_f T_incremented cmd_phi cmd_theta
ctrlLee float KR_x KR_y KR_z Kw_x Kw_y Kw_z Kpos_Px Kpos_Py Kpos_Pz Kpos_Dx Kpos_Dy Kpos_Dz thrustSi torquex torquey
ctrlLee float torquez rpyx rpyy rpyz rpydx rpydy rpydz error_posx error_posy error_posz error_velx error_vely
ctrlLee float error_velz omegax omegay omegaz omegarx omegary omegarz
pm float vbat
pm u16 vbatMV
pm float extVbat
pm u16 extVbatMV
pm float extCurr chargeCurrent
pm i8 state
pm u8 batteryLevel
pm float temp
"""

# "group type[/flags] name=default ...", defaults of a cf2. Flags: p persistent, r read only, c core (kept stable).
_PARAMETERS = """
system u8 storageStats=0 storageReformat=0
system i8/rc selftestPassed=1
system u8 assertInfo=0 testLogParam=0 doAssert=0
system u8/c taskDump=0
imu_tests u8/r MPU6500_SIM=1 HMC5883L_SIM=1 MS5611_SIM=1
imu_sensors u8/r HMC5883L_SIM=1 MS5611_SIM=1
crtpsrv u16 echoDelay=0
memTst u8 resetW=0
supervisor u8 infdmp=0
supervisor u16/p prefltTimeout=30000 landedTimeout=3000
supervisor u8/p tmblChckEn=1
supervisor u16/p spinupTimeout=2000
supervisor float/p crashDetectGs=0
stabilizer u8/c stop=0 estimator=2 controller=1
colAv u8/c enable=0
colAv float/c ellipsoidX=0.3 ellipsoidY=0.3 ellipsoidZ=0.9
colAv float bboxMinX=-3.4028235e38 bboxMinY=-3.4028235e38 bboxMinZ=-3.4028235e38 bboxMaxX=3.4028235e38
colAv float bboxMaxY=3.4028235e38 bboxMaxZ=3.4028235e38 horizon=1 maxSpeed=0.5 sidestepThrsh=0.25
colAv i32 maxPeerLocAge=5000
colAv float vorTol=1e-5
colAv i32 vorIters=100
commander u8/c enHighLevel=0
flightmode u8/c althold=0 poshold=0 posSet=0
flightmode u8 yawMode=2
flightmode u8/c stabModeRoll=1 stabModePitch=1 stabModeYaw=0
cppm float/p rateRoll=720 ratePitch=720 angPitch=50 angRoll=50 rateYaw=400
locSrv u8/c enRangeStreamFP32=0 enLhAngleStream=0 enLhMtchStm=0 maxTimeLhMtchStm=25 minBsLhMtchStm=2
locSrv float/c extPosStdDev=0.01 extQuatStdDev=0.0045
sensfusion6 float/pc kp=0.8 ki=0.002
sensfusion6 float baseZacc=1
posEstAlt float/pc estAlphaAsl=0.9 estAlphaZr=0.9
posEstAlt float/p velFactor=1 velZAlpha=0.995
posEstAlt float/pc vAccDeadband=0.04
kalman u8/c resetEstimation=0 robustTdoa=0 robustTwr=0
kalman float/pc pNAcc_xy=0.5 pNAcc_z=1 pNVel=0 pNPos=0 pNAtt=0 mNBaro=2 mNGyro_rollpitch=0.1 mNGyro_yaw=0.1
kalman float/c initialX=0 initialY=0 initialZ=0 initialYaw=0
kalman float/pc dragB_x=0 dragB_y=0 dragB_z=0 cop_x=0 cop_y=0 cop_z=0
kalman float/c maxPos=100 maxVel=10
flowdeck float/pc flowdeckPos_x=0 flowdeckPos_y=0 flowdeckPos_z=0
pid_rate float/p roll_kp=250 roll_ki=500 roll_kd=2.5 roll_kff=0 pitch_kp=250 pitch_ki=500 pitch_kd=2.5 pitch_kff=0
pid_rate float/p yaw_kp=120 yaw_ki=16.7 yaw_kd=0 yaw_kff=0
pid_rate i8/p rateFiltEn=0
pid_rate float/p omxFiltCut=30 omyFiltCut=30 omzFiltCut=30
pid_attitude float/p roll_kp=6 roll_ki=3 roll_kd=0 roll_kff=0 pitch_kp=6 pitch_ki=3 pitch_kd=0 pitch_kff=0 yaw_kp=6
pid_attitude float/p yaw_ki=1 yaw_kd=0.35 yaw_kff=0 yawMaxDelta=0
pid_attitude i8/p attFiltEn=0
pid_attitude float/p attFiltCut=15
posCtlPid float/p xKp=2 xKi=0 xKd=0 xKff=0 yKp=2 yKi=0 yKd=0 yKff=0 zKp=2 zKi=0.5 zKd=0 zKff=0
posCtlPid u16/p thrustBase=36000 thrustMin=20000
posCtlPid float/p rLimit=20 pLimit=20 xVelMax=1 yVelMax=1 zVelMax=1
velCtlPid float/p vxKp=25 vxKi=1 vxKd=0 vxKFF=0 vyKp=25 vyKi=1 vyKd=0 vyKFF=0 vzKp=25 vzKi=15 vzKd=0 vzKFF=0
ctrlMel float/pc kp_xy=0.4 kd_xy=0.2 ki_xy=0.05
ctrlMel float/p i_range_xy=2
ctrlMel float/pc kp_z=1.25 kd_z=0.4 ki_z=0.05
ctrlMel float/p i_range_z=0.4
ctrlMel float/pc mass=0.029 massThrust=132000 kR_xy=70000 kR_z=60000 kw_xy=20000 kw_z=12000 ki_m_xy=0 ki_m_z=500
ctrlMel float/pc kd_omega_rp=200
ctrlMel float/p i_range_m_xy=1 i_range_m_z=1500
ctrlINDI float thrust_threshold=300 bound_ctrl_input=32000 g1_p=0.0066146 g1_q=0.0052125 g1_r=0.001497 g2=4.3475e-5
ctrlINDI float ref_err_p=5 ref_err_q=5 ref_err_r=5 ref_rate_p=24 ref_rate_q=24 ref_rate_r=24 act_dyn_p=0.03149
ctrlINDI float act_dyn_q=0.03149 act_dyn_r=0.03149 filt_cutoff=8 filt_cutoff_r=8
ctrlINDI u8 outerLoopActive=1
posCtrlIndi float K_xi_x=1 K_xi_y=1 K_xi_z=1 K_dxi_x=5 K_dxi_y=5 K_dxi_z=5 pq_clamping=10
ctrlAtt float tau_xy=0.3 zeta_xy=0.85 tau_z=0.3 zeta_z=0.85 tau_rp=0.25 mixing_factor=1 coll_fairness=0.25
ctrlLee float KR_x=0.007 KR_y=0.007 KR_z=0.008 KI_x=0.03 KI_y=0.03 KI_z=0.03 Kw_x=0.00115 Kw_y=0.00115 Kw_z=0.002
ctrlLee float J_x=1.657171e-5 J_y=1.6655602e-5 J_z=2.9261652e-5 Kpos_Px=7 Kpos_Py=7 Kpos_Pz=7 Kpos_P_limit=100
ctrlLee float Kpos_Dx=4 Kpos_Dy=4 Kpos_Dz=4 Kpos_D_limit=100 Kpos_Ix=0 Kpos_Iy=0 Kpos_Iz=0 Kpos_I_limit=2 mass=0.029
powerDist u32/pc idleThrust=0
hlCommander float/c vtoff=0.5 vland=0.5
hlCommander u8/c groupmask=0
motorPowerSet u8/c enable=0
motorPowerSet u16/c m1=0 m2=0 m3=0 m4=0
pm float/pc lowVoltage=3.2 criticalLowVoltage=3
firmware u32/rc revision0=706280489
firmware u16/rc revision1=40315
firmware u8/rc modified=1
"""

# Defaults that are other ones on a brushless drone.
CF21BL = {
    "pid_rate.roll_kp": 200.0,
    "pid_rate.roll_ki": 400.0,
    "pid_rate.pitch_kp": 200.0,
    "pid_rate.pitch_ki": 400.0,
    "posCtlPid.thrustBase": 30000.0,
    "ctrlMel.mass": 0.0393,
    "ctrlLee.mass": 0.0393,
    "powerDist.idleThrust": 7000.0,
}


@dataclass(frozen=True)
class Parameter:
    """Type, flags ("p" persistent, "r" read only, "c" core) and the value at boot of a cf2, in the firmware's unit."""

    kind: str
    flags: str
    default: float


def _log(text: str) -> dict[str, str]:
    runs = [line.split() for line in text.strip().split("\n")]
    return {f"{group}.{name}": kind for group, kind, *names in runs for name in names}


def _parameters(text: str) -> dict[str, Parameter]:
    table = {}
    for line in text.strip().split("\n"):
        group, kind, *entries = line.split()
        kind, _, flags = kind.partition("/")
        for entry in entries:
            name, _, default = entry.partition("=")
            table[f"{group}.{name}"] = Parameter(kind, flags, float(default))
    return table


LOG = _log(_LOG)  # name -> type
PARAMETERS = _parameters(_PARAMETERS)


def defaults(names: tuple[str, ...] | list[str], platform: str = "cf2") -> dict[str, float]:
    """Boot values of those parameters on a platform ("cf2", "cf21bl"). Raises KeyError for a name not in the table."""
    special = CF21BL if platform == "cf21bl" else {}
    return {name: special.get(name, PARAMETERS[name].default) for name in names}
