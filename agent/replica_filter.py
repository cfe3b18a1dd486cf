"""Cooperative localization of a small team by raw data: every robot keeps the joint belief of all.

Each robot tells everybody its odometry and measurements; whatever is heard is used at its instant. Raw data have noise
of their own, so what is not heard is merely not known: the belief is that of a centralized filter on the data that came
through, and without loss the same one at every robot. It needs a team that is known, and about N^2 memory and N^3 time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agent.cooperative_filter import FilterMark
from agent.effects import Broadcast, Effect, Estimate, TrackEstimate
from agent.estimation.mounting import levelled
from agent.estimation.observation import AbsoluteModel, RelativeModel, told
from agent.events import LinkChange, Observation, Received
from agent.pair_clock import PairClocks
from agent.saved_state import Saved
from agent.settings import AgentSettings
from agent.team_history import OWN, Belief, Datum, Fate, TeamHistory
from agent.team_teller import Teller
from agent.team_track import Life
from network.messages import (
    NO_MOUNT,
    Body,
    Channel,
    Epoch,
    Measurement,
    Mount,
    PairRequest,
    RawMeasurement,
    SplitRequest,
    StartRequest,
    TeamReport,
)
from network.wire_team import MAX_INDEX

Array = NDArray[np.float64]

FAR_FUTURE_NS = 2**62


class ReplicaFilter:
    """The kind `replica`; see `agent.cooperative_filter` for what each method is given."""

    keeps_factors = False

    def __init__(
        self, settings: AgentSettings, counters: Counter[str], count_nis: Callable[[str, float], None]
    ) -> None:
        self._settings, self._counters, self._count_nis = settings, counters, count_nis
        self._history = TeamHistory(settings, counters, self._applied, self._over)
        self._teller = Teller(settings.start_ns)
        self._clocks = PairClocks(settings)
        self._motions = {target.id: target.motion for target in settings.targets}
        self._contacts: dict[str, Epoch] = {}
        self._heard_ns: int | None = None
        self._revision = object()
        self._told_of: tuple[Belief | None, Estimate] = None, Estimate(0, "", settings.mean, settings.cov)

    @property
    def t_ns(self) -> int:
        return self._history.t_ns

    @property
    def complete_ns(self) -> int:
        return self.t_ns

    @property
    def revision(self) -> object:
        return self._revision

    def mark(self) -> FilterMark | None:
        """The team has been told: nothing is taken back. What was measured is put in its place by the history."""
        return None

    def rewind(self, mark: FilterMark) -> None:
        raise RuntimeError("there is no mark of this filter")

    def estimate(self) -> Estimate:
        belief, robot = self._history.belief(), self._settings.robot
        if self._told_of[0] is belief:
            return self._told_of[1]
        tracks = tuple(
            TrackEstimate(name, self._motions[name].layout.name, *belief.filter.belief(name))
            for name in self._history.targets
        )
        found = Estimate(self.t_ns, self._settings.layout.name, *belief.filter.belief(robot), tracks)
        self._told_of = belief, found
        return found

    def contacts(self) -> dict[str, Epoch]:
        return dict(self._contacts)

    def form(self) -> tuple[str, str]:
        silent = [name for name in self._others() if not self._present(name)]
        told_of = f"silent: {', '.join(silent)}" if silent else "everybody is heard"
        return "replica", f"configured; {told_of}"

    def saved(self) -> Saved | None:
        """Nothing: the belief follows from raw data, which the team tells no more."""
        return None

    def _others(self) -> tuple[str, ...]:
        return tuple(name for name in self._history.robots if name != self._settings.robot)

    def _present(self, robot: str) -> bool:
        """Whether a peer's odometry of within the horizon is known."""
        track = self._history.tracks.get(robot)
        return track is not None and track.newest.t_ns > self.t_ns - self._settings.lateness.horizon_ns

    # -- own information ------------------------------------------------------------------------------------

    def advance(self, t_ns: int, delta: Array, cov: Array) -> None:
        reckoning = self._teller.moved(t_ns, delta, cov)
        self._history.reckon(self._settings.robot, OWN, reckoning, 0)
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
        if isinstance(model, AbsoluteModel):
            self._measure(t_ns, None, model.kind, z, R)
        else:
            self._measure(t_ns, f"landmark:{landmark}", model.kind, z, R, levelled(model.mount, model.attitude))

    def sighting(self, t_ns: int, target: str, event: Observation) -> None:
        if target not in self._history.targets:
            self._counters["observation.unknown_target"] += 1
            return
        item = told(event)
        self._measure(t_ns, f"target:{target}", item.kind, item.z, item.R, item.mount)

    def measured(
        self, peer: str, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...], effects: list[Effect]
    ) -> None:
        if peer not in self._history.robots:
            self._counters["pair.not_in_team"] += 1
            return
        self._counters["pair.started"] += 1
        for item in measurements:
            wide = self._clocks.widened(peer, item)
            self._measure(t_ns, peer, wide.kind, wide.z, wide.R, wide.mount)

    def _measure(self, t_ns: int, of: str | None, kind: str, z: Array, R: Array, mount: Mount = NO_MOUNT) -> None:
        """Use a measurement, and tell it to the team."""
        lateness = self._settings.lateness
        late = t_ns < self.t_ns - lateness.tolerance_ns
        index = self._teller.index(t_ns, self.t_ns - lateness.horizon_ns)
        item = RawMeasurement(t_ns, index, of, kind, z, R, mount)
        refused = late and lateness.kind == "discard"
        if refused or index > MAX_INDEX or not self._history.measure(self._settings.robot, OWN, item, 0):
            self._counters["late.dropped"] += 1
            return
        if late:
            self._counters["late.compensated"] += 1
        self._teller.measured(item)
        self._revision = object()

    def _applied(self, datum: Datum) -> None:
        """A measurement is used for the first time: a contact, if it is of the robot and a peer."""
        own, peer = self._settings.robot, datum.peer
        if datum.source == own and peer is not None:
            self._counters["pair.applied_initiator"] += 1
        elif peer == own:
            peer = datum.source
            self._counters["pair.applied_responder"] += 1
        else:
            return
        epoch = Epoch(datum.t_ns, datum.source, datum.item.index)
        self._contacts[peer] = max(epoch, self._contacts.get(peer, epoch))

    def _over(self, datum: Datum) -> None:
        """A measurement has left the horizon."""
        used = datum.fate is Fate.USED
        self._counters["replica.used" if used else f"replica.{datum.fate.value}"] += 1
        if used and datum.source == self._settings.robot:
            of, colon, _ = (datum.item.of or "").partition(":")
            about = "" if not of else f"{of if colon else 'pair'}_"
            self._counters[f"used.{about}{datum.item.kind}"] += 1
            self._count_nis(f"{about}{datum.item.kind}", datum.nis)

    # -- peers ----------------------------------------------------------------------------------------------

    def heard(self, event: Received, effects: list[Effect]) -> None:
        header, body = event.message.header, event.message.body
        source = header.source
        if not isinstance(body, TeamReport):
            self._counters["received.unused"] += 1
            return
        if source not in self._others():
            self._counters["replica.not_in_team"] += 1
            return
        life, offset_ns = (header.incarnation, header.boot_id), self._clocks.offset_ns(event)
        self._history.begin(source, life, body.born_ns, offset_ns)
        for reckoning in body.reckonings:
            self._history.reckon(source, life, reckoning, offset_ns)
        for item in body.measurements:
            self._take(source, life, item, offset_ns)
        self._heard_ns = event.t_ns if self._heard_ns is None else self._heard_ns

    def _take(self, source: str, life: Life, item: RawMeasurement, offset_ns: int) -> None:
        """A measurement by a peer. One that is repeated is nothing new."""
        if item.of is not None:
            kind, _, name = item.of.rpartition(":")
            known = {"": self._history.robots, "target": self._history.targets, "landmark": self._settings.landmarks}
            if name not in known[kind]:
                self._counters[f"replica.unknown_{kind or 'robot'}"] += 1
                return
            if kind != "landmark":
                wide = self._clocks.widened(source, Measurement(item.kind, item.z, item.R))
                item = replace(item, R=wide.R)
        if not self._history.measure(source, life, item, offset_ns):
            self._counters["replica.too_late"] += 1

    def settled(self, until_ns: int, effects: list[Effect]) -> None:
        for report in self._teller.reports(until_ns):
            stamps = [item.t_ns for item in report.reckonings] + [item.t_ns for item in report.measurements]
            effects.append(Broadcast(Channel.BELIEF, max(stamps), report))
        if self._heard_ns is not None and self._heard_ns <= until_ns:
            self._heard_ns = None
            self._revision = object()

    def deadline_ns(self) -> int:
        due = [t_ns for t_ns in (self._teller.due_ns(), self._heard_ns) if t_ns is not None]
        return min(due) + self._settings.lateness.settle_ns if due else FAR_FUTURE_NS

    # -- what only pairs do ---------------------------------------------------------------------------------

    def instant_ns(self, event: Received) -> int:
        body = event.message.body
        assert isinstance(body, PairRequest | SplitRequest | StartRequest)
        return body.epoch.t_meas_ns - self._clocks.offset_ns(event)

    def requested(self, event: Received, t_ns: int, effects: list[Effect]) -> None:
        self._counters["pair.other_form"] += 1

    def replied(self, peer: str, body: Body) -> None:
        self._counters["pair.other_form"] += 1

    def link_changed(self, event: LinkChange) -> None:
        """A new life tells of itself in its reports."""

    def expire(self, now_ns: int, effects: list[Effect]) -> None:
        """Nothing is waited for."""
