"""A small fleet that is steered."""

from __future__ import annotations

from typing import Any

from sim.scenario import Scenario
from sim.scenario_checks import check

SHARES = {"speed_share": 0.05, "yaw_rate_per_mps": 0.1}


def scenario(noise: dict[str, float] = SHARES, whole: dict[str, Any] | None = None, **change: Any) -> Scenario:
    """Robots r1 and r2 choose their motion, r3 drives a circle; `change` is of each robot, `whole` of the scenario."""
    robots = [
        {
            "id": name,
            "start": {"pose": [4.0 * index, 0.0, 0.5]},
            "start_sigma": {"position_m": 0.5, "heading_rad": 0.1},
            "noise": noise,
            "sensors": {"range": {"of": ["peers"], "sigma_m": 0.1}},
            **change,
            **({"control": {"speed_mps": 0.3, "yaw_rate_radps": 0.05}} if name == "r3" else {}),
            "planning": {"kind": "none" if name == "r3" else "random"},
        }
        for index, name in enumerate(("r1", "r2", "r3"))
    ]
    data = {"version": 1, "name": "test", "duration_s": 100.0, "step_s": 1.0, "window_s": [0.0, 100.0]}
    made = Scenario.model_validate(data | {"robots": robots} | (whole or {}))
    check(made)
    return made
