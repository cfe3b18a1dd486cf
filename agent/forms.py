"""Which filter a robot runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

from agent.auto_filter import AutoFilter
from agent.cooperative_filter import CooperativeFilter
from agent.factor_filter import FactorFilter
from agent.fixed_filter import FixedFilter
from agent.health import Health
from agent.jlatt_filter import JlattFilter
from agent.joint_filter import JointFilter
from agent.leader_filter import LeaderFilter
from agent.naming_filter import NamingFilter
from agent.relative_filter import RelativeFilter
from agent.replica_filter import ReplicaFilter
from agent.saved_state import Saved, SavedFactors, SavedSplit
from agent.settings import AgentSettings
from agent.split_filter import SplitFilter
from agent.triangulating_filter import TriangulatingFilter
from agent.waiting_filter import WaitingFilter


def build_filter(
    settings: AgentSettings,
    counters: Counter[str],
    count_nis: Callable[[str, float], None],
    health: Health,
    saved: Saved | None = None,
) -> CooperativeFilter:
    """The filter of `settings.localization`; of a robot that does not know where it is, one that waits for it.

    Who tracks by bearings of many has one that knows no targets, and a triangulator beside it; who finds out whom its
    camera sees, that beside both. `saved`: what it begins with, which is of the form of the settings
    (`agent.saved_state.decode`). The kinds `replica` and `leader` judge no peer.
    """
    found = _tracking(settings, counters, count_nis, health, saved)
    names = _names(settings) and not isinstance(found, WaitingFilter)
    return NamingFilter(found, settings, counters) if names else found


def _tracking(
    settings: AgentSettings,
    counters: Counter[str],
    count_nis: Callable[[str, float], None],
    health: Health,
    saved: Saved | None,
) -> CooperativeFilter:
    """The filter that localizes, and tracks targets."""
    if settings.tracking.kind == "own" or not settings.track:
        return _localizing(settings, counters, count_nis, health, saved)
    own = _localizing(replace(settings, track=False), counters, count_nis, health, saved)
    return own if isinstance(own, WaitingFilter) else TriangulatingFilter(own, settings, counters)


def _names(settings: AgentSettings) -> bool:
    """Whether the robot, or one of its peers, finds out whom its camera sees while it localizes by contacts."""
    return settings.localization.kind == "clat" and bool(settings.relative.peers) and not settings.relative.known


def _localizing(
    settings: AgentSettings,
    counters: Counter[str],
    count_nis: Callable[[str, float], None],
    health: Health,
    saved: Saved | None,
) -> CooperativeFilter:
    if settings.localization.kind == "fixed" and settings.source == "survey":
        return FixedFilter(settings, counters, saved if isinstance(saved, SavedSplit) else None)
    if settings.localization.kind == "leader" and settings.source == "survey":
        return LeaderFilter(settings, counters, count_nis, saved if isinstance(saved, SavedSplit) else None)
    if settings.localization.kind == "relative" and settings.source == "survey":
        return RelativeFilter(settings, counters, saved if isinstance(saved, SavedSplit) else None)
    if isinstance(saved, SavedFactors):
        kept = JointFilter if settings.localization.form == "joint" else FactorFilter
        return kept(settings, counters, count_nis, saved, health=health)
    if isinstance(saved, SavedSplit) and settings.localization.kind == "jlatt":
        return JlattFilter(settings, counters, count_nis, saved, health=health)
    if isinstance(saved, SavedSplit):
        split = AutoFilter if settings.localization.form == "auto" else SplitFilter
        return split(settings, counters, count_nis, saved, health=health)
    if settings.source != "survey":
        return WaitingFilter(settings, counters)
    if settings.localization.kind == "jlatt":
        return JlattFilter(settings, counters, count_nis, health=health)
    if settings.localization.kind == "replica":
        return ReplicaFilter(settings, counters, count_nis)
    if settings.localization.form == "split_joint":
        return SplitFilter(settings, counters, count_nis, health=health)
    if settings.localization.form == "auto":
        return AutoFilter(settings, counters, count_nis, health=health)
    if settings.localization.form == "joint":
        return JointFilter(settings, counters, count_nis, health=health)
    return FactorFilter(settings, counters, count_nis, health=health)
