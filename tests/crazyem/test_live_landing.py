"""Landing over a link on which packets overtake one another."""

import pytest
from relayed import now_on, relayed, up

from crazyem.control.trajectories import hover
from crazyem.estimation.online import OnlineEstimator
from crazyem.links.crazyflie import CrazyflieLink
from crazyem.live.controllers import LEE
from crazyem.live.flight import Flight, FlightPlan
from crazyem.live.session import Session
from crazyem.vehicle import load_vehicle


@pytest.mark.slow
def test_setpoints_that_the_plan_to_land_overtakes_do_not_drop_the_drone(simulator):
    """Every setpoint is 0.1 s late, whatever else passes at once: the last ones arrive after the command to land.

    The firmware forgets a plan when a setpoint comes, and stops the motors when it is released without one.
    """
    drone = simulator("--seed", "5")
    with relayed(drone.uri) as relay:
        link = CrazyflieLink(relay.uri)
        link.connect(30.0)
        session = Session(link, vehicle=load_vehicle("cf2"), estimator=OnlineEstimator(load_vehicle("cf2")))
        plan = FlightPlan(
            trajectory=lambda position, yaw: hover(position=position, yaw=yaw, duration=3.0), controller=LEE
        )
        begun = []

        def progress(phase, seconds):
            if phase == "hover" and not begun:
                begun.append(seconds)
                now_on(relay, up("reorder", rate=1.0, distance=100, kinds=("setpoint.generic",)))

        session.start()
        Flight(session, plan, progress=progress).fly()
        session.close()
        link.close()
    assert begun
    track = session.history.track_array()
    time, height = track[:, 0], track[:, 3]
    falling = (height[:-10] - height[10:]) / (time[10:] - time[:-10])
    assert height.max() > 0.5
    assert falling.max() < 1.2  # m/s over a tenth of a second; cut at 1 m it would come down with 4
