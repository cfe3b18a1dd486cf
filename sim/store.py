"""What a report is made from, kept in the run directory as `trace.npz`."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.estimation.gate_test import GateTest
from sim.metrics import StateTrace, TrialTrace
from sim.relative_figures import RelativeTrace, ShownGate
from sim.sight import View

FILE = "trace.npz"
GATE_PARTS = ("bearings", "weight", "expected", "spread", "gate")

Instants = dict[tuple[str, str], NDArray[np.float64]]
"""Times [s] at which a robot measured somebody, by (robot, of)."""


@dataclass(frozen=True, slots=True)
class Stored:
    """A trial's samples with the contacts (time [s], robot, peer), landmarks, instants of relative measurements, and
    fields of view by robot.
    """

    trace: TrialTrace
    contacts: list[tuple[float, str, str]]
    landmarks: dict[str, tuple[float, float]]
    measured: Instants = field(default_factory=dict)
    views: dict[str, list[View]] = field(default_factory=dict)
    gate: ShownGate | None = None


def save_trace(
    run_dir: Path,
    trace: TrialTrace,
    contacts: list[tuple[float, str, str]],
    landmarks: dict[str, tuple[float, ...]],
    measured: Instants | None = None,
    views: dict[str, list[View]] | None = None,
    gate: ShownGate | None = None,
) -> None:
    """Write `trace.npz`, of landmarks x and y.

    Instants are kept to the microsecond as gaps, which are nearly all alike and so pack well.
    """
    arrays: dict[str, Any] = {"t_s": trace.t_s}
    index: list[dict[str, Any]] = []

    def add(group: str, names: list[str], state: StateTrace) -> None:
        key = str(len(index))
        index.append({"group": group, "names": names, "angles": list(state.angles), "position": list(state.position)})
        arrays[f"{key}.truth"], arrays[f"{key}.mean"], arrays[f"{key}.cov"] = state.truth, state.mean, state.cov

    for name, state in trace.robots.items():
        add("robots", [name], state)
    for target, owners in trace.targets.items():
        for owner, state in owners.items():
            add("targets", [target, owner], state)
    for group, states in (trace.bound or {}).items():
        for name, state in states.items():
            add(f"bound.{group}", [name], state)
    for place, times in enumerate((measured or {}).values()):
        arrays[f"measured.{place}"] = np.diff(np.round(times * 1e6).astype(np.int64), prepend=0)
    parts = [item.name for item in fields(RelativeTrace)]
    for place, relative in enumerate(trace.relatives.values()):
        arrays |= {f"relative.{place}.{name}": getattr(relative, name) for name in parts}
    if gate is not None:
        arrays |= {f"gate.{name}": getattr(gate.test, name) for name in GATE_PARTS} | {"gate.truth": gate.truth}
    meta = {
        "index": index,
        "relatives": list(trace.relatives),
        "contacts": contacts,
        "landmarks": {name: place[:2] for name, place in landmarks.items()},
        "bound": trace.bound is not None,
        "measured": list(measured or {}),
        "views": views or {},
        "gate": None if gate is None else [gate.t_s, gate.robot, gate.peer, gate.test.limit],
    }
    np.savez_compressed(run_dir / FILE, meta=np.array(json.dumps(meta)), **arrays)


def load_trace(run_dir: Path) -> Stored | None:
    """Read `trace.npz`; None when the run has none (many trials keep no samples)."""
    path = run_dir / FILE
    if not path.exists():
        return None
    with np.load(path, allow_pickle=False) as data:
        meta = json.loads(str(data["meta"]))
        robots: dict[str, StateTrace] = {}
        targets: dict[str, dict[str, StateTrace]] = {}
        bound: dict[str, dict[str, StateTrace]] = {"robots": {}, "targets": {}}
        for key, entry in enumerate(meta["index"]):
            state = StateTrace(
                data[f"{key}.truth"],
                data[f"{key}.mean"],
                data[f"{key}.cov"],
                tuple(entry["angles"]),
                tuple(entry.get("position", (0, 1))),
            )
            names = entry["names"]
            if entry["group"] == "robots":
                robots[names[0]] = state
            elif entry["group"] == "targets":
                targets.setdefault(names[0], {})[names[1]] = state
            else:
                bound[entry["group"].removeprefix("bound.")][names[0]] = state
        relatives = {
            (str(robot), str(peer)): RelativeTrace(
                **{item.name: data[f"relative.{place}.{item.name}"] for item in fields(RelativeTrace)}
            )
            for place, (robot, peer) in enumerate(meta.get("relatives", []))
        }
        best = bound if meta["bound"] else None
        trace = TrialTrace(t_s=data["t_s"], robots=robots, targets=targets, bound=best, relatives=relatives)
        measured = {
            (str(robot), str(of)): np.cumsum(data[f"measured.{place}"]) * 1e-6
            for place, (robot, of) in enumerate(meta.get("measured", []))
        }
        gate = None
        if meta.get("gate"):
            t_s, robot, peer, limit = meta["gate"]
            test = GateTest(**{name: data[f"gate.{name}"] for name in GATE_PARTS}, limit=limit)
            gate = ShownGate(t_s, robot, peer, data["gate.truth"], test)
    contacts = [(float(t), str(a), str(b)) for t, a, b in meta["contacts"]]
    landmarks = {name: (float(x), float(y)) for name, (x, y) in meta["landmarks"].items()}
    views = {name: [View(*item) for item in items] for name, items in meta.get("views", {}).items()}
    return Stored(trace, contacts, landmarks, measured, views, gate)
