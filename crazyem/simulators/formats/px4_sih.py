"""PX4 SIH: parameters of an airframe script or of a ground station. Body axes are FRD; thrust is linear in command.

SIH has one drag and one damping for all axes. Of products of inertia Ixy and Ixz change their sign with the axes.
"""

from crazyem.simulators.documents.spliced import ParamDocument
from crazyem.simulators.fields import Field, Format

_CORNERS = ((1, 1), (-1, -1), (1, -1), (-1, 1))  # forward and right of PX4's rotors 1 to 4


def _fields(document: ParamDocument, name: str) -> list[Field]:
    allocation = [
        Field((f"CA_ROTOR{k}_{key}",), quantity, "m", magnitude=True, checked=False, given=False)
        for k in range(4) for key, quantity in (("PX", "arm_x"), ("PY", "arm_y"), ("KM", "torque_per_thrust"))
    ]  # fmt: skip
    hover = Field(("MPC_THR_HOVER",), "hover_share", "", given=False)
    return [
        Field(("SIH_MASS",), "mass", "kg"),
        *(Field((f"SIH_I{a}",), f"inertia_{a.lower()}", "kg m^2") for a in ("XX", "YY", "ZZ", "YZ")),
        *(Field((f"SIH_I{a}",), f"inertia_{a.lower()}", "kg m^2", factor=-1.0) for a in ("XY", "XZ")),
        Field(("SIH_L_ROLL",), "arm_y", "m"),
        Field(("SIH_L_PITCH",), "arm_x", "m"),
        Field(("SIH_T_MAX",), "thrust_max", "N"),
        Field(("SIH_Q_MAX",), "torque_max", "N m"),
        Field(("SIH_KDV",), "drag", "N/(m/s)"),
        Field(("SIH_KDW",), "damping", "N m/(rad/s)"),
        Field(("SIH_T_TAU",), "lag", "s"),
        # of the controller and its allocation: they follow where they are set
        *(f for f in (hover, *allocation) if document.get(f.path) is not None),
    ]


def _read_more(document: ParamDocument, name: str, found: dict[str, float]) -> list[str]:
    factor = document.get(("THR_MDL_FAC",))
    return [f"THR_MDL_FAC is {factor:g}, but SIH's thrust is linear in the command"] if factor else []


def _skeleton(name: str) -> str:
    lines = [
        "SIH_MASS", "SIH_IXX", "SIH_IYY", "SIH_IZZ", "SIH_IXY", "SIH_IXZ", "SIH_IYZ", "SIH_T_MAX", "SIH_Q_MAX",
        "SIH_L_ROLL", "SIH_L_PITCH", "SIH_KDV", "SIH_KDW", "SIH_T_TAU", "MPC_THR_HOVER", "THR_MDL_FAC",
    ]  # fmt: skip
    text = f"#!/bin/sh\n#\n# @name {name} SIH\n#\n# @type Quadrotor x\n#\n\n. ${{R}}etc/init.d/rc.mc_defaults\n\n"
    text += "PX4_SIMULATOR=${PX4_SIMULATOR:=sihsim}\nPX4_SIM_MODEL=${PX4_SIM_MODEL:=quadx}\n\n"
    text += "".join(f"param set-default {key} 0\n" for key in lines)
    text += "\nparam set-default CA_ROTOR_COUNT 4\n"
    for k, (x, y) in enumerate(_CORNERS):
        spin = 1 if k < 2 else -1
        text += f"param set-default CA_ROTOR{k}_PX {x}\nparam set-default CA_ROTOR{k}_PY {y}\n"
        text += f"param set-default CA_ROTOR{k}_KM {spin}\n"
    return text + "\nparam set SIH_VEHICLE_TYPE 0\n"


PX4_SIH = Format(
    name="px4-sih",
    order=70,
    suffix="",
    words="PX4 SIH parameters",
    open=ParamDocument,
    recognises=lambda text: "SIH_MASS" in text or "SIH_IXX" in text,
    fields=_fields,
    skeleton=_skeleton,
    read_more=_read_more,
    source="PX4, simulator_sih/sih.cpp (generate_force_and_torques, equations_of_motion, read_motors)",
)
