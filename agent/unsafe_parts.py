"""`[unsafe]`: switches that turn one protection off each, to see what it is good for. Never for a robot that drives."""

from __future__ import annotations

from agent.config_file import Part
from agent.settings import UnsafeSettings


class UnsafePart(Part):
    ignore_correlation: bool = False
    ignore_gaps: bool = False
    trust_liars: bool = False
    trust_clocks: bool = False
    accept_duplicates: bool = False
    accept_stale: bool = False
    use_late_as_new: bool = False
    trust_restarts: bool = False
    send_before_saving: bool = False

    def settings(self) -> UnsafeSettings:
        return UnsafeSettings(**self.model_dump())
