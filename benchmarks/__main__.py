"""What cofix costs, as ratios measured side by side in one run: `python -m benchmarks`."""

from __future__ import annotations

import argparse
import gc
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

from benchmarks import correspondence, exchange, fleet, kernel, planner

Step = Callable[[], object]


@dataclass(frozen=True, slots=True)
class Result:
    """One line of the table: a figure, and the limit it has to keep."""

    what: str
    value: float | None
    limit: str
    holds: bool | None
    note: str = ""

    def line(self) -> str:
        value = "-" if self.value is None else f"{self.value:.3g}"
        verdict = "" if self.holds is None else "holds" if self.holds else "FAILS"
        return f"| {self.what} | {value} | {self.limit} | {verdict} | {self.note} |"


def side_by_side(first: Step, second: Step, rounds: int = 30, calls: int = 50) -> tuple[float, float]:
    """Least time [s] of one call of each, measured in turns: what disturbs one disturbs the other."""
    best = [float("inf"), float("inf")]
    for step in (first, second):
        step()
    gc.disable()
    try:
        for _ in range(rounds):
            for index, step in enumerate((first, second)):
                begin = time.perf_counter()
                for _ in range(calls):
                    step()
                best[index] = min(best[index], (time.perf_counter() - begin) / calls)
    finally:
        gc.enable()
    return best[0], best[1]


def against(name: str, library: Callable[[], Step], most: float) -> Result:
    """Our kernel over a library's."""
    what = f"kernel with {kernel.PEERS} peers' factors / {name}"
    try:
        other = library()
    except ImportError:
        return Result(what, None, f"<= {most:g}", None, f"{name} is not installed: pip install '.[benchmarks]'")
    own_s, other_s = side_by_side(kernel.ours(), other)
    note = f"{own_s * 1e6:.0f} us / {other_s * 1e6:.0f} us"
    return Result(what, own_s / other_s, f"<= {most:g}", own_s / other_s <= most, note)


def engine(name: str, interval_s: float, least: float) -> Result:
    """Simulated time over CPU time of ten agents at 10 Hz."""
    found = fleet.virtual(10, 10.0, interval_s, 12.0)
    what, note = f"virtual engine, ten agents at 10 Hz, {name}: x real time", f"{found.contacts_per_s:.0f} contacts/s"
    return Result(what, found.speed, f">= {least:g}", found.speed >= least, note)


def pair_exchange() -> Result:
    """Our own time in a pair exchange of two agents over Zenoh, beyond the transport's."""
    found = exchange.exchange()
    added_ms = (found.pair_s - found.bare_s) * 1e3
    sizes = " + ".join(str(size) for size in found.bytes_sent)
    note = f"{found.pair_s * 1e3:.2f} ms / {found.bare_s * 1e3:.2f} ms, {sizes} bytes"
    return Result("pair exchange above a bare round trip over Zenoh [ms]", added_ms, "< 1", added_ms < 1.0, note)


def plan() -> Result:
    """Time of one robot's choice by predicted beliefs."""
    found = planner.choice()
    what = f"choice of motion, kind optimal, {planner.NEIGHBOURS} neighbours [ms]"
    note = f"{found.single_s / found.batch_s:.0f} times as long with one candidate after the other"
    return Result(what, found.batch_s * 1e3, "<= 5", found.batch_s <= 5e-3, note)


def leader_steps() -> list[Result]:
    """Time of one leader's step at 20 Hz by form, and as a multiple of the baseline's."""
    found = correspondence.times()
    nearest_s = found["nearest"]
    return [
        Result(
            f"step of a leader of {correspondence.TARGETS} robots, form {name} [ms]",
            found[name] * 1e3,
            "<= 2",
            found[name] <= 2e-3,
            f"{found[name] / nearest_s:.1f} times as long as nearest ({nearest_s * 1e3:.2f} ms)",
        )
        for name in ("improved", "published")
    ]


def processes(rate_hz: float, count: int, required: bool = True) -> Result:
    """Lag of all agents' timers, 99th percentile, in periods."""
    found = fleet.processes(count, rate_hz, 20.0)
    periods = found.lag_p99_s * rate_hz
    note = f"worst lag {found.lag_max_s * 1e3:.0f} ms"
    what = f"{count} processes at {rate_hz:g} Hz: p99 lag / period"
    return Result(what, periods, "< 1" if required else "", periods < 1.0 if required else None, note)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--processes", type=int, default=40, help="agent processes started at once (0: none)")
    options = parser.parse_args()
    print("| what | value | limit | | note |\n|---|---|---|---|---|", flush=True)
    results: list[Callable[[], Result | list[Result]]] = [
        lambda: against("filterpy UKF", kernel.filterpy, 1.0),
        lambda: against("Stone Soup UKF", kernel.stone_soup, 0.1),
        lambda: engine("every contact", 0.0, 5.0),
        lambda: engine("one contact per pair and second", 1.0, 12.0),
        plan,
        leader_steps,
        pair_exchange,
        fleet_memory,
    ]
    if options.processes:
        results += [lambda: processes(5.0, options.processes), lambda: processes(10.0, options.processes, False)]
    failed = False
    for measure in results:
        found = measure()
        for result in found if isinstance(found, list) else [found]:
            failed = failed or result.holds is False
            print(result.line(), flush=True)
    return 1 if failed else 0


def fleet_memory() -> Result:
    """Growth of the memory in use between the two halves of a run, relative to what is in use."""
    growth, used = fleet.memory_growth(3, 5.0, 480.0)
    note = f"{used / 1e6:.1f} MB"
    return Result("memory of three agents, growth over four minutes", growth, "< 0.02", growth < 0.02, note)


if __name__ == "__main__":
    sys.exit(main())
