"""A team that tells each other all raw data: the centralized filter in every robot, and honest whatever is lost."""

from __future__ import annotations

import numpy as np
import pytest

from sim.metrics import reduce_trial
from sim.scenario_file import load
from sim.trial import run_trial
from tests.sizes import THOROUGH, sized

WINDOW = (20.0, 60.0)
DENSE = [f"duration_s={WINDOW[1]}", f"window_s=[{WINDOW[0]}, {WINDOW[1]}]", "localization.kind=replica"]
SEEDS = range(1, sized(2, 4) + 1)


@pytest.mark.parametrize(
    ("name", "more"),
    [
        ("dense-6", []),
        ("dense-6-anchored", ["localization.transform=jacobian"]),
        ("ut-clat-quadrotors", []),
        ("ajlatt-replica", []),
    ],
)
def test_without_loss_every_robot_has_the_centralized_belief(name: str, more: list[str]) -> None:
    made = load(name, ["duration_s=20", "window_s=[5, 20]", "localization.kind=replica", *more])
    trace = run_trial(made, 2, with_bound=True).trace
    assert trace.bound is not None
    for robot, own in trace.robots.items():
        bound = trace.bound["robots"][robot]
        np.testing.assert_allclose(own.mean, bound.mean, atol=1e-9)
        np.testing.assert_allclose(own.cov, bound.cov, atol=1e-9)
    for target, tracks in trace.targets.items():
        bound = trace.bound["targets"][target]
        for track in tracks.values():
            np.testing.assert_allclose(track.mean, bound.mean, atol=1e-9)
            np.testing.assert_allclose(track.cov, bound.cov, atol=1e-9)


def played(loss: float) -> tuple[dict[str, float], float]:
    """Mean NEES per degree of freedom of robots and of tracks, the worst of each; mean log of the final volume."""
    made = load("dense-6", [*DENSE, f"links.loss={loss}"])
    robots, tracks, volumes = [], [], []
    for seed in SEEDS:
        trace = run_trial(made, seed).trace
        reduced = reduce_trial(trace, WINDOW)
        robots += [item["nees"] / item["count"] for item in reduced["robots"].values()]
        tracks += [item["nees"] / item["count"] for item in reduced["targets"]["t1"].values()]
        volumes += [float(np.linalg.slogdet(own.cov[-1])[1]) for own in trace.robots.values()]
    figures = {
        "robots": float(np.mean(robots)),
        "worst robot": max(robots),
        "tracks": float(np.mean(tracks)),
        "worst track": max(tracks),
    }
    return figures, float(np.mean(volumes))


@pytest.fixture(scope="module")
def lossless() -> tuple[dict[str, float], float]:
    return played(0.0)


@pytest.mark.parametrize("loss", [0.3, 0.6] if THOROUGH else [0.6])
def test_a_robot_that_misses_much_knows_less_and_says_so(loss: float, lossless: tuple[dict[str, float], float]) -> None:
    """The same seeds without loss are the measure, since linearization and few seeds make it differ from 1.

    Robots that count what they missed as known would be overconfident by factors.
    """
    figures, volume = played(loss)
    ideal, smallest = lossless
    assert volume > smallest
    for name in ("robots", "tracks"):
        assert 0.7 * ideal[name] < figures[name] < 1.25 * ideal[name], (figures, ideal)
    for name in ("worst robot", "worst track"):
        assert figures[name] < 1.7 * ideal[name], (figures, ideal)
