"""Robots that are seen and not heard: a plan keeps clear of them too.

Who is cut off, or whose clock is of no use, tells nothing. Where the own sensors have placed it counts instead, for as
long as a report would, with a robot that stands there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from agent.effects import Estimate
from agent.estimation.jlatt import PLACING
from agent.estimation.motion import LAYOUTS
from agent.estimation.observation import relative_model
from agent.estimation.track_start import seen_place
from agent.events import Observation
from agent.peer_tables import remember
from agent.planning.situation import Member
from agent.rounds import OLDEST_ROUNDS
from agent.settings import AgentSettings

Array = NDArray[np.float64]


class Lookout:
    """Places of peers by the own sensors, of a robot in the plane; nothing is known of others."""

    def __init__(self, settings: AgentSettings) -> None:
        self._settings = settings
        self._sightings: dict[str, Observation] = {}
        self._places: dict[str, tuple[int, Array, Array]] = {}

    def saw(self, peer: str, event: Observation) -> None:
        """Keep a measurement of a peer until the next plan."""
        if event.kind in PLACING and self._settings.layout.altitude is None and self._settings.layout.heading == 2:
            remember(self._sightings, peer, event)

    def place(self, estimate: Estimate) -> None:
        """Place what has been seen since the last plan, by the own belief of now."""
        pose, cov = estimate.mean[:3], estimate.cov[:3, :3]
        layout = LAYOUTS["unicycle"]
        for peer, event in self._sightings.items():
            at = seen_place(relative_model(event, layout, layout), pose, np.zeros(()), event.z)
            away = at - pose[:2]
            # As far off as the least sure direction: along the line of sight, or across it with the own heading.
            polar = event.kind == "range_bearing"
            across = float(event.R[1, 1]) * (float(away @ away) if polar else 1.0) + cov[2, 2] * float(away @ away)
            wide = cov[:2, :2] + max(float(event.R[0, 0]), across) * np.eye(2)
            if np.isfinite(at).all():
                remember(self._places, peer, (event.t_meas_ns, at, wide))
        self._sightings.clear()

    def members(self, t_ns: int, heard: set[str]) -> list[Member]:
        """Those who have told nothing, as robots that stand where they were seen."""
        oldest = t_ns - OLDEST_ROUNDS * self._settings.round.period_ns
        found = []
        for peer, (seen_ns, at, cov) in self._places.items():
            if peer not in heard and seen_ns >= oldest:
                wide = np.zeros((3, 3))
                wide[:2, :2], wide[2, 2] = cov, 1.0
                found.append(Member(peer, np.append(at, 0.0), wide, 0.0, 0.0, (), max(0, t_ns - seen_ns) * 1e-9))
        return found
