"""The rules of the house that a machine can check: imports point down, the pure rooms have no I/O."""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FLOORS = ("network", "agent", "sim", "deploy")
IMPURE = {"asyncio", "socket", "threading", "time", "random", "os", "subprocess", "secrets", "zenoh", "select"}

PURE = (
    "network/messages.py",
    "network/wire.py",
    "network/relative_messages.py",
    "network/wire_relative.py",
    "network/endpoint.py",
    "network/clock.py",
    "network/peers.py",
    "network/links.py",
    "agent/core.py",
    "agent/timeline.py",
    "agent/history.py",
    "agent/belief.py",
    "agent/pairing.py",
    "agent/pairs.py",
    "agent/node.py",
    "agent/events.py",
    "agent/effects.py",
    "agent/settings.py",
    "agent/sensor_input.py",
    "agent/autopilot.py",
    "agent/steering_link.py",
    "agent/flight_modes.py",
    "agent/plan_timer.py",
    "agent/frames.py",
    "agent/relative_filter.py",
    "agent/relative_leader.py",
    "agent/told_hypotheses.py",
    "agent/peer_motion.py",
    *(str(path.relative_to(ROOT)) for path in sorted((ROOT / "agent" / "estimation").glob("*.py"))),
    *(str(path.relative_to(ROOT)) for path in sorted((ROOT / "agent" / "planning").glob("*.py"))),
    "sim/world.py",
    "sim/motion.py",
    "sim/course.py",
    "sim/arcs.py",
    "sim/clutter.py",
    "sim/relative_figures.py",
    "sim/directions.py",
    "sim/vehicle.py",
    "sim/motion_figures.py",
    "sim/sight.py",
    "sim/noise.py",
    "sim/metrics.py",
    "sim/vehicle_control.py",
)
CONFIG_ONLY = (
    "agent/config.py",
    "agent/config_file.py",
    "agent/config_parts.py",
    "agent/fault_parts.py",
    "agent/planning_parts.py",
    "agent/relative_parts.py",
    "agent/start_config.py",
    "sim/scenario.py",
)


@functools.cache
def imports(path: Path) -> frozenset[str]:
    """Modules a file imports, wherever in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found.add(node.module)
    return frozenset(found)


def modules() -> list[Path]:
    return [path for floor in FLOORS for path in sorted((ROOT / floor).rglob("*.py"))]


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_down(path: Path) -> None:
    floor = FLOORS.index(path.relative_to(ROOT).parts[0])
    above = [name for name in imports(path) if name.split(".")[0] in FLOORS[floor + 1 :]]
    assert above == []
    if str(path.relative_to(ROOT)) not in CONFIG_ONLY:
        assert not [name for name in imports(path) if name.split(".")[0] == "pydantic"]


@pytest.mark.parametrize("name", PURE)
def test_pure_rooms_have_no_io(name: str) -> None:
    assert not {module.split(".")[0] for module in imports(ROOT / name)} & IMPURE


@pytest.mark.parametrize("path", modules(), ids=lambda path: str(path.relative_to(ROOT)))
def test_no_module_sits_in_a_circle(path: Path) -> None:
    graph: dict[str, set[str]] = {}
    for item in modules():
        name = ".".join(item.relative_to(ROOT).with_suffix("").parts)
        graph[name] = {module for module in imports(item) if module.split(".")[0] in FLOORS}
    start = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    # What is imported only for type checking may point back.
    if start in ("deploy.launch", "deploy.status"):
        graph["deploy.status"] = graph["deploy.status"] - {"deploy.launch"}
    seen: set[str] = set()
    frontier = sorted(graph[start])
    while frontier:
        name = frontier.pop()
        assert name != start, f"{start} imports itself in the end"
        if name not in seen:
            seen.add(name)
            frontier += sorted(graph.get(name, set()))


def test_make_test_plays_every_test_of_real_time() -> None:
    """It looks for them in a few folders, for to collect all tests takes seconds."""
    (line,) = re.findall(r"-m realtime (.*)", (ROOT / "Makefile").read_text())
    marked = {path for path in (ROOT / "tests").rglob("test_*.py") if "mark.realtime" in path.read_text()}
    found = {path for path in marked if any(path.is_relative_to(ROOT / folder) for folder in line.split())}
    assert marked - found == {Path(__file__)}
