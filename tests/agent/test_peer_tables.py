"""Whoever takes ever new names on the air fills no table, and keeps nobody from going on with what was saved."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from agent.core import Agent
from agent.effects import Send
from agent.events import LinkChange, Observation, Odometry, Received
from agent.figures import MAX_KINDS
from agent.peer_tables import remember
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings
from network.messages import Header, Message, PairReply, PairRequest, ReplyStatus
from network.peers import MAX_PEERS

FORMS = ("safe", "published", "joint", "split_joint", "auto")
DELTA, NOISE = np.array([0.1, 0.0, 0.0, 0.0]), np.diag([0.01, 0.01, 0.0, 0.01])


def agent(form: Any, robot: str = "r1") -> Agent:
    localization = LocalizationSettings(form=form, pair_interval_ns=0)
    place, cov = np.array([3.0 if robot != "r1" else 0.0, 0.0, 0.0]), np.diag([0.25, 0.25, 0.01])
    lateness = LatenessSettings(horizon_ns=60 * NS)
    return Agent(AgentSettings(robot, 0, place, cov, localization=localization, lateness=lateness, track=False))


def request(form: str, peer: str, kinds: tuple[str, ...] = ("bearing",)) -> Received:
    """A genuine request to r1 about its start, of a robot that has just come on the air."""
    asker = agent(form, peer)
    asker.handle(Odometry(0, 0, 0, DELTA, NOISE))
    effects: list[Any] = []
    for index, kind in enumerate(kinds):
        z = {"bearing": [np.pi], "range": [3.0], "range_bearing": [3.0, np.pi]}[kind]
        seen = Observation(0, 0, kind, "r1", np.array(z), 0.01 * np.eye(len(z)), f"sensor{index}")
        effects += asker.handle(seen)
    (sent,) = [effect for effect in effects if isinstance(effect, Send)]
    return Received(0, Message(Header(peer, 1, 1, 0, 0, 0), sent.body))


@pytest.mark.parametrize("form", FORMS)
def test_ever_new_names_leave_a_state_that_a_restart_can_read(form: str) -> None:
    found = agent(form)
    found.handle(LinkChange(0, "r2", True, 1, 1))
    found.handle(request(form, "r2"))
    for index in range(3 * MAX_PEERS):
        found.handle(LinkChange(0, f"x-{index}", True, 1, index))
    payload = found.saved()
    assert payload is not None
    assert "r2" in Agent(found.settings, payload).filter.contacts()
    # The life of a robot that was met is not forgotten: that it begins another one is noticed.
    found.handle(LinkChange(0, "r2", True, 2, 2))
    assert found.counters["pair.restarts"] == 1


@pytest.mark.parametrize("form", ["safe", "published", "joint", "split_joint"])
def test_there_is_room_for_so_many_pairs_and_the_first_ones_stay(form: str) -> None:
    found = agent(form)
    for index in range(MAX_PEERS + 5):
        found.handle(request(form, f"x-{index:03}"))
        found.handle(Received(0, Message(Header(f"y-{index}", 1, 1, 0, 0, 0), refusal_of(f"y-{index}"))))
    assert found.counters["pair.too_many_peers"] == 5
    again = request(form, "x-000")
    before = found.counters["pair.too_many_peers"]
    found.handle(again)
    assert found.counters["pair.too_many_peers"] == before
    payload = found.saved()
    assert payload is not None
    Agent(found.settings, payload)


def refusal_of(peer: str) -> PairReply:
    """An answer to a request that was never sent."""
    body = request("safe", "r2").message.body
    assert isinstance(body, PairRequest)
    return PairReply(replace(body.epoch, initiator="r1"), ReplyStatus.BUSY)


def test_figures_are_kept_of_so_many_kinds_of_contacts_however_they_are_mixed() -> None:
    found = agent("split_joint")
    for index, kinds in enumerate(product(("bearing", "range"), repeat=7)):
        found.figures.count_nis("pair_" + "+".join(kinds), 1.0 + index)
    assert len(found.nis) == MAX_KINDS
    assert found.nis["other"].count == 2**7 - (MAX_KINDS - 1)
    found.figures.count_nis("pair_" + "+".join(["bearing"] * 7), 1.0)
    assert found.nis["pair_" + "+".join(["bearing"] * 7)].count == 2


def test_a_table_forgets_who_was_put_longest_ago_but_for_those_to_keep() -> None:
    table: dict[str, int] = {}
    for index in range(MAX_PEERS):
        remember(table, f"p{index}", index, ("p0",))
    remember(table, "p1", 1, ("p0",))
    remember(table, "new", 0, ("p0",))
    assert len(table) == MAX_PEERS and {"p0", "p1", "new"} <= table.keys() and "p2" not in table
