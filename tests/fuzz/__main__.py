"""`python -m tests.fuzz`: everything a peer can send, in millions, with what became of it.

    --endpoint N   mutated messages into decoders and endpoints
    --core N       packets into the robots of virtual runs
    --examples N   messages that hypothesis makes
    --seed N       another seed, other messages
    --out FOLDER   where results are kept; the same command goes on where it stopped
"""

from __future__ import annotations

import argparse
import json
import math
import time
import tracemalloc
from collections import Counter
from pathlib import Path

from tests.fuzz.corpus import FORMS
from tests.fuzz.examples import play_examples
from tests.fuzz.floods import CONTENTS, CoreFlood, EndpointFlood, largest_difference

CHUNK = 100_000
EXAMPLES_CHUNK = 10_000
CORE_SECONDS = 60.0
LIES_MOVE = 10.0
"""How far an authentic liar may move any number of an estimate [m, m^2, ...]; it was 1.7 at most."""

JUDGING = ("safe", "joint", "split_joint", "jlatt", "icf_plus", "relative")
"""Forms that judge what peers tell."""

RSS_SLACK_MB = 24.0
"""How much a process may grow after its first part: fragments, and caches that fill."""


def rss_mb() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


class Results:
    """Finished parts, one line of JSON each; a part that is there is not played again."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._path = folder / "parts.jsonl"
        self.parts: dict[str, dict] = {}
        if self._path.exists():
            for line in self._path.read_text().splitlines():
                part = json.loads(line)
                self.parts[part["part"]] = part

    def add(self, part: dict) -> None:
        self.parts[part["part"]] = part
        with self._path.open("a") as file:
            file.write(json.dumps(part) + "\n")
        shown = {key: value for key, value in part.items() if key not in ("reasons", "decisions")}
        print(json.dumps(shown), flush=True)


def endpoint_parts(results: Results, seed: int, count: int) -> None:
    flood, base_mb = EndpointFlood(), 0.0
    for index in range(-(-count // CHUNK)):
        name = f"endpoint/{seed}/{index}"
        if name in results.parts:
            continue
        before, started = flood.reasons(), time.perf_counter()
        number = min(CHUNK, count - index * CHUNK)
        if base_mb and index % 10 == 5:
            # Allocations that stay, over some messages of the part: the endpoints' tables are full by now.
            tracemalloc.start()
            flood.play(seed * 10**6 + index, 5_000)
            first = tracemalloc.get_traced_memory()[0]
            flood.play(seed * 10**6 + index + 500_000, 5_000)
            stayed_kb = (tracemalloc.get_traced_memory()[0] - first) / 1024
            tracemalloc.stop()
            flood.play(seed * 10**6 + index + 700_000, max(0, number - 10_000))
        else:
            stayed_kb = None
            flood.play(seed * 10**6 + index, number)
        base_mb = base_mb or rss_mb()
        reasons = flood.reasons() - before
        results.add(
            {
                "part": name,
                "messages": reasons.total(),
                "rss_mb": round(rss_mb(), 1),
                "grown_mb": round(rss_mb() - base_mb, 1),
                "stayed_kb": stayed_kb,
                "wall_s": round(time.perf_counter() - started, 1),
                "reasons": dict(reasons),
            }
        )
        assert rss_mb() - base_mb < RSS_SLACK_MB, f"{name}: memory grew from {base_mb:.0f} to {rss_mb():.0f} MB"


def core_parts(results: Results, seed: int, count: int) -> None:
    each = -(-count // (len(FORMS) * len(CONTENTS)))
    for form in FORMS if each else ():
        still = None
        for content in CONTENTS:
            name = f"core/{seed}/{form}/{content}/{each}"
            if name in results.parts:
                continue
            started = time.perf_counter()
            if still is None:
                still = CoreFlood(form, None, seed, CORE_SECONDS)
                still.play()
            flood = CoreFlood(form, content, seed, CORE_SECONDS, each)
            flood.play()
            difference = largest_difference(still.estimates(), flood.estimates(), among=content != "lies")
            results.add(
                {
                    "part": name,
                    "messages": flood.sent,
                    "largest_difference": difference,
                    "rss_mb": round(rss_mb(), 1),
                    "wall_s": round(time.perf_counter() - started, 1),
                    "reasons": dict(flood.reasons() - still.reasons()),
                    "decisions": dict(flood.decisions() - still.decisions()),
                }
            )
            most = 0.0 if content != "lies" else LIES_MOVE if form in JUDGING else math.inf
            assert difference <= most, f"{name}: the estimates differ by {difference}"


def example_parts(results: Results, seed: int, count: int) -> None:
    for index in range(-(-count // EXAMPLES_CHUNK)):
        name = f"examples/{seed}/{index}"
        if name in results.parts:
            continue
        started = time.perf_counter()
        reasons = play_examples(seed * 1000 + index, min(EXAMPLES_CHUNK, count - index * EXAMPLES_CHUNK))
        results.add(
            {
                "part": name,
                "messages": reasons.total(),
                "rss_mb": round(rss_mb(), 1),
                "wall_s": round(time.perf_counter() - started, 1),
                "reasons": dict(reasons),
            }
        )


def table(results: Results) -> str:
    """What became of all messages, by reason and part of the check."""
    columns = ("endpoint", "core", "examples")
    by_column = {column: Counter() for column in columns}
    decisions: Counter[str] = Counter()
    for name, part in results.parts.items():
        by_column[name.split("/")[0]].update(part["reasons"])
        decisions.update(part.get("decisions", {}))
    reasons = sorted({reason for found in by_column.values() for reason in found})
    lines = [f"{'what became of a message':28}" + "".join(f"{column:>14}" for column in columns)]
    for reason in reasons:
        lines.append(f"{reason:28}" + "".join(f"{by_column[column][reason]:>14,}" for column in columns))
    lines.append(f"{'all':28}" + "".join(f"{by_column[column].total():>14,}" for column in columns))
    lines += ["", "what the cores did with what was let through"]
    lines += [f"{name:42}{count:>12,}" for name, count in sorted(decisions.items())]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.split("\n")[0])
    parser.add_argument("--endpoint", type=int, default=10_000_000)
    parser.add_argument("--core", type=int, default=1_000_000)
    parser.add_argument("--examples", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("runs/check-fuzz"))
    options = parser.parse_args()
    results = Results(options.out)
    endpoint_parts(results, options.seed, options.endpoint)
    core_parts(results, options.seed, options.core)
    example_parts(results, options.seed, options.examples)
    print(table(results))


if __name__ == "__main__":
    main()
