"""Draws the cases of a study from one seed: hidden effects, their strength, drone and flights."""

import json
import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from crazyem.vehicle import load_vehicle

from .foreign_world import ABROAD, HIDEABLE, foreign_case
from .paths import FLIGHTS, Study, write
from .random_world import random_case
from .sizes import ALIKE, CATALOGUE, OUTSIDE, Concealed, Random

NOTHING, PAIRS, OUTSIDERS = 0.20, 0.15, 0.10  # shares; the rest are single effects, each equally often
BRUSHLESS = 0.12  # share of cf21bl if the effect is possible on both drones
FAVOURABLE = 0.75  # share of flights with a style that shows the effect well; the others have any style
STYLES = ("hover", "excite", "figure8", "fast")
DURATION = 20.0  # s of trajectory, after take-off and 3 s of hover
Case = dict[str, Any]


def draw(*, cases: int, seed: int, world: str = "home") -> list[Case]:
    """`cases` of them, in random order. The same seed gives the same cases.

    Each: case (its name), kind (nothing, single, pair, outside), platform, effects and hidden (tables of the scenario),
    strength (name -> 0 weak to 1 strong), flights (style, seed, waypoints or None, for "recording" and "held_out").

    world: "home", in which only hidden effects and flights differ; "random", see `random_case`;
    "foreign", see `foreign_case`.
    """
    make, catalogue, outside = WORLDS[world]
    random = np.random.default_rng([seed, 0])
    contents = _contents(cases, random, catalogue, outside)
    order = random.permutation(len(contents))
    return [make(f"{i:04d}", *contents[j], np.random.default_rng([seed, 1, i])) for i, j in enumerate(order, start=1)]


def _contents(
    cases: int, random: Random, catalogue: Sequence[str], others: Sequence[str]
) -> list[tuple[str, dict[str, float]]]:
    """Kind and strengths of every case, with the effects that a world can hide."""
    nothing = math.ceil(NOTHING * cases)
    pairs, outside = round(PAIRS * cases), round(OUTSIDERS * cases)
    singles = cases - nothing - pairs - outside
    found: list[tuple[str, dict[str, float]]] = [("nothing", {})] * nothing
    found += [("single", one) for one in _evenly(list(catalogue), singles, random)]
    found += [("outside", one) for one in _evenly(list(others), outside, random)]
    possible = [p for p in combinations(catalogue, 2) if not any(set(p) <= family for family in ALIKE)]
    for pair in _rare_first(possible, pairs, random, catalogue):
        found.append(("pair", {name: float(random.uniform(0.2, 1.0)) for name in pair}))
    return found


def _evenly(names: Sequence[str], count: int, random: Random) -> list[dict[str, float]]:
    """Every name equally often (up to one), its strengths evenly over [0, 1]."""
    turns = [str(n) for _ in range(-(-count // len(names))) for n in random.permutation(names)][:count]
    out = []
    places = {name: list(random.permutation(turns.count(name))) for name in names}
    for name in turns:
        u = (places[name].pop() + random.random()) / turns.count(name)
        out.append({name: float(u)})
    return out


def _rare_first(
    pairs: Sequence[tuple[str, str]], count: int, random: Random, catalogue: Sequence[str]
) -> list[tuple[str, str]]:
    """Pairs such that every effect takes part about equally often."""
    used = dict.fromkeys(catalogue, 0)
    out: list[tuple[str, str]] = []
    while len(out) < count:
        fresh = [p for p in pairs if p not in out] or list(pairs)
        least = min(used[a] + used[b] for a, b in fresh)
        a, b = fresh[int(random.choice([i for i, (a, b) in enumerate(fresh) if used[a] + used[b] == least]))]
        used[a] += 1
        used[b] += 1
        out.append((a, b))
    return out


def _case(name: str, kind: str, strength: dict[str, float], random: Random) -> Case:
    hidden = {n: (CATALOGUE.get(n) or OUTSIDE[n]) for n in strength}
    wanted = {h.platform for h in hidden.values() if h.platform}
    platform = wanted.pop() if wanted else ("cf21bl" if random.random() < BRUSHLESS else "cf2")
    vehicle = load_vehicle(platform)
    tables = {n: h.draw(strength[n], random, vehicle) for n, h in hidden.items()}
    styles = _styles(list(hidden.values()), random)
    return {
        "case": name,
        "kind": kind,
        "platform": platform,
        "effects": {n: t for n, t in tables.items() if n in CATALOGUE},
        "hidden": {n: t for n, t in tables.items() if n in OUTSIDE},
        "strength": {n: round(u, 4) for n, u in strength.items()},
        "flights": {
            flight: {"style": style, "seed": int(random.integers(1, 2**31)), "waypoints": waypoints(style, random)}
            for flight, style in zip(FLIGHTS, styles)
        },
    }


def _styles(hidden: Sequence[Concealed], random: Random) -> tuple[str, str]:
    """Styles of the fitted and of the held-out flight: different ones if several show the effect."""
    suited = [h.trajectories for h in hidden]
    if any("low" in styles for styles in suited):
        return "low", "low"
    good = [s for s in STYLES if all(s in styles for styles in suited)] or list(suited[0] if suited else STYLES)
    first = str(random.choice(good if suited and random.random() < FAVOURABLE else STYLES))
    second = str(random.choice([s for s in (*good, *STYLES) if s != first]))
    return first, second


def waypoints(style: str, random: Random) -> list[dict[str, float]] | None:
    """Rows of a waypoint file (x, y, z [m], yaw [rad], time [s]) for the styles that need one, else None.

    fast: random points 1 m around, up to some 2 m/s, turning; low: down to 0.1 to 0.3 m above the floor and up again.
    """
    if style == "fast":
        times = np.linspace(1.5, DURATION - 1.5, 12)
        places = random.uniform((-0.9, -0.9, 0.75), (0.9, 0.9, 1.5), (12, 3))
        yaws = random.uniform(-0.7, 0.7, 12)
    elif style == "low":
        times = np.linspace(2.0, DURATION - 2.0, 8)
        heights = np.where(np.arange(8) % 2 == 0, random.uniform(0.25, 0.35, 8), random.uniform(0.45, 0.8, 8))
        places = np.column_stack([random.uniform(-0.4, 0.4, (8, 2)), heights])
        yaws = random.uniform(-0.4, 0.4, 8)
    else:
        return None
    rows = [
        {"x": round(x, 3), "y": round(y, 3), "z": round(z, 3), "yaw": round(a, 3), "time": round(t, 3)}
        for (x, y, z), a, t in zip(places.tolist(), yaws.tolist(), times.tolist())
    ]
    return [*rows, {"x": 0.0, "y": 0.0, "z": 1.0, "yaw": 0.0, "time": DURATION}]


def scenario(case: Case, vehicle_file: str) -> str:
    """The simulator's scenario file: the nominal vehicle with the hidden effects."""
    lines = [f"platform = {json.dumps(case['platform'])}", f"vehicle_file = {json.dumps(vehicle_file)}"]
    for section in ("effects", "hidden"):
        for name, table in case[section].items():
            lines += ["", f"[{section}.{name}]", *(f"{k} = {json.dumps(v)}" for k, v in table.items())]
    return "\n".join(lines) + "\n"


WORLDS: dict[str, tuple[Any, Sequence[str], Sequence[str]]] = {
    "home": (_case, tuple(CATALOGUE), tuple(OUTSIDE)),
    "random": (random_case, tuple(CATALOGUE), tuple(OUTSIDE)),
    "foreign": (foreign_case, HIDEABLE, tuple(ABROAD)),
}


def write_cases(study: Study, *, cases: int, seed: int, world: str = "home") -> int:
    """Write truth and scenario files of a drawn study; existing files are kept."""
    written = 0
    for name in ("cf2", "cf21bl"):
        file = study.folder / "vehicles" / f"{name}.toml"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(load_vehicle(name).to_toml())
    for case in draw(cases=cases, seed=seed, world=world):
        if study.truth(case["case"]).is_file():
            continue
        if world == "home":
            study.scenario(case["case"]).parent.mkdir(parents=True, exist_ok=True)
            study.scenario(case["case"]).write_text(scenario(case, f"../vehicles/{case['platform']}.toml"))
        else:
            study.vehicle(case["case"]).write_text(case["vehicle"])
        write(study.truth(case["case"]), {**case, "study_seed": seed})
        written += 1
    return written
