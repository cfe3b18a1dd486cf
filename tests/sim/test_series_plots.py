"""Lines over time: pooled over robots, and one per run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes

from sim import plots
from sim.series_plots import (
    anees_over_time,
    each_rmse,
    fleet_anees,
    fleet_rmse,
    pair_distances,
    pooled,
    rmse_over_time,
    shortened,
)

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(autouse=True)
def _coarse_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plots, "DPI", 40)


@pytest.fixture
def dotted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Colours of the dotted lines that have points, as they are drawn."""
    found: list[str] = []
    real = Axes.plot

    def note(self: Axes, *points: Any, **look: Any) -> Any:
        if look.get("ls") == ":" and len(points[0]):
            found.append(look["color"])
        return real(self, *points, **look)

    monkeypatch.setattr(Axes, "plot", note)
    return found


def series(scale: float = 1.0, seconds: int = 20, bound: float | None = 0.5) -> dict[str, Any]:
    line = [scale * (1.0 + 0.1 * k) for k in range(seconds)]
    robots: dict[str, list[float | None]] = {"r1": list(line), "r2": [None, *line[1:]]}
    found: dict[str, Any] = {
        "t_s": [float(k) for k in range(seconds)],
        "position_rmse_m": robots,
        "anees": robots,
        "target_position_rmse_m": {"t1": robots},
    }
    if bound is not None:
        found["bound_position_rmse_m"] = {name: [bound] * seconds for name in robots}
        found["bound_target_position_rmse_m"] = {"t1": [bound] * seconds}
    return found


def test_pairs_are_drawn_with_the_nearest_of_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[np.ndarray[Any, Any]] = []
    real = Axes.plot

    def note(self: Axes, *points: Any, **look: Any) -> Any:
        if len(points[0]):
            drawn.append(np.asarray(points[1]))
        return real(self, *points, **look)

    monkeypatch.setattr(Axes, "plot", note)
    t_s = np.arange(3.0)
    places = np.zeros((3, 3, 2))
    places[:, 1, 0], places[:, 2, 0] = [3.0, 4.0, 9.0], [10.0, 10.0, 10.0]
    path = pair_distances(t_s, places, 2.0, tmp_path / "distances.png")
    assert path.read_bytes().startswith(PNG)
    assert sorted(map(tuple, drawn[0].T)) == [(3.0, 4.0, 9.0), (7.0, 6.0, 1.0), (10.0, 10.0, 10.0)]
    np.testing.assert_array_equal(drawn[1], [3.0, 4.0, 1.0])
    swarm = np.random.default_rng(1).normal(size=(3, 20, 2))
    pair_distances(t_s, swarm, 2.0, tmp_path / "swarm.png")
    assert drawn[2].shape == (3, plots.MAX_PAIRS)
    np.testing.assert_array_equal(drawn[3], drawn[2].min(axis=1))


def test_pooling_takes_what_there_is() -> None:
    lines: list[list[float | None]] = [[3.0, None, None], [4.0, 2.0, None]]
    assert pooled(lines, root=True)[:2] == pytest.approx([np.sqrt(12.5), 2.0])
    assert pooled(lines, root=False)[:2] == pytest.approx([3.5, 2.0])
    assert np.isnan(pooled(lines, root=True)[2])


def test_a_filter_all_runs_share_is_dotted_once(tmp_path: Path, dotted: list[str]) -> None:
    fleet_rmse([("a", series()), ("b", series(2.0)), ("c", series(3.0))], tmp_path / "p.png")
    assert dotted == [plots.GREY, plots.GREY]  # robots and tracks


def test_filters_on_different_data_are_dotted_in_the_colour_of_their_first_run(
    tmp_path: Path, dotted: list[str]
) -> None:
    runs = [("a", series()), ("b", series(2.0)), ("c", series(3.0, bound=0.7)), ("d", series(bound=None))]
    fleet_rmse(runs, tmp_path / "p.png")
    assert dotted == [plots.colour(0), plots.colour(2)] * 2


def test_runs_of_different_lengths_and_fleets_share_the_pictures(tmp_path: Path) -> None:
    other = series(seconds=35, bound=None)
    other["position_rmse_m"] = {"drone": [1.0] * 35}
    other["anees"], other["target_position_rmse_m"] = other["position_rmse_m"], {}
    runs = [("short", series()), ("long", other)]
    for make in (fleet_rmse, each_rmse, fleet_anees):
        assert make(runs, tmp_path / "p.png").read_bytes().startswith(PNG)


def test_many_trials_have_their_picture_with_and_without_targets(tmp_path: Path, dotted: list[str]) -> None:
    rmse_over_time(series(), tmp_path / "p.png")
    assert dotted == [plots.colour(0), plots.colour(1), plots.GREY]
    alone = series(bound=None)
    del alone["target_position_rmse_m"]
    rmse_over_time(alone, tmp_path / "q.png")
    assert len((tmp_path / "q.png").read_bytes()) < len((tmp_path / "p.png").read_bytes())


@pytest.mark.parametrize("dof", [None, 3])
def test_consistency_is_drawn_whether_or_not_the_size_of_the_states_is_known(tmp_path: Path, dof: int | None) -> None:
    assert anees_over_time(series(), dof, 10, tmp_path / "p.png").read_bytes().startswith(PNG)


def test_long_names_are_cut() -> None:
    assert shortened("loss=0.3") == "loss=0.3"
    assert len(shortened("x" * 100)) == 34
