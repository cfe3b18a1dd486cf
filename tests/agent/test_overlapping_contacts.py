"""Several contacts of one robot under way at once, with own late data between: honest, and stable."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from agent.core import Agent
from agent.effects import Effect, Send
from agent.estimation.motion import compose
from agent.events import Event, Fix, Observation, Odometry, Received
from agent.settings import NS, AgentSettings, LatenessSettings, LocalizationSettings
from network.messages import Header, Message
from tests.sizes import sized

Array = NDArray[np.float64]


class Fleet:
    """Agents whose messages take as long as the test says: `delay_ns(sender)`."""

    def __init__(
        self, starts: dict[str, tuple[Array, Array]], localization: LocalizationSettings, delays: dict[str, int]
    ) -> None:
        lateness = LatenessSettings(horizon_ns=20 * NS)
        self.agents = {
            name: Agent(
                AgentSettings(
                    robot=name,
                    start_ns=0,
                    mean=mean,
                    cov=cov,
                    localization=localization,
                    lateness=lateness,
                    track=False,
                )
            )
            for name, (mean, cov) in starts.items()
        }
        self._delays = delays
        self._under_way: list[tuple[int, int, str, Send]] = []
        self._sent = 0

    def handle(self, robot: str, event: Event) -> None:
        self._send(robot, event.t_ns, self.agents[robot].handle(event))

    def deliver(self, now_ns: int) -> None:
        """Everything that arrives by `now_ns`, and what follows from it by then."""
        while self._under_way and self._under_way[0][0] <= now_ns:
            t_ns, count, sender, item = heapq.heappop(self._under_way)
            header = Header(sender, 1, 1, count, item.t_meas_ns, t_ns)
            self.handle(item.peer, Received(t_ns, Message(header, item.body)))

    def _send(self, robot: str, now_ns: int, effects: list[Effect]) -> None:
        for item in effects:
            if isinstance(item, Send):
                self._sent += 1
                arrival = now_ns + self._delays.get(robot, 0)
                heapq.heappush(self._under_way, (arrival, self._sent, robot, item))


NOISE = np.diag([0.02, 0.03, 0.0, 0.0])
FIX, RANGE = np.diag([0.05, 0.04]), np.array([[0.02]])
PLACES = {"r1": np.array([0.0, 0.0, 0.3]), "r2": np.array([5.0, 3.0, -1.0]), "r3": np.array([-2.0, 6.0, 2.0])}
COVS = {"r1": np.diag([0.2, 0.3, 1e-12]), "r2": np.diag([0.4, 0.2, 1e-12]), "r3": np.diag([0.3, 0.5, 1e-12])}
DELTA = np.array([0.3, 0.1, 0.0, 0.0])
ONE_WAY = {"r2": 2 * NS + NS // 2, "r3": 3 * NS}
SIZE = 1e-4


def overlapping(noise: tuple[str, ...], column: int, size: float) -> Fleet:
    """r1 ranges r2 and r3 at 3 s and hears from them at 5.5 and 6 s; its fixes of 2 and 4 s come at 5.7 and 7 s.

    All estimates start at the truth and nothing is noisy but what `noise` names: the start of a robot, one of its
    odometry steps, or a measurement, by one unit of its noise times `size`.
    """
    starts = {}
    for name, place in PLACES.items():
        off = size * np.linalg.cholesky(COVS[name])[:, column] if noise == ("start", name) else np.zeros(3)
        starts[name] = (place + off, COVS[name])
    localization = LocalizationSettings(
        form="split_joint", transform="jacobian", pair_interval_ns=0, pair_timeout_ns=100 * NS
    )
    fleet = Fleet(starts, localization, ONE_WAY)
    truth = {name: [place] for name, place in PLACES.items()}

    def measured(name: str, z: Array, R: Array) -> Array:
        return z + size * np.linalg.cholesky(R)[:, column] if noise == ("measured", name) else z

    def fixed(second: int, now_ns: int) -> None:
        z = measured(f"fix{second}", truth["r1"][second][:2], FIX)
        fleet.handle("r1", Fix(now_ns, second * NS, "position", z, FIX, "gps"))

    for k in range(8):
        for name in PLACES:
            truth[name].append(compose(truth[name][-1], DELTA[[0, 1, 3]]))
            delta = DELTA.copy()
            if noise == ("odometry", name, str(k)):
                delta[column] += size * np.sqrt(NOISE[column, column])
            fleet.handle(name, Odometry((k + 1) * NS, k * NS, (k + 1) * NS, delta, NOISE))
        if k + 1 == 3:
            for peer in ("r2", "r3"):
                z = np.array([np.hypot(*(truth[peer][3] - truth["r1"][3])[:2])])
                z = measured(peer, z, RANGE) if column == 0 else z
                fleet.handle("r1", Observation(3 * NS, 3 * NS, "range", peer, z, RANGE, "uwb"))
        if k + 1 == 5:
            fleet.deliver(5 * NS + 600_000_000)
            fixed(2, 5 * NS + 700_000_000)
        fleet.deliver((k + 1) * NS)
        if k + 1 == 7:
            fixed(4, 7 * NS)
    return fleet


def test_overlapping_contacts_and_late_fixes_claim_their_true_covariance() -> None:
    """The estimate's response to every unit noise gives the covariance of its error: the claimed one, of 0.1 m^2."""
    still = overlapping((), 0, 0.0).agents["r1"]
    assert still.counters["pair.applied_initiator"] == 2
    assert still.counters["late.compensated"] == 2
    sources = [("start", name) for name in PLACES]
    sources += [("odometry", name, str(k)) for name in PLACES for k in range(8)]  # type: ignore[misc]
    sources += [("measured", name) for name in ("r2", "r3", "fix2", "fix4")]
    columns = []
    for source in sources:
        for column in (0, 1):
            ahead = overlapping(source, column, SIZE).agents["r1"].filter.state.mean
            columns.append((ahead - still.filter.state.mean)[:2] / SIZE)
    errors = np.stack(columns, axis=1)
    assert np.abs(still.filter.state.cov[:2, :2] - errors @ errors.T).max() < 1e-4


def test_a_dense_fleet_far_behind_stays_where_it_is() -> None:
    """Eight robots, each ranging all others at once, with a second each way on the link (seed 1).

    Each robot has seven contacts of the same instants under way all the time. Updates that move the present alone
    throw the fleet apart by tens of metres within a minute.
    """
    rng = np.random.default_rng(1)
    step_ns, sigma = NS // 5, np.array([0.1, 0.03, 0.01])
    noise = np.diag([sigma[0], sigma[1], 0.0, sigma[2]]) ** 2
    names = [f"r{index}" for index in range(8)]
    P = np.diag([0.25, 0.25, 0.0025])
    truth = {name: rng.uniform([-10, -10, -3], [10, 10, 3]) for name in names}
    starts = {name: (truth[name] + rng.multivariate_normal(np.zeros(3), P), P) for name in names}
    fleet = Fleet(starts, LocalizationSettings(form="split_joint", pair_timeout_ns=100 * NS), dict.fromkeys(names, NS))
    squares = []
    for k in range(1, sized(100, 200) + 1):
        now_ns = k * step_ns
        fleet.deliver(now_ns - 1)
        for name in names:
            u = np.array([0.1, 0.0, rng.uniform(-0.1, 0.1)])
            truth[name] = compose(truth[name], u + rng.normal(size=3) * sigma)
            fleet.handle(name, Odometry(now_ns, now_ns - step_ns, now_ns, np.array([u[0], 0.0, 0.0, u[2]]), noise))
        if k % 5 == 0:
            z = truth["r0"][:2] + rng.normal(size=2) * 0.3
            fleet.handle("r0", Fix(now_ns, now_ns, "position", z, 0.09 * np.eye(2), "gps"))
        fleet.deliver(now_ns)
        for index, name in enumerate(names):
            for peer in names[index + 1 :]:
                z = np.array([np.hypot(*(truth[peer] - truth[name])[:2]) + rng.normal() * 0.1])
                fleet.handle(name, Observation(now_ns, now_ns, "range", peer, z, np.eye(1) * 0.01, "range"))
        squares += [float(np.sum((fleet.agents[name].filter.state.mean - truth[name])[:2] ** 2)) for name in names]
    assert sum(agent.counters["pair.applied_initiator"] for agent in fleet.agents.values()) > 200
    assert np.sqrt(np.mean(squares)) < 1.5
    for agent in fleet.agents.values():
        np.linalg.cholesky(agent.filter.state.cov)
