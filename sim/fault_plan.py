"""The faults of one trial: those a scenario states, and those it has drawn.

A plan is drawn from the trial's seed alone. Link faults follow each other like weather: partitions last at least
`STABLE_S`, links are clogged one by one and freed in another order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agent.fault_parts import AnyFaultPart, made, named
from sim.noise import generator
from sim.scenario import Scenario

STABLE_S = 1.0
"""The shortest partition; also the shortest time between two of them."""


@dataclass(frozen=True, slots=True)
class Intensity:
    """What a plan may do: how many spells of each sort per robot or fleet and minute, and how bad they are."""

    background_loss: float
    background_tail_s: float
    partitions: float
    clogs: float
    bursts: float
    sensors: float
    clocks: float
    processes: float
    forgeries: float
    corrupt: float
    duplicate: float
    longest_s: float


INTENSITIES = {
    "calm": Intensity(0.02, 0.02, 0.5, 0.5, 0.5, 0.5, 0.0, 0.0, 0.0, 0.0, 0.02, 3.0),
    "field": Intensity(0.15, 0.15, 2.0, 2.0, 2.0, 1.0, 0.5, 1.0, 0.5, 0.01, 0.1, 6.0),
    "storm": Intensity(0.35, 0.5, 5.0, 5.0, 5.0, 2.0, 1.0, 3.0, 2.0, 0.05, 0.3, 10.0),
}


def trial_faults(scenario: Scenario, seed: int) -> dict[str, AnyFaultPart]:
    """All faults of a trial by name: the stated ones, then the drawn ones in order of their begin."""
    found = named(scenario.faults)
    if scenario.fault_plan is not None:
        drawn = sorted(Draw(scenario, seed).faults(), key=lambda fault: (fault.at_s, fault.kind))
        for index, fault in enumerate(drawn, start=1):
            found[f"drawn-{index}-{fault.kind}"] = fault
    return found


class Draw:
    """Draws the plan of one trial."""

    def __init__(self, scenario: Scenario, seed: int) -> None:
        assert scenario.fault_plan is not None
        self._part = scenario.fault_plan
        self._intensity = INTENSITIES[self._part.intensity]
        self._scenario = scenario
        self._robots = [robot.id for robot in scenario.robots]
        self._end_s = max(scenario.duration_s - self._part.quiet_s, 0.0)
        self._random = generator(seed, "fault_plan", self._part.intensity)

    def faults(self) -> list[AnyFaultPart]:
        """The faults, in no order."""
        if self._end_s < STABLE_S:
            return []
        found: list[AnyFaultPart] = self._background()
        if len(self._robots) > 1:
            found += self._partitions() + self._clogs() + self._bursts() + self._forgeries()
        found += self._sensors() + self._clocks()
        if self._part.processes:
            found += self._processes()
        return found

    # -- numbers ------------------------------------------------------------------------------------------

    def _count(self, per_minute: float) -> int:
        return int(self._random.poisson(per_minute * self._end_s / 60.0))

    def _uniform(self, low: float, high: float) -> float:
        return round(float(self._random.uniform(low, high)), 3)

    def _span(self, shortest_s: float = 0.5) -> dict[str, float]:
        """A spell that is over by the quiet end."""
        longest = min(max(self._intensity.longest_s, shortest_s), self._end_s)
        lasting = self._uniform(min(shortest_s, longest), longest)
        return {"at_s": self._uniform(0.0, max(self._end_s - lasting, 0.0)), "for_s": max(lasting, 0.001)}

    def _robot(self) -> str:
        return str(self._random.choice(self._robots))

    def _pair(self) -> tuple[str, str]:
        a, b = self._random.choice(len(self._robots), size=2, replace=False)
        return self._robots[int(a)], self._robots[int(b)]

    # -- sorts of faults ----------------------------------------------------------------------------------

    def _background(self) -> list[AnyFaultPart]:
        """What is wrong with all links until the quiet end."""
        how, lasting = self._intensity, {"for_s": self._end_s}
        found: list[AnyFaultPart] = [
            made(kind="loss", share=self._uniform(0.0, how.background_loss), **lasting),
            made(kind="delay", tail_s=self._uniform(0.0, how.background_tail_s), **lasting),
            made(
                kind="duplicate", share=self._uniform(0.0, how.duplicate), within_s=self._uniform(0.0, 1.0), **lasting
            ),
        ]
        if how.corrupt:
            found.append(made(kind="corrupt", share=self._uniform(0.0, how.corrupt), **lasting))
        return found

    def _partitions(self) -> list[AnyFaultPart]:
        """One after the other, symmetric, one-sided or of a single robot, each stable for a while."""
        found: list[AnyFaultPart] = []
        t_s = 0.0
        for _ in range(self._count(self._intensity.partitions)):
            t_s += self._uniform(STABLE_S, self._intensity.longest_s)
            lasting = self._uniform(STABLE_S, max(self._intensity.longest_s, STABLE_S))
            if t_s + lasting > self._end_s:
                break
            span = {"at_s": t_s, "for_s": lasting}
            t_s += lasting
            sort = self._random.integers(3)
            if sort == 0:
                found.append(made(kind="isolate", robot=self._robot(), **span))
                continue
            inside = [robot for robot in self._robots if self._random.random() < 0.5] or [self._robots[0]]
            outside = [robot for robot in self._robots if robot not in inside] or [self._robots[-1]]
            if sort == 1:
                found.append(made(kind="partition", groups=[inside, outside], **span))
            else:
                found.append(made(kind="partition", sources=inside, destinations=outside, both_ways=False, **span))
        return found

    def _clogs(self) -> list[AnyFaultPart]:
        """Links of a random subset are clogged one by one and freed in another order."""
        found: list[AnyFaultPart] = []
        for _ in range(self._count(self._intensity.clogs)):
            span = self._span(1.0)
            links = [self._pair() for _ in range(int(self._random.integers(1, 4)))]
            begins = np.sort(self._random.uniform(0.0, 0.4, len(links)))
            ends = self._random.uniform(0.6, 1.0, len(links))
            for (source, destination), begin, end in zip(links, begins, ends):
                found.append(
                    made(
                        kind="clog",
                        sources=[source],
                        destinations=[destination],
                        at_s=round(span["at_s"] + float(begin) * span["for_s"], 3),
                        for_s=max(round(float(end - begin) * span["for_s"], 3), 0.001),
                    )
                )
        return found

    def _bursts(self) -> list[AnyFaultPart]:
        found: list[AnyFaultPart] = []
        for _ in range(self._count(self._intensity.bursts)):
            source, destination = self._pair()
            links = {"sources": [source], "destinations": [destination]}
            if self._random.random() < 0.7:
                good, bad = self._uniform(0.3, 3.0), self._uniform(0.1, 2.0)
                found.append(made(kind="burst_loss", good_s=good, bad_s=bad, **links, **self._span()))
            else:
                rate = self._uniform(200.0, 2000.0)
                found.append(made(kind="rate_cap", bytes_per_s=rate, **links, **self._span()))
        return found

    def _forgeries(self) -> list[AnyFaultPart]:
        return [
            made(
                kind="forge",
                claims=self._robot(),
                content=str(self._random.choice(["damaged", "hostile", "replayed"])),
                rate_hz=self._uniform(1.0, 20.0),
                **self._span(),
            )
            for _ in range(self._count(self._intensity.forgeries))
        ]

    def _sensors(self) -> list[AnyFaultPart]:
        found: list[AnyFaultPart] = []
        for robot in self._scenario.robots:
            for _ in range(self._count(self._intensity.sensors)):
                names = sorted(robot.sensors)
                if not names or self._random.random() < 0.3:
                    span = self._span()
                    span["for_s"] = min(span["for_s"], 2.0)
                    found.append(made(kind="autopilot_silence", robot=robot.id, **span))
                    continue
                name = str(self._random.choice(names))
                found.append(made(kind="sensor_dropout", robot=robot.id, sensor=name, **self._span()))
        return found

    def _clocks(self) -> list[AnyFaultPart]:
        """Clocks drift as oscillators do; steps are left to stories that say what is to come of them."""
        return [
            made(kind="clock_drift", robot=robot, ppm=self._uniform(-50.0, 50.0), for_s=self._end_s)
            for robot in self._robots
            if self._random.random() < self._intensity.clocks
        ]

    def _processes(self) -> list[AnyFaultPart]:
        found: list[AnyFaultPart] = []
        for _ in range(self._count(self._intensity.processes)):
            robot, span = self._robot(), self._span()
            sort = self._random.integers(4)
            if sort == 0:
                found.append(made(kind="restart", robot=robot, **span))
            elif sort == 1:
                found.append(made(kind="pause", robot=robot, **span))
            else:
                state = "kept" if sort == 2 else "lost"
                found.append(made(kind="crash", robot=robot, state=state, **span))
        return found
