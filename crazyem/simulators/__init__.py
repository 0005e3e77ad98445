"""Files of other simulators: read, written in place, checked by flights, and sampled.

>>> from crazyem.simulators import convert, load_source
>>> made = convert(load_source("cf21bl").vehicle, "gym-pybullet-drones")
>>> made.text.splitlines()[2]
'<robot name="cf2">'
"""

from crazyem.simulators.convert import Conversion, Omission, Source, convert, known_formats, load_source

__all__ = ["Conversion", "Omission", "Source", "convert", "known_formats", "load_source"]
