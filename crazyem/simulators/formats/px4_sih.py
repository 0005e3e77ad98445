"""PX4 SIH: parameters of an airframe script or of a ground station. Body axes are FRD; thrust is linear in command.

SIH has one drag and one damping for all axes. The products of inertia Ixy and Ixz change sign between FLU and FRD.
"""

from crazyem.simulators.documents.spliced import ParamDocument
from crazyem.simulators.fields import Field, Format, template


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
        # parameters of the controller and its allocation change only where they are set
        *(f for f in (hover, *allocation) if document.get(f.path) is not None),
    ]


def _read_more(document: ParamDocument, name: str, found: dict[str, float]) -> list[str]:
    factor = document.get(("THR_MDL_FAC",))
    return [f"THR_MDL_FAC is {factor:g}, but SIH's thrust is linear in the command"] if factor else []


PX4_SIH = Format(
    name="px4-sih",
    order=70,
    suffix="",
    words="PX4 SIH parameters",
    open=ParamDocument,
    recognises=lambda text: "SIH_MASS" in text or "SIH_IXX" in text,
    fields=_fields,
    skeleton=template("px4_sih.txt"),
    read_more=_read_more,
    source="PX4, simulator_sih/sih.cpp (generate_force_and_torques, equations_of_motion, read_motors)",
)
