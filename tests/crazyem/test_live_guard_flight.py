"""The guard and the simulated firmware: a wrong mass that is pushed in flight is taken back.

The drone's time is the only clock (benchmarks/indi_flight.py), so that no busy machine makes estimates late. The rest
of the rules, and that each write and decision is recorded: test_live_write_supervisor.py.
"""

from dataclasses import replace

import pytest

from benchmarks.indi_flight import GuardedFlight
from crazyem.control.trajectories import hover
from crazyem.estimation.result import Estimate
from crazyem.live.controllers import LEE
from crazyem.vehicle import load_vehicle
from firmware_sim.scenario import parse_scenario


def biased(estimate: Estimate) -> Estimate:
    """As if a sensor lied: the mass times 1.3, everything else as it is."""
    p = estimate["mass"]
    low, high = (1.3 * x for x in p.ci95)
    wrong = replace(p, value=1.3 * p.value, sd=1.3 * p.sd, ci95=(low, high))
    return replace(estimate, parameters={**estimate.parameters, "mass": wrong})


def test_a_lie_about_the_mass_is_taken_back_in_flight() -> None:
    flight = GuardedFlight(parse_scenario({}, "plain"), 1, load_vehicle("cf2"), LEE.number, tamper=biased)
    flight.fly(hover(position=(0.0, 0.0, 1.0), duration=12.0))
    assert not flight.crashed
    pushed = [value for _, name, value in flight.writes if name == "ctrlLee.mass"]
    assert pushed, flight.history.guard
    assert max(pushed) > 0.033  # it was believed
    assert flight.reverted
    assert flight.read("ctrlLee.mass") == pytest.approx(0.029, rel=0.01)
    assert any("flew worse after" in n for n in flight.history.notices)
