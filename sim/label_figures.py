"""How often robots are right about whom their cameras have seen, who do not tell: figures of one trial, and of many."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from agent.effects import Named
from agent.settings import NS
from sim.world import Output

KEPT_NS = 30 * NS
"""Bearings that have no name by then have none."""


class LabelLog:
    """Bearings of one trial that came without a name, and the names that robots gave them; `seen` of a robot,
    `right` and `wrong` names."""

    def __init__(self) -> None:
        self._truly: dict[tuple[str, str, bytes], tuple[int, str]] = {}
        self._forgotten_ns = 0
        self.seen = self.right = self.wrong = 0

    def add(self, outputs: Iterable[Output]) -> None:
        """What a world offers at an instant."""
        for item in outputs:
            if item.truly is not None:
                self._truly[item.robot, item.sensor, item.z.tobytes()] = item.t_ns, item.truly
                self.seen += item.truly != ""
                if item.t_ns >= self._forgotten_ns + KEPT_NS:
                    kept = {key: found for key, found in self._truly.items() if found[0] > self._forgotten_ns}
                    self._truly, self._forgotten_ns = kept, item.t_ns

    def judge(self, robot: str, named: Named) -> None:
        """A robot has given a name. A bearing counts once."""
        found = self._truly.pop((robot, named.sensor, named.z.tobytes()), None)
        if found is not None:
            self.right += found[1] == named.peer
            self.wrong += found[1] != named.peer

    def figures(self) -> dict[str, int] | None:
        """Counts of the trial; None if no camera kept a name to itself."""
        return {"seen": self.seen, "right": self.right, "wrong": self.wrong} if self.seen else None


def combine_labels(trials: Sequence[dict[str, int]]) -> dict[str, Any]:
    """Over trials: `used`, bearings with a name; the share of wrong ones among them; the share of bearings that were of
    a robot and used."""
    seen, right, wrong = (sum(trial[key] for trial in trials) for key in ("seen", "right", "wrong"))
    used = right + wrong
    return {"used": used, "wrong_share": wrong / used if used else None, "used_share": used / seen if seen else None}
