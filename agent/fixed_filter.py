"""A robot that trusts what it is told of its own pose (kind `fixed`): by its autopilot, or by who set it up.

The newest information of each kind takes the place of what was believed, with the covariance it states, and odometry
moves it on. Nothing is averaged, for what an autopilot tells is a filter's estimate whose error lasts, and nothing is
asked of peers. What it says of itself is only as honest as what it is told.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from agent.cooperative_filter import FilterMark, refusal
from agent.course import Course, Moment
from agent.effects import Effect, Estimate
from agent.estimation.gaussian import wrap_components
from agent.estimation.observation import AbsoluteModel, RelativeModel
from agent.estimation.split_joint import Split
from agent.events import LinkChange, Observation, Received
from agent.joint_tracks import JointState
from agent.pair_clock import PairClocks
from agent.saved_state import SavedSplit
from agent.settings import AgentSettings
from network.messages import Body, Epoch, Measurement, PairRequest, SplitRequest, StartRequest

Array = NDArray[np.float64]

FAR_FUTURE_NS = 2**62


class FixedFilter:
    """The kind `fixed`; see `agent.cooperative_filter` for what each method is given."""

    keeps_factors = False

    def __init__(self, settings: AgentSettings, counters: Counter[str], saved: SavedSplit | None = None) -> None:
        self._settings, self._counters = settings, counters
        first = Moment(settings.start_ns, settings.mean, settings.cov)
        if saved is not None:
            first = Moment(saved.state.t_ns, saved.state.mean, saved.state.cov)
        lateness = settings.lateness
        self._own = Course(first, settings.layout.angles, lateness.horizon_ns, lateness.tolerance_ns)
        self._clocks = PairClocks(settings)
        self._revision = object()

    @property
    def t_ns(self) -> int:
        return self._own.newest.t_ns

    @property
    def complete_ns(self) -> int:
        return self.t_ns

    @property
    def revision(self) -> object:
        return self._revision

    def estimate(self) -> Estimate:
        own = self._own.newest
        return Estimate(own.t_ns, self._settings.layout.name, own.mean, own.cov, ())

    def contacts(self) -> dict[str, Epoch]:
        """There are no contacts of pairs."""
        return {}

    def form(self) -> tuple[str, str]:
        return "fixed", "configured"

    def saved(self) -> SavedSplit:
        own = self._own.newest
        return SavedSplit(JointState(own.t_ns, own.mean, Split(np.zeros_like(own.cov), own.cov), (), (), {}))

    def mark(self) -> FilterMark | None:
        """What comes late is used at its own instant."""
        return None

    def rewind(self, mark: FilterMark) -> None:
        raise RuntimeError("there is no mark of this filter")

    # -- own information ------------------------------------------------------------------------------------

    def advance(self, t_ns: int, delta: Array, cov: Array) -> None:
        now = self._own.newest
        dt_s = (t_ns - now.t_ns) * 1e-9
        transform = self._settings.localization.transform
        self._own.advance(t_ns, self._settings.motion.advance(now.mean, now.cov, delta, cov, dt_s, transform))
        self._revision = object()

    def absolute(
        self,
        t_ns: int,
        kind: str,
        model: AbsoluteModel | RelativeModel,
        z: Array,
        R: Array,
        landmark: str | None = None,
    ) -> None:
        if not isinstance(model, AbsoluteModel):
            self._counters["fixed.unused"] += 1
            return
        lateness = self._settings.lateness
        late = t_ns < self.t_ns - lateness.tolerance_ns
        then = None if late and lateness.kind == "discard" else self._own.at(t_ns)
        if then is None:
            self._counters["late.dropped"] += 1
            return
        told = list(model.components)
        mean, cov = then.mean.copy(), then.cov.copy()
        mean[told] = z
        cov[told, :] = cov[:, told] = 0.0
        cov[np.ix_(told, told)] = R
        if not self._own.correct(then, wrap_components(mean, self._settings.layout.angles), cov):
            self._counters["update.not_positive_definite"] += 1
            return
        self._counters[f"used.{kind}"] += 1
        self._counters["late.compensated"] += late
        self._revision = object()

    def sighting(self, t_ns: int, target: str, event: Observation) -> None:
        self._counters["fixed.unused"] += 1

    def measured(
        self, peer: str, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...], effects: list[Effect]
    ) -> None:
        self._counters["fixed.unused"] += len(measurements)

    # -- peers ----------------------------------------------------------------------------------------------

    def heard(self, event: Received, effects: list[Effect]) -> None:
        self._counters["received.unused"] += 1

    def link_changed(self, event: LinkChange) -> None:
        """No peer matters."""

    def settled(self, until_ns: int, effects: list[Effect]) -> None:
        """Nothing is told."""

    def expire(self, now_ns: int, effects: list[Effect]) -> None:
        """Nothing waits."""

    def deadline_ns(self) -> int:
        return FAR_FUTURE_NS

    def instant_ns(self, event: Received) -> int:
        body = event.message.body
        assert isinstance(body, PairRequest | SplitRequest | StartRequest)
        return body.epoch.t_meas_ns - self._clocks.offset_ns(event)

    def requested(self, event: Received, t_ns: int, effects: list[Effect]) -> None:
        self._counters["pair.other_form"] += 1
        if isinstance(event.message.body, PairRequest):
            effects.append(refusal(event.message.header.source, event.message.body.epoch))

    def replied(self, peer: str, body: Body) -> None:
        self._counters["pair.other_form"] += 1
