"""What other leaders told: each report once, whatever the network does; and what can be told."""

from __future__ import annotations

from collections import Counter

import numpy as np

from agent.estimation.correspondence import Hypotheses
from agent.settings import NS, RoundSettings
from agent.told_hypotheses import MAX_KEPT, ToldHypotheses, sendable_part


def hypotheses(k: int = 1, prior: bool = False) -> Hypotheses:
    covs = np.tile(np.eye(4), (k, 1, 1))
    if not prior:
        return Hypotheses(np.full(k, 1.0 / max(k, 1)), np.ones((k, 4)), covs)
    return Hypotheses(np.full(k, 1.0 / k), np.ones((k, 4)), covs, np.ones((k, 4)), 2.0 * covs, np.arange(k) == 0)


def table() -> tuple[ToldHypotheses, Counter[str]]:
    counters: Counter[str] = Counter()
    return ToldHypotheses(RoundSettings(), counters), counters


def hear(told: ToldHypotheses, t_s: float, part: int = 0, parts: int = 1, peer: str = "l2", names: str = "p1") -> None:
    stamp = round(t_s * NS)
    told.hear(peer, stamp, stamp, part, parts, {name: hypotheses() for name in names.split()})


def test_a_report_is_used_once_however_often_it_arrives() -> None:
    told, counters = table()
    hear(told, 1.0)
    hear(told, 1.0)
    assert counters["hypotheses.known"] == 1
    assert [item.peer for item in told.take(NS)] == ["l2"]
    hear(told, 1.0)
    assert counters["hypotheses.overtaken"] == 1
    assert told.take(2 * NS) == []


def test_parts_are_put_together_and_a_lost_one_is_missing() -> None:
    told, _ = table()
    hear(told, 1.0, 1, 2, names="p2")
    assert not told.complete(NS)
    hear(told, 1.0, 0, 2, names="p1 l1")
    assert told.complete(NS)
    (whole,) = told.take(NS)
    assert sorted(whole.subjects) == ["l1", "p1", "p2"]
    hear(told, 2.0, 1, 2, names="p2")
    (half,) = told.take(2 * NS)
    assert sorted(half.subjects) == ["p2"], "what has arrived is used"
    hear(told, 2.0, 0, 2)
    assert told.take(3 * NS) == [], "the rest of it comes too late"


def test_what_is_of_the_future_waits_and_what_is_overtaken_goes() -> None:
    told, counters = table()
    for t_s in (1.0, 2.0, 3.0):
        hear(told, t_s)
    (taken,) = told.take(2 * NS)
    assert taken.t_ns == 2 * NS and counters["hypotheses.overtaken"] == 1
    (later,) = told.take(3 * NS)
    assert later.t_ns == 3 * NS


def test_leaders_that_told_lately_are_waited_for() -> None:
    told, _ = table()
    assert not told.complete(NS), "at first nobody knows who there is"
    hear(told, 1.0)
    hear(told, 1.0, peer="l3")
    assert told.leaders(NS) == ["l2", "l3"] and told.complete(NS)
    told.take(NS)
    hear(told, 2.0)
    assert not told.complete(2 * NS)
    hear(told, 5.0)
    assert told.complete(5 * NS), "who was silent for some rounds is not"


def test_a_new_life_tells_anew() -> None:
    told, counters = table()
    hear(told, 5.0)
    told.take(5 * NS)
    told.forget("l2")
    hear(told, 1.0)
    assert not counters["hypotheses.overtaken"] and len(told.take(NS)) == 1


def test_nobody_can_make_it_keep_more() -> None:
    told, counters = table()
    for k in range(1, 100):
        hear(told, float(k))
    assert counters["hypotheses.overflow"] == 99 - MAX_KEPT
    for index in range(500):
        hear(told, 1.0, peer=f"x{index}")
    assert len(told._waiting) <= 128


def test_what_is_told_is_the_best_that_single_precision_holds() -> None:
    part, left_out = sendable_part("p1", hypotheses(3))
    assert part is not None and left_out == 0 and part.priors is None and part.prior_known == ()
    good = hypotheses(3)
    covs = good.covs.copy()
    covs[1] = np.outer(np.ones(4), np.ones(4)) + 1e-13 * np.eye(4)
    part, left_out = sendable_part("p1", Hypotheses(good.weights, good.means, covs))
    assert part is not None and left_out == 1 and len(part.weights) == 2
    assert sendable_part("p1", hypotheses(0)) == (None, 0)


def test_who_has_no_prior_says_so() -> None:
    part, _ = sendable_part("p1", hypotheses(2, prior=True))
    assert part is not None and part.prior_known == (True, False)
    assert part.prior_covs is not None and np.array_equal(part.prior_covs[1], np.eye(4))
