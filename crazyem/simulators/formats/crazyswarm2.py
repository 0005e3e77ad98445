"""crazyswarm2: `robots.NAME.firmware_params` of config/crazyflies.yaml, the constants of the controllers on board.

Crazyswarm2's own simulator does not read them.
"""

from crazyem.simulators.documents.tables import YamlDocument
from crazyem.simulators.fields import Field, Format, template


def _fields(document: YamlDocument, name: str) -> list[Field]:
    lee, mellinger = (("robots", name, "firmware_params", group) for group in ("ctrlLee", "ctrlMel"))
    return [
        Field((*lee, "mass"), "mass", "kg"),
        *(Field((*lee, f"J_{a}"), f"inertia_{a}{a}", "kg m^2") for a in "xyz"),
        Field((*mellinger, "mass"), "mass", "kg"),
    ]


def _recognises(text: str) -> bool:
    lines = text.splitlines()
    return any(line.rstrip() == "robots:" for line in lines) and ("uri:" in text or "firmware_params:" in text)


CRAZYSWARM2 = Format(
    name="crazyswarm2",
    order=60,
    suffix=".yaml",
    words="crazyswarm2's crazyflies.yaml",
    open=YamlDocument,
    recognises=_recognises,
    names=lambda document: document.keys(("robots",)),
    fields=_fields,
    skeleton=template("crazyswarm2.yaml"),
    source="crazyswarm2, config/crazyflies.yaml; parameter groups ctrlLee and ctrlMel of the firmware",
)
