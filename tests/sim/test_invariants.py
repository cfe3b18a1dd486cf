"""The invariant checker: silent over honest fleets under faults, and every rule fires by its name when it is broken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agent.core import Agent
from agent.effects import Estimate
from agent.estimation.split_joint import Split
from agent.node import Node
from agent.split_filter import SplitFilter
from network.endpoint import Endpoint
from network.messages import Epoch
from sim.engine import VirtualEngine
from sim.invariants import InvariantBreach, InvariantChecker
from sim.scenario import Scenario
from sim.scenario_file import load
from sim.trial import open_world, run_trial
from tests.sizes import sized

SEEDS = range(1, sized(6, 40) + 1)


def checked(scenario: Scenario, seed: int) -> int:
    checker = InvariantChecker(seed, f"cofix run {scenario.name} --seed {seed}")
    run_trial(scenario, seed, checker=checker)
    return checker.checked


@pytest.mark.parametrize("intensity", ["field", "storm"])
def test_nothing_is_broken_under_random_faults(intensity: str) -> None:
    scenario = load("fault-plan", [f"fault_plan.intensity={intensity}"])
    for seed in SEEDS if intensity == "field" else SEEDS[:2]:
        assert checked(scenario, seed) > 1000


@pytest.mark.parametrize("form", ["safe", "published", "joint", "split_joint"])
def test_nothing_is_broken_in_any_form(form: str) -> None:
    scenario = load("ut-clat", [f"localization.form={form}", "duration_s=40", "window_s=[0, 40]", "links.loss=0.2"])
    assert checked(scenario, 2) > 100


@pytest.mark.parametrize("intensity", ["field", "storm"])
def test_nothing_is_broken_in_rounds(intensity: str) -> None:
    scenario = load("fault-plan", ["localization.kind=jlatt", f"fault_plan.intensity={intensity}"])
    # In the first of them a robot begins again without its state, long after its survey.
    for seed in (14, *SEEDS[:2]):
        assert checked(scenario, seed) > 1000


@pytest.mark.parametrize("name", ["ut-clat-quadrotors", "dense-6", "demo", "ajlatt", "ajlatt-replica"])
def test_nothing_is_broken_in_other_worlds(name: str) -> None:
    assert checked(load(name, ["duration_s=20", "window_s=[0, 20]"]), 1) > 100


# -- every rule fires ---------------------------------------------------------------------------------------


def broken(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, wrong: Callable[..., Any], form: str) -> str:
    """The rule that stops a run in which a method is replaced by `wrong`, which is given the real one first."""
    real = getattr(owner, name)
    calls = [0]

    def instead(self: Any, *arguments: Any, **keywords: Any) -> Any:
        calls[0] += 1
        return wrong(real, calls[0], self, *arguments, **keywords)

    monkeypatch.setattr(owner, name, property(instead) if isinstance(real, property) else instead)
    scenario = load("fault-plan", ["fault_plan.intensity=calm", f"localization.form={form}"])
    engine = VirtualEngine(scenario, open_world(scenario, 3), 3, checker=InvariantChecker(3, "cofix run it --seed 3"))
    with pytest.raises(InvariantBreach) as breach:
        engine.run()
    assert "seed 3" in str(breach.value) and "cofix run it --seed 3" in str(breach.value)
    return breach.value.rule


def altered(change: Callable[[Estimate], Estimate]) -> Callable[..., Any]:
    def wrong(real: Callable[..., Any], call: int, self: Agent) -> Estimate | None:
        estimate = real(self)
        return change(estimate) if estimate is not None and call > 200 else estimate

    return wrong


@pytest.mark.parametrize(
    "change",
    [
        lambda estimate: replace(estimate, cov=-estimate.cov),
        lambda estimate: replace(estimate, cov=estimate.cov + 0.01 * np.triu(np.ones((3, 3)), 1)),
        lambda estimate: replace(estimate, mean=estimate.mean * np.nan),
        lambda estimate: replace(
            estimate, tracks=tuple(replace(track, cov=track.cov * np.inf) for track in estimate.tracks)
        ),
    ],
)
def test_a_covariance_that_is_none(monkeypatch: pytest.MonkeyPatch, change: Callable[[Estimate], Estimate]) -> None:
    assert broken(monkeypatch, Agent, "estimate", altered(change), "auto") == "covariance"


def test_a_deadline_that_does_not_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    def stuck(real: Callable[..., Any], call: int, self: Agent) -> int:
        return real(self) if call < 200 else self.now_ns

    assert broken(monkeypatch, Agent, "next_deadline_ns", stuck, "auto") == "deadlines"


def test_time_that_goes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    def back(estimate: Estimate) -> Estimate:
        return replace(estimate, t_ns=estimate.t_ns - 10**9)

    assert broken(monkeypatch, Agent, "estimate", altered(back), "auto") == "time"


def test_a_pose_that_gets_surer_by_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []

    def surer(estimate: Estimate) -> Estimate:
        seen.append(1)
        return replace(estimate, cov=estimate.cov * 0.999 ** len(seen))

    assert broken(monkeypatch, Agent, "estimate", altered(surer), "auto") == "information"


def test_a_message_that_is_forgotten_in_the_books(monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(real: Callable[..., Any], call: int, self: Endpoint, *arguments: Any) -> Any:
        found = real(self, *arguments)
        if call == 50:
            self.counters["received"] += 1
        return found

    assert broken(monkeypatch, Endpoint, "receive", lost, "auto") == "books"


def test_a_number_that_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def skipped(real: Callable[..., Any], call: int, self: Endpoint, *arguments: Any) -> Any:
        if call == 20:
            self._next_seq[arguments[1], arguments[2]] = 999
        return real(self, *arguments)

    assert broken(monkeypatch, Endpoint, "_packet", skipped, "auto") == "sequence"


def test_a_buffer_that_grows(monkeypatch: pytest.MonkeyPatch) -> None:
    def grown(real: Callable[..., Any], call: int, self: Agent) -> dict[str, tuple[int, int]]:
        return {**real(self), "attic": (call, 300)}

    assert broken(monkeypatch, Agent, "sizes", grown, "auto") == "bounds"


def test_a_counter_that_falls(monkeypatch: pytest.MonkeyPatch) -> None:
    def fallen(real: Callable[..., Any], call: int, self: Node, *arguments: Any) -> Any:
        found = real(self, *arguments)
        if call > 100 and self.agent.counters["pair.started"]:
            self.agent.counters["pair.started"] -= 1
        return found

    assert broken(monkeypatch, Node, "on_sensor", fallen, "auto") == "counters"


def test_a_private_part_that_is_no_covariance(monkeypatch: pytest.MonkeyPatch) -> None:
    def stolen(real: Callable[..., Any], call: int, self: Split, *arguments: Any) -> Split:
        found: Split = real(self, *arguments)
        return Split(found.private - 0.5 * found.cov, found.shared + 0.5 * found.cov) if call > 50 else found

    assert broken(monkeypatch, Split, "mapped", stolen, "split_joint") == "split"


def test_a_contact_that_is_applied_out_of_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    from agent.factor_filter import FactorFilter

    def earlier(real: Callable[..., Any], call: int, self: FactorFilter) -> dict[str, Epoch]:
        found: dict[str, Epoch] = real(self)
        if call < 400:
            return found
        return {peer: replace(epoch, t_meas_ns=epoch.t_meas_ns - call) for peer, epoch in found.items()}

    assert broken(monkeypatch, FactorFilter, "contacts", earlier, "safe") == "contacts"


@pytest.mark.parametrize("last", [False, True])
def test_a_contact_that_is_used_again(monkeypatch: pytest.MonkeyPatch, last: bool) -> None:
    """The newest one with its peer, or an earlier one."""
    kept: list[Any] = []

    def again(real: Callable[..., Any], call: int, self: SplitFilter, *arguments: Any, **keywords: Any) -> None:
        own = [item for item in kept if item[0] is self]
        if call > 30 and own:
            _, arguments, keywords = own[-1 if last else 0]
        kept.append((self, arguments, keywords))
        real(self, *arguments, **keywords)

    assert broken(monkeypatch, SplitFilter, "_apply", again, "split_joint") == "once"


def test_a_new_life_begins_anew() -> None:
    """Stamps, numbers and counters of a restarted robot start again, which is no breach."""
    scenario = load(
        "fault-plan", ["fault_plan.intensity=calm", 'faults=[{kind = "restart", robot = "r2", at_s = 9.0}]']
    )
    assert checked(scenario, 1) > 1000
