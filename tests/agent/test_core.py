"""The core: order of time, late data, odometry cut at measurements, and whatever foreign input can be."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from agent.core import Agent
from agent.effects import Send
from agent.estimation.motion import LAYOUTS, SpatialMotion, TargetMotion, split_increment
from agent.events import ClockJudged, Event, Fix, Observation, Odometry, Tick
from agent.recording import pack
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings, TargetSettings
from network.messages import PairRequest

Array = NDArray[np.float64]

MS = 1_000_000
NOISE = np.diag([0.02, 0.01, 0.0, 0.001])


def agent(**lateness: object) -> Agent:
    return Agent(
        AgentSettings(
            robot="r1",
            start_ns=0,
            mean=np.array([1.0, 2.0, 0.4]),
            cov=np.diag([0.3, 0.2, 0.05]),
            landmarks={"L1": (5.0, 1.0)},
            localization=LocalizationSettings(form="safe", transform="jacobian"),
            lateness=replace(LatenessSettings(), **lateness),  # type: ignore[arg-type]
        )
    )


def odometry(t0_ns: int, t_ns: int, now_ns: int | None = None, dx: float = 0.3) -> Odometry:
    return Odometry(t_ns if now_ns is None else now_ns, t0_ns, t_ns, np.array([dx, 0.02, 0.0, 0.05]), NOISE)


def position(t_ns: int, now_ns: int, x: float = 1.2) -> Fix:
    return Fix(now_ns, t_ns, "position", np.array([x, 2.1]), np.diag([0.04, 0.05]), "gps")


def landmark(t_ns: int, now_ns: int) -> Observation:
    return Observation(now_ns, t_ns, "range", "landmark:L1", np.array([4.0]), np.array([[0.01]]))


def fed(subject: Agent, *events: Event) -> Agent:
    for event in events:
        subject.handle(event)
    return subject


def assert_same_belief(one: Agent, other: Agent, tolerance: float) -> None:
    assert one.filter.state.t_ns == other.filter.state.t_ns
    assert np.abs(one.filter.state.mean - other.filter.state.mean).max() <= tolerance
    assert np.abs(one.filter.state.cov - other.filter.state.cov).max() <= tolerance


def test_odometry_is_cut_at_a_measurement() -> None:
    """A fix in the middle of an increment acts as if the increment had come in two parts."""
    half = NS // 2
    first, first_cov, second, second_cov = split_increment(odometry(0, NS).delta, NOISE, 0.5)
    parts = fed(
        agent(),
        Odometry(half, 0, half, first, first_cov),
        position(half, half),
        Odometry(NS, half, NS, second, second_cov),
    )
    cut = fed(agent(settle_ns=100 * MS), position(half, half), odometry(0, NS), Tick(2 * NS))
    assert_same_belief(parts, cut, 1e-12)
    # A fix that comes when the state has passed it is compensated: the same to first order.
    late = fed(agent(), odometry(0, NS), position(half, NS))
    assert late.counters["late.compensated"] == 1
    assert_same_belief(parts, late, 2e-3)


def test_a_late_fix_equals_the_timely_one_when_linear() -> None:
    """Heading known, no other update in between: compensation is exact."""

    def known_heading() -> Agent:
        base = agent()
        return Agent(replace(base.settings, cov=np.diag([0.3, 0.2, 1e-12])))

    noise = np.diag([0.02, 0.01, 0.0, 0.0])
    drives = [Odometry((k + 1) * NS, k * NS, (k + 1) * NS, np.array([0.3, 0.1, 0.0, 0.0]), noise) for k in range(4)]
    timely = fed(known_heading(), drives[0], position(NS, NS), *drives[1:])
    late = fed(known_heading(), *drives, position(NS, 4 * NS))
    assert_same_belief(timely, late, 1e-9)
    assert late.counters["late.compensated"] == 1


def test_late_data_never_claim_more_than_timely_ones() -> None:
    drives = [odometry(k * NS, (k + 1) * NS) for k in range(4)]
    timely = fed(agent(), drives[0], position(NS, NS), drives[1], landmark(2 * NS, 2 * NS), *drives[2:])
    late = fed(agent(), drives[0], drives[1], landmark(2 * NS, 2 * NS), *drives[2:], position(NS, 4 * NS))
    assert np.linalg.eigvalsh(late.filter.state.cov - timely.filter.state.cov).min() > -1e-3
    assert np.trace(late.filter.state.cov) >= np.trace(timely.filter.state.cov) - 1e-9


def test_late_data_are_dropped_when_told_so_or_too_old() -> None:
    dropped = fed(agent(kind="discard"), odometry(0, NS), position(NS // 2, NS))
    assert dropped.counters["late.dropped"] == 1
    old = agent(horizon_ns=NS)
    fed(old, *(odometry(k * NS, (k + 1) * NS) for k in range(5)), position(NS, 5 * NS))
    assert old.counters["late.dropped"] == 1


def test_a_gap_in_odometry_is_coasted_with_growing_covariance() -> None:
    subject = fed(agent(), odometry(0, NS))
    before = subject.filter.state.cov
    fed(subject, odometry(3 * NS, 4 * NS))
    assert subject.counters["odometry.coasted"] == 1
    assert subject.filter.state.t_ns == 4 * NS
    # Two seconds at the coasting speed of 0.5 m/s and 0.5 rad/s, one sigma.
    assert subject.filter.state.cov[0, 0] > before[0, 0] + 0.99
    assert subject.filter.state.cov[2, 2] > before[2, 2] + 0.99


def test_data_wait_for_odometry_and_then_coast() -> None:
    subject = fed(agent(odometry_wait_ns=NS), position(NS, NS))
    assert subject.filter.state.t_ns == 0
    assert subject.next_deadline_ns() == 2 * NS
    fed(subject, Tick(2 * NS))
    assert subject.filter.state.t_ns == NS
    assert subject.counters["used.position"] == 1


def test_any_order_of_arrival_gives_the_same_estimate() -> None:
    """Within the settling time the order of arrival does not matter, to the bit."""
    inputs = [
        odometry(0, NS, now_ns=NS),
        position(NS, NS),
        landmark(NS, NS),
        Fix(NS, NS, "heading", np.array([0.5]), np.array([[0.02]]), "compass"),
    ]
    results = set()
    for arrival in permutations(inputs):
        subject = fed(agent(settle_ns=NS // 2), *arrival, Tick(2 * NS))
        assert subject.counters["used.position"] == subject.counters["used.heading"] == 1
        state = subject.filter.state
        results.add((state.t_ns, state.mean.tobytes(), state.cov.tobytes()))
    assert len(results) == 1


def test_equal_events_give_equal_effects() -> None:
    events = [odometry(k * NS, (k + 1) * NS) for k in range(5)]
    events[2:2] = [position(2 * NS, 2 * NS), landmark(2 * NS, 2 * NS)]  # type: ignore[list-item]
    first, second = agent(), agent()
    for event in events:
        assert [pack(e) for e in first.handle(event)] == [pack(e) for e in second.handle(event)]


@pytest.mark.parametrize(
    ("event", "counter"),
    [
        (Observation(NS, NS, "smell", "r2", np.zeros(1), np.eye(1)), "observation.unknown_kind"),
        (Observation(NS, NS, "range", None, np.ones(1), np.eye(1)), "observation.no_identity"),
        (Observation(NS, NS, "range", "r1", np.ones(1), np.eye(1)), "observation.of_self"),
        (Observation(NS, NS, "range", "landmark:no", np.ones(1), np.eye(1)), "observation.unknown_landmark"),
        (Observation(NS, NS, "range", "target:no", np.ones(1), np.eye(1)), "observation.unknown_target"),
        (Observation(NS, NS, "range", "r0", np.ones(1), np.eye(1)), "pair.not_owner"),
        (Fix(NS, NS, "altitude", np.ones(1), np.eye(1)), "fix.unused_kind"),
        (Fix(NS, 10**18, "position", np.ones(2), np.eye(2)), "input.future"),
        (odometry(NS, NS // 2, now_ns=NS), "odometry.out_of_order"),
        (odometry(-2 * NS, -NS, now_ns=NS), "odometry.out_of_order"),
    ],
)
def test_what_is_not_used_is_counted(event: Event, counter: str) -> None:
    subject = fed(agent(), odometry(0, NS))
    before = subject.filter.state
    subject.handle(event)
    assert subject.counters[counter] == 1
    assert subject.filter.state.mean is before.mean


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 0, 2)])
def test_the_higher_id_keeps_what_is_its_own_besides_a_two_way_range(order: tuple[int, ...]) -> None:
    """Bearing and one-way range of a lower id count, whatever comes first; the two-way range is the lower id's."""
    base = agent(settle_ns=NS // 2).settings
    subject = Agent(replace(base, one_way_sensors=("camera",)))
    seen = [
        Observation(NS, NS, "range", "r0", np.array([3.0]), np.eye(1), "uwb"),
        Observation(NS, NS, "bearing", "r0", np.array([0.1]), np.eye(1), "camera"),
        Observation(NS, NS, "range", "r0", np.array([3.0]), np.eye(1), "camera"),
    ]
    fed(subject, odometry(0, NS), *(seen[index] for index in order))
    (request,) = [effect.body for effect in subject.handle(Tick(2 * NS)) if isinstance(effect, Send)]
    assert isinstance(request, PairRequest)
    assert sorted(item.kind for item in request.measurements) == ["bearing", "range"]
    assert subject.counters["pair.not_owner"] == 1


def test_no_contact_is_opened_to_a_peer_whose_clock_is_of_no_use() -> None:
    """And the measurement that goes unused has its reason; once nothing speaks against the clock, it goes on."""
    subject = agent()

    def opened(t_s: int) -> int:
        made = subject.handle(Observation(t_s * NS, t_s * NS, "range", "r2", np.array([4.0]), np.array([[0.01]])))
        made += subject.handle(Tick((t_s + 1) * NS))
        return sum(isinstance(effect, Send) and isinstance(effect.body, PairRequest) for effect in made)

    assert opened(1) == 1
    subject.handle(ClockJudged(10 * NS, "r2", "offset"))
    assert opened(10) == 0
    assert subject.counters["observation.clock_unusable"] == 1
    subject.handle(ClockJudged(20 * NS, "r2", None))
    assert opened(20) == 1
    assert subject.counters["observation.clock_unusable"] == 1


def test_buffers_are_bounded() -> None:
    subject = agent(horizon_ns=3 * NS)
    for k in range(20):
        fed(subject, odometry(k * NS, (k + 1) * NS))
    assert len(subject.filter.history) <= 5
    for _ in range(2000):
        fed(subject, landmark(22 * NS, 20 * NS))
    assert subject.counters["input.overflow"] > 1000


STAMPS = st.integers(0, 400)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from(["odometry", "fix", "landmark", "tick"]), STAMPS, st.integers(1, 60), STAMPS),
        max_size=40,
    ),
    st.sampled_from([0, 1, 15, 50]),
    st.sampled_from([0, 30]),
)
def test_no_order_of_stamps_stalls_the_core(
    inputs: list[tuple[str, int, int, int]], tolerance_ms: int, settle_ms: int
) -> None:
    """Increments of any length, overlapping, with gaps, late and early: the core ends, and time never goes back."""
    subject = agent(tolerance_ns=tolerance_ms * MS, settle_ns=settle_ms * MS)
    reached = 0
    for kind, start, length, now in inputs:
        t_ns, end_ns, now_ns = start * MS, (start + length) * MS, now * MS
        if kind == "odometry":
            subject.handle(odometry(t_ns, end_ns, now_ns=now_ns, dx=0.01))
        elif kind == "fix":
            subject.handle(position(t_ns, now_ns))
        elif kind == "landmark":
            subject.handle(landmark(t_ns, now_ns))
        else:
            subject.handle(Tick(now_ns))
        assert subject.filter.state.t_ns >= reached
        reached = subject.filter.state.t_ns
        assert subject.next_deadline_ns() >= subject.now_ns
        np.linalg.cholesky(subject.filter.state.cov)


# --- sightings of targets that come late -------------------------------------------------------------------------


def tracker() -> Agent:
    layout = LAYOUTS["constant_velocity"]
    motion = TargetMotion(layout, noise_sigma=(0.3, 0.3))
    target = TargetSettings("t1", motion, np.array([5.0, 3.0, 0.1, 0.0]), np.eye(4))
    return Agent(replace(agent().settings, cov=np.diag([0.3, 0.2, 1e-12]), targets=(target,)))


def sighted(t_ns: int, now_ns: int) -> Observation:
    return Observation(now_ns, t_ns, "vector", "target:t1", np.array([4.4, -0.6]), 0.02 * np.eye(2))


def straight(k: int) -> Odometry:
    still = np.diag([0.02, 0.01, 0.0, 0.0])
    return Odometry((k + 1) * NS, k * NS, (k + 1) * NS, np.array([0.3, 0.1, 0.0, 0.0]), still)


def test_a_late_sighting_of_a_target_equals_the_timely_one_when_linear() -> None:
    drives = [straight(k) for k in range(3)]
    timely = fed(tracker(), drives[0], sighted(NS, NS), *drives[1:])
    late = fed(tracker(), *drives, sighted(NS, 3 * NS))
    assert late.counters["late.target_compensated"] == 1
    assert_same_belief(timely, late, 1e-9)
    for one, other in zip(timely.estimate().tracks, late.estimate().tracks):
        np.testing.assert_allclose(one.mean, other.mean, atol=1e-9)
        np.testing.assert_allclose(one.cov, other.cov, atol=1e-9)


def test_a_sighting_from_before_the_last_one_is_not_used_twice() -> None:
    drives = [straight(k) for k in range(3)]
    seen = fed(tracker(), *drives, sighted(3 * NS, 3 * NS))
    before = seen.estimate().tracks[0].cov
    fed(seen, sighted(2 * NS, 3 * NS))
    assert seen.counters["late.target_dropped"] == 1
    np.testing.assert_array_equal(seen.estimate().tracks[0].cov, before)
    twice = fed(tracker(), *drives, sighted(NS, 3 * NS), sighted(2 * NS, 3 * NS))
    assert twice.counters["late.target_dropped"] == 1


# --- with an altitude --------------------------------------------------------------------------------------


def drone(altitude_m: float = 10.0) -> Agent:
    return Agent(
        replace(
            agent().settings,
            mean=np.array([1.0, 2.0, altitude_m, 0.4]),
            cov=np.diag([0.3, 0.2, 0.1, 0.05]),
            motion=SpatialMotion(),
            landmarks={"L1": (2.0, 2.5), "high": (5.0, 1.0, 30.0)},
        )
    )


def fix(kind: str, *z: float) -> Fix:
    return Fix(NS, NS, kind, np.array(z), np.eye(len(z)) * 0.01, "nav")


def seen_from_above(of: str, attitude: tuple[float, float] = (0.0, 0.0)) -> Observation:
    down = (0.0, 0.0, 0.0, 0.0, np.pi / 2, 0.0)
    return Observation(NS, NS, "pixel", of, np.array([0.05, 0.0]), np.eye(2) * 1e-4, "camera", down, attitude)


@pytest.mark.parametrize(
    ("kind", "size"), [("position", 2), ("position", 3), ("pose", 3), ("pose", 4), ("altitude", 1)]
)
def test_a_drone_uses_what_a_fix_says_of_its_state(kind: str, size: int) -> None:
    z = {"position": [1.5, 2.5, 11.0], "pose": [1.5, 2.5, 11.0, 0.5], "altitude": [11.0]}[kind]
    z = [1.5, 2.5, 0.5] if (kind, size) == ("pose", 3) else z[:size]
    subject = fed(drone(), odometry(0, NS, dx=0.0), fix(kind, *z))
    assert subject.counters[f"used.{kind}"] == 1
    mean = subject.estimate().mean
    assert (mean[2] > 10.5) == (11.0 in z)
    assert (mean[0] > 1.3) == (1.5 in z)


def test_a_rover_leaves_out_the_altitude_of_a_fix() -> None:
    flat = fed(agent(), odometry(0, NS), fix("position", 1.5, 2.5))
    high = fed(agent(), odometry(0, NS), fix("position", 1.5, 2.5, 80.0))
    assert_same_belief(flat, high, 1e-12)
    assert_same_belief(
        fed(agent(), odometry(0, NS), fix("pose", 1.5, 2.5, 0.5)),
        fed(agent(), odometry(0, NS), fix("pose", 1.5, 2.5, 80.0, 0.5)),
        1e-12,
    )
    alone = fed(agent(), odometry(0, NS), fix("altitude", 80.0))
    assert alone.counters["fix.unused_kind"] == 1


def test_a_pixel_of_what_is_behind_the_camera_is_refused_and_counted() -> None:
    below = fed(drone(), odometry(0, NS), seen_from_above("landmark:L1"))
    assert below.counters["used.landmark_pixel"] == 1
    above = fed(drone(), odometry(0, NS), seen_from_above("landmark:high"))
    assert above.counters["observation.out_of_view"] == 1
    assert above.counters["update.failed"] == 0
    assert_same_belief(above, fed(drone(), odometry(0, NS)), 1e-15)


def test_the_attitude_of_the_body_counts() -> None:
    level = fed(drone(), odometry(0, NS), seen_from_above("landmark:L1"))
    tilted = fed(drone(), odometry(0, NS), seen_from_above("landmark:L1", (0.0, 0.1)))
    shift = tilted.estimate().mean[:2] - level.estimate().mean[:2]
    heading = level.estimate().mean[3]
    # With the nose down the same pixel is of what lies further back, so the robot is further ahead.
    assert shift @ [np.cos(heading), np.sin(heading)] > 0.3


def test_a_peer_is_told_of_a_level_camera() -> None:
    (effect,) = [
        item
        for item in drone().handle(replace(seen_from_above("r2", (0.1, 0.2)), t_ns=0, t_meas_ns=0))
        if isinstance(item, Send)
    ]
    assert isinstance(effect.body, PairRequest)
    (measurement,) = effect.body.measurements
    assert measurement.kind == "pixel"
    assert measurement.mount != seen_from_above("r2").mount
    assert effect.body.snapshot.belief.model == "spatial"
