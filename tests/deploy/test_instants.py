"""Which published estimate stands for a sampled instant: the nearest, as it was at that instant."""

from __future__ import annotations

import numpy as np
import pytest

from agent.effects import Estimate
from deploy.instants import InstantEstimates
from sim.sampling import Sampler
from sim.scenario import Scenario
from sim.trial import open_world
from tests.sim.test_starts import robot, scenario

NS = 1_000_000_000


@pytest.fixture
def made() -> Scenario:
    return scenario(duration_s=6.0, window_s=[0.0, 6.0], robots=[robot(1, [0.0, 0.0, 0.0], {})])


class Told:
    """A robot that publishes estimates whose x says which one it is."""

    def __init__(self, made: Scenario) -> None:
        world = open_world(made, 1)
        self._sampler = Sampler(made, world, False)
        self.rows = InstantEstimates(self._sampler, world, "r1")

    def publishes(self, t_s: float, x: float) -> None:
        self.rows.published(Estimate(round(t_s * NS), "unicycle", np.array([x, 0.0, 0.0]), np.eye(3), ()))

    def found(self) -> list[float]:
        self.rows.end()
        return [float(value) for value in self._sampler.trace().robots["r1"].mean[:, 0]]


def test_an_estimate_of_shortly_after_does_not_stand_for_an_instant(made: Scenario) -> None:
    told = Told(made)
    for t_s, x in ((0.0, 0.0), (1.0, 1.0), (1.2, 7.0), (2.0, 2.0), (3.001, 3.0), (3.1, 7.0), (4.2, 4.0), (5.0, 5.0)):
        told.publishes(t_s, x)
    assert told.found()[:6] == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


def test_an_estimate_grows_by_what_was_measured_until_then(made: Scenario) -> None:
    told = Told(made)
    told.publishes(1.0, 1.0)
    told.rows.measured(1 * NS)
    told.publishes(1.0, 2.0)
    told.rows.measured(round(1.01 * NS))
    told.publishes(1.0, 3.0)
    told.publishes(2.0, 4.0)
    assert told.found()[1:3] == [2.0, 4.0]


def test_a_robot_that_falls_behind_has_no_estimate_of_the_instant(made: Scenario) -> None:
    told = Told(made)
    for t_s, x in ((0.0, 0.0), (1.0, 1.0), (4.0, 4.0)):
        told.publishes(t_s, x)
    found = told.found()
    # A step and a half is still near enough.
    assert found[:3] == [0.0, 1.0, 1.0]
    assert np.isnan(found[3])
    assert found[4] == 4.0


def test_what_a_life_tells_of_the_time_before_it_does_not_count(made: Scenario) -> None:
    told = Told(made)
    told.rows.begin(round(2.5 * NS))
    for t_s in (1.0, 2.0, 3.0, 4.0):
        told.publishes(t_s, t_s)
    found = told.found()
    assert np.isnan(found[:3]).all()
    assert found[3:5] == [3.0, 4.0]
