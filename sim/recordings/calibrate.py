"""Pair biases of ranges from a recording with truth: `python -m sim.recordings.calibrate PATH [--first SECONDS]`.

Prints for every robot the table `calibration.bias_of` that takes them off, to be written into a scenario or an agent's
file. The bias of a pair is the median of range minus true distance, so single outliers do not matter.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace

import numpy as np

from sim.recordings import LOADERS
from sim.recordings.recording import Recording, RecordingError

MIN_RANGES = 10
"""Fewer ranges of a pair tell no bias."""
SIGMA_OF_MAD = 1.4826


@dataclass(frozen=True, slots=True)
class PairBias:
    """Median error [m] of one robot's ranges to a subject, their robust deviation [m], and how many they were."""

    bias_m: float
    sigma_m: float
    count: int


def pair_biases(recording: Recording) -> dict[str, dict[str, PairBias]]:
    """By robot and subject, from all ranges between robots whose truth is known at their instants."""
    found: dict[str, dict[str, PairBias]] = {}
    for name, robot in recording.robots.items():
        errors: dict[str, list[float]] = {}
        sightings = robot.sightings
        for t_ns, subject, distance in zip(sightings.t_ns, sightings.subject, sightings.range_m):
            if not recording.start_ns <= t_ns <= recording.end_ns:
                continue
            other = recording.robots.get(subject)
            if robot.truth is None or other is None or other.truth is None:
                continue
            apart = recording.truth_at(subject, int(t_ns))[:2] - recording.truth_at(name, int(t_ns))[:2]
            errors.setdefault(subject, []).append(float(distance - np.hypot(*apart)))
        for subject in sorted(errors):
            values = np.array(errors[subject])
            if len(values) >= MIN_RANGES:
                bias = float(np.median(values))
                sigma = SIGMA_OF_MAD * float(np.median(np.abs(values - bias)))
                found.setdefault(name, {})[subject] = PairBias(bias, sigma, len(values))
    return found


def table(biases: dict[str, dict[str, PairBias]]) -> str:
    """The tables as TOML, one line per robot."""
    lines = []
    for robot, pairs in biases.items():
        entries = ", ".join(f"{subject} = {pair.bias_m:.3f}" for subject, pair in pairs.items())
        sigma = float(np.median([pair.sigma_m for pair in pairs.values()]))
        lines.append(f"# {robot}: deviation {sigma:.3f} m\ncalibration.bias_of = {{ {entries} }}")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m sim.recordings.calibrate", description=__doc__)
    parser.add_argument("path", help="a recording with truth, best of robots that stand")
    parser.add_argument("--format", choices=sorted(LOADERS), default="tiers")
    parser.add_argument("--first", type=float, metavar="SECONDS", help="use no more than its beginning")
    options = parser.parse_args(arguments)
    try:
        recording = LOADERS[options.format](options.path)
        if options.first is not None:
            end_ns = min(recording.end_ns, recording.start_ns + round(options.first * 1e9))
            recording = replace(recording, end_ns=end_ns)
        biases = pair_biases(recording)
    except RecordingError as error:
        print(error, file=sys.stderr)
        return 2
    if not biases:
        print(f"{options.path}: no robot ranges with another one whose truth is known", file=sys.stderr)
        return 1
    print(table(biases))
    return 0


if __name__ == "__main__":
    sys.exit(main())
