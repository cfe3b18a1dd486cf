"""Where what the own sensors saw belongs within its instant."""

from __future__ import annotations

from agent.estimation.observation import RELATIVE_ANGLES
from agent.events import Observation
from agent.timeline import Item, Phase


def placed_observation(event: Observation, robot: str, takes_unnamed: bool) -> Item | str:
    """The item of the timeline that an observation is, or else the reason why a robot can't use it, to be counted.

    `takes_unnamed`: it finds out by itself whom an observation that names nobody is of.
    """
    if event.kind not in RELATIVE_ANGLES:
        return "observation.unknown_kind"
    if event.of is None:
        return Item(event.t_meas_ns, Phase.PAIR, "", event) if takes_unnamed else "observation.no_identity"
    if event.of == robot:
        return "observation.of_self"
    phase = Phase.PAIR
    if event.of.startswith("landmark:"):
        phase = Phase.PRIVATE
    elif event.of.startswith("target:"):
        phase = Phase.TARGET
    return Item(event.t_meas_ns, phase, event.of, event)
