"""The comparison with a factor-graph smoother: `python -m benchmarks.smoother`."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from agent.estimation.triangulation import transition
from benchmarks.smoother import (
    PLAIN,
    Bearings,
    Played,
    bearing_error,
    bearings,
    centralized,
    distributed,
    main,
    motion_error,
    nearest,
    smoothed,
    table,
)
from sim.scenario_file import load
from tests.agent.estimation.triangulation_world import LAYOUT

SHORT = ("duration_s=2.0", "window_s=[1.0, 2.0]")


@pytest.fixture(scope="module")
def made() -> Bearings:
    return bearings(load("stt-circle", SHORT), 1)


class Two:
    """A factor of two states, and their values, in one."""

    def __init__(self, *states: np.ndarray) -> None:
        self._states = states

    def keys(self) -> list[int]:
        return list(range(len(self._states)))

    def atVector(self, key: int) -> np.ndarray:
        return self._states[key]


def test_without_gtsam_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "gtsam", None)
    assert main([]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "gtsam is not installed" in line and "pip install --editable '.[smoother]'" in line


def test_bearings_are_those_of_the_scenario(made: Bearings) -> None:
    np.testing.assert_allclose(made.places, LAYOUT)
    assert made.near.shape == (10, 3) and made.directions.shape == (20, 10, 3) and made.q == pytest.approx(5.0)
    away = made.truth[:, None, :3] - made.places
    cosine = np.sum(away * made.directions, axis=-1) / np.linalg.norm(away, axis=-1)
    angles = np.arccos(np.clip(cosine, -1.0, 1.0))
    assert np.sqrt(np.mean(angles**2) / 2.0) == pytest.approx(0.1 / np.sqrt(3.0), rel=0.15)


def test_errors_vanish_at_the_truth_and_slopes_are_theirs() -> None:
    rng = np.random.default_rng(3)
    state, dt = np.append(rng.normal(size=3), rng.normal(size=3)), 0.1
    away = state[:3] - LAYOUT
    exact = bearing_error(LAYOUT, away / np.linalg.norm(away, axis=-1)[:, None])
    assert np.abs(exact(Two(state), Two(state), None)).max() < 1e-12
    assert nearest(LAYOUT, away / np.linalg.norm(away, axis=-1)[:, None]) == pytest.approx(state[:3])
    moving = motion_error(transition(dt))
    assert np.abs(moving(Two(state, transition(dt) @ state), Two(state, transition(dt) @ state), None)).max() < 1e-12
    noisy = bearing_error(LAYOUT, away + 3.0 * rng.normal(size=away.shape))
    for error, states in ((noisy, [state]), (moving, [state, rng.normal(size=6)])):
        slopes = [np.empty(0)] * len(states)
        error(Two(*states), Two(*states), slopes)
        for which, slope in enumerate(slopes):
            for axis in range(6):
                ends = []
                for step in (1e-6, -1e-6):
                    there = [item.copy() for item in states]
                    there[which][axis] += step
                    ends.append(error(Two(*there), Two(*there), None))
                np.testing.assert_allclose((ends[0] - ends[1]) / 2e-6, slope[:, axis], atol=1e-6)


def test_filters_are_those_that_robots_run(made: Bearings) -> None:
    """All settle within two seconds, as they do in a fleet; that of all bearings is the best."""
    last = {kind: centralized(kind, made).errors[-5:, :3] for kind in ("ckf", "central_plus")}  # type: ignore[arg-type]
    last |= {kind: distributed(kind, made).errors[-5:, :, :3] for kind in ("stt", "icf_plus")}  # type: ignore[arg-type]
    rmse = {kind: float(np.sqrt(np.mean(np.sum(errors**2, axis=-1)))) for kind, errors in last.items()}
    assert rmse["central_plus"] < rmse["icf_plus"] < rmse["stt"] < 4.5, rmse


def test_figures_are_over_all_trials_and_times_are_ratios() -> None:
    off = np.zeros((200, 6))
    off[:, 0], off[:, 4] = 3.0, 2.0
    better = off.copy()
    better[99:, :] = 0.0
    printed = table({"ckf": [Played(off, 0.5)], "other": [Played(better, 10.0), Played(off, 6.0)]}, 0.1, "made up")
    first, other = printed.splitlines()[4:6]
    assert [cell.strip() for cell in first.strip("|").split("|")] == ["`ckf`", "3.00", "3.00", "2.00", "2.00", "1.0"]
    assert [cell.strip() for cell in other.strip("|").split("|")][2:] == ["2.12", "1.73", "1.41", "16"]


def test_the_newest_state_is_that_of_a_filter_of_plain_least_squares(made: Bearings) -> None:
    gtsam = pytest.importorskip("gtsam", reason="gtsam is not installed: pip install --editable '.[smoother]'")
    newest, whole = smoothed(made, gtsam)
    plain = centralized("central_plus", made, gate=PLAIN)

    def rmse(played: Played) -> float:
        return float(np.sqrt(np.mean(np.sum(played.errors[5:, :3] ** 2, axis=-1))))

    assert rmse(newest) == pytest.approx(rmse(plain), rel=0.1)
    assert rmse(whole) < rmse(newest)
    np.testing.assert_array_equal(whole.errors[-1], newest.errors[-1])
