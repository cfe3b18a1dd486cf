"""A robot that is killed and goes on with its factors: the books of a pair stay exact, whatever was under way.

See `tests.agent.test_pair_interleavings`; the motion that a restarted robot knows nothing of is one more noise.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from agent.core import Agent
from agent.effects import Persist, Send
from agent.events import LinkChange, Observation, Received
from agent.saved_state import begun_again
from agent.settings import NS, CoastSettings, UnsafeSettings
from network.messages import Header, Message, PairReply, PairRequest
from tests.agent.courier import FIRST, SECOND, Letter, Pair
from tests.agent.test_pair_interleavings import FATES, OTHER, STARTS, WHO, Story, Unwilling, assert_books_exact
from tests.sizes import every

Array = NDArray[np.float64]

COAST = CoastSettings(speed_mps=0.4, yaw_rate_radps=0.0)


class KilledStory(Story):
    """A story in which robots are killed and started again with what they had kept last."""

    def __init__(self, fates: tuple[str, ...], timeout_s: float = 1000.0) -> None:
        super().__init__(fates, timeout_s)
        self._kept: dict[str, tuple[bytes, Array]] = {}
        for name, agent in self.pair.agents.items():
            at_once = replace(agent.settings.lateness, odometry_wait_ns=0)
            settings = replace(agent.settings, coast=COAST, persist_ns=3 * NS, lateness=at_once)
            self.pair.agents[name] = Agent(settings)
        for name in self.pair.agents:
            self._tell(name, 1)

    def _tell(self, about: str, boot_id: int) -> None:
        self.pair.agents[OTHER[about]].handle(LinkChange(self.pair.now_ns, about, True, 1, boot_id))

    def _note_files(self) -> None:
        """Remember the error of every state that has just been kept."""
        for name, payload in self.pair.files.items():
            if name not in self._kept or self._kept[name][0] is not payload:
                self._kept[name] = payload, self.ledger.error[name].copy()

    def step(self) -> list[Letter]:
        letters = super().step()
        self._note_files()
        return letters

    def travel(self, letters: list[Letter]) -> None:
        self._note_files()
        super().travel(letters)

    def _handed(self, letter: Letter) -> list[Letter]:
        answers = super()._handed(letter)
        self._note_files()
        return answers

    def killed(self, robot: str, file: tuple[bytes, Array] | None = None) -> None:
        """`robot` is killed now and started at once with its file; the peer does not know yet."""
        payload, error = file or self._kept[robot]
        agent = self.pair.agents[robot] = Agent(self.pair.agents[robot].settings, payload)
        columns = self.ledger.error[robot].shape[1] - error.shape[1]
        self.ledger.error[robot] = np.hstack([error, np.zeros((3, columns))])
        begin = agent.filter.t_ns // NS
        for k in range(begin, self.k):
            # A velocity that is unknown and constant over the gap, cut at each second.
            variance = COAST.speed_mps**2 * ((k + 1 - begin) ** 2 - (k - begin) ** 2)
            self.ledger.moved(robot, 0.0, np.zeros(4), np.diag([variance, variance, 0.0, 0.0]))
            self.ledger.mark_one(robot, (k + 1) * NS)
        self.pair.lives[robot] += 1
        self._untold = robot

    def learn(self) -> None:
        if self._untold is not None:
            robot, self._untold = self._untold, None
            life = self.pair.lives[robot]
            self._tell(robot, life)
            self._late = [letter for letter in self._late if letter.source != robot or letter.life == life]


@pytest.mark.parametrize("robot", [FIRST, SECOND])
@pytest.mark.parametrize("again", [FIRST, SECOND])
@pytest.mark.parametrize("first", WHO)
def test_the_books_stay_exact_through_a_kill(first: str, again: str, robot: str) -> None:
    """Letters of before arrive before or after the peer hears of the new start, a second after the kill or at once."""
    for fates, late_s, when in every(5, product(product(FATES, repeat=2), (0, 2), range(3))):
        note = f"{first}, {again}, kill of {robot} {late_s} s later, told {when}: {' '.join(fates)}"
        story = KilledStory(("now", "now", *fates))
        story.step()
        story.contact((FIRST,))
        story.step()
        story.contact(WHO[first])
        for _ in range(late_s):
            story.step()
        story.killed(robot)
        if when == 0:
            story.learn()
        story.late()
        if when == 1:
            story.learn()
        story.step()
        story.contact((again,))
        story.late()
        story.step()
        story.contact((OTHER[again],))
        story.learn()
        assert_books_exact(story, note)
        for agent in story.pair.agents.values():
            assert agent.counters["pair.restarts"] == agent.counters["pair.fallback"] == 0, note


@pytest.mark.parametrize("order", ["refusal first", "repetition first"])
def test_a_contact_refused_as_inconsistent_stays_refused_through_a_kill(order: str) -> None:
    """The refusal is late, and the request is repeated to a life that would use it, when the line may be gone."""
    story = KilledStory(("now", "now", "now", "late"), timeout_s=1.0)
    story.step()
    story.contact((FIRST,))
    story.step()
    story.step()
    responder = story.pair.agents[SECOND]
    responder.filter._pairs._health = Unwilling(SECOND, frozenset({(SECOND, 3)}))  # type: ignore[attr-defined]
    story.contact((FIRST,))
    assert responder.counters["pair.request_apply"] == 2 and len(story.applied) == 2
    again = story.step()
    assert [letter.destination for letter in again] == [SECOND]
    story.killed(SECOND)
    answers = story._handed(again[0]) if order == "repetition first" else []
    story.late()
    for letter in answers or story._handed(again[0]):
        story.travel([letter])
    assert story.pair.agents[SECOND].counters["pair.request_answer_inconsistent"] == 1
    assert len(story.applied) == 2
    story.learn()
    story.step()
    story.contact((FIRST,))
    assert len(story.applied) == 4
    assert_books_exact(story, order)


def test_a_file_older_than_the_last_message_is_noticed_by_the_pair() -> None:
    """Why states are written first: with an older one the correlation is lost, and both double what they claim."""
    story = KilledStory(())
    story.step()
    older = story.pair.agents[SECOND].saved(), story.ledger.error[SECOND].copy()
    assert older[0] is not None
    story.contact((FIRST,))
    story.killed(SECOND, older)
    story.learn()
    story.step()
    story.contact((FIRST,))
    assert all(agent.counters["pair.fallback"] == 1 for agent in story.pair.agents.values())


@pytest.mark.parametrize("kind", ["range", "bearing"])
def test_states_come_before_the_messages_that_rely_on_them(kind: str) -> None:
    """And what is kept has the line of the contact, whose answer it awaits or has given."""
    pair = Pair(STARTS)
    for name in STARTS:
        pair.odometry(name, 0, NS, np.array([0.3, 0.1, 0.0, 0.0]), np.diag([0.01, 0.02, 0.0, 0.0]))
    measured = Observation(NS, NS, kind, SECOND, np.array([6.1 if kind == "range" else 0.3]), np.array([[0.01]]), "s")
    kept, sent, *_ = pair.agents[FIRST].handle(measured)
    assert isinstance(kept, Persist) and kept.ahead and isinstance(sent, Send) and isinstance(sent.body, PairRequest)
    assert Agent(pair.agents[FIRST].settings, kept.payload).filter.state.pair(SECOND).lines == (sent.body.epoch,)
    request = Received(NS, Message(Header(FIRST, 1, 1, 0, NS, NS), sent.body))
    kept, sent, *_ = pair.agents[SECOND].handle(request)
    assert isinstance(kept, Persist) and kept.ahead and isinstance(sent, Send) and isinstance(sent.body, PairReply)
    again = Agent(pair.agents[SECOND].settings, kept.payload)
    assert again.filter.state.pair(FIRST).base == sent.body.epoch
    # The request is repeated, and the answer is gone: a refusal would say that the contact was not applied.
    assert not [effect for effect in again.handle(request) if isinstance(effect, Send)]
    assert again.counters["pair.request_ignore"] == 1


def test_fifty_starts_in_a_minute_inflate_a_peer_no_further() -> None:
    """With its state nothing at all; each start without it is a new life, and one a minute may double the peer."""
    story = KilledStory(())
    story.step()
    story.contact((FIRST,))
    peer = story.pair.agents[SECOND]
    before = peer.filter.state.cov
    for _ in range(50):
        story.killed(FIRST)
        story.learn()
    np.testing.assert_array_equal(peer.filter.state.cov, before)
    assert peer.counters["pair.resumed"] == 50
    limited = replace(peer.settings, localization=replace(peer.settings.localization, restart_interval_ns=60 * NS))
    peer = story.pair.agents[SECOND] = Agent(limited, peer.saved())
    for life in range(50):
        now_ns = story.pair.now_ns + life * NS
        peer.handle(LinkChange(now_ns, FIRST, True, 2 + life, 100 + life))
        # It meets the peer each time: there is something to forget.
        peer.filter.state = peer.filter.state.with_base(FIRST, peer.filter.state.pair(FIRST).base, np.eye(3), np.eye(3))
    assert float(np.max(np.diagonal(peer.filter.state.cov) / np.diagonal(before))) <= 2.0 + 1e-9


def test_who_does_not_save_first_or_trusts_restarts_is_not_protected() -> None:
    """What the switches of `[unsafe]` take away: the state before the message, and the bound of a new life."""
    pair = Pair(STARTS)
    unsafe = UnsafeSettings(send_before_saving=True, trust_restarts=True)
    pair.agents = {name: Agent(replace(agent.settings, unsafe=unsafe)) for name, agent in pair.agents.items()}
    for name in STARTS:
        pair.odometry(name, 0, NS, np.array([0.3, 0.1, 0.0, 0.0]), np.diag([0.01, 0.02, 0.0, 0.0]))
        pair.tell_life(name, OTHER[name])
    effects = pair.agents[FIRST].handle(Observation(NS, NS, "range", SECOND, np.array([6.1]), np.array([[0.01]]), "s"))
    assert not any(isinstance(effect, Persist) and effect.ahead for effect in effects)
    pair.converse([Letter(FIRST, SECOND, NS, item.body) for item in effects if isinstance(item, Send)])
    before = pair.agents[FIRST].filter.state.cov
    pair.lives[SECOND] += 1
    pair.tell_life(SECOND, FIRST)
    assert pair.agents[FIRST].counters["pair.restarts"] == 1
    np.testing.assert_array_equal(pair.agents[FIRST].filter.state.cov, before)
    again = begun_again(pair.agents[SECOND].settings)
    np.testing.assert_array_equal(again.cov, STARTS[SECOND][1])


class ForgetfulStory(Story):
    """A robot that has lost its file and could not write the number of its new life down: it has the old number."""

    def learn(self) -> None:
        if self._untold is not None:
            robot, self._untold = self._untold, None
            life = self.pair.lives[robot]
            self.pair.agents[OTHER[robot]].handle(LinkChange(self.pair.now_ns, robot, True, 1, life))
            self._late = [letter for letter in self._late if letter.source != robot or letter.life == life]


@pytest.mark.parametrize("kept", [False, True])
@pytest.mark.parametrize("robot", [FIRST, SECOND])
@pytest.mark.parametrize("again", [FIRST, SECOND])
@pytest.mark.parametrize("first", WHO)
def test_a_life_of_an_old_number_that_knows_nothing_claims_no_more_than_is_true(
    first: str, again: str, robot: str, kept: bool
) -> None:
    """The disk is full for two starts on end: the first contact finds no correlation, and begins the pair anew."""
    fallbacks = 0
    for fates, when in product(product(FATES, repeat=2), range(3)):
        note = f"{first}, {again}, {robot} begins anew, told {when}: {' '.join(fates)}"
        story = ForgetfulStory(("now", "now", *fates))
        story.step()
        story.contact((FIRST,))
        story.step()
        story.contact(WHO[first])
        story.reborn(robot, kept)
        if when == 0:
            story.learn()
        story.late()
        if when == 1:
            story.learn()
        story.step()
        story.contact((again,))
        story.late()
        story.step()
        story.contact((OTHER[again],))
        story.learn()
        low, high = (story.pair.agents[name].filter.state.cov for name in (FIRST, SECOND))
        cross = story.pair.cross()
        if cross is None:
            # Nobody takes it for anything: what each claims of itself has to hold.
            cross = story.ledger.cov(FIRST, SECOND)
        claimed = np.block([[low, cross], [cross.T, high]])
        true = np.block([[story.ledger.cov(a, b) for b in (FIRST, SECOND)] for a in (FIRST, SECOND)])
        lowest = float(np.linalg.eigvalsh(claimed - true).min())
        assert lowest > -1e-9, f"{note}: too small by {-lowest:.2e}"
        fallbacks += sum(agent.counters["pair.fallback"] for agent in story.pair.agents.values())
    assert fallbacks
