"""Which filter a robot runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from agent.auto_filter import AutoFilter
from agent.cooperative_filter import CooperativeFilter
from agent.factor_filter import FactorFilter
from agent.joint_filter import JointFilter
from agent.replica_filter import ReplicaFilter
from agent.settings import AgentSettings
from agent.split_filter import SplitFilter
from agent.waiting_filter import WaitingFilter


def build_filter(
    settings: AgentSettings, counters: Counter[str], count_nis: Callable[[str, float], None]
) -> CooperativeFilter:
    """The filter of `settings.localization`; of a robot that does not know where it is, one that waits for it."""
    if settings.source != "survey":
        return WaitingFilter(settings, counters)
    if settings.localization.kind == "replica":
        return ReplicaFilter(settings, counters, count_nis)
    if settings.localization.form == "split_joint":
        return SplitFilter(settings, counters, count_nis)
    if settings.localization.form == "auto":
        return AutoFilter(settings, counters, count_nis)
    if settings.localization.form == "joint":
        return JointFilter(settings, counters, count_nis)
    return FactorFilter(settings, counters, count_nis)
