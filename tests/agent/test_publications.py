"""What people are told: estimates no more often than they can look, equal alarms once per window."""

from __future__ import annotations

import logging
import time

import msgpack
import numpy as np
import pytest

from agent.effects import Alarm, Estimate, RelativeEstimate, TrackEstimate
from agent.publications import ALARM_INTERVAL_S, PUBLISH_INTERVAL_S, Publications, estimate_bytes

ESTIMATE = Estimate(
    5,
    "unicycle",
    np.array([1.0, 2.0, 0.5]),
    np.eye(3),
    (TrackEstimate("t1", "unicycle", np.zeros(3), 2.0 * np.eye(3), 4),),
)


class Wall:
    """Wall time that is set by hand."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.s = 1000.0
        monkeypatch.setattr(time, "monotonic", lambda: self.s)


def test_an_estimate_is_told_as_plain_lists(monkeypatch: pytest.MonkeyPatch) -> None:
    Wall(monkeypatch)
    payload = Publications().estimate(ESTIMATE)
    assert payload is not None
    told = msgpack.unpackb(payload)
    assert (told["t_ns"], told["model"], told["mean"]) == (5, "unicycle", [1.0, 2.0, 0.5])
    assert told["cov"] == np.eye(3).tolist() and told["tracks"]["t1"] == [[0.0] * 3, (2.0 * np.eye(3)).tolist()]


def test_estimates_are_told_at_a_bounded_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    wall, subject = Wall(monkeypatch), Publications()
    assert subject.estimate(ESTIMATE) is not None
    wall.s += 0.5 * PUBLISH_INTERVAL_S
    assert subject.estimate(ESTIMATE) is None
    wall.s += 0.6 * PUBLISH_INTERVAL_S
    assert subject.estimate(ESTIMATE) is not None


def test_an_equal_alarm_is_logged_once_per_window(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    wall, subject = Wall(monkeypatch), Publications()
    with caplog.at_level(logging.WARNING, "cofix.agent"):
        for alarm in (Alarm("peer.silent", "r2"), Alarm("peer.silent", "r2"), Alarm("peer.silent", "r3")):
            subject.warn(alarm)
        wall.s += ALARM_INTERVAL_S
        subject.warn(Alarm("peer.silent", "r2"))
    assert [record.getMessage() for record in caplog.records] == [
        "peer.silent: r2",
        "peer.silent: r3",
        "peer.silent: r2",
    ]


def test_where_others_are_is_told_with_how_sure_it_is() -> None:
    found = RelativeEstimate("p1", 9, np.arange(4.0), np.eye(4), np.float64(0.75), 0.25, 2, np.bool_(True))
    told = msgpack.unpackb(estimate_bytes(Estimate(10, "spatial", np.zeros(4), np.eye(4), (), (found,))))
    assert told["relatives"]["p1"] == {
        "t_ns": 9,
        "mean": [0.0, 1.0, 2.0, 3.0],
        "cov": np.eye(4).tolist(),
        "weight": 0.75,
        "ambiguity": 0.25,
        "tracks": 2,
        "confirmed": True,
    }
