"""Cooperative localization with correlation factors of robot and targets together; see `agent.joint_factors`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

from agent.effects import Estimate, TrackEstimate
from agent.events import Observation
from agent.factor_filter import FactorFilter
from agent.factor_model import FactorModel
from agent.health import Health
from agent.joint_factors import JointFactors
from agent.saved_state import SavedFactors
from agent.settings import AgentSettings


class JointFilter(FactorFilter):
    """The form `joint`; see `agent.cooperative_filter` for what each method is given."""

    def __init__(
        self,
        settings: AgentSettings,
        counters: Counter[str],
        count_nis: Callable[[str, float], None],
        saved: SavedFactors | None = None,
        *,
        health: Health | None = None,
    ) -> None:
        super().__init__(settings, counters, count_nis, saved, health=health)
        if saved is not None:
            self._factors.group, self._factors.nonlinearity = saved.group, saved.nonlinearity

    def saved(self) -> SavedFactors:
        return replace(super().saved(), group=self.group, nonlinearity=self.nonlinearity)

    @property
    def group(self) -> frozenset[str] | None:
        """Robots whose errors may be correlated with the own one, and the own id, as told to peers (None: nothing)."""
        return self._factors.group

    @group.setter
    def group(self, group: frozenset[str]) -> None:
        self._factors.group = group

    @property
    def nonlinearity(self) -> float:
        """Noticeable second-order residuals of measurements so far, as shares of their variances, one at most each."""
        return self._factors.nonlinearity

    def _aside(self) -> float:
        return self._factors.nonlinearity

    def _put_aside(self, aside: float) -> None:
        self._factors.nonlinearity = aside

    def _model(self) -> FactorModel:
        self._factors = JointFactors(self._settings, self._counters)
        return self._factors

    def form(self) -> tuple[str, str]:
        return "joint", "configured"

    def estimate(self) -> Estimate:
        state, joint = self.state, self._factors.joint
        tracks = tuple(
            TrackEstimate(name, model, state.mean[block], state.cov[block, block])
            for (name, model), block in zip(joint.models, joint.blocks)
        )
        own = joint.own
        return Estimate(state.t_ns, self._settings.layout.name, state.mean[own], state.cov[own, own], tracks)

    def sighting(self, t_ns: int, target: str, event: Observation) -> None:
        if target not in self._factors.joint.tracks:
            self._counters["observation.unknown_target"] += 1
            return
        nis = self._use(
            t_ns,
            "late.target_compensated",
            "late.target_dropped",
            lambda then: self._factors.sighting(then, target, event),
        )
        if nis is not None:
            self._counters["used.sighting"] += 1
            self._count_nis(f"target_{event.kind}", nis)
