"""A robot that localizes by its leader, or is the leader (kind `leader`; Zhang & Cao 2019).

The follower measures range and bearing of the leader, and the leader tells where it was: to everybody at each instant
of a round, or to who asks (the paper's figure 1). What the word completes is an own datum of the instant of the
measurement, handed to the core (`completed`), which puts it in its place (`lateness.kind = "replay"`) or hands it over
as late.

Nobody is told what the follower believes, and the leader does not use its followers: nothing is shared, and a follower
may make its belief anew as far back as it likes. The leader is trusted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import cast

import numpy as np
from numpy.typing import NDArray

from agent.cooperative_filter import FilterMark, refusal
from agent.course import Course, CourseMark, Moment
from agent.effects import Effect, Estimate, Send
from agent.estimation.colocalization import Options, absolute_update
from agent.estimation.delayed import NEAREST_M, LeaderSight, moved
from agent.estimation.gaussian import gain, wrap_components
from agent.estimation.motion import PLANAR, PLANAR_SQUARE
from agent.estimation.observation import AbsoluteModel, OutOfViewError, RelativeModel
from agent.estimation.split_joint import Split
from agent.estimation.unscented import Propagated
from agent.events import Completed, LinkChange, Observation, Received
from agent.joint_tracks import JointState
from agent.late_words import LateWords, UnderWay
from agent.leader_voice import LeaderVoice
from agent.leader_words import LeaderWords, Word
from agent.pair_clock import PairClocks
from agent.saved_state import SavedSplit
from agent.settings import NS, AgentSettings
from network.leader_messages import LeaderReport, LeaderRequest
from network.messages import Body, Epoch, Measurement, PairRequest, SplitRequest, StartRequest

Array = NDArray[np.float64]

FAR_FUTURE_NS = 2**62
POSE = 3
"""Components of the pose; behind it there may be the leader's clock."""


class LeaderFilter:
    """The kind `leader`; see `agent.cooperative_filter` for what each method is given."""

    keeps_factors = False

    def __init__(
        self,
        settings: AgentSettings,
        counters: Counter[str],
        count_nis: Callable[[str, float], None],
        saved: SavedSplit | None = None,
    ) -> None:
        self._settings, self._counters, self._count_nis = settings, counters, count_nis
        lateness, localization = settings.lateness, settings.localization
        self._leads = settings.robot == localization.leader
        mean, cov, start_ns = settings.mean, settings.cov, settings.start_ns
        if saved is not None:
            mean, cov, start_ns = saved.state.mean, saved.state.cov, saved.state.t_ns
        self._clock_sigma_s = 0.0
        if localization.clock_state and not self._leads:
            self._clock_sigma_s = lateness.clock_sigma_ns / NS
            mean, cov = np.append(mean, 0.0), _with_clock(cov, self._clock_sigma_s)
        self._own = Course(Moment(start_ns, mean, cov), (2,), lateness.horizon_ns, lateness.tolerance_ns)
        self._options = Options(localization.transform, localization.parameters, localization.innovation_cap)
        self._clocks = PairClocks(settings)
        self._offset_ns: int | None = None
        self._words = LeaderWords(settings, counters)
        self._late = LateWords(lateness, settings.start_ns, self._own, counters)
        self._voice = LeaderVoice(settings, self._own, counters) if self._leads else None
        self._life: tuple[int, int] | None = None
        self._done: list[Completed] = []
        self._last: Epoch | None = None
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
        return Estimate(own.t_ns, self._settings.layout.name, own.mean[:POSE], own.cov[:POSE, :POSE], ())

    def clock(self) -> tuple[float, float] | None:
        """By how much the leader's clock is ahead beyond what is known, and its deviation [s]; None: not asked."""
        own = self._own.newest
        return (float(own.mean[POSE]), float(own.cov[POSE, POSE]) ** 0.5) if self._clock_sigma_s > 0.0 else None

    def contacts(self) -> dict[str, Epoch]:
        return {} if self._last is None else {self._last.initiator: self._last}

    def form(self) -> tuple[str, str]:
        leader = self._settings.localization.leader
        return "leader", "configured; leads" if self._leads else f"configured; follows {leader}"

    def sizes(self) -> dict[str, tuple[int, int]]:
        """What is kept, and the most there may be of it, by name."""
        return {**self._words.sizes(), **self._late.sizes()}

    def saved(self) -> SavedSplit:
        """The pose; of the leader's clock a new life finds out anew."""
        own = self._own.newest
        mean, cov = own.mean[:POSE].copy(), own.cov[:POSE, :POSE].copy()
        return SavedSplit(JointState(own.t_ns, mean, Split(np.zeros_like(cov), cov), (), (), {}))

    def mark(self) -> FilterMark:
        return FilterMark(self, (self._own.mark(), self._late.under_way()))

    def rewind(self, mark: FilterMark) -> None:
        course, flights = cast("tuple[CourseMark, UnderWay]", mark.kept)
        self._own.rewind(course)
        self._late.restore(flights)
        self._revision = object()

    # -- own information ------------------------------------------------------------------------------------

    def advance(self, t_ns: int, delta: Array, cov: Array) -> None:
        self._late.leave()
        now, step = self._own.newest, delta[list(PLANAR)]
        mean, after, F = moved(now.mean, now.cov, step, cov[PLANAR_SQUARE])
        self._own.advance(t_ns, Propagated(mean, after, F))
        self._late.moved(F, step, cov[PLANAR_SQUARE])
        if self._voice is not None:
            self._voice.moved(t_ns, (mean[:2] - now.mean[:2]) * NS / (t_ns - now.t_ns))
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
        lateness = self._settings.lateness
        late = t_ns < self.t_ns - lateness.tolerance_ns
        then = None if late and self._late.policy(t_ns) == "discard" else self._own.at(t_ns)
        if then is None:
            self._counters["late.dropped"] += 1
            return
        pose, cov = then.mean[:POSE], then.cov[:POSE, :POSE]
        if self._leads and self._settings.localization.fixes == "trusted" and isinstance(model, AbsoluteModel):
            after = _replaced(pose, cov, model, z, R)
            self._counters["leader.trusted"] += 1
        else:
            update = absolute_update(pose, cov, self._settings.layout, model, z, R, self._options)
            if update is None:
                self._counters["update.not_positive_definite"] += 1
                return
            after = update.mean, update.cov
            self._count_nis(kind, update.nis)
        mean, whole = _extended(then, *after)
        left = gain(whole, then.cov)
        if not self._own.correct(then, mean, whole):
            self._counters["update.not_positive_definite"] += 1
            return
        self._late.updated(left)
        self._counters[f"used.{kind}"] += 1
        self._counters["late.compensated"] += late
        self._revision = object()

    def sighting(self, t_ns: int, target: str, event: Observation) -> None:
        self._counters["leader.unused"] += 1

    # -- the leader, measured and heard ---------------------------------------------------------------------

    def measured(
        self, peer: str, t_ns: int, now_ns: int, measurements: tuple[Measurement, ...], effects: list[Effect]
    ) -> None:
        localization = self._settings.localization
        usable = tuple(item for item in measurements if item.kind == "range_bearing")
        if self._leads or peer != localization.leader or not usable:
            self._counters["leader.unused"] += len(measurements)
            return
        if localization.exchange == "request":
            number = self._words.ask(t_ns, now_ns, usable)
            if number is None:
                return
            effects.append(Send(peer, t_ns, LeaderRequest(number)))
            done: list[Completed] = []
        else:
            done = self._words.measured(t_ns, usable)
        self._counters["leader.measured"] += len(usable)
        self._done += done
        if abs(t_ns - self.t_ns) <= self._settings.lateness.tolerance_ns and not done:
            expected = self._words.expected_cov()
            for item in usable:
                sight = None if expected is None else _sight(item, np.zeros(2), expected, np.zeros(2))
                self._late.measured(t_ns, item.z, sight)

    def heard(self, event: Received, effects: list[Effect]) -> None:
        header, body = event.message.header, event.message.body
        if self._leads or header.source != self._settings.localization.leader or not isinstance(body, LeaderReport):
            self._counters["received.unused"] += 1
            return
        offset_ns, cov, estimated = self._offset(event), body.cov, self._clock_sigma_s > 0.0
        if body.answers is None and not estimated:
            # An answer has it in it: the leader knows how well it knows the instant it was asked for.
            cov = cov + self._clocks.sigma_s(header.source) ** 2 * np.outer(body.velocity, body.velocity)
        word = Word(header.t_meas_ns - offset_ns, body.place, cov, body.velocity, header.t_meas_ns, body.before_ns)
        if body.answers is None:
            self._done += self._words.told(word)
        else:
            self._done += self._words.answered(body.answers, word, not estimated)

    def completed(self) -> list[Completed]:
        """Own measurements that a word has completed since this was asked last."""
        found, self._done = self._done, []
        return found

    def use(self, item: Completed) -> None:
        """A completed measurement, of the present instant or of a past one. Raises `OutOfViewError`."""
        sight = _sight(item, item.place, item.place_cov, item.velocity)
        if item.z[0] < NEAREST_M or float(np.hypot(*(item.place - self._own.newest.mean[:2]))) < NEAREST_M:
            raise OutOfViewError("the leader is too near for a bearing")
        before = self._own.newest
        found = self._late.use(item, sight, self._settings.lateness.iterations)
        if self._own.newest is not before:
            self._revision = object()
        if found is None:
            return
        self._counters["used.leader"] += 1
        self._count_nis("leader", float(found.nis))
        leader = self._settings.localization.leader
        self._last = Epoch(item.t_meas_ns, leader, 0)

    def link_changed(self, event: LinkChange) -> None:
        life = event.incarnation, event.boot_id
        if self._leads or event.peer != self._settings.localization.leader or not event.up or life == self._life:
            return
        if self._life is not None:
            self._counters["leader.new_life"] += 1
            self._words.begin_anew()
            self._offset_ns = None
            if self._clock_sigma_s > 0.0:
                now = self._own.newest
                mean, cov = now.mean.copy(), _with_clock(now.cov[:POSE, :POSE], self._clock_sigma_s)
                mean[POSE] = 0.0
                self._own.correct(now, mean, cov)
        self._life = life

    # -- what is told ---------------------------------------------------------------------------------------

    def settled(self, until_ns: int, effects: list[Effect]) -> None:
        if self._voice is not None and self._settings.localization.exchange == "broadcast":
            self._voice.tell(until_ns, effects)

    def expire(self, now_ns: int, effects: list[Effect]) -> None:
        if not self._leads:
            until_ns = self.t_ns - self._settings.lateness.horizon_ns
            self._words.forget(until_ns)
            self._late.forget(until_ns)

    def deadline_ns(self) -> int:
        told = self._voice is not None and self._settings.localization.exchange == "broadcast"
        due_ns = self._voice.deadline_ns() if told and self._voice is not None else None
        return FAR_FUTURE_NS if due_ns is None else due_ns

    def instant_ns(self, event: Received) -> int:
        body, header = event.message.body, event.message.header
        assert isinstance(body, PairRequest | SplitRequest | StartRequest | LeaderRequest)
        stamp_ns = header.t_meas_ns if isinstance(body, LeaderRequest) else body.epoch.t_meas_ns
        return stamp_ns - self._clocks.offset_ns(event)

    def requested(self, event: Received, t_ns: int, effects: list[Effect]) -> None:
        peer, body = event.message.header.source, event.message.body
        if not isinstance(body, LeaderRequest):
            self._counters["pair.other_form"] += 1
            if isinstance(body, PairRequest):
                effects.append(refusal(peer, body.epoch))
            return
        if self._voice is None:
            self._counters["leader.not_leading"] += 1
            return
        report = self._voice.answer(t_ns, body.number, self._clocks.sigma_s(peer))
        if report is not None:
            effects.append(Send(peer, t_ns, report))

    def replied(self, peer: str, body: Body) -> None:
        self._counters["pair.other_form"] += 1

    def _offset(self, event: Received) -> int:
        """The leader's clock minus the own one. If what is left of it is estimated, it is held."""
        offset_ns = self._clocks.offset_ns(event)
        if self._clock_sigma_s == 0.0:
            return offset_ns
        if self._offset_ns is None:
            self._offset_ns = offset_ns
        return self._offset_ns


def _sight(item: Measurement | Completed, place: Array, cov: Array, velocity: Array) -> LeaderSight:
    x, y, _, _, _, yaw = item.mount
    return LeaderSight(item.z, item.R, place, cov, velocity, (x, y, yaw))


def _with_clock(cov: Array, sigma_s: float) -> Array:
    """Covariance (4, 4) of a pose (3, 3) and a clock that nothing is known of together."""
    found = np.zeros((POSE + 1, POSE + 1))
    found[:POSE, :POSE], found[POSE, POSE] = cov, sigma_s**2
    return found


def _replaced(mean: Array, cov: Array, model: AbsoluteModel, z: Array, R: Array) -> tuple[Array, Array]:
    """What a fix says takes the place of what was believed, as of the kind `fixed`."""
    told = list(model.components)
    after, changed = mean.copy(), cov.copy()
    after[told] = z
    changed[told, :] = changed[:, told] = 0.0
    changed[np.ix_(told, told)] = R
    return wrap_components(after, (2,)), changed


def _extended(then: Moment, mean: Array, cov: Array) -> tuple[Array, Array]:
    """The belief after one of the pose (3,), (3, 3) has changed, about which alone something was learnt."""
    if len(then.mean) == POSE:
        return mean, cov
    share = gain(then.cov[POSE:, :POSE], then.cov[:POSE, :POSE])
    whole, after = then.cov.copy(), then.mean.copy()
    shift = wrap_components(mean - then.mean[:POSE], (2,))
    after[:POSE], after[POSE:] = mean, then.mean[POSE:] + share @ shift
    whole[:POSE, :POSE], whole[POSE:, :POSE] = cov, share @ cov
    whole[:POSE, POSE:] = whole[POSE:, :POSE].T
    whole[POSE:, POSE:] += share @ (cov - then.cov[:POSE, :POSE]) @ share.T
    return after, whole
