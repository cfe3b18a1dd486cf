"""Robot and targets with factors: what pairs claim is the truth of a linear world, and no peer can upset it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from itertools import cycle, product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as limits
from hypothesis import strategies as st

import agent.joint_factors
from agent.belief import Part
from agent.core import Agent
from agent.effects import Send
from agent.events import LinkChange, Observation, Odometry, Received
from agent.history import History
from agent.joint_factors import JointFactors, resolve
from agent.settings import NS, LatenessSettings, LocalizationSettings
from network.messages import (
    MAX_MESSAGE_BYTES,
    NEVER,
    Epoch,
    Header,
    JointSnapshot,
    Line,
    Measurement,
    Message,
    PairReply,
    PairRequest,
    ReplyStatus,
)
from network.wire import decode, encode
from tests.agent.courier import sends
from tests.agent.joint_story import (
    DELTA,
    FIRST,
    KNOWN,
    NOISE,
    OTHER,
    SECOND,
    TARGET_COV,
    Act,
    Story,
    settings,
    true_covariance,
)
from tests.sizes import every, sized

FATES = ("now", "late", "lost", "twice")
BOTH = [*KNOWN, *(7 + index for index in KNOWN)]
CLIPPED = 3e-3
"""What canonical correlations of 0.999 and a target that is the same to a centimetre cost, of variances up to 2 m^2."""


def contacts(*who: tuple[str, ...]) -> tuple[Act, ...]:
    """Contacts at 1 and 3 s; what both learn of themselves and the target lies between."""
    first, second = who
    return (
        *(Act(1, name, "peer") for name in first),
        Act(2, FIRST, "target"),
        Act(2, SECOND, "fix"),
        *(Act(3, name, "peer") for name in second),
    )


WHO = (
    ((FIRST,), (FIRST,)),
    ((FIRST,), (SECOND,)),
    ((SECOND,), (FIRST,)),
    ((FIRST, SECOND), (FIRST,)),
    ((SECOND,), (FIRST, SECOND)),
)


def excess(acts: tuple[Act, ...], fates: tuple[str, ...], steps: int, drive: float = 0.0) -> tuple[Story, np.ndarray]:
    """A story, and what both claim together beyond the truth (12, 12)."""
    story = Story(acts, fates, steps, {}, drive)
    difference = story.claimed() - true_covariance(acts, fates, steps, drive)
    return story, difference[np.ix_(BOTH, BOTH)]


@pytest.fixture(autouse=True, scope="module")
def _the_same_target() -> Iterator[None]:
    """What is claimed can be compared with the truth where the targets are taken for the same, as they are."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(agent.joint_factors, "SAME_TARGET_M2", 1e-4)
        yield


# -- what is claimed -----------------------------------------------------------------------------------------


def test_before_anybody_met_robots_have_the_prior_of_the_target_in_common() -> None:
    _, difference = excess((Act(1, FIRST, "target"), Act(2, SECOND, "target"), Act(2, FIRST, "fix")), (), 3)
    assert np.abs(difference).max() < 1e-6


def test_every_interleaving_of_two_contacts_claims_the_true_joint_covariance() -> None:
    """Loss, delay, duplication and order of the first three messages, by whoever opens the contacts."""
    applied = Counter[int]()
    for fates, who in every(6, zip(product(FATES, repeat=3), cycle(WHO))):
        story, difference = excess(contacts(*who), fates, 4)
        assert np.abs(difference).max() < CLIPPED, f"{who}: {' '.join(fates)}: off by {np.abs(difference).max():.1e}"
        for name in (FIRST, SECOND):
            np.linalg.cholesky(story.filter(name).state.cov)
        applied[story.count("pair.applied_initiator") + story.count("pair.applied_responder")] += 1
    # One-sided contacts occur as do complete ones.
    assert {2, 3, 4} <= set(applied)


def test_a_contact_that_is_not_accounted_for_would_be_noticed() -> None:
    acts = contacts((FIRST,), (FIRST,))
    claimed = Story(acts, ("now", "lost"), 4, {}).claimed()
    truth = true_covariance(acts, (), 4)
    assert np.abs((claimed - truth)[np.ix_(BOTH, BOTH)]).max() > 10.0 * CLIPPED


def test_a_target_seen_by_one_is_known_better_by_both() -> None:
    acts = (Act(1, FIRST, "target"), Act(1, FIRST, "fix"), Act(2, FIRST, "peer"))
    apart, met = Story(acts[:2], (), 3, {}), Story(acts, (), 3, {})
    for name, gain in ((FIRST, 0.99), (SECOND, 0.5)):
        before, after = (np.trace(found.filter(name).state.cov[3:5, 3:5]) for found in (apart, met))
        assert after < gain * before


@pytest.mark.parametrize("steps", [1, 2, 3, 4])
def test_common_noise_between_two_steps_is_accounted_for_exactly(steps: int) -> None:
    """Contacts at every step: each covers one instant of the target's process noise, and the columns are exact."""
    acts = tuple(Act(k, (FIRST, SECOND)[k % 2], "peer") for k in range(1, steps + 1))
    _, difference = excess(acts, (), steps, drive=0.4)
    assert np.abs(difference).max() < CLIPPED


def test_common_noise_of_a_longer_silence_is_mostly_accounted_for() -> None:
    """What is told understates it, never more than the noise is, and by a fraction of what leaving it out would do."""
    acts, cross = (Act(1, FIRST, "peer"),), np.ix_([3, 4, 5, 6], [3, 4, 5, 6])
    story = Story(acts, (), 6, {}, 0.4)
    truth = true_covariance(acts, (), 6, 0.4)[:7, 7:][cross]
    told = [replace(story.filter(name).snapshot(OTHER[name]), noise=None) for name in (FIRST, SECOND)]
    low, high = told
    assert isinstance(low, JointSnapshot) and isinstance(high, JointSnapshot)
    found = resolve(low, high)
    assert found is not None and not found[1]
    claimed = story.claimed()[:7, 7:][cross]
    assert np.abs(truth - claimed).max() < 0.4 * np.abs(truth - found[0][cross]).max()
    assert np.linalg.eigvalsh(truth - (claimed + claimed.T) / 2.0)[0] > -CLIPPED


@pytest.mark.parametrize("fates", [(), ("now", "late"), ("late",), ("twice", "lost")])
def test_late_own_data_keep_the_claims_near_the_truth(fates: tuple[str, ...]) -> None:
    """A fix of 2 s comes at 4 s, after a contact that would have had another gain with it.

    How a contact's gain maps the own error is kept as for third parties (eq. 28), which is not exact.
    """
    acts = (
        Act(1, FIRST, "peer"),
        Act(2, FIRST, "target"),
        Act(2, SECOND, "fix", arrives=4),
        Act(3, SECOND, "peer"),
    )
    story, difference = excess(acts, fates, 5)
    assert story.agents[SECOND].counters["late.compensated"] == 1
    assert np.abs(difference).max() < 0.03
    assert np.linalg.eigvalsh(difference)[0] > -0.02


def test_a_line_opened_late_holds_the_noise_it_would_have_held() -> None:
    epoch = Epoch(NS, FIRST, 1)
    lines = []
    for late in (False, True):
        model = JointFactors(settings(FIRST, 0.4), Counter())
        state = model.initial()
        history = History(settings(FIRST, 0.4), model, state)
        for k in range(1, 4):
            state = history.advance(state, k * NS, DELTA, NOISE)
            if k == (3 if late else 1):
                state = history.opened(NS, SECOND, epoch)
        block = state.stack.block((Part.LINE, SECOND, epoch))
        assert block is not None
        lines.append(block)
    assert np.abs(lines[0][3:, 7:]).max() > 0.1
    assert np.abs(lines[0] - lines[1]).max() < 1e-12


def test_a_new_life_doubles_what_is_claimed_and_starts_from_nothing_in_common() -> None:
    story = Story((Act(1, FIRST, "peer"),), (), 2, {})
    subject = story.agents[FIRST]
    before = story.filter(FIRST).state.cov
    for life in (1, 2):
        subject.handle(LinkChange(2 * NS, SECOND, True, life, life))
    assert np.array_equal(story.filter(FIRST).state.cov, 2.0 * before)
    told = story.filter(FIRST).snapshot(SECOND)
    fresh = Story((), (), 2, {}).filter(SECOND).snapshot(FIRST)
    assert isinstance(told, JointSnapshot) and isinstance(fresh, JointSnapshot)
    assert told.anew and told.prior is None and fresh.prior is not None
    found = resolve(told, fresh)
    assert found is not None
    assert not found[0].any()


# -- messages ------------------------------------------------------------------------------------------------


def seen(peer: str, t_ns: int) -> Observation:
    """Where the peer is, as the other one sees it."""
    z = np.array([-1.1, -5.2]) if peer == FIRST else np.array([5.3, 0.3])
    return Observation(t_ns, t_ns, "vector", peer, z, np.eye(2) * 0.01, "camera")


def sees(agent: Agent, peer: str, t_ns: int) -> Send | None:
    """`agent` sees `peer` at `t_ns`; what it sends."""
    found = sends(agent.handle(seen(peer, t_ns)))
    return found[0] if found else None


def test_no_message_is_above_the_limit_however_many_contacts_are_open() -> None:
    """Answers never come, so that lines pile up: noise is left out first, then the oldest lines."""
    long = "r" * 23
    quick = LocalizationSettings(form="joint", transform="jacobian", pair_interval_ns=0, pair_timeout_ns=NS // 2)
    for own, peer in ((long + "1", long + "2"), (long + "2", long + "1")):
        short = LatenessSettings(horizon_ns=2 * NS)
        agent = Agent(replace(settings(FIRST, 0.2), robot=own, localization=quick, lateness=short))
        other = Agent(replace(settings(SECOND, 0.2), robot=peer, localization=quick, lateness=short))
        sent: list[Send] = []
        for k in range(1, 40):
            for subject in (agent, other):
                found = sends(subject.handle(Odometry(k * NS, (k - 1) * NS, k * NS, DELTA, NOISE)))
                sent += found if subject is agent else []
            requests = sends(agent.handle(seen(peer, k * NS)))
            sent += requests
            if k == 1:
                (request,) = requests
                (reply,) = sends(other.handle(Received(NS, Message(Header(own, 1, 1, 1, NS, NS), request.body))))
                agent.handle(Received(NS, Message(Header(peer, 1, 1, 1, NS, NS), reply.body)))
        assert agent.counters["pair.applied_initiator"] == 1
        assert agent.counters["pair.noise_left_out"] > 0
        assert agent.counters["pair.shortened"] > 0
        header = Header(own, 2**53, 2**53, 2**53, 2**62, 2**62)
        sizes = [len(encode(header, item.body)) for item in sent]
        assert 900 < max(sizes) <= MAX_MESSAGE_BYTES


def test_both_sides_compute_with_what_the_wire_carries() -> None:
    """Rounded before it is told: what a peer decodes is what the sender used."""
    story = Story(contacts((FIRST,), (SECOND,)), (), 4, {}, 0.3)
    checked = 0
    for source, item in story.sent:
        assert isinstance(item.body, PairRequest | PairReply)
        told = item.body.snapshot
        body = decode(encode(Header(source, 1, 1, 1, 1, 1), item.body), source).body
        assert isinstance(body, PairRequest | PairReply)
        heard = body.snapshot
        assert isinstance(told, JointSnapshot) and isinstance(heard, JointSnapshot)
        for name in ("mean", "cov", "factor", "line", "noise", "prior"):
            mine, theirs = getattr(told, name), getattr(heard, name)
            assert (mine is None) == (theirs is None)
            assert mine is None or np.array_equal(mine, theirs)
            checked += mine is not None
    assert checked > 12


def test_a_peer_that_tells_no_noise_is_met_without_its_targets() -> None:
    story = Story((Act(1, FIRST, "peer"),), (), 3, {}, 0.3)
    told = story.filter(SECOND).snapshot(FIRST)
    assert isinstance(told, JointSnapshot)
    before = story.filter(FIRST).state.cov
    item = Measurement("vector", np.array([-1.0, -5.0]), np.eye(2))
    story.agents[FIRST].handle(received(PairRequest(Epoch(3 * NS, SECOND, 9), (item,), replace(told, noise=None))))
    assert story.agents[FIRST].counters["pair.targets_unused"] == 1
    assert story.agents[FIRST].counters["pair.applied_responder"] == 1
    after = story.filter(FIRST).state.cov
    assert after[0, 0] < before[0, 0]


# -- what a peer may tell ------------------------------------------------------------------------------------


def received(body: PairRequest | PairReply, seq: int = 9) -> Received:
    return Received(3 * NS, Message(Header(SECOND, 1, 1, seq, 3 * NS, 3 * NS), body))


def met() -> Story:
    return Story((Act(1, FIRST, "peer"),), (), 3, {}, 0.3)


EPOCHS = [Epoch(NS, FIRST, 1), Epoch(2 * NS, SECOND, 4), Epoch(3 * NS, SECOND, 1)]
MODELS = {"unicycle": 3, "spatial": 4, "constant_velocity": 4, "hovercraft": 2}
SIZES = [0, 1, 3, 4, 7, 8]


@st.composite
def snapshots(draw: st.DrawFn) -> JointSnapshot:
    """Well-formed values in sizes that need not fit together, more often than not those that do."""
    model, target = draw(st.sampled_from(list(MODELS))), draw(st.sampled_from(list(MODELS)))
    targets = draw(st.sampled_from([(), (("t1", target),), (("t2", target),)]))
    c = sum(MODELS[item] for _, item in targets)
    n = MODELS[model] + c
    scale = draw(st.sampled_from([1e-9, 1.0, 1e8]))

    def block(columns: int) -> np.ndarray:
        rows, columns = draw(st.sampled_from([n, n, n, 3])), draw(st.sampled_from([columns, columns, *SIZES]))
        return np.full((rows, columns), scale)

    def maybe(columns: int) -> np.ndarray | None:
        return draw(st.one_of(st.none(), st.just(block(columns))))

    lines = draw(st.lists(st.sampled_from(EPOCHS)))
    return JointSnapshot(
        model,
        targets,
        np.full(draw(st.sampled_from([n, n, n, 3])), draw(st.sampled_from([0.0, 6.0, 1e8]))),
        np.eye(draw(st.sampled_from([n, n, n, 3]))) * scale,
        draw(st.sampled_from([NEVER, *EPOCHS])),
        maybe(7),
        maybe(n),
        maybe(c),
        maybe(c),
        draw(st.sampled_from([0.0, 3.0, 1e9])),
        tuple(Line(epoch, block(n + draw(st.sampled_from([0, c])))) for epoch in lines),
        draw(st.booleans()),
        draw(st.booleans()),
    )


@limits(max_examples=sized(100, 300), deadline=None)
@given(snapshots(), st.sampled_from(["range", "bearing", "vector", "smell"]), st.sampled_from(EPOCHS))
def test_no_snapshot_stops_the_agent(snapshot: JointSnapshot, kind: str, epoch: Epoch) -> None:
    story = met()
    subject = story.agents[FIRST]
    z = np.array([5.0, 0.1])[: 2 if kind == "vector" else 1]
    subject.handle(received(PairRequest(epoch, (Measurement(kind, z, np.eye(len(z)) * 0.01),), snapshot)))
    sees(subject, SECOND, 3 * NS)
    subject.handle(received(PairReply(Epoch(3 * NS, FIRST, 2), ReplyStatus.OK, snapshot), 10))
    np.linalg.cholesky(story.filter(FIRST).state.cov)
    assert np.all(np.isfinite(story.filter(FIRST).state.mean))


@pytest.mark.parametrize(
    "wrong",
    [
        {"factor": np.ones((7, 3))},
        {"line": np.ones((7, 3))},
        {"noise": np.ones((7, 3))},
        {"prior": np.ones((7, 5))},
        {"mean": np.zeros(3)},
        {"cov": np.eye(3)},
        {"targets": ()},
        {"targets": (("t1", "hovercraft"),)},
        {"model": "hovercraft"},
        {"model": "constant_velocity"},
        {"lines": (Line(EPOCHS[1], np.eye(3)),)},
    ],
)
def test_a_wrong_size_is_counted_and_changes_nothing(wrong: dict[str, object]) -> None:
    story = met()
    told = story.filter(SECOND).snapshot(FIRST)
    assert isinstance(told, JointSnapshot)
    before = story.filter(FIRST).state
    item = Measurement("vector", np.array([-1.0, -5.0]), np.eye(2))
    spoiled = replace(told, **wrong)  # type: ignore[arg-type]
    story.agents[FIRST].handle(received(PairRequest(EPOCHS[2], (item,), spoiled)))
    assert story.agents[FIRST].counters["pair.malformed"] == 1
    assert story.filter(FIRST).state is before
    # The same without the fault is used.
    story.agents[FIRST].handle(received(PairRequest(EPOCHS[2], (item,), told), 10))
    assert story.agents[FIRST].counters["pair.applied_responder"] == 1


def test_other_forms_are_refused_and_counted() -> None:
    story = met()
    plain = Agent(replace(settings(SECOND), localization=LocalizationSettings(form="published")))
    plain.handle(Odometry(3 * NS, 0, 3 * NS, DELTA, NOISE))
    sent = sees(plain, FIRST, 3 * NS)
    assert sent is not None and isinstance(sent.body, PairRequest)
    story.agents[FIRST].handle(received(sent.body))
    assert story.agents[FIRST].counters["pair.other_form"] == 1
    own = sees(story.agents[FIRST], SECOND, 3 * NS)
    assert own is not None and isinstance(own.body, PairRequest)
    plain.handle(Received(3 * NS, Message(Header(FIRST, 1, 1, 1, 3 * NS, 3 * NS), own.body)))
    assert plain.counters["pair.other_form"] == 1


def test_targets_that_only_one_tracks_are_no_matter_of_the_pair() -> None:
    """A robot that tracks nothing is met like any other."""
    bare = Agent(replace(settings(SECOND), track=False))
    bare.handle(Odometry(3 * NS, 0, 3 * NS, 3.0 * DELTA, NOISE))
    fresh = Agent(settings(FIRST))
    fresh.handle(Odometry(3 * NS, 0, 3 * NS, 3.0 * DELTA, NOISE))
    sent = sees(bare, FIRST, 3 * NS)
    assert sent is not None and isinstance(sent.body, PairRequest)
    fresh.handle(received(sent.body))
    assert fresh.counters["pair.applied_responder"] == 1
    assert fresh.counters["pair.targets_unused"] == 0
    assert np.trace(fresh.filter.state.cov[3:5, 3:5]) > 0.9 * np.trace(TARGET_COV[:2, :2])
