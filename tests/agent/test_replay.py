"""Own data that come late within the horizon: by a rewind the result is that of data in time, in any order."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.core import Agent
from agent.estimation.motion import LAYOUTS, TargetMotion
from agent.events import Event, Fix, Observation, Odometry, Received, Tick
from agent.replay import MAX_ALLOWANCE, MAX_LOGGED, STEPS_PER_S
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings, TargetSettings, TeamMember
from network.messages import Header, Message
from tests.agent.courier import sends

MS = 1_000_000
STEP_NS = 100 * MS
END_NS = 2 * NS
HORIZON_NS = 3 * NS
EXAMPLES = int(os.environ.get("COFIX_REPLAY_EXAMPLES", "6"))
Kind = Literal["compensate", "replay", "discard"]
FORMS = ["safe", "published", "joint", "split_joint", "auto"]


def agent(form: str, kind: Kind = "replay", horizon_ns: int = HORIZON_NS) -> Agent:
    motion = TargetMotion(LAYOUTS["constant_velocity"], noise_sigma=(0.3, 0.3))
    own = AgentSettings(
        robot="r1",
        start_ns=0,
        mean=np.array([1.0, 2.0, 0.4]),
        cov=np.diag([0.3, 0.2, 0.05]),
        landmarks={"L1": (5.0, 1.0), "L2": (-3.0, 6.0)},
        targets=(TargetSettings("t1", motion, np.array([5.0, 3.0, 0.1, 0.0]), np.eye(4)),),
        localization=LocalizationSettings(form=form if form != "replica" else "auto"),  # type: ignore[arg-type]
        lateness=LatenessSettings(kind=kind, horizon_ns=horizon_ns),
    )
    if form == "replica":
        member = TeamMember("r2", own.motion, np.array([3.0, 3.0, 0.0]), np.eye(3))
        own = replace(own, localization=LocalizationSettings(kind="replica"), team=(member,))
    return Agent(own)


def odometry(k: int) -> Odometry:
    delta = np.array([0.05 + 0.001 * k, 0.002, 0.0, 0.02 * np.sin(k)])
    end = (k + 1) * STEP_NS
    return Odometry(end, k * STEP_NS, end, delta, np.diag([4e-4, 1e-4, 0.0, 4e-4]))


def measured(t_ns: int, kind: str, of: str, rng: np.random.Generator) -> Event:
    noise = rng.standard_normal(2)
    if kind == "position":
        return Fix(t_ns, t_ns, kind, np.array([1.2, 2.1]) + 0.3 * noise, np.diag([0.09, 0.08]), of)
    if kind == "heading":
        return Fix(t_ns, t_ns, kind, np.array([0.45]) + 0.1 * noise[:1], np.array([[0.01]]), of)
    if kind == "bearing":
        return Observation(t_ns, t_ns, kind, of, np.array([-0.6]) + 0.05 * noise[:1], np.array([[0.0025]]), "eye")
    z = {"landmark:L1": 4.0, "landmark:L2": 5.4, "target:t1": 3.9}[of]
    return Observation(t_ns, t_ns, "range", of, np.array([z]) + 0.2 * noise[:1], np.array([[0.04]]), "uwb")


CHOICES = [
    ("position", "gps"),
    ("position", "gps2"),
    ("heading", "compass"),
    ("range", "landmark:L1"),
    ("range", "landmark:L2"),
    ("bearing", "landmark:L1"),
    ("range", "target:t1"),
    ("bearing", "target:t1"),
]


def rank(event: Event) -> tuple[int, int, str, str, str, bytes]:
    """The order in which data of one instant are used."""
    if isinstance(event, Odometry):
        return event.t_meas_ns, 0, "", "", "", b""
    assert isinstance(event, Fix | Observation)
    if isinstance(event, Fix):
        return event.t_meas_ns, 1, event.sensor, event.sensor, event.kind, event.z.tobytes()
    assert event.of is not None
    phase = 1 if event.of.startswith("landmark") else 2
    return event.t_meas_ns, phase, event.of, event.sensor, event.kind, event.z.tobytes()


def story(seed: int) -> list[Event]:
    """Odometry and measurements over two seconds, in order; these are between its instants, at them, and together."""
    rng = np.random.default_rng(seed)
    events: list[Event] = [odometry(k) for k in range(END_NS // STEP_NS)]
    for _ in range(16):
        kind, of = CHOICES[rng.integers(len(CHOICES))]
        on_step = rng.random() < 0.5
        t_ns = int(rng.integers(0, 20)) * STEP_NS if on_step else int(rng.integers(0, 1950)) * MS
        events.append(measured(t_ns, kind, of, rng))
        if rng.random() < 0.3:
            kind, of = CHOICES[rng.integers(len(CHOICES))]
            events.append(measured(t_ns, kind, of, rng))
    return sorted(events, key=rank)


def played(subject: Agent, deliveries: list[tuple[int, Event]]) -> Agent:
    """Events at their deliveries, and all deadlines in between."""
    for now_ns, event in [*sorted(deliveries, key=lambda item: item[0]), (6 * NS, Tick(6 * NS))]:
        for _ in range(200):
            due = subject.next_deadline_ns()
            if due >= now_ns:
                break
            subject.handle(Tick(due))
        before = subject.filter.t_ns
        subject.handle(replace(event, t_ns=now_ns))
        assert subject.filter.t_ns >= before
        assert all(size <= bound for size, bound in subject.sizes().values())
    return subject


def in_time(form: str, events: list[Event]) -> Agent:
    return played(agent(form, "compensate"), [(rank(event)[0], event) for event in events])


def assert_same_estimate(one: Agent, other: Agent, tolerance: float = 1e-9) -> None:
    first, second = one.estimate(), other.estimate()
    assert first is not None and second is not None
    assert first.t_ns == second.t_ns
    np.testing.assert_allclose(first.mean, second.mean, atol=tolerance, rtol=0.0)
    np.testing.assert_allclose(first.cov, second.cov, atol=tolerance, rtol=0.0)
    assert [track.target for track in first.tracks] == [track.target for track in second.tracks]
    for mine, theirs in zip(first.tracks, second.tracks):
        np.testing.assert_allclose(mine.mean, theirs.mean, atol=tolerance, rtol=0.0)
        np.testing.assert_allclose(mine.cov, theirs.cov, atol=tolerance, rtol=0.0)


@pytest.mark.parametrize("form", FORMS)
@settings(max_examples=EXAMPLES, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_late_data_in_any_order_and_twice_give_the_result_of_data_in_time(form: str, seed: int, order: int) -> None:
    events, rng = story(seed), np.random.default_rng(order)
    longest_ns = int(rng.choice([50 * MS, 300 * MS, 2500 * MS]))
    deliveries = []
    for event in events:
        for _ in range(1 + (rng.random() < 0.2)):
            late_ns = int(rng.integers(0, longest_ns)) if rng.random() < 0.7 else 0
            deliveries.append((rank(event)[0] + late_ns, event))
    # An increment is of a stretch before its instant, and the robot goes back to an instant before that.
    horizon_ns = longest_ns + 3 * STEP_NS
    timely, late = in_time(form, events), played(agent(form, horizon_ns=horizon_ns), deliveries)
    assert_same_estimate(timely, late)
    known = len(deliveries) - len(events)
    assert late.counters["input.duplicate"] == known
    for kind in ("used.position", "used.heading", "used.sighting", "used.landmark_range", "used.landmark_bearing"):
        assert late.counters[kind] == timely.counters[kind]
    assert late.nis.keys() == timely.nis.keys()
    assert {kind: figure.count for kind, figure in late.nis.items()} == {
        kind: figure.count for kind, figure in timely.nis.items()
    }


def test_a_replica_uses_what_it_measured_late_in_its_place() -> None:
    """Its odometry was told and stays; measurements may come in any order, and twice."""
    for seed in range(EXAMPLES):
        events, rng = story(seed), np.random.default_rng(seed)
        deliveries = []
        for event in events:
            late = not isinstance(event, Odometry)
            for _ in range(1 + (late and rng.random() < 0.2)):
                late_ns = int(rng.integers(0, 2500 * MS)) if late else 0
                deliveries.append((rank(event)[0] + late_ns, event))
        assert_same_estimate(in_time("replica", events), played(agent("replica"), deliveries))


def test_compensation_is_not_as_good() -> None:
    """The check above can fail: a delayed update is another result."""
    events = story(1)
    late = [(rank(e)[0] + (0 if isinstance(e, Odometry) else 700 * MS), e) for e in events]
    timely = in_time("safe", events)
    with pytest.raises(AssertionError):
        assert_same_estimate(timely, played(agent("safe", "compensate"), late))
    assert_same_estimate(timely, played(agent("safe"), late))


@pytest.mark.parametrize("form", FORMS)
def test_late_odometry_replaces_what_was_coasted(form: str) -> None:
    events = [*(odometry(k) for k in range(20)), measured(1550 * MS, "position", "gps", np.random.default_rng(3))]
    lost = {7, 8, 9, 13}
    late = [
        (rank(e)[0] + (1300 * MS if isinstance(e, Odometry) and e.t0_ns // STEP_NS in lost else 0), e) for e in events
    ]
    subject = played(agent(form), late)
    assert_same_estimate(in_time(form, sorted(events, key=rank)), subject)
    assert subject.counters["late.odometry_replayed"] == len(lost)
    assert subject.counters["odometry.coasted"] >= 2


def test_a_late_fix_within_a_gap_of_the_odometry_finds_the_same_coast() -> None:
    """However often a gap is cut, what may have happened in it adds up to the same, also when gone through twice."""
    rng = np.random.default_rng(4)
    drives: list[Event] = [odometry(k) for k in range(20) if k not in range(5, 12)]
    cuts = [measured(t_ms * MS, "heading", "compass", rng) for t_ms in (700, 900, 1100)]
    late = measured(1000 * MS, "heading", "compass", rng)
    events = sorted([*drives, *cuts, late], key=rank)
    deliveries = [(rank(event)[0] + (600 * MS if event is late else 0), event) for event in events]
    assert_same_estimate(in_time("safe", events), played(agent("safe"), deliveries))


@pytest.mark.parametrize("form", FORMS)
def test_what_is_older_than_the_horizon_is_refused_and_counted(form: str) -> None:
    drives: list[tuple[int, Event]] = [((k + 1) * STEP_NS, odometry(k)) for k in range(20) if k != 3]
    plain = played(agent(form, horizon_ns=NS), drives)
    fix = measured(900 * MS, "position", "gps", np.random.default_rng(0))
    late = played(agent(form, horizon_ns=NS), [*drives, (END_NS, fix), (END_NS, odometry(3))])
    assert_same_estimate(plain, late, 0.0)
    assert late.counters["late.too_old"] == 1
    assert late.counters["late.odometry_too_old"] == 1
    assert late.counters["replay.rewinds"] == 0


def test_a_flood_of_late_data_costs_no_more_than_its_allowance() -> None:
    """Half a second of five late fixes a millisecond, each of them before all that was used so far."""
    subject, rng = agent("safe"), np.random.default_rng(5)
    for k in range(20):
        subject.handle(odometry(k))
    count = 500
    for number in range(count):
        late = measured((count - number) * MS, "position", "gps", rng)
        subject.handle(replace(late, t_ns=END_NS + number * MS // 5))
        assert all(size <= bound for size, bound in subject.sizes().values())
    elapsed_s = subject.now_ns / NS
    # What is allowed at first and gained since, and the last rewind, which may do as much again as there is.
    assert subject.counters["replay.steps"] <= MAX_ALLOWANCE + STEPS_PER_S * elapsed_s + count + 20
    assert subject.counters["replay.rewinds"] < count
    played(subject, [])
    assert subject.counters["late.replayed"] == count


def test_data_beyond_what_the_log_holds_cut_the_horizon_short() -> None:
    subject, rng = agent("safe"), np.random.default_rng(6)
    for k in range(20):
        subject.handle(odometry(k))
    for number in range(MAX_LOGGED + 10):
        subject.handle(replace(measured(number * 400_000, "heading", "compass", rng), t_ns=END_NS))
    assert len(subject.sizes()) == 6
    assert all(size <= bound for size, bound in subject.sizes().values())
    assert subject.counters["replay.horizon_cut"] >= 1
    assert subject.counters["late.too_old"] + subject.counters["input.overflow"] >= 10


# --- across contacts ---------------------------------------------------------------------------------------------


class Two:
    """Robots `r1` and `r2` of one form; only `r1` has data of its own. Contacts are at 1.0 s, by a range of `r1`."""

    def __init__(self, form: str, kind: Kind) -> None:
        self.own = agent(form, kind)
        other = replace(self.own.settings, robot="r2", mean=np.array([4.0, 3.0, 0.1]))
        self.peer, self.sent, self._seq = Agent(other), 0, 0

    def own_event(self, event: Event, now_ns: int) -> None:
        """An event for `r1`; what comes of it is carried between both until nothing is left to say."""
        letters = [("r1", item) for item in sends(self.own.handle(replace(event, t_ns=now_ns)))]
        while letters:
            source, letter = letters.pop(0)
            self.sent, self._seq = self.sent + 1, self._seq + 1
            header = Header(source, 1, 1, self._seq, letter.t_meas_ns, now_ns)
            receiver = self.peer if source == "r1" else self.own
            event = Received(now_ns, Message(header, letter.body))
            name = "r2" if source == "r1" else "r1"
            letters += [(name, item) for item in sends(receiver.handle(event))]

    def drive(self, first: int, last: int) -> None:
        for k in range(first, last):
            now_ns = (k + 1) * STEP_NS
            self.peer.handle(odometry(k))
            self.own_event(odometry(k), now_ns)

    def meet(self) -> None:
        found = Observation(NS, NS, "range", "r2", np.array([3.3]), np.array([[0.01]]), "uwb")
        self.own_event(found, NS)


def fix(t_ns: int, seed: int) -> Event:
    return measured(t_ns, "position", "gps", np.random.default_rng(seed))


@pytest.mark.parametrize("form", FORMS)
def test_a_contact_ends_what_is_done_again_and_is_told_once(form: str) -> None:
    """What is earlier than a contact is used as a delayed update right after it, and all later data are used again."""
    timely = Two(form, "compensate")
    timely.drive(0, 10)
    timely.meet()
    for early in (300, 550, 750):
        timely.own_event(fix(early * MS, early), NS)
    for kind, seed in (("position", 5), ("heading", 6)):
        timely.own_event(measured(NS, kind, "gps", np.random.default_rng(seed)), NS)
    timely.drive(10, 14)
    timely.own_event(fix(1400 * MS, 2), 1400 * MS)
    timely.own_event(measured(1400 * MS, "range", "landmark:L1", np.random.default_rng(3)), 1400 * MS)
    timely.drive(14, 18)
    timely.own_event(fix(1800 * MS, 4), 1800 * MS)
    timely.drive(18, 20)

    late = Two(form, "replay")
    late.drive(0, 10)
    late.meet()
    late.own_event(measured(NS, "heading", "gps", np.random.default_rng(6)), NS)
    late.drive(10, 14)
    late.own_event(measured(1400 * MS, "range", "landmark:L1", np.random.default_rng(3)), 1400 * MS)
    late.drive(14, 18)
    late.own_event(fix(1800 * MS, 4), 1800 * MS)
    late.drive(18, 20)
    late.own_event(fix(1400 * MS, 2), END_NS)
    late.own_event(measured(NS, "position", "gps", np.random.default_rng(5)), END_NS)
    for early in (300, 550, 750, 550):
        late.own_event(fix(early * MS, early), END_NS)

    assert timely.own.counters["pair.applied_initiator"] == late.own.counters["pair.applied_initiator"] == 1
    assert timely.sent == late.sent == 2
    assert_same_estimate(timely.own, late.own)
    assert late.own.counters["late.compensated"] == 3
    assert late.own.counters["late.replayed"] == 2
    assert late.own.counters["input.duplicate"] == 1


@pytest.mark.parametrize("form", FORMS)
def test_odometry_from_before_a_contact_is_counted_and_not_used(form: str) -> None:
    two = Two(form, "replay")
    two.drive(0, 5)
    two.drive(6, 10)
    two.meet()
    two.drive(10, 12)
    before = two.own.filter.revision
    two.own_event(odometry(5), 1200 * MS)
    assert two.own.counters["late.odometry_unused"] == 1
    assert two.own.filter.revision is before


def test_of_late_odometry_only_what_lies_within_the_horizon_is_driven_again() -> None:
    """What was coasted over before it stays coasted over."""
    rng = np.random.default_rng(7)
    lost = Odometry(0, 500 * MS, 1100 * MS, np.array([0.3, 0.0, 0.0, 0.1]), np.diag([4e-4, 1e-4, 0.0, 4e-4]))
    cuts = [measured(t_ms * MS, "heading", "compass", rng) for t_ms in (700, 850)]
    others: list[Event] = [odometry(k) for k in range(19) if k not in range(5, 11)]
    timely, coasted, late = (agent("safe", horizon_ns=NS) for _ in range(3))
    for event in sorted([*others, *cuts], key=rank):
        for subject in (coasted, late):
            subject.handle(replace(event, t_ns=rank(event)[0]))
    for event in sorted([*others, *cuts, lost], key=rank):
        timely.handle(replace(event, t_ns=rank(event)[0]))
    late.handle(replace(lost, t_ns=1910 * MS))
    assert late.counters["late.odometry_replayed"] == 1
    history = late.filter.history  # type: ignore[attr-defined]
    oldest = history.cut(history.oldest_ns)
    assert oldest is not None and oldest.t_ns == history.oldest_ns
    best, found, worst = (subject.filter.state.cov for subject in (timely, late, coasted))  # type: ignore[attr-defined]
    assert np.linalg.eigvalsh(found - best).min() > -1e-6
    assert np.trace(best) < np.trace(found) < np.trace(worst)
