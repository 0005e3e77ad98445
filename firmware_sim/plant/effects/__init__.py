"""Physical effects beyond the plain rigid body, one file for an effect or a small family.

catalogue.py names them and checks a scenario's tables, constants.py converts them to the constants of layout.py,
body.py computes mass properties. At run time drive.py replaces the plain rotors, step.py the plain body; sensing.py
changes the values of positioning, inertial sensors and log. If all effects are neutral, flight.py chooses the tick
without effects of controllers/tick.py.
docs/reference/firmware_sim_effects.md has all definitions and signs.
"""
