"""A leader's steps while it finds out which bearing is of whom, in all forms side by side."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agent.estimation.correspondence import BodyMotion, Correspondence, CorrespondenceSettings, Scan
from agent.estimation.gaussian import wrap
from agent.estimation.relative_motion import stepped

Array = NDArray[np.float64]

TARGETS = 4
RATE_HZ = 20.0
STEPS = 200
SCAN_EVERY = 2
FORMS = {
    "improved": CorrespondenceSettings(),
    "published": CorrespondenceSettings(form="published"),
    "nearest": CorrespondenceSettings(kind="nearest"),
}

# Noises of De Silva, Mann, Gosine 2015, section III.
VELOCITY = np.diag([0.05, 0.05, 0.05, 0.02236068]) ** 2 * RATE_HZ
BEARING = 0.0036 * np.eye(2)
RANGE_M2, HEIGHT_M2 = 8e-6, 5e-6
DETECTION = 0.95

PEERS = tuple(f"p{index + 1}" for index in range(TARGETS))


@dataclass(frozen=True, slots=True)
class Step:
    """What a leader is told of one step: how everybody moved, and what it sensed at the end, if anything."""

    own: BodyMotion
    peers: dict[str, BodyMotion]
    scan: Scan | None


def story(seed: int = 1) -> list[Step]:
    """Ten seconds of a leader and its targets, which begin anywhere within 10 m and fly circles."""
    rng = np.random.default_rng(seed)
    places = np.column_stack([rng.uniform(-5.0, 5.0, (TARGETS, 2)), rng.uniform(-1.0, 1.0, TARGETS)])
    truth = np.column_stack([places, rng.uniform(-np.pi, np.pi, TARGETS)])
    flown = np.zeros((1 + TARGETS, 4))
    flown[:, 0], flown[:, 3] = rng.uniform(0.4, 0.8, 1 + TARGETS), rng.uniform(0.1, 0.25, 1 + TARGETS)
    steps, nothing = [], np.zeros((4, 4))
    for k in range(1, STEPS + 1):
        truth, _ = stepped(
            truth, np.zeros((TARGETS, 4, 4)), flown[0], nothing, flown[1:], nothing, 1.0 / RATE_HZ, False
        )
        told = flown + rng.normal(0.0, np.sqrt(np.diagonal(VELOCITY)), flown.shape)
        own, *others = (BodyMotion(velocity, VELOCITY) for velocity in told)
        scan = _scan(rng, truth) if k % SCAN_EVERY == 0 else None
        steps.append(Step(own, dict(zip(PEERS, others, strict=True)), scan))
    return steps


def _scan(rng: np.random.Generator, truth: Array) -> Scan:
    """Ranges and heights of known robots, bearings of nobody knows whom, and one of nobody."""
    x, y, z = truth[:, :3].T
    directions = np.column_stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])
    seen = directions[rng.uniform(size=TARGETS) < DETECTION]
    seen = seen + rng.multivariate_normal(np.zeros(2), BEARING, len(seen))
    false = rng.uniform([-np.pi, -0.25 * np.pi], [np.pi, 0.25 * np.pi], (rng.poisson(1.0), 2))
    bearings = np.concatenate([seen, false])
    bearings[:, 0] = wrap(bearings[:, 0])
    distances = np.linalg.norm(truth[:, :3], axis=1) + rng.normal(0.0, RANGE_M2**0.5, TARGETS)
    ranges = {peer: (float(r), RANGE_M2) for peer, r in zip(PEERS, distances) if rng.uniform() < DETECTION}
    heights = {peer: (float(h + rng.normal(0.0, HEIGHT_M2**0.5)), HEIGHT_M2) for peer, h in zip(PEERS, z)}
    return Scan(rng.permutation(bearings), BEARING, ranges, heights)


def times(rounds: int = 3) -> dict[str, float]:
    """Mean CPU time [s] of one step by form, all forms in turns; of the round that was least disturbed."""
    told, best = story(), dict.fromkeys(FORMS, float("inf"))
    for _ in range(rounds):
        leaders = {name: Correspondence(settings, PEERS, "l1") for name, settings in FORMS.items()}
        taken = dict.fromkeys(FORMS, 0.0)
        for step in told:
            for name, leader in leaders.items():
                begin = time.process_time()
                leader.advance(step.own, step.peers, 1.0 / RATE_HZ)
                if step.scan is not None:
                    leader.scan(step.scan)
                taken[name] += time.process_time() - begin
        best = {name: min(best[name], taken[name] / len(told)) for name in FORMS}
    return best
