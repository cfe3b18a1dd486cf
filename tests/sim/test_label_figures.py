"""Names that robots give to bearings, counted against the truth."""

from __future__ import annotations

import numpy as np
import pytest

from agent.effects import Named
from agent.settings import NS
from agent.timeline import Phase
from sim.label_figures import KEPT_NS, LabelLog, combine_labels
from sim.world import Output


def output(azimuth: float, truly: str | None, t_ns: int = 0, of: str | None = None) -> Output:
    return Output(t_ns, Phase.PAIR, "r1", "camera", "bearing3", of, np.array([azimuth, 0.0]), np.eye(2), truly=truly)


def name(peer: str, azimuth: float) -> Named:
    return Named(peer, 0, "camera", np.array([azimuth, 0.0]))


def test_right_and_wrong_names_are_counted_once() -> None:
    log = LabelLog()
    log.add([output(0.1, "r2"), output(0.2, "r3"), output(0.3, ""), output(0.4, "r2")])
    for named in (name("r2", 0.1), name("r2", 0.1), name("r2", 0.2), name("r2", 0.3)):
        log.judge("r1", named)
    assert log.figures() == {"seen": 3, "right": 1, "wrong": 2}
    log.judge("r2", name("r2", 0.4))
    assert log.figures() == {"seen": 3, "right": 1, "wrong": 2}, "another robot has seen nothing of the kind"


def test_where_names_are_told_there_are_no_figures() -> None:
    log = LabelLog()
    log.add([output(0.1, None, of="r2")])
    log.judge("r1", name("r2", 0.1))
    assert log.figures() is None


def test_old_bearings_are_forgotten() -> None:
    log = LabelLog()
    for second in range(200):
        log.add([output(0.001 * second, "r2", second * NS)])
    assert len(log._truly) <= 2 * KEPT_NS // NS + 1


def test_shares_are_over_all_trials() -> None:
    found = combine_labels([{"seen": 10, "right": 6, "wrong": 0}, {"seen": 30, "right": 9, "wrong": 1}])
    assert found == {"used": 16, "wrong_share": pytest.approx(1 / 16), "used_share": pytest.approx(0.4)}
    assert combine_labels([{"seen": 1, "right": 0, "wrong": 0}])["wrong_share"] is None
