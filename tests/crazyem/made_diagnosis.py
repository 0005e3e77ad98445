"""A made-up result of a diagnosis, as its JSON has it, with pictures: for the report."""

from typing import Any

import numpy as np

from crazyem.diagnosis.report import Series


def errors(position: float, starts: int = 412) -> dict[str, Any]:
    def part(unit: str, *values: float) -> dict[str, Any]:
        return {"unit": unit, "rms": list(values), "mean": [0.8 * v for v in values]}

    return {
        "horizon_s": [0.01, 0.1, 0.5],
        "starts": starts,
        "position": part("m", 0.0004, 0.03 * position, position),
        "velocity": part("m/s", 0.006, 0.2 * position, 2.1 * position),
        "attitude": part("rad", 0.002, 0.01, 0.11),
        "body_rate": part("rad/s", 0.05, 0.2, 0.9),
    }


def where(axis: str, regime: str, interval: list[float], size: float) -> dict[str, Any]:
    return {
        "signal": "force", "axis": axis, "regime": regime, "interval": interval, "effect_size": size, "unit": "N"
    }  # fmt: skip


def document() -> dict[str, Any]:
    return {
        "format": "crazyem-diagnosis", "mismatch": True,
        "recordings": ["flights/circle_fast_1.csv", "flights/figure8_2.csv"],
        "vehicle": "cf2",
        "where": [
            where("body z", "all", [3.2, 41.0], -0.082),
            where("body x", "speed 1 to 2 m/s", [5.0, 38.0], -0.011),
        ],
        "effects": [
            {
                "name": "thrust_scale",
                "parameters": {"scale": {"value": 0.6123, "unit": "", "sd": 0.0041, "ci95": [0.604, 0.6205]}},
                "evidence": {"held_out_nats": 812.4, "p_value": None},
                "confidence": 0.99,
            },
            {
                "name": "linear_drag",
                "parameters": {
                    "x": {"value": 0.0112, "unit": "N s/m", "sd": 0.0009, "ci95": [0.0094, 0.013]},
                    "y": {"value": 0.0108, "unit": "N s/m", "sd": 0.001, "ci95": [0.0088, 0.0128]},
                    "z": {"value": 0.0021, "unit": "N s/m", "sd": 0.002, "ci95": [-0.0019, 0.0061]},
                },
                "evidence": {"held_out_nats": 95.1, "p_value": None},
                "confidence": 0.93,
            },
        ],
        "ranking": [
            {"name": "thrust_scale", "held_out_nats": 812.4, "p_value": None, "note": "claimed"},
            {
                "name": "payload", "gain_nats": 3815.4, "held_out_nats": 811.0, "p_value": None,
                "note": "cannot be told from thrust scale",
            },
            {"name": "linear_drag", "held_out_nats": 95.1, "p_value": None, "note": "claimed"},
            {
                "name": "battery_sag", "label": "battery_sag[gain_per_second]", "words": "battery sag with time",
                "held_out_nats": 60.0, "p_value": None, "note": "",
            },
            {"name": "ground_effect", "held_out_nats": -2.5, "p_value": None, "note": "no better on held-out flight"},
        ],
        "indistinguishable": [["thrust_scale", "payload"]],
        "would_separate": ["weigh the drone", "fly straight legs of different speeds in opposite directions"],
        "unexplained": {"found": False, "nats": 3.0, "explained_share": 0.97, "where": []},
        "fit": {
            "train": {"before": errors(0.75), "after": errors(0.031)},
            "held_out": {"before": errors(0.77, 120), "after": errors(0.034, 120)},
        },
        "not_identifiable": ["inertia", "mass against thrust"],
        "left_free": [
            {
                "name": "input_delay", "words": "input delay", "parameter": "delay", "value": -0.0026, "sd": 0.0006,
                "unit": "s", "expected": 0.0, "usual": 0.002,
            },
            {
                "name": None, "words": "rotor clock", "parameter": "delay, circle_fast_1.csv", "value": 0.0123,
                "sd": 0.0011, "unit": "s", "expected": 0.0, "usual": None,
            },
        ],
        "notices": ["the battery voltage was withheld"],
    }  # fmt: skip


def pictures() -> dict[str, Series]:
    rng = np.random.default_rng(0)
    time = np.linspace(0, 45, 9000)
    force = {axis: 0.01 * np.sin(0.7 * time + k) + 0.004 * rng.normal(size=time.size) for k, axis in enumerate("xyz")}
    force["z"] = force["z"] - 0.08
    short = time[(time > 10) & (time < 15)]
    measured = np.sin(2 * short)
    ahead = {
        "measured": measured,
        "before": measured + 0.4 * np.sin(5 * short),
        "after": measured + 0.02 * np.sin(7 * short),
    }
    return {
        "force": Series("Force that the model lacks", time, force, y_label="force [N], body", shaded=[(3.2, 41.0)]),
        "turning": Series("Torque that the model lacks", time, {"x": force["x"]}, y_label="torque", level=0.004),
        "overlay": Series(
            "x, half a second ahead, on flight kept apart", short, ahead, y_label="position x [m]", section="fit"
        ),
    }
