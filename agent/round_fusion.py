"""What a round makes of a robot's own measurements and of what its neighbours have told (Su 2022, eq. 2.8-2.15).

First the robot is corrected by the peers and targets it has seen, then each target by what all believe of it, and by
where the sensors of all place it. What a neighbour told of another instant is carried to the one it is needed at.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from agent.course import Course, Moment
from agent.estimation.gaussian import quadratic_form, wrap_components
from agent.estimation.jlatt import Detection, Placed, robot_update, target_correction, target_update
from agent.estimation.motion import STATES, StateLayout
from agent.estimation.observation import OutOfViewError, RelativeModel, relative_model
from agent.events import Observation
from agent.health import Health
from agent.peer_tables import remember
from agent.plausible import agree
from agent.round_carry import Carrier
from agent.round_tracks import RoundTracks
from agent.rounds import Told
from agent.settings import AgentSettings
from agent.tracks import CONTRADICTIONS
from network.messages import Correction, Measurement, RoundReport

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """The own measurement of a target; `fresh`: the track does not hold it yet."""

    t_ns: int
    model: RelativeModel
    z: Array
    R: Array
    fresh: bool = True

    @staticmethod
    def of(event: Observation, t_ns: int, own: StateLayout, target: StateLayout) -> Seen:
        return Seen(t_ns, relative_model(event, own, target), event.z, event.R)


@dataclass(frozen=True, slots=True, eq=False)
class Detected:
    """The own measurements of a peer at one instant."""

    peer: str
    t_ns: int
    measurements: tuple[Measurement, ...]


class RoundFusion:
    """Fusion with the settings of one robot."""

    def __init__(
        self,
        settings: AgentSettings,
        counters: Counter[str],
        count_nis: Callable[[str, float], None],
        health: Health,
    ) -> None:
        self._settings, self._counters, self._count_nis, self._health = settings, counters, count_nis, health
        self._carrier = Carrier(settings)
        self._used: dict[str, int] = {}
        self.used_until_ns: int | None = None
        """What was told of instants up to then has perhaps been used by an earlier life."""

    def forget(self, peer: str) -> None:
        """A peer has begun anew."""
        self._used.pop(peer, None)

    def usable(self, told: list[Told[RoundReport]], t_ns: int) -> dict[str, Told[RoundReport]]:
        """By peer, what may be used at `t_ns` under the policy for what is late."""
        unsafe, lateness = self._settings.unsafe, self._settings.lateness
        if unsafe.use_late_as_new:
            return {item.peer: replace(item, t_ns=t_ns) for item in told}
        near = t_ns - self._settings.round.period_ns // 2
        return {item.peer: item for item in told if lateness.kind != "discard" or item.t_ns >= near}

    # -- the robot ------------------------------------------------------------------------------------------

    def correct_robot(
        self,
        own: Course,
        tracks: RoundTracks,
        detected: dict[str, Detected],
        seen: dict[str, Seen],
        told: dict[str, Told[RoundReport]],
    ) -> None:
        """Use what was seen since the last round, in order of its instants."""
        instants = {item.t_ns for item in detected.values()} | {item.t_ns for item in seen.values()}
        for t_ns in sorted(instants):
            then = own.at(t_ns)
            if then is None:
                self._counters["late.dropped"] += 1
                continue
            found: list[Detection] = []
            with self._counted_failure():
                found += self._of_peers(then, t_ns, detected, told)
            with self._counted_failure():
                found += self._of_targets(then, t_ns, tracks, seen)
            if not found:
                continue
            with self._counted_failure():
                mean, cov = robot_update(
                    then.mean, then.cov, self._settings.layout.angles, found, self._settings.localization.weights
                )
                if own.correct(then, mean, cov):
                    self._counters["round.used_detections"] += len(found)
                else:
                    self._counters["update.not_positive_definite"] += 1

    @contextmanager
    def _counted_failure(self) -> Iterator[None]:
        """What a peer told may lead to a matrix that can't be inverted: that is not used, and the round goes on."""
        try:
            yield
        except np.linalg.LinAlgError:
            self._counters["update.failed"] += 1

    def _of_peers(
        self, then: Moment, t_ns: int, detected: dict[str, Detected], told: dict[str, Told[RoundReport]]
    ) -> Iterator[Detection]:
        for peer, item in sorted(detected.items()):
            if item.t_ns != t_ns:
                continue
            if peer not in told:
                self._counters["round.unheard"] += len(item.measurements)
                continue
            belief = self._carrier.belief(told[peer], t_ns)
            subject = STATES[belief.model]
            for measurement in item.measurements:
                model = relative_model(measurement, self._settings.layout, subject)
                found = Detection(model, measurement.z, measurement.R, belief.mean, belief.cov)
                nis = self._nis(then, found)
                if nis is None or not self._health.usable(peer, t_ns, nis, own_observed=True):
                    continue
                self._count_nis(f"pair_{measurement.kind}", nis)
                yield found

    def _of_targets(
        self, then: Moment, t_ns: int, tracks: RoundTracks, seen: dict[str, Seen]
    ) -> Iterator[Detection]:
        health = self._settings.health
        for target, item in sorted(seen.items()):
            track = tracks.at(target, t_ns)
            if item.t_ns != t_ns or track is None or not item.fresh:
                continue
            found = Detection(item.model, item.z, item.R, track.mean, track.cov)
            nis = self._nis(then, found)
            if nis is None:
                continue
            if health.enabled and nis > health.gate_nis:
                self._contradicted(target, item, then, tracks)
                del seen[target]
                continue
            tracks.doubt(target, False)
            self._count_nis(f"target_{item.model.kind}", nis)
            yield found

    def _nis(self, then: Moment, item: Detection) -> float | None:
        """NIS per degree of freedom as if errors were independent; None if it can't be had."""
        joint = np.concatenate([then.mean, item.mean])
        try:
            H = item.model.jacobian(joint)
            nu = wrap_components(item.z - item.model.h(joint), item.model.angles)
        except OutOfViewError:
            self._counters["observation.out_of_view"] += 1
            return None
        n = len(then.mean)
        S = item.R + H[:, :n] @ then.cov @ H[:, :n].T + H[:, n:] @ item.cov @ H[:, n:].T
        return float(quadratic_form(nu, S)) / len(nu)

    def _contradicted(self, target: str, item: Seen, then: Moment, tracks: RoundTracks) -> None:
        """A sighting and a track cannot both be right; after some on end the track ends, and begins anew."""
        self._counters["observation.gated"] += 1
        if tracks.doubt(target, True) >= CONTRADICTIONS:
            tracks.end(target)
            tracks.start_seen(target, item.model, then, item.z, item.R)

    # -- targets --------------------------------------------------------------------------------------------

    def correction(self, target: str, seen: Seen, own: Moment, track: Moment, t_ns: int) -> Correction | None:
        """Where an own measurement places a target at `t_ns`; None if it alone does not tell."""
        altitude = seen.model.subject.altitude
        variance = 0.0 if altitude is None else float(track.cov[altitude, altitude])
        found = None
        with self._counted_failure():
            found = target_correction(seen.model, own.mean, own.cov, track.mean, seen.z, seen.R, variance)
        if found is None:
            self._counters["round.undetermined"] += 1
            return None
        placed = self._carrier.placed(target, found, track, t_ns - seen.t_ns)
        return Correction(target, placed.place, placed.sensor, placed.pose)

    def correct_targets(
        self,
        tracks: RoundTracks,
        t_ns: int,
        corrections: dict[str, Correction],
        seen: dict[str, Seen],
        told: dict[str, Told[RoundReport]],
    ) -> None:
        """Use what all believe of each target at `t_ns`, and where all place it."""
        trusted = {peer: item for peer, item in told.items() if self._health.trusts(peer)}
        for target in self._settings.tracked:
            with self._counted_failure():
                self._correct(target.id, tracks, t_ns, corrections.get(target.id), seen.get(target.id), trusted)
        for peer, item in told.items():
            remember(self._used, peer, item.t_ns)

    def _correct(
        self,
        target: str,
        tracks: RoundTracks,
        t_ns: int,
        correction: Correction | None,
        seen: Seen | None,
        told: dict[str, Told[RoundReport]],
    ) -> None:
        layout = tracks.layout(target)
        beliefs = dict(self._beliefs(target, layout, t_ns, told))
        before = tracks.at(target, t_ns)
        if before is None:
            if not beliefs:
                return
            # What one of them believes is the own belief from now on.
            peer = min(beliefs, key=lambda name: float(np.trace(beliefs[name][0].cov)))
            first, learnt_ns = beliefs.pop(peer)
            if not tracks.start(target, first, learnt_ns):
                return
            before = tracks.at(target, t_ns)
            assert before is not None
        learnt = []
        others = []
        for belief, learnt_ns in beliefs.values():
            if agree(self._settings.health, before.mean, before.cov, belief.mean, belief.cov, layout.angles):
                others.append((belief.mean, belief.cov))
                learnt.append(learnt_ns)
            else:
                self._counters["round.disagrees"] += 1
        placed = []
        if correction is not None and seen is not None and seen.fresh:
            placed.append(Placed(correction.place, correction.sensor, correction.pose))
            learnt.append(seen.t_ns)
        for peer, item in self._placed(target, before, t_ns, told):
            d = len(item.place)
            block = before.cov[:d, :d]
            if agree(self._settings.health, before.mean[:d], block, item.place, item.sensor + item.pose, ()):
                placed.append(item)
                learnt.append(told[peer].t_ns)
            else:
                self._counters["round.disagrees"] += 1
        if not others and not placed:
            return
        mean, cov = target_update(
            before.mean, before.cov, layout.angles, others, placed, self._settings.localization.weights
        )
        if tracks.correct(target, before, mean, cov, max(learnt)):
            self._counters["round.used_corrections"] += len(placed)
        else:
            self._counters["update.not_positive_definite"] += 1

    def _beliefs(
        self, target: str, layout: StateLayout, t_ns: int, told: dict[str, Told[RoundReport]]
    ) -> Iterator[tuple[str, tuple[Moment, int]]]:
        """By peer, what it believes of a target at `t_ns`, and when something was last learnt of it."""
        for peer, item in told.items():
            for belief in item.report.targets:
                if belief.target != target:
                    continue
                if belief.belief.model != layout.name:
                    self._counters["round.other_model"] += 1
                    continue
                moved = self._carrier.target(target, belief.belief, t_ns - item.t_ns)
                yield peer, (Moment(t_ns, *moved), item.t_ns - belief.age_ns)

    def _placed(
        self, target: str, before: Moment, t_ns: int, told: dict[str, Told[RoundReport]]
    ) -> Iterator[tuple[str, Placed]]:
        """By peer, where it places a target in x, y; the sensor's part counts as new once only.

        What is of a former round is in what neighbours who heard it in time believe now.
        """
        near = t_ns - self._settings.round.period_ns // 2
        for peer, item in told.items():
            for found in item.report.corrections:
                if found.target != target:
                    continue
                placed = Placed(found.place[:2], found.sensor[:2, :2], found.pose[:2, :2])
                before_life = self.used_until_ns is not None and item.t_ns <= self.used_until_ns
                if before_life or item.t_ns < near or self._used.get(peer) == item.t_ns:
                    placed = placed.used()
                yield peer, self._carrier.placed(target, placed, before, t_ns - item.t_ns)
