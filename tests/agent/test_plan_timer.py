"""How long plans take, by a clock that the test moves."""

from __future__ import annotations

from agent.effects import Steer
from agent.node import Outgoing
from agent.plan_timer import KEPT, PlanTimer

MS = 1_000_000
PLANNED = Outgoing(steer=Steer((0.5, 0.0, 0.0), 0.1, 0))


class Clock:
    def __init__(self) -> None:
        self.now_ns = 0
        self.timer = PlanTimer(500 * MS, lambda: self.now_ns)

    def call(self, out: Outgoing, took_ns: int) -> bool:
        def made() -> Outgoing:
            self.now_ns += took_ns
            return out

        found, overran = self.timer.timed(made)
        assert found is out
        return overran


def test_only_a_plan_that_takes_longer_than_it_may_overruns() -> None:
    clock = Clock()
    assert not clock.call(PLANNED, 500 * MS)
    assert clock.call(PLANNED, 500 * MS + 1)
    assert not clock.call(Outgoing(), 900 * MS), "no plan was made"
    assert clock.timer.told() == [500_000, 500_000]
    assert clock.timer.overruns == 1


def test_it_keeps_the_last_plans_only() -> None:
    clock = Clock()
    for k in range(KEPT + 10):
        clock.call(PLANNED, k * 1000)
    assert clock.timer.told() == list(range(10, KEPT + 10))
