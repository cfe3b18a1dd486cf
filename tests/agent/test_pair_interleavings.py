"""Every interleaving of loss, duplication, reordering and restart, two agents, four messages.

Headings are known, so everything is linear, and the books must be exact: the claimed covariances and the
cross-covariance the next contact would recover equal those of the true errors, whichever side applied which contact
and when. After a restart they must bound them.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.core import Agent
from agent.estimation.colocalization import resolve_cross
from agent.estimation.motion import UNICYCLE
from agent.estimation.observation import RelativeModel
from agent.events import Tick
from agent.health import Health
from agent.settings import NS, HealthSettings
from network.messages import Epoch, PairReply, PairRequest
from tests.agent.courier import FIRST, SECOND, TINY, Ledger, Letter, Pair, gains_of
from tests.sizes import every

Array = NDArray[np.float64]

STARTS = {
    FIRST: (np.array([0.0, 0.0, 0.0]), np.diag([0.3, 0.2, TINY])),
    SECOND: (np.array([6.0, 2.0, 0.5]), np.diag([0.4, 0.5, TINY])),
}
NOISE = np.diag([0.01, 0.02, 0.0, 0.0])
R = np.diag([0.05, 0.02]) ** 2

FATES = ("now", "late", "lost", "twice")
MESSAGES = 4
WHO = {"first": (FIRST,), "second": (SECOND,), "both": (FIRST, SECOND)}
OTHER = {FIRST: SECOND, SECOND: FIRST}


class Story:
    """Two contacts of a pair, with a fate for each of the first four messages; then a clean third contact."""

    def __init__(self, fates: tuple[str, ...], timeout_s: float = 1000.0) -> None:
        self.pair = Pair(STARTS, timeout_s=timeout_s, horizon_s=1000.0)
        self.ledger = Ledger(STARTS)
        self.requests: dict[Epoch, PairRequest] = {}
        self.replies: dict[Epoch, PairReply] = {}
        self.applied: list[tuple[Epoch, str]] = []
        self._fates = list(fates)
        self._late: list[Letter] = []
        self._untold: str | None = None
        self._anew = False
        self.k = 0
        self.pair.tell_life(FIRST, SECOND)
        self.pair.tell_life(SECOND, FIRST)

    def step(self) -> list[Letter]:
        """Both robots drive one second; returns what they send."""
        self.k += 1
        letters = []
        for name, agent in self.pair.agents.items():
            delta = np.array([0.3, 0.1, 0.0, 0.0])
            self.ledger.moved(name, float(agent.filter.state.mean[2]), delta, NOISE)
            letters += self.pair.odometry(name, (self.k - 1) * NS, self.k * NS, delta, NOISE)
        return letters

    def contact(self, who: tuple[str, ...]) -> None:
        """Those named measure the other; their letters and what follows meet their fates."""
        self.ledger.mark(self.k * NS)
        letters = []
        for name in who:
            own, other = self.pair.agents[name].filter.state.mean, self.pair.agents[OTHER[name]].filter.state.mean
            z = RelativeModel("range_bearing", UNICYCLE).h(np.concatenate([own, other])) + np.array([0.05, -0.02])
            letters += self.pair.measure(name, self.k * NS, "range_bearing", z, R)
        self.travel(letters)

    def late(self) -> None:
        """What was held back arrives, the newest first."""
        held, self._late = self._late[::-1], []
        for letter in held:
            self.travel(self._handed(letter))

    def travel(self, letters: list[Letter]) -> None:
        """Letters and what follows from them, each with its fate."""
        while letters:
            following: list[Letter] = []
            for letter in letters:
                fate = self._fates.pop(0) if self._fates else "now"
                if fate == "late":
                    self._late.append(letter)
                elif fate != "lost":
                    for _ in range(2 if fate == "twice" else 1):
                        following += self._handed(letter)
            letters = following

    def _handed(self, letter: Letter) -> list[Letter]:
        """Deliver a letter and enter what the receiver did with it into the ledger."""
        if letter.source == self._untold and letter.life == self.pair.lives[letter.source]:
            self.learn()
        if isinstance(letter.body, PairRequest):
            self.requests[letter.body.epoch] = letter.body
        robot, peer = letter.destination, letter.source
        before = self.pair.agents[robot].filter.state.pair(peer).base
        answers = self.pair.deliver(letter)
        for reply in (*answers, letter):
            if isinstance(reply.body, PairReply) and reply.body.snapshot is not None:
                self.replies[reply.body.epoch] = reply.body
        after = self.pair.agents[robot].filter.state.pair(peer).base
        if after != before and after.met:
            request, reply_body = self.requests[after], self.replies[after]
            own_initiated = after.initiator == robot
            responder = OTHER[after.initiator]
            cross = self.ledger.at(after.initiator, after.t_meas_ns) @ self.ledger.at(responder, after.t_meas_ns).T
            if self._anew:
                # What is claimed is a bound only; the gain follows from the claim.
                cross = claimed_cross(request, reply_body, after.initiator)
            psi = self.pair.agents[robot].filter.snapshot(peer).line
            K, H_i, H_j, noise = gains_of(request, reply_body, psi, own_initiated, cross)
            self.ledger.applied(robot, request, K, H_i, H_j, noise)
            self.applied.append((after, robot))
        return answers

    def restart(self, robot: str) -> None:
        """`robot` comes back without its factors, told from its old estimate; its own covariance is doubled."""
        old = self.pair.agents[robot].filter.state
        fresh = Pair({FIRST: (old.mean, 2.0 * old.cov), SECOND: (old.mean, 2.0 * old.cov)}, timeout_s=1000.0)
        agent = fresh.agents[robot]
        agent.handle(Tick(self.k * NS))
        self.pair.agents[robot] = agent
        self.pair.lives[robot] += 1
        self.pair.tell_life(robot, OTHER[robot])
        self._late = [letter for letter in self._late if letter.destination != robot and letter.source != robot]


    def reborn(self, robot: str, kept: bool) -> None:
        """`robot` comes back without its factors; the peer does not know yet.

        Its belief is the old one with twice the covariance (`kept`), or one that owes nothing to anybody.
        """
        old = self.pair.agents[robot]
        cov = 2.0 * old.filter.state.cov if kept else STARTS[robot][1]
        settings = replace(old.settings, start_ns=self.k * NS, mean=old.filter.state.mean, cov=cov)
        self.pair.agents[robot] = Agent(settings)
        self.pair.lives[robot] += 1
        if not kept:
            self.ledger.begin_anew(robot, STARTS[robot][1])
        self._untold = robot
        self._anew = True

    def learn(self) -> None:
        """The peer hears of the new life: what the old one sent is refused by the endpoint from now on."""
        if self._untold is not None:
            robot, self._untold = self._untold, None
            self.pair.tell_life(robot, OTHER[robot])
            life = self.pair.lives[robot]
            self._late = [letter for letter in self._late if letter.source != robot or letter.life == life]


class Unwilling(Health):
    """Refuses a robot's contacts of given seconds."""

    def __init__(self, robot: str, refused: frozenset[tuple[str, int]]) -> None:
        super().__init__(HealthSettings(), Counter())
        self._robot, self._refused = robot, refused

    def usable(self, peer: str, t_ns: int, nis: float, own_observed: bool) -> bool:
        return (self._robot, round(t_ns / NS)) not in self._refused


def claimed_cross(request: PairRequest, reply: PairReply, initiator: str) -> Array:
    """P_ij (i the initiator) as both robots recover it."""
    assert reply.snapshot is not None
    if initiator == FIRST:
        cross = resolve_cross(request.snapshot, reply.snapshot)
    else:
        cross = resolve_cross(reply.snapshot, request.snapshot)
    assert cross is not None
    return cross if initiator == FIRST else cross.T


def run(
    fates: tuple[str, ...], first: str, second: str, refused: frozenset[tuple[str, int]] = frozenset()
) -> Story:
    """`refused`: robots that do not use their contacts of a second, the peer being in quarantine."""
    story = Story(fates)
    for name, agent in story.pair.agents.items():
        agent.health = agent.filter._pairs._health = Unwilling(name, refused)  # type: ignore[attr-defined]
    story.step()
    story.contact(WHO[first])
    story.step()
    story.step()
    story.contact(WHO[second])
    story.late()
    story.step()
    story.late()
    return story


def assert_books_exact(story: Story, note: str) -> None:
    for name, agent in story.pair.agents.items():
        difference = np.abs(agent.filter.state.cov - story.ledger.cov(name, name)).max()
        assert difference < 1e-9, f"{note}: covariance of {name} is off by {difference:.2e}"
        np.linalg.cholesky(agent.filter.state.cov)
    assert len(set(story.applied)) == len(story.applied), f"{note}: a contact was applied twice by one side"
    cross = story.pair.cross()
    assert cross is not None, f"{note}: the correlation was lost"
    difference = np.abs(cross - story.ledger.cov(FIRST, SECOND)).max()
    assert difference < 1e-9, f"{note}: recovered cross-covariance is off by {difference:.2e}"


@pytest.mark.parametrize("second", WHO)
@pytest.mark.parametrize("first", WHO)
def test_every_interleaving_keeps_the_books_exact(first: str, second: str) -> None:
    runs = 0
    for fates in every(3, product(FATES, repeat=MESSAGES)):
        note = f"{first}, {second}: {' '.join(fates)}"
        story = run(fates, first, second)
        assert_books_exact(story, note)
        runs += 1
    assert runs >= len(FATES) ** MESSAGES // 3


@pytest.mark.parametrize("robot", [FIRST, SECOND])
@pytest.mark.parametrize("first", WHO)
def test_after_a_restart_claims_bound_the_truth(first: str, robot: str) -> None:
    """The restarted robot and its peer start the pair anew; the joint covariance they claim is never too small."""
    for fates in product(FATES, repeat=2):
        story = Story(fates)
        story.step()
        story.contact(WHO[first])
        story.restart(robot)
        story.late()
        cross = story.pair.cross()
        assert cross is not None
        claimed = np.block(
            [
                [story.pair.agents[FIRST].filter.state.cov, cross],
                [cross.T, story.pair.agents[SECOND].filter.state.cov],
            ]
        )
        true = np.block([[story.ledger.cov(a, b) for b in (FIRST, SECOND)] for a in (FIRST, SECOND)])
        lowest = float(np.linalg.eigvalsh(claimed - true).min())
        assert lowest > -1e-9, f"{first}, restart of {robot}: {' '.join(fates)}: too small by {-lowest:.2e}"


@pytest.mark.parametrize("kept", [False, True])
@pytest.mark.parametrize("robot", [FIRST, SECOND])
@pytest.mark.parametrize("again", [FIRST, SECOND])
@pytest.mark.parametrize("first", WHO)
def test_whatever_arrives_around_a_new_life_claims_bound_the_truth(
    first: str, again: str, robot: str, kept: bool
) -> None:
    """Letters of the old life and for it arrive before or after the peer hears of the new one.

    Two contacts before the restart, so that the pair is correlated, and one after it.
    """
    for fates in every(3, product(FATES, repeat=3 if first == "both" else 2)):
        for when in ("before", "between", "after"):
            note = f"{first}, {again}, new life of {robot}, told {when}: {' '.join(fates)}"
            story = Story(("now", "now", *fates))
            story.step()
            story.contact((FIRST,))
            story.step()
            story.contact(WHO[first])
            story.step()
            story.reborn(robot, kept)
            if when == "before":
                story.learn()
            story.late()
            if when == "between":
                story.learn()
            story.step()
            story.contact((again,))
            story.late()
            story.step()
            story.contact((OTHER[again],))
            story.learn()
            assert len(set(story.applied)) == len(story.applied), note
            low, high = (story.pair.agents[name].filter.state.cov for name in (FIRST, SECOND))
            cross = story.pair.cross()
            assert cross is not None, note
            claimed = np.block([[low, cross], [cross.T, high]])
            true = np.block([[story.ledger.cov(a, b) for b in (FIRST, SECOND)] for a in (FIRST, SECOND)])
            lowest = float(np.linalg.eigvalsh(claimed - true).min())
            assert lowest > -1e-9, f"{note}: too small by {-lowest:.2e}"


def test_an_instant_that_has_left_the_ring_is_answered_too_old() -> None:
    """The request comes when the responder's history no longer reaches back: nobody uses it, nothing is lost."""
    story = Story(("late",))
    responder = story.pair.agents[SECOND]
    short = replace(responder.settings, lateness=replace(responder.settings.lateness, horizon_ns=2 * NS))
    story.pair.agents[SECOND] = Agent(short)
    story.pair.tell_life(FIRST, SECOND)
    story.step()
    story.contact(WHO["first"])
    for _ in range(5):
        story.step()
    story.late()
    assert responder_counters(story)["pair.too_old"] == 1
    assert story.pair.agents[FIRST].counters["pair.answer_too_old"] == 1
    assert story.pair.agents[FIRST].filter.state.pair(SECOND).lines == ()
    assert story.applied == []
    story.contact(WHO["first"])
    assert len(story.applied) == 2
    assert_books_exact(story, "after too old")


def responder_counters(story: Story) -> Counter[str]:
    return story.pair.agents[SECOND].counters


@pytest.mark.parametrize("lost", [("lost",), ("now", "lost")])
def test_a_repeated_request_completes_the_contact_exactly(lost: tuple[str, ...]) -> None:
    """Request or reply lost: the same request goes out again after the time-out, and both sides use it once."""
    story = Story(lost, timeout_s=1.0)
    story.step()
    story.contact(WHO["first"])
    again = story.step()
    assert len(again) == 1
    story.travel(again)
    assert sorted(robot for _, robot in story.applied) == [FIRST, SECOND]
    assert_books_exact(story, f"repeated after {lost}")


@pytest.mark.parametrize("second", WHO)
@pytest.mark.parametrize("first", WHO)
def test_contacts_unused_in_quarantine_keep_the_books_exact(first: str, second: str) -> None:
    seats = [(FIRST, 1), (SECOND, 1), (FIRST, 3), (SECOND, 3)]
    unused = 0
    for chosen in product((False, True), repeat=len(seats)):
        refused = frozenset(seat for seat, taken in zip(seats, chosen) if taken)
        for fates in product(("now", "late", "lost"), repeat=2):
            story = run(fates, first, second, refused)
            note = f"{first}, {second}, {fates}, refused {sorted(refused)}"
            assert_books_exact(story, note)
            assert not any((robot, round(epoch.t_meas_ns / NS)) in refused for epoch, robot in story.applied), note
            unused += bool(refused) and len(story.applied) < 4
    assert unused
