"""The virtual engine: equal arguments give equal runs, and everything goes over the wire and its links."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from agent.effects import Effect, Send
from agent.events import Event, LinkChange, Observation, Received
from agent.node import Node, Outgoing
from network.links import FateRecord, packet_fate
from network.messages import Packet, PairReply, PairRequest, ReplyStatus, SplitReply, SplitRequest
from sim.engine import TrialResult, VirtualEngine, network_figures
from sim.metrics import StateTrace
from sim.sampling import sample_stride
from sim.scenario import Scenario
from sim.scenario_checks import check
from sim.trial import open_world

S = 1_000_000_000


def scenario(links: dict[str, Any] | None = None, **change: Any) -> Scenario:
    """Robots that start 4 m apart, move slowly, range each other and track a target."""
    parts = [
        {
            "id": f"r{index + 1}",
            "start": {"pose": [4.0 * index, 0.5 * index, 0.5]},
            "start_sigma": {"position_m": 0.5, "heading_rad": 0.1},
            "control": {"speed_mps": 0.3, "yaw_rate_radps": 0.1},
            "noise": {"speed_mps": 0.1, "yaw_rate_radps": 0.02},
            "sensors": {
                "range": {"of": ["peers"], "sigma_m": 0.1},
                "eye": {"kind": "range", "of": ["targets"], "sigma_m": 0.1},
            },
        }
        for index in range(3)
    ]
    target = {
        "id": "t1",
        "start": {"pose": [3.0, 8.0, 0.0]},
        "start_sigma": {"position_m": 1.0, "heading_rad": 0.1},
        "noise": {"speed_mps": 0.1, "yaw_rate_radps": 0.1},
    }
    data = {
        "version": 1,
        "name": "test",
        "duration_s": 20.0,
        "step_s": 1.0,
        "window_s": [0.0, 20.0],
        "robots": parts,
        "targets": [target],
        "links": links or {},
    }
    made = Scenario.model_validate(data | change)
    check(made)
    return made


class Run:
    """One trial with all that can be observed of it from outside."""

    def __init__(self, made: Scenario, seed: int = 1, with_bound: bool = False) -> None:
        self.scenario = made
        self.world = open_world(made, seed)
        self.events: list[tuple[str, Event, list[Effect]]] = []
        self.fates: list[FateRecord] = []
        self.engine = VirtualEngine(
            made,
            self.world,
            seed,
            with_bound=with_bound,
            recorders={robot: self._recorder(robot) for robot in self.world.robots},
            fate_sink=self.fates.append,
        )
        self.result = self.engine.run()

    def _recorder(self, robot: str) -> Any:
        return lambda event, effects: self.events.append((robot, event, effects))

    def endpoint_sum(self, name: str) -> int:
        return sum(node.endpoint.counters[name] for node in self.engine.nodes.values())


def assert_equal_traces(left: StateTrace, right: StateTrace) -> None:
    for name in ("truth", "mean", "cov"):
        np.testing.assert_array_equal(getattr(left, name), getattr(right, name))


def assert_equal_results(left: TrialResult, right: TrialResult) -> None:
    for name in ("contacts", "network", "rejected", "nis", "counters"):
        assert getattr(left, name) == getattr(right, name)
    assert left.trace.robots.keys() == right.trace.robots.keys()
    for robot in left.trace.robots:
        assert_equal_traces(left.trace.robots[robot], right.trace.robots[robot])
        assert_equal_traces(left.trace.targets["t1"][robot], right.trace.targets["t1"][robot])


HARSH = {"loss": 0.2, "delay_s": 0.1, "delay_tail_s": 0.2, "duplicate": 0.2, "range_m": 7.0}


# --- determinism ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("links", [{}, HARSH], ids=["perfect", "harsh"])
def test_a_run_repeated_is_equal_bit_for_bit(links: dict[str, Any]) -> None:
    one, other = Run(scenario(links)), Run(scenario(links))
    assert_equal_results(one.result, other.result)
    assert one.fates == other.fates
    assert one.result.contacts


def test_watching_a_run_does_not_change_it() -> None:
    made = scenario(HARSH)
    plain = VirtualEngine(made, open_world(made, 1), 1).run()
    assert_equal_results(plain, Run(made, with_bound=True).result)
    assert plain.trace.bound is None


def test_another_seed_is_another_run() -> None:
    one, other = Run(scenario(), 1).result, Run(scenario(), 2).result
    assert not np.array_equal(one.trace.robots["r1"].mean, other.trace.robots["r1"].mean)


def test_every_relative_measurement_the_world_offers_is_noted() -> None:
    run = Run(scenario())
    offered: dict[tuple[str, str], list[float]] = {}
    for k in range(1, run.world.steps + 1):
        for item in run.world.outputs(k):
            if item.of is not None:
                offered.setdefault((item.robot, item.of), []).append(item.t_ns * 1e-9)
    assert ("r1", "target:t1") in offered
    assert sorted(run.result.measured) == sorted(offered)
    for key, times in offered.items():
        np.testing.assert_allclose(run.result.measured[key], times)


# --- order of events --------------------------------------------------------------------------------------


def test_with_zero_delay_an_exchange_completes_before_anything_else_happens() -> None:
    run = Run(scenario())
    exchanges = refused = 0
    for index, (robot, event, effects) in enumerate(run.events):
        sends = [effect for effect in effects if isinstance(effect, Send)]
        sent = [effect for effect in sends if isinstance(effect.body, PairRequest | SplitRequest)]
        if not sent:
            continue
        (request,) = sent
        asked, asked_event, _ = run.events[index + 1]
        answered, answer_event, _ = run.events[index + 2]
        assert isinstance(asked_event, Received) and isinstance(answer_event, Received)
        assert isinstance(asked_event.message.body, PairRequest | SplitRequest)
        assert isinstance(answer_event.message.body, PairReply | SplitReply)
        assert (asked, answered) == (request.peer, robot)
        assert asked_event.message.body.epoch == answer_event.message.body.epoch == request.body.epoch
        assert event.t_ns == asked_event.t_ns == answer_event.t_ns
        exchanges += 1
        # A peer that keeps no factors any more refuses a request with some; then both go on without.
        answer = answer_event.message.body
        refused += isinstance(answer, PairReply) and answer.status is ReplyStatus.OTHER_FORM
    assert exchanges - refused == run.result.network["pair"]["completed"] > 5
    assert refused <= len(run.scenario.robots)


def test_no_event_goes_back_in_time_and_data_arrive_at_their_instants() -> None:
    run = Run(scenario(HARSH))
    instants = [event.t_ns for _, event, _ in run.events]
    assert instants == sorted(instants)
    for _, event, _ in run.events:
        if isinstance(event, Observation):
            assert event.t_ns == event.t_meas_ns


def test_nothing_from_beyond_the_end_is_played() -> None:
    run = Run(scenario({"delay_s": 0.7}))
    assert max(event.t_ns for _, event, _ in run.events) <= 20 * S


# --- links ------------------------------------------------------------------------------------------------


def test_a_delay_passes_in_virtual_time() -> None:
    run = Run(scenario({"delay_s": 0.25}))
    delays = {event.t_ns - event.message.header.t_send_ns for _, event, _ in run.events if isinstance(event, Received)}
    assert delays == {S // 4}
    assert run.result.network["pair"]["completed"] > 5
    assert {round(t % 1.0, 6) for t, _, _ in run.result.contacts} == {0.25, 0.5}


def test_when_everything_is_lost_nobody_meets() -> None:
    run = Run(scenario({"loss": 1.0}))
    assert run.result.contacts == []
    assert not any(isinstance(event, Received | LinkChange) for _, event, _ in run.events)
    figures = run.result.network
    assert (figures["delivered"], figures["pair"]["completed"], figures["pair"]["one_sided"]) == (0, 0, 0)
    assert figures["lost"] == len(run.fates) > 0
    assert figures["pair"]["started"] > 0


def test_links_end_where_the_range_ends() -> None:
    """Positions of the instant count: robots on the edge of the range come and go."""
    plain = scenario().model_dump(exclude_none=True)["robots"]
    plain[1]["control"] = {"speed_mps": 1.0, "yaw_rate_radps": 0.5}
    run = Run(scenario({"range_m": 5.0}, robots=plain, duration_s=60.0, window_s=[0.0, 60.0]))
    states: dict[tuple[str, str], list[bool]] = {}
    for fate in run.fates:
        k = fate.t_send_ns // S
        gap = np.linalg.norm((run.world.truth(fate.source, k) - run.world.truth(fate.destination, k))[:2])
        assert fate.in_range == (gap <= 5.0)
        states.setdefault((fate.source, fate.destination), []).append(fate.in_range)
    changes = sum(before != after for seen in states.values() for before, after in pairwise(seen))
    assert changes > 10, changes
    assert {(a, b) for _, a, b in run.result.contacts} <= {(f.destination, f.source) for f in run.fates if f.in_range}


@pytest.mark.parametrize("links", [{}, HARSH], ids=["perfect", "harsh"])
def test_traffic_adds_up(links: dict[str, Any]) -> None:
    run = Run(scenario(links))
    figures = run.result.network
    arrived = [fate for fate in run.fates if fate.in_range and not fate.lost]
    assert figures["delivered"] == len(arrived)
    assert figures["lost"] == len(run.fates) - len(arrived)
    assert figures["sent"] == run.endpoint_sum("sent")
    assert figures["bytes"] == run.endpoint_sum("sent_bytes") > 0
    hellos = {(fate.source, fate.seq) for fate in run.fates if fate.channel == "hello"}
    directed = [fate for fate in run.fates if fate.channel == "pair"]
    assert figures["sent"] == len(hellos) + len(directed)
    assert len(run.fates) == 2 * len(hellos) + len(directed)
    assert run.endpoint_sum("received") == sum(len(arrivals(run, fate)) for fate in arrived)
    for node in run.engine.nodes.values():
        counters = node.endpoint.counters
        refused = sum(count for name, count in counters.items() if name.startswith("rejected."))
        assert counters["received"] == counters["delivered"] + counters["hellos"] + refused


def arrivals(run: Run, record: FateRecord) -> list[int]:
    """Instants within the run at which a packet arrives."""
    fate = packet_fate(
        run.scenario.links.settings(seed=1),
        source=record.source,
        destination=record.destination,
        channel=record.channel,
        incarnation=record.incarnation,
        seq=record.seq,
    )
    delays = [fate.delay_ns] if fate.duplicate_delay_ns is None else [fate.delay_ns, fate.duplicate_delay_ns]
    return [record.t_send_ns + delay for delay in delays if record.t_send_ns + delay <= 20 * S]


def test_every_message_really_crosses_the_wire(monkeypatch: pytest.MonkeyPatch) -> None:
    """Damage on the way is noticed: what a robot hears is decoded from bytes."""
    hear = Node.on_packet

    def damaged(self: Node, now_ns: int, packet: Packet) -> Outgoing:
        payload = bytes([packet.payload[0] ^ 0xFF]) + packet.payload[1:]
        return hear(self, now_ns, Packet(packet.source, packet.channel, packet.destination, payload))

    monkeypatch.setattr(Node, "on_packet", damaged)
    result = Run(scenario()).result
    assert result.contacts == []
    assert sum(result.rejected.values()) == result.network["delivered"] > 0


def test_a_duplicate_is_refused_by_name_and_used_once() -> None:
    run = Run(scenario({"duplicate": 1.0}))
    assert run.result.rejected == {"duplicate": len(run.fates)}
    once = Run(scenario())
    np.testing.assert_array_equal(run.result.trace.robots["r3"].mean, once.result.trace.robots["r3"].mean)


@pytest.mark.parametrize("links", [{}, HARSH], ids=["perfect", "harsh"])
def test_every_contact_applied_is_listed_once(links: dict[str, Any]) -> None:
    run = Run(scenario(links))
    for robot, counters in run.result.counters.items():
        applied = counters.get("pair.applied_initiator", 0) + counters.get("pair.applied_responder", 0)
        assert applied == sum(own == robot for _, own, _ in run.result.contacts) > 0


# --- figures ----------------------------------------------------------------------------------------------


def test_samples_cover_the_run_and_start_with_the_initial_beliefs() -> None:
    run = Run(scenario(step_s=0.5))
    trace = run.result.trace
    np.testing.assert_allclose(trace.t_s, np.arange(21.0))
    for robot in run.world.robots:
        mean, cov = run.world.start_belief(robot)
        np.testing.assert_array_equal(trace.robots[robot].mean[0], mean)
        np.testing.assert_array_equal(trace.robots[robot].cov[0], cov)
        np.testing.assert_array_equal(trace.robots[robot].truth[7], run.world.truth(robot, 14))
        assert np.all(np.isfinite(trace.targets["t1"][robot].cov))
        assert np.all(np.linalg.eigvalsh(trace.robots[robot].cov) > 0.0)


@pytest.mark.parametrize(("step_s", "stride"), [(0.01, 100), (0.1, 10), (0.5, 2), (1.0, 1), (2.0, 1)])
def test_figures_are_sampled_once_a_second_at_most(step_s: float, stride: int) -> None:
    assert sample_stride(round(step_s * S)) == stride


def test_figures_are_sampled_more_often_if_they_are_to_be() -> None:
    assert sample_stride(S // 10, S // 5) == 2


def test_a_robot_that_tracks_nothing_has_no_tracks() -> None:
    plain = scenario().model_dump(exclude_none=True)["robots"]
    plain[0]["tracking"] = {"kind": "none"}
    tracks = Run(scenario(robots=plain)).result.trace.targets["t1"]
    assert np.all(np.isnan(tracks["r1"].mean))
    assert np.all(np.isfinite(tracks["r2"].mean))


def test_progress_is_told_step_by_step() -> None:
    made = scenario()
    told: list[tuple[int, int]] = []
    VirtualEngine(made, open_world(made, 1), 1).run(lambda done, of: told.append((done, of)))
    assert told == [(k, 20) for k in range(1, 21)]


def test_pair_figures_are_sums_over_the_fleet() -> None:
    own = {
        "r1": {"pair.started": 5, "pair.applied_initiator": 3, "pair.fallback": 1},
        "r2": {"pair.started": 1, "pair.applied_responder": 4, "pair.too_old": 2},
    }
    figures = network_figures(Counter(sent=9, delivered=7, lost=2, bytes=900), own)
    assert figures == {
        "sent": 9,
        "delivered": 7,
        "lost": 2,
        "bytes": 900,
        "pair": {"started": 6, "completed": 3, "one_sided": 1, "fallback": 1, "too_old": 2},
    }
