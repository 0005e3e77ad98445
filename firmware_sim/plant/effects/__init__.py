"""Physical effects beyond the plain rigid body, one file an effect or a small family of them.

catalogue.py names them and checks a scenario's tables, constants.py turns them into the numbers of layout.py, body.py
loads the body. At run time drive.py takes the place of the plain rotors, step.py that of the plain body,
sensing.py is what positioning, inertial sensors and log see. A drone whose effects are all neutral flies without them:
flight.py chooses between the two ticks of controllers/tick.py.
docs/reference/firmware_sim_effects.md has all definitions and signs.
"""
