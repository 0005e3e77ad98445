"""A case of a random world: hidden effects as in the home world, all other properties drawn, too (`conditions`).

It also makes the inputs of both sides: the vehicle file of the diagnosis, and each flight's scenario of the simulator.
"""

from dataclasses import replace
from typing import Any

from crazyem.vehicle import load_vehicle, parse_vehicle
from firmware_sim.controllers import parameters

from . import conditions
from .paths import FLIGHTS
from .sizes import CATALOGUE, OUTSIDE, Random

Table = dict[str, Any]
DRAGS = ("linear_drag", "quadratic_drag", "velocity_moment")  # effects that count as one drag of the true drone
BLOWN = ("gusts", "wind")


def random_case(name: str, kind: str, strength: dict[str, float], random: Random) -> Table:
    """A case as in `draw`, with the properties that are not hidden.

    More keys: world, aside, vehicle (the file's text), own (effects of that file), built (effects that every flight
    has, known or not), conditions (of both flights), and in each flight its day.
    """
    from .draw import waypoints

    hidden = {n: (CATALOGUE.get(n) or OUTSIDE[n]) for n in strength}
    wanted = {h.platform for h in hidden.values() if h.platform}
    platform = wanted.pop() if wanted else ("cf21bl" if random.random() < conditions.BRUSHLESS else "cf2")
    vehicle = load_vehicle(platform)
    tables = {n: h.draw(strength[n], random, vehicle) for n, h in hidden.items()}
    kind_of_air, built = conditions.air(random, hidden)
    trimmed = bool(random.random() < 0.5)
    own = conditions.trim(random, conditions.OWN_TRIM, heavy=False) if trimmed else None
    flights = {
        flight: conditions.flight(style, waypoints(style, random), random, own)
        for flight, style in zip(FLIGHTS, conditions.styles(hidden, random))
    }
    filed = {**({"trim": own} if own is not None else {}), **(built if kind_of_air == "right" else {})}
    draught = any("gusts" in f for f in flights.values())
    return {
        "case": name,
        "world": "random",
        "kind": kind,
        "platform": platform,
        "effects": {n: t for n, t in tables.items() if n in CATALOGUE},
        "hidden": {n: t for n, t in tables.items() if n in OUTSIDE},
        "strength": {n: round(u, 4) for n, u in strength.items()},
        "air": kind_of_air,
        "aside": [*(DRAGS if kind_of_air == "free" else ()), *(BLOWN if draught else ())],
        "own": filed,
        "vehicle": replace(vehicle, name="drone", effects={**vehicle.effects, **filed}).to_toml(),
        "built": built,
        "conditions": {
            "scenario": conditions.sensors(random, hidden),
            **conditions.controller(random, platform),
            "log": conditions.log(random, platform, hidden),
        },
        "flights": flights,
    }


def of_the_day(case: Table, flight: str, hidden: Table) -> Table:
    """Trim, thrust and lag of one flight's day as effects, added to the hidden ones; empty without a day."""
    today = case["flights"][flight]["day"]
    if "trim" not in today:
        return {}
    own, scale = case["own"]["trim"], hidden.get("thrust_scale", {}).get("scale", 1.0)
    lag = hidden.get("motor_lag", {}).get("time_constant", parse_vehicle(case["vehicle"]).motor_time_constant)
    return {
        "trim": {a: own[a] + today["trim"][a] for a in "xyz"},
        "thrust_scale": {"scale": scale * today["thrust"]},
        "motor_lag": {"time_constant": lag * today["lag"]},
    }


def scenario_of(case: Table, flight: str) -> Table:
    """The simulator's scenario of one flight, without the vehicle file."""
    drawn, mine = case["conditions"], case["flights"][flight]
    today = mine["day"]
    effects = {**case["built"], **case["effects"], **of_the_day(case, flight, case["effects"])}
    if "gusts" in mine:
        effects["gusts"] = mine["gusts"]
    scenario: Table = {"platform": case["platform"], "effects": effects, "hidden": case["hidden"]}
    scenario.update({section: dict(table) for section, table in drawn["scenario"].items()})
    scenario["battery"]["charge"] = today["charge"]
    scenario["parameters"] = {**drawn["parameters"], **drawn["filter"], **gains(case)}
    return scenario


def gains(case: Table) -> dict[str, float]:
    """The controller's gains: the platform's, each times its factor; weights of a cost (LQG) times its square."""
    usual = parameters.defaults(case["platform"])
    power = 2 if case["conditions"]["controller"] == "lqg" else 1
    return {name: usual[name] * by**power for name, by in case["conditions"]["gains"].items()}
