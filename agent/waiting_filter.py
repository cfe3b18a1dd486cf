"""What a robot runs that does not know where it is: it listens, asks peers it sees, and tells nothing of itself."""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from agent.cooperative_filter import FilterMark
from agent.effects import Effect, Estimate, Send
from agent.estimation.motion import STATES
from agent.estimation.observation import RELATIVE_ANGLES, AbsoluteModel, RelativeModel
from agent.estimation.track_start import DETERMINING
from agent.events import LinkChange, Observation, Received
from agent.pair_clock import PairClocks
from agent.saved_state import Saved
from agent.settings import AgentSettings
from agent.start import StartEvidence, Told
from network.messages import (
    MAX_MEASUREMENTS,
    Body,
    Epoch,
    JointSnapshot,
    Measurement,
    PairReply,
    PairRequest,
    ReplyStatus,
    Snapshot,
    SplitReply,
    SplitRequest,
    SplitSnapshot,
    StartRequest,
)

Array = NDArray[np.float64]

FAR_FUTURE_NS = 2**62


class WaitingFilter:
    """Before the start; see `agent.cooperative_filter` for what each method is given."""

    keeps_factors = False

    def __init__(self, settings: AgentSettings, counters: Counter[str]) -> None:
        self._settings, self._counters = settings, counters
        self._t_ns = settings.start_ns
        self._evidence = StartEvidence(settings)
        self._clocks = PairClocks(settings)
        self._asked: dict[str, tuple[Epoch, int, tuple[Measurement, ...]]] = {}
        self._count = 0

    @property
    def t_ns(self) -> int:
        return self._t_ns

    @property
    def complete_ns(self) -> int:
        return self.t_ns

    @property
    def revision(self) -> object:
        """There is no estimate that could change."""
        return None

    def begun(self) -> AgentSettings | None:
        """The settings of the robot that starts now; None while something is missing."""
        return self._evidence.begun(self._t_ns)

    def missing(self) -> tuple[str, ...]:
        """What the start waits for, in words."""
        return self._evidence.missing()

    def advance(self, t_ns: int, delta: Array, cov: Array) -> None:
        self._evidence.moved(self._t_ns, t_ns, delta, cov)
        self._t_ns = t_ns

    def absolute(
        self,
        t_ns: int,
        kind: str,
        model: AbsoluteModel | RelativeModel,
        z: Array,
        R: Array,
        landmark: str | None = None,
    ) -> None:
        if isinstance(model, AbsoluteModel):
            self._evidence.fix(t_ns, model, z, R)
            self._counters[f"start.{kind}"] += 1
        else:
            self._counters["waiting.unused"] += 1

    def sighting(self, t_ns: int, target: str, event: Observation) -> None:
        self._counters["waiting.unused"] += 1

    # -- peers ----------------------------------------------------------------------------------------------

    def measured(
        self, peer: str, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...], effects: list[Effect]
    ) -> None:
        if self._settings.source != "peer":
            self._counters["waiting.unused"] += 1
            return
        told = tuple(self._clocks.widened(peer, item) for item in measurements[:MAX_MEASUREMENTS])
        self._evidence.view(t_ns, peer, told)
        if not any(item.kind in DETERMINING for item in told):
            return
        asked = self._asked.get(peer)
        if asked is not None and now_ns < asked[1]:
            return
        self._count += 1
        epoch = Epoch(t_ns, self._settings.robot, self._count)
        self._asked[peer] = epoch, now_ns + self._settings.localization.pair_timeout_ns, told
        self._counters["start.asked"] += 1
        effects.append(Send(peer, t_ns, StartRequest(epoch)))

    def instant_ns(self, event: Received) -> int:
        body = event.message.body
        assert isinstance(body, PairRequest | SplitRequest | StartRequest)
        return body.epoch.t_meas_ns - self._clocks.offset_ns(event)

    def requested(self, event: Received, t_ns: int, effects: list[Effect]) -> None:
        peer, body = event.message.header.source, event.message.body
        if isinstance(body, PairRequest):
            # The peer forgets the contact: no correlation comes of it that both know.
            effects.append(Send(peer, body.epoch.t_meas_ns, PairReply(body.epoch, ReplyStatus.BUSY)))
        if not isinstance(body, PairRequest | SplitRequest):
            self._counters["waiting.asked"] += 1
            return
        late = self._t_ns - t_ns > self._settings.lateness.horizon_ns
        known = all(item.kind in RELATIVE_ANGLES for item in body.measurements)
        told = _told(body.snapshot)
        if late or told is None or not known:
            self._counters["waiting.unused"] += 1
        elif self._evidence.contact(t_ns, peer, told, body.measurements, own_observed=False):
            self._counters["start.told"] += 1
        else:
            self._counters["waiting.unused"] += 1

    def replied(self, peer: str, body: Body) -> None:
        if not isinstance(body, PairReply | SplitReply):
            return
        epoch, _, measurements = self._asked.get(peer, (None, 0, ()))
        told = None if body.snapshot is None else _told(body.snapshot)
        if epoch != body.epoch or told is None:
            self._counters["waiting.unused"] += 1
            return
        del self._asked[peer]
        if self._evidence.contact(body.epoch.t_meas_ns, peer, told, measurements, own_observed=True):
            self._counters["start.answered"] += 1

    def heard(self, event: Received, effects: list[Effect]) -> None:
        self._counters["waiting.unused"] += 1

    def link_changed(self, event: LinkChange) -> None:
        """Nothing is known of any peer yet."""

    def settled(self, until_ns: int, effects: list[Effect]) -> None:
        """Nothing is told."""

    def expire(self, now_ns: int, effects: list[Effect]) -> None:
        """A request that is not answered is made again with the next measurement."""

    def deadline_ns(self) -> int:
        return FAR_FUTURE_NS

    # -- for people -----------------------------------------------------------------------------------------

    def mark(self) -> FilterMark | None:
        """There is no estimate that could be made again."""
        return None

    def rewind(self, mark: FilterMark) -> None:
        raise RuntimeError("there is no mark of this filter")

    def estimate(self) -> Estimate | None:
        return None

    def contacts(self) -> dict[str, Epoch]:
        return {}

    def form(self) -> tuple[str, str]:
        return self._settings.localization.form, "waiting for a start"

    def saved(self) -> Saved | None:
        return None


def _told(snapshot: Snapshot | SplitSnapshot | JointSnapshot) -> Told | None:
    """The robot's own part of what a peer has told; None if it is none of a robot."""
    belief = snapshot.belief if isinstance(snapshot, Snapshot) else snapshot
    layout = STATES.get(belief.model)
    if layout is None or layout.heading is None:
        return None
    return Told(belief.model, belief.mean[: layout.dim], belief.cov[: layout.dim, : layout.dim])
