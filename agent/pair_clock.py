"""What a pair's clocks do to its measurements: the offset that is believed, and the noise it leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from agent.events import Received
from agent.peer_tables import remember
from agent.settings import AgentSettings
from network.messages import Measurement


class PairClocks:
    """Clock offsets of the peers as the own measurements see them."""

    def __init__(self, settings: AgentSettings) -> None:
        self._settings = settings
        self._sigma_ns: dict[str, int] = {}

    def offset_ns(self, event: Received) -> int:
        """Clock of the message's sender minus the own one: the measured offset blended with the prior.

        A fleet whose clocks are known to agree (`clock_sigma_ns` = 0) needs no measurement.
        """
        prior = self._settings.lateness.clock_sigma_ns
        sigma = event.offset_sigma_ns
        if prior == 0 or sigma is None:
            remember(self._sigma_ns, event.message.header.source, prior)
            return 0
        share = prior**2 / (prior**2 + sigma**2)
        remember(self._sigma_ns, event.message.header.source, round(share**0.5 * sigma))
        return round(share * event.offset_ns)

    def sigma_s(self, peer: str) -> float:
        """Standard deviation [s] of a peer's offset, as of the last `offset_ns`."""
        return self._sigma_ns.get(peer, self._settings.lateness.clock_sigma_ns) * 1e-9

    def widened(self, peer: str, item: Measurement) -> Measurement:
        """R widened by how far the peer may move within the uncertainty of its clock (coasting speed)."""
        sigma_s = self.sigma_s(peer)
        if sigma_s == 0.0:
            return item
        moved = (self._settings.coast.speed_mps * sigma_s) ** 2
        reach = max(float(item.z[0]), 1.0) if item.kind == "range_bearing" else 1.0
        extra = {
            "range": [moved],
            "bearing": [moved / reach**2],
            "bearing3": [moved, moved],
            "pixel": [moved, moved],
            "range_bearing": [moved, moved / reach**2],
            "vector": [moved, moved],
        }
        return replace(item, R=item.R + np.diag(extra[item.kind]))
