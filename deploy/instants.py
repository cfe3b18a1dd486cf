"""Which estimate of a robot stands for a sampled instant, so that truth is held against it fairly."""

from __future__ import annotations

from agent.clock_faults import FaultyClock
from agent.effects import Estimate
from agent.events import Event, Observation, Received
from agent.fault_parts import ClockDriftPart, ClockStepPart
from agent.settings import nanoseconds
from network.messages import PairReply, PairRequest, SplitReply, SplitRequest, StartRequest
from sim.fault_plan import trial_faults
from sim.sampling import Sampler
from sim.scenario import Scenario
from sim.world import World

# An estimate counts for a sampled instant if its own instant lies no further behind, or ahead, than so many steps.
MAX_BEHIND_STEPS = 1.5
AHEAD_STEPS = 0.3
ROUNDING_NS = 1_000
CONTACTS = (PairRequest, PairReply, SplitRequest, SplitReply, StartRequest)


class Clocks:
    """Clocks of the robots as they were injected."""

    def __init__(self, scenario: Scenario, seed: int, t0_ns: int) -> None:
        self._faulty: dict[str, FaultyClock] = {}
        for fault in trial_faults(scenario, seed).values():
            if isinstance(fault, ClockStepPart | ClockDriftPart):
                self._faulty.setdefault(fault.robot, FaultyClock()).add(fault.clock(t0_ns))

    def __call__(self, robot: str) -> FaultyClock:
        return self._faulty.get(robot, FaultyClock())


class Measured:
    """When it was measured what events tell: sensors that lag tell of instants that are over."""

    def __init__(self, scenario: Scenario, clocks: Clocks) -> None:
        self._clocks = clocks
        self._lags_ns = {
            robot.id: {name: nanoseconds(sensor.lag_s) for name, sensor in robot.sensors.items()}
            for robot in scenario.robots
        }
        self._of_peers_ns = {
            robot.id: max((nanoseconds(s.lag_s) for s in robot.sensors.values() if "peers" in s.of), default=0)
            for robot in scenario.robots
        }

    def at_ns(self, robot: str, event: Event) -> int | None:
        """The true instant at which a relative measurement was made; None for an event that tells of none."""
        if isinstance(event, Observation):
            lag_ns = self._lags_ns[robot].get(event.sensor, 0)
            return self._clocks(robot).origin_ns(event.t_meas_ns + lag_ns)
        if isinstance(event, Received) and isinstance(event.message.body, CONTACTS):
            epoch = event.message.body.epoch
            lag_ns = self._of_peers_ns.get(epoch.initiator, 0)
            return self._clocks(epoch.initiator).origin_ns(epoch.t_meas_ns + lag_ns)
        return None


class InstantEstimates:
    """Puts the estimate that stands for each sampled instant into the sampler; all instants are since the start.

    That is the one nearest to the instant, as it was before the robot was told what was measured after it. Sensors
    that lag tell of instants that are over: what an estimate becomes by that is hindsight, which neither a robot in
    virtual time nor the centralized filter has at that instant.
    """

    def __init__(self, sampler: Sampler, world: World, robot: str) -> None:
        self._sampler, self._robot = sampler, robot
        self._stride_ns = sampler.stride_ns
        self._ahead_ns, self._behind_ns = AHEAD_STEPS * world.step_ns, MAX_BEHIND_STEPS * world.step_ns
        self._span_ns = world.steps * world.step_ns
        self._row, self._measured_ns = 0, 0
        self._latest: Estimate | None = None
        self._chosen: Estimate | None = None

    @property
    def _row_ns(self) -> int:
        return self._row * self._stride_ns

    def begin(self, t_ns: int) -> None:
        """A life begins. What it tells of the time before it is hindsight: nobody was there to ask."""
        self._latest = self._chosen = None
        self._row = max(self._row, -(-t_ns // self._stride_ns))

    def measured(self, t_ns: int) -> None:
        """The robot is told of something that was measured at `t_ns`."""
        self._measured_ns = max(self._measured_ns, t_ns)

    def published(self, estimate: Estimate) -> None:
        while self._latest is None and self._row_ns + self._ahead_ns < estimate.t_ns:
            self._row += 1  # Before the robot knew where it is.
        self._settle(estimate.t_ns)
        if self._chosen is None or self._better(estimate, self._chosen):
            self._chosen = estimate
        self._latest = estimate

    def _better(self, estimate: Estimate, chosen: Estimate) -> bool:
        if estimate.t_ns == chosen.t_ns:
            return self._measured_ns <= self._row_ns + ROUNDING_NS
        return abs(estimate.t_ns - self._row_ns) < abs(chosen.t_ns - self._row_ns)

    def end(self) -> None:
        """A life ends."""
        if self._latest is not None:
            self._settle(min(self._latest.t_ns + self._behind_ns, self._span_ns + 2 * self._ahead_ns))

    def _settle(self, until_ns: float) -> None:
        """Fill the rows whose instant is over once there is an estimate for a later one."""
        while self._chosen is not None and self._row_ns + self._ahead_ns < until_ns and self._row_ns <= self._span_ns:
            chosen = self._chosen
            if self._row_ns - chosen.t_ns <= self._behind_ns:
                self._sampler.put(self._robot, self._robot, self._row, chosen.mean, chosen.cov)
                for track in chosen.tracks:
                    self._sampler.put(self._robot, track.target, self._row, track.mean, track.cov)
                self._sampler.put_relatives(self._robot, self._row, chosen.relatives)
            self._row += 1
            self._chosen = self._latest
