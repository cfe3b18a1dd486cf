"""Pictures of robots that choose their motion: what is drawn where."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.patches import Wedge

from sim import plots
from sim.metrics import StateTrace, TrialTrace
from sim.motion_plots import potentials, snapshots
from sim.sight import View


@pytest.fixture(autouse=True)
def _coarse_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plots, "DPI", 40)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> dict[str, tuple[Any, Any]]:
    """Lines that have a name, as they are drawn."""
    found: dict[str, tuple[Any, Any]] = {}
    real = Axes.plot

    def note(self: Axes, *points: Any, **look: Any) -> Any:
        if "label" in look:
            found[look["label"]] = points[0], points[1]
        return real(self, *points, **look)

    monkeypatch.setattr(Axes, "plot", note)
    return found


def test_published_and_improved_differ_where_they_should(tmp_path: Path, drawn: dict[str, tuple[Any, Any]]) -> None:
    assert potentials(15.0, tmp_path / "p.png").stat().st_size > 0

    def free(name: str) -> tuple[float, float]:
        """Where the cost is nothing."""
        distance, cost = drawn[name]
        return float(distance[cost == 0.0].min()), float(distance[cost == 0.0].max())

    assert free("target, published") == pytest.approx((4.0, 18.0), abs=0.1)
    assert free("target, improved") == pytest.approx((5.0, 12.0), abs=0.1)
    assert free("neighbour, published") == pytest.approx((4.0, 28.0), abs=0.1)
    assert free("neighbour, improved") == pytest.approx((5.0, 28.0), abs=0.1)
    distance, capped = drawn["radial, capped"]
    printed_at, printed = drawn["as printed: without end at 6 m"]
    assert np.isfinite(capped).all() and printed.min() < 2.0 * capped.min()
    assert printed_at.min() > 6.0
    np.testing.assert_allclose(printed[printed_at > 6.2], capped[distance > 6.2])
    potentials(10.0, tmp_path / "p.png")
    assert free("target, improved")[1] == pytest.approx(7.0, abs=0.1)


def trace() -> TrialTrace:
    """r1 drives east, r2 stands and looks north; a target far in the north east."""
    t_s = np.arange(11.0)

    def state(x: Any, y: float, heading: float) -> StateTrace:
        truth = np.stack([np.broadcast_to(x, t_s.shape), np.full(11, y), np.full(11, heading)], axis=1)
        return StateTrace(truth, truth + np.array([0.5, 0.0, 0.0]), np.tile(np.eye(3), (11, 1, 1)), (2,))

    tracks = {"r1": state(20.0, 30.0, 0.0), "r2": state(20.0, 30.0, 0.0)}
    return TrialTrace(t_s, {"r1": state(t_s, 0.0, 0.0), "r2": state(0.0, 5.0, np.pi / 2)}, {"t1": tracks}, None)


def test_a_snapshot_has_a_panel_per_instant_and_a_sector_per_sensor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sectors: list[Wedge] = []
    panels: dict[int, Axes] = {}
    real = Axes.add_patch

    def note(self: Axes, patch: Any) -> Any:
        if isinstance(patch, Wedge):
            sectors.append(patch)
            panels[id(self)] = self
        return real(self, patch)

    monkeypatch.setattr(Axes, "add_patch", note)
    views = {"r1": [View(1.0, 0.5, 0.0, 1.0, 2.0, 15.0)], "r2": [View(1.0, 0.5, 0.0, 1.0, 2.0, None)]}
    snapshots(trace(), views, (0.0, 4.2, 99.0), tmp_path / "s.png")
    assert [axes.get_title(loc="left") for axes in panels.values()] == ["0 s", "4 s", "10 s"]
    assert len(sectors) == 6
    assert [tuple(sector.center) for sector in sectors[::2]] == [(1.0, 0.5), (5.0, 0.5), (11.0, 0.5)]
    assert sectors[1].center == pytest.approx((-0.5, 6.0)), "the mount turns with the robot"
    assert np.radians([sectors[1].theta1, sectors[1].theta2]) == pytest.approx(np.pi / 2 + np.array([-0.5, 0.5]))
    assert (sectors[0].r, sectors[0].width) == (15.0, 13.0)
    widths = {round(axes.get_xlim()[1] - axes.get_xlim()[0], 6) for axes in panels.values()}
    assert len(widths) == 1, "one scale"
    for axes in panels.values():
        assert axes.get_xlim()[0] < 0.0 and axes.get_ylim()[1] > 30.0, "everybody is inside"
