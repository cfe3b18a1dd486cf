"""Which planner a robot has."""

from __future__ import annotations

from agent.planning.encircle import Encircle
from agent.planning.optimal import OptimalPlanner
from agent.planning.potential import PotentialLaw, PotentialPlanner
from agent.planning.random_walk import RandomWalk
from agent.planning.situation import Planner
from agent.settings import PlanningSettings


def build_planner(settings: PlanningSettings, robot: str) -> Planner | None:
    """The planner that `settings` name for the robot `robot`; None for the kind `none`.

    Raises ValueError if `settings.candidates` leave `optimal` no choice.
    """
    if settings.kind == "none":
        return None
    if settings.kind == "random":
        return RandomWalk(robot, settings.seed, settings.max_speed_mps, settings.max_turn_radps)
    if settings.kind == "encircle":
        return Encircle(
            radius_m=settings.radius_m,
            closest_m=settings.closest_m,
            max_speed_mps=settings.max_speed_mps,
            max_climb_mps=settings.max_climb_mps,
            max_turn_radps=settings.max_turn_radps,
        )
    law = PotentialLaw(
        closest_m=settings.closest_m,
        apart_m=settings.apart_m,
        radio_range_m=settings.radio_range_m,
        max_speed_mps=settings.max_speed_mps,
        max_turn_radps=settings.max_turn_radps,
    )
    if settings.kind == "potential":
        return PotentialPlanner(law, settings.form == "improved")
    return OptimalPlanner(settings, PotentialPlanner(law, improved=True))
