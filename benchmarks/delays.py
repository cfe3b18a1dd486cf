"""What becomes of a leader's word that comes late, policy by policy: `python -m benchmarks.delays`.

Plays a follower 3 m behind its leader on a rounded rectangle (Zhang & Cao 2019, section 4) with the kernels of
`agent.estimation.delayed`, all trials at once, and prints tables in Markdown: position RMSE [cm] / heading RMSE [deg] /
ANEES. `nodelay` is the filter that gets every word that comes at its own instant. With `--scenarios N` the same is
played through agents and their network as well, N trials each.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agent.estimation.delayed import (
    Corrected,
    InFlight,
    LeaderSight,
    algorithm1,
    anticipated,
    begun,
    compensated,
    corrected,
    equivalent,
    moved,
)
from agent.estimation.gaussian import quadratic_form, wrap
from agent.estimation.motion import compose
from benchmarks.runs import run

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

DT, STEPS, WARM_UP = 0.1, 300, 50
BEHIND = 30
"""Steps that the follower is behind."""

TURN_RADPS = np.pi / 4.0
SIGMA_U = DT * np.array([0.1, 0.0, np.radians(3.0)])
NOISE = np.diag(SIGMA_U**2)
SIGMA_Z = np.array([0.5, np.radians(0.5)])
TOLD_M = 0.1
START = np.array([0.3, 0.3, np.radians(5.0)])
POLICIES = ("nodelay", "ignore", "discard", "algorithm1", "compensate", "anticipate", "equivalent", "replay")
"""`compensate` knows the leader's word at once for the gain, but not for the mean; `anticipate` as an agent must do."""


@dataclass(frozen=True, slots=True, eq=False)
class Story:
    """Trials (n, ...) of what happens: odometry u (n, K, 3), z (n, K + 1, 2), words (n, K + 1, 2) with velocities.

    `measured` (n, K + 1): there is a measurement, and `delay` (n, K + 1) how many periods its word takes; < 0: lost.
    """

    truth: Array
    u: Array
    z: Array
    words: Array
    velocity: Array
    measured: Mask
    delay: NDArray[np.int64]
    tau_s: Array

    @property
    def trials(self) -> int:
        return len(self.u)


def lap(count: int) -> tuple[Array, Array]:
    """Increments (count, 3) and poses (count + 1, 3) on the rounded rectangle, from the beginning of a side."""
    turning = np.arange(count) % 60 >= 40
    u = np.stack([np.full(count, DT), np.zeros(count), np.where(turning, DT * TURN_RADPS, 0.0)], axis=-1)
    poses = np.zeros((count + 1, 3))
    for k in range(count):
        poses[k + 1] = compose(poses[k], u[k])
    return u, poses


def story(
    trials: int,
    rng: np.random.Generator,
    *,
    delay: NDArray[np.int64] | int = 0,
    loss: float = 0.0,
    every: int = 1,
    offset: int = 0,
    correlation_s: float = 0.0,
) -> Story:
    """`delay`: periods, or so many per measurement; `offset`: clocks are off by a whole number of periods up to it."""
    u, poses = lap(STEPS + 2 * BEHIND)
    truth, leader = poses[: STEPS + 1], poses[BEHIND : BEHIND + STEPS + 1]
    apart = leader[:, :2] - truth[:, :2]
    clean = np.stack([np.hypot(*apart.T), wrap(np.arctan2(apart[:, 1], apart[:, 0]) - truth[:, 2])], axis=-1)
    off = rng.integers(-offset, offset + 1, trials)
    index = BEHIND + np.arange(STEPS + 1) - off[:, None]
    keep = np.exp(-DT / correlation_s) if correlation_s > 0.0 else 0.0
    error = rng.standard_normal((trials, STEPS + 1, 2))
    for k in range(1, STEPS + 1):
        error[:, k] = keep * error[:, k - 1] + np.sqrt(1.0 - keep**2) * error[:, k]
    late = np.broadcast_to(np.asarray(delay), (trials, STEPS + 1))
    came = rng.random((trials, STEPS + 1)) >= loss
    return Story(
        truth,
        u[:STEPS] + SIGMA_U * rng.standard_normal((trials, STEPS, 3)),
        clean + SIGMA_Z * rng.standard_normal((trials, STEPS + 1, 2)),
        poses[index, :2] + TOLD_M * error,
        (poses[index + 1, :2] - poses[index, :2]) / DT,
        np.broadcast_to(np.arange(STEPS + 1) % every == 0, late.shape),
        np.where(came, late, -1),
        np.asarray(DT * off, dtype=np.float64),
    )


@dataclass(slots=True, eq=False)
class Figures:
    """Over all trials and periods after the warm-up."""

    position_cm: float
    heading_deg: float
    anees: float
    tau_ms: float = 0.0

    def __str__(self) -> str:
        return f"{self.position_cm:.1f}/{self.heading_deg:.2f}/{self.anees:.2f}"


class Follower:
    """The filter of all trials at once, under one policy."""

    def __init__(
        self, story: Story, rng: np.random.Generator, policy: str, iterations: int, scale: float, tau_sigma_s: float
    ) -> None:
        self._story, self._policy, self._iterations = story, policy, iterations
        self._told = scale * TOLD_M**2 * np.eye(2)
        sigma = START if tau_sigma_s == 0.0 else np.append(START, tau_sigma_s)
        start = story.truth[0] + START * rng.standard_normal((story.trials, 3))
        self.mean = np.concatenate([start, np.zeros((story.trials, len(sigma) - 3))], axis=1)
        self.cov = np.broadcast_to(np.diag(sigma**2), (story.trials, len(sigma), len(sigma)))
        self._flights: dict[int, InFlight] = {}
        self._past: list[tuple[Array, Array]] = []

    def sight(self, s: int) -> LeaderSight:
        found = self._story
        return LeaderSight(
            found.z[:, s], np.diag(SIGMA_Z**2), found.words[:, s], self._told, found.velocity[:, s]
        )

    def _take(self, found: Corrected, mask: Mask) -> None:
        self.mean = np.where(mask[:, None], found.mean, self.mean)
        self.cov = np.where(mask[:, None, None], found.cov, self.cov)

    def _fly(self, left: Array, mask: Mask) -> None:
        left = np.where(mask[:, None, None], left, np.eye(left.shape[-1]))
        self._flights = {s: flight.updated(left) for s, flight in self._flights.items()}

    def step(self, k: int) -> None:
        """Period k: the motion that leads to it, what is measured at it, and the words that arrive."""
        found, policy = self._story, self._policy
        if k > 0:
            u = found.u[:, k - 1]
            self.mean, self.cov, F = moved(self.mean, self.cov, u, NOISE)
            self._flights = {s: flight.moved(F, u) for s, flight in self._flights.items()}
        self._past.append((self.mean, self.cov))
        measured = found.measured[:, k]
        if policy == "nodelay":
            came = measured & (found.delay[:, k] >= 0)
            self._take(corrected(self.mean, self.cov, self.sight(k), self._iterations), came)
            return
        if measured.any() and policy in ("compensate", "anticipate", "algorithm1", "equivalent"):
            flight = begun(self.mean, self.cov)
            if policy in ("compensate", "anticipate"):
                expected = (anticipated if policy == "anticipate" else corrected)(self.mean, self.cov, self.sight(k))
                flight = replace(flight, gain=expected.gain)
                self._fly(expected.left, measured)
                self.cov = np.where(measured[:, None, None], expected.cov, self.cov)
            self._flights[k] = flight
        self._arrive(k)

    def _arrive(self, k: int) -> None:
        found = self._story
        longest = int(found.delay.max(initial=0))
        first = max(0, k - longest)
        masks = {s: found.measured[:, s] & (found.delay[:, s] == k - s) for s in range(first, k + 1)}
        coming = [s for s, mask in masks.items() if mask.any()]
        if self._policy == "replay":
            if coming:
                self._replay(coming[0], k)
        else:
            for s in coming:
                self._use(s, k, masks[s])
        self._flights.pop(k - longest, None)

    def _use(self, s: int, k: int, mask: Mask) -> None:
        sight, policy = self.sight(s), self._policy
        if policy == "ignore" or (policy == "discard" and s == k):
            self._take(corrected(self.mean, self.cov, sight), mask)
        elif policy in ("compensate", "anticipate"):
            after = compensated(self.mean, self._flights[s], sight)
            self.mean = np.where(mask[:, None], after, self.mean)
        elif policy != "discard":
            update = algorithm1 if policy == "algorithm1" else equivalent
            done = update(self.mean, self.cov, self._flights[s], sight)
            self._take(done, mask)
            self._fly(done.left, mask)

    def _replay(self, first: int, k: int) -> None:
        """From `first` on again, with all words that are there by now."""
        found = self._story
        self.mean, self.cov = self._past[first]
        for j in range(first, k + 1):
            if j > first:
                self.mean, self.cov, _ = moved(self.mean, self.cov, found.u[:, j - 1], NOISE)
                self._past[j] = self.mean, self.cov
            here = found.measured[:, j] & (found.delay[:, j] >= 0) & (found.delay[:, j] <= k - j)
            if here.any():
                self._take(corrected(self.mean, self.cov, self.sight(j), self._iterations), here)


def play(
    found: Story,
    seed: int,
    policy: str,
    *,
    iterations: int = 1,
    scale: float = 1.0,
    tau_sigma_s: float = 0.0,
) -> Figures:
    """One policy on a story; `scale`: of the covariance that words tell of."""
    follower = Follower(found, np.random.default_rng(seed), policy, iterations, scale, tau_sigma_s)
    errors, nees = [], []
    for k in range(STEPS + 1):
        follower.step(k)
        if k >= WARM_UP:
            error = follower.mean[:, :3] - found.truth[k]
            error[:, 2] = wrap(error[:, 2])
            errors.append(error)
            nees.append(quadratic_form(error, follower.cov[:, :3, :3]) / 3.0)
    all_errors = np.array(errors)
    place = float(np.sqrt((all_errors[..., :2] ** 2).sum(axis=-1).mean()))
    tau = follower.mean[:, 3] - found.tau_s if tau_sigma_s > 0.0 else np.zeros(1)
    return Figures(
        100.0 * place,
        float(np.degrees(np.sqrt((all_errors[..., 2] ** 2).mean()))),
        float(np.mean(nees)),
        1e3 * float(np.sqrt((tau**2).mean())),
    )


# -- tables -------------------------------------------------------------------------------------------------------

EACH_PERIOD = ((1, 0.0), (2, 0.0), (4, 0.0), (8, 0.0), (8, 0.3), (12, 0.0), (20, 0.0), (20, 0.3))
REQUESTS = ((8, 0.0), (8, 0.3), (20, 0.0), (20, 0.3))
VARIABLE = ((8, 0.0), (20, 0.0), (20, 0.3))


def table(title: str, heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Rows in Markdown under a title."""
    lines = [f"**{title}**", "", f"| {' | '.join(heads)} |", f"|{' --- |' * len(heads)}"]
    lines += [f"| {' | '.join(map(str, row))} |" for row in rows]
    return "\n".join([*lines, ""])


def delays_table(trials: int, seed: int) -> str:
    rows = []
    for delay, loss in EACH_PERIOD:
        found = story(trials, np.random.default_rng(seed), delay=delay, loss=loss)
        cells = [play(found, seed, policy) for policy in POLICIES]
        twice = [play(found, seed, policy, iterations=2) for policy in ("nodelay", "replay")]
        rows.append([f"{delay}, {loss:g}", *cells, *twice])
    heads = ["periods, loss", *POLICIES, "nodelay, 2 iterations", "replay, 2 iterations"]
    return table("One measurement per period", heads, rows)


def exchanges_table(trials: int, seed: int) -> str:
    rows = []
    shown = [policy for policy in POLICIES if policy != "nodelay"]
    stories: list[tuple[str, dict[str, Any]]] = [
        (f"request, {n} periods, loss {loss:g}", {"delay": n, "loss": loss, "every": n + 1})
        for n, loss in REQUESTS
    ]
    for n, loss in VARIABLE:
        drawn = np.random.default_rng(seed + 1).integers(0, n + 1, (trials, STEPS + 1))
        stories.append((f"0 to {n} periods, loss {loss:g}", {"delay": drawn, "loss": loss}))
    for name, what in stories:
        found = story(trials, np.random.default_rng(seed), **what)
        cells = [play(found, seed, policy) for policy in shown]
        rows.append([name, *cells, play(found, seed, "replay", iterations=2)])
    heads = ["case", *shown, "replay, 2 iterations"]
    return table("Requests, one in flight; and delays that vary, so that words overtake each other", heads, rows)


def clocks_table(trials: int, seed: int) -> str:
    rows = []
    for offset, sigma_s in ((0, 0.1), (2, 0.2), (5, 0.5)):
        found = story(trials, np.random.default_rng(seed), delay=8, offset=offset)
        trusting = play(found, seed, "replay")
        knowing = play(found, seed, "replay", tau_sigma_s=sigma_s)
        before = 1e3 * float(np.sqrt((found.tau_s**2).mean()))
        twice = play(found, seed, "replay", tau_sigma_s=sigma_s, iterations=2)
        rows.append([offset, trusting, knowing, f"{knowing.tau_ms:.0f} ms (from {before:.0f})", twice])
    heads = ["offset up to, periods", "stamps trusted", "offset estimated", "its error at the end", "2 iterations"]
    return table("Clock offset that nobody knows, 8 periods late, replay", heads, rows)


def correlation_table(trials: int, seed: int) -> str:
    found = story(trials, np.random.default_rng(seed), delay=8, correlation_s=5.0)
    cells = [play(found, seed, "replay", iterations=2, scale=scale) for scale in (1.0, 10.0, 25.0, 50.0)]
    heads = ["covariance as told", "10 times", "25 times", "50 times (tau_c / period)"]
    return table("Leader's error correlated over 5 s, 8 periods late, replay, 2 iterations", heads, [cells])


# -- through agents and their network -----------------------------------------------------------------------------

OF_SCENARIOS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    *(
        (kind, "leader-follower", (f"lateness.kind={kind}", "lateness.iterations=1"))
        for kind in ("ignore", "discard", "algorithm1", "compensate", "equivalent", "replay")
    ),
    ("replay, 2 iterations", "leader-follower", ()),
    ("replay, 2 iterations, loss 0.3", "leader-follower", ("links.loss=0.3",)),
    ("request, replay, 2 iterations", "leader-follower-request", ()),
    ("0 to 8 periods, replay, 2 iterations", "leader-follower-variable", ()),
    ("clock off by 0.15 s, stamps trusted", "leader-follower-offset", ("localization.clock_state=false",)),
    ("clock off by 0.15 s, offset estimated", "leader-follower-offset", ()),
    (
        "error over 5 s, taken as new",
        "leader-follower",
        ("robots.r1.sensors.pose.correlation_s=5.0",),
    ),
    (
        "error over 5 s, leader_correlation_s = 5",
        "leader-follower",
        ("robots.r1.sensors.pose.correlation_s=5.0", "localization.leader_correlation_s=5.0"),
    ),
)
"""Name, scenario and what is set: 8 periods late, all of them."""


def scenarios_table(trials: int, seed: int, jobs: int, out: Path) -> str:
    """Figures of the follower. Raises `RuntimeError` if a command fails."""
    rows: list[list[object]] = []
    for name, scenario, changes in OF_SCENARIOS:
        where = out / f"{scenario}-{len(rows)}-{trials}-{seed}"
        command = ["montecarlo", scenario, "--trials", str(trials), "--seed", str(seed), "--jobs", str(jobs)]
        command += ["--no-report", "--set", "expect={}"]
        for change in changes:
            command += ["--set", change]
        run(command, where)
        found = json.loads((where / "summary.json").read_text())["robots"]["r2"]
        figures = Figures(
            100.0 * found["position_rmse_m"], float(np.degrees(found["heading_rmse_rad"])), found["anees"]
        )
        rows.append([name, figures])
    return table(f"Through agents and their network, 0.8 s late, {trials} trials each", ["case", "follower"], rows)


TABLES = {
    "delays": delays_table,
    "exchanges": exchanges_table,
    "clocks": clocks_table,
    "correlation": correlation_table,
}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.delays", description=__doc__)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--tables", nargs="*", default=list(TABLES), choices=list(TABLES))
    parser.add_argument("--scenarios", type=int, default=0, metavar="N", help="trials through the network; 0: none")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="trials played at once")
    parser.add_argument("--out", type=Path, default=Path("runs/delays"), help="where finished trials are")
    options = parser.parse_args(arguments)
    for name in options.tables:
        print(TABLES[name](options.trials, options.seed), flush=True)
    if options.scenarios:
        print(scenarios_table(options.scenarios, options.seed, options.jobs, options.out), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
