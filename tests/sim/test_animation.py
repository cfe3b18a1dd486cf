"""The moving picture: what is packed into the page, and that the player finds all it asks for."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sim.animation import MAX_FRAMES, SCRIPT, film, pack, player, unpack
from sim.metrics import StateTrace, TrialTrace, position_errors
from sim.sight import View
from sim.store import Stored

Array = NDArray[np.float64]


def state(count: int, seed: int, n: int = 3, position: tuple[int, ...] = (0, 1)) -> StateTrace:
    rng = np.random.default_rng(seed)
    truth = np.cumsum(rng.normal(size=(count, n)), axis=0)
    root = rng.normal(size=(count, n, n))
    cov = root @ root.swapaxes(1, 2) + 0.1 * np.eye(n)
    return StateTrace(truth, truth + rng.normal(size=truth.shape), cov, (len(position),), position)


def stored(count: int = 300, robots: int = 2, **change: StateTrace) -> Stored:
    fleet = {f"r{k + 1}": state(count, k) for k in range(robots)} | change
    tracks = {name: state(count, 10 + k) for k, name in enumerate(fleet)}
    contacts = [(5.0, "r2", "r1"), (5.0, "r1", "r2"), (9.123456, "r1", "r2")]
    measured = {("r1", "r2"): np.arange(3.0, 20.0), ("r2", "target:t1"): np.arange(50.0)}
    return Stored(TrialTrace(np.arange(count) * 1.0, fleet, {"t1": tracks}), contacts, {"L1": (1.0, 2.0)}, measured)


@given(st.lists(st.one_of(st.floats(-1e5, 1e5), st.just(float("nan"))), min_size=1, max_size=50))
def test_numbers_come_back_to_a_sixty_thousandth_of_their_span(values: list[float]) -> None:
    given_values = np.array(values)
    back = unpack(pack(given_values))
    np.testing.assert_array_equal(np.isnan(back), np.isnan(given_values))
    there = given_values[~np.isnan(given_values)]
    if len(there):
        # Lowest value and step are written with seven digits.
        slack = np.ptp(there) / 60_000 + 1e-5 * np.abs(there).max() + 1e-9
        np.testing.assert_allclose(back[~np.isnan(back)], there, rtol=0.0, atol=slack)


def test_every_state_is_in_the_film() -> None:
    source = stored()
    made = film(source)
    own, channels = source.trace.robots["r2"], made["robots"][1]["channels"]
    np.testing.assert_allclose(unpack(channels["X"]), own.truth[:, 0], atol=1e-2)
    np.testing.assert_allclose(unpack(channels["y"]), own.mean[:, 1], atol=1e-2)
    np.testing.assert_allclose(unpack(channels["e"]), position_errors(own), atol=1e-2)
    assert made["t"] == source.trace.t_s.tolist()
    first, second = made["targets"][0]["tracks"]
    assert (first["robot"], second["robot"]) == (0, 1)
    assert "X" in first["channels"] and "X" not in second["channels"]


def test_the_ellipse_is_the_three_sigma_ellipse() -> None:
    source = stored()
    channels = {name: unpack(data) for name, data in film(source)["robots"][0]["channels"].items()}
    for row in (0, 17, 250):
        cos, sin = np.cos(channels["p"][row]), np.sin(channels["p"][row])
        turn = np.array([[cos, -sin], [sin, cos]])
        again = turn @ np.diag([channels["a"][row] ** 2, channels["b"][row] ** 2]) @ turn.T / 9.0
        np.testing.assert_allclose(again, source.trace.robots["r1"].cov[row, :2, :2], atol=0.02)


def test_meetings_are_spells_and_contacts_are_told_once_per_instant() -> None:
    made = film(stored())
    assert made["contacts"] == [{"pair": ("r1", "r2"), "t": [5.0, 9.12]}]
    assert made["seen"][0] == {"robot": "r1", "of": "r2", "spells": [[3.0, 19.0]]}
    assert made["landmarks"] == [{"name": "L1", "at": [1.0, 2.0]}]


def test_fields_of_view_are_in_the_film_of_who_has_some() -> None:
    plain = stored()
    seeing = replace(plain, views={"r2": [View(0.2, 0.0, 0.5, 1.0, 2.0, None)]})
    made = film(seeing)
    assert [robot["views"] for robot in made["robots"]] == [[], [(0.2, 0.0, 0.5, 1.0, 2.0, None)]]
    json.dumps(made, allow_nan=False)
    assert "Sectors: " in player(seeing)
    assert "<label hidden>" in player(plain)
    assert "Sectors: " not in player(plain)


def test_a_long_trial_and_a_big_fleet_stay_small() -> None:
    assert len(film(stored(count=5000))["t"]) == MAX_FRAMES
    swarm = film(stored(count=1000, robots=30))
    assert 20 <= len(swarm["t"]) <= MAX_FRAMES
    assert len(player(stored(count=1000, robots=30))) < 2_000_000


def test_a_robot_without_estimate_is_left_out_and_altitude_is_told() -> None:
    silent = state(300, 3)
    silent.mean[100:200], silent.cov[100:200] = np.nan, np.nan
    flying = state(300, 4, 4, (0, 1, 2))
    made = film(stored(r3=silent, r4=flying))
    channels = made["robots"][2]["channels"]
    for name in ("x", "y", "a", "b", "e"):
        assert np.isnan(unpack(channels[name])).sum() == 100, name
    assert not np.isnan(unpack(channels["X"])).any()
    np.testing.assert_allclose(unpack(made["robots"][3]["channels"]["z"]), flying.mean[:, 2], atol=1e-2)
    assert "z" not in channels
    json.dumps(made, allow_nan=False)


@pytest.mark.parametrize("end_s", [20.0, 800.0, 3600.0])
def test_it_plays_in_about_half_a_minute(end_s: float) -> None:
    whole = stored()
    made = film(Stored(TrialTrace(np.linspace(0.0, end_s, 300), whole.trace.robots, {}), [], {}))
    assert made["speed"] in made["speeds"]
    assert 12.0 < end_s / made["speed"] < 60.0


def test_the_player_finds_its_parts_in_the_page() -> None:
    page, script = player(stored()), SCRIPT.read_text(encoding="utf-8")
    asked = set(re.findall(r'find\("\.(\w+)"\)', script)) | set(re.findall(r'"\.(\w+)"', script))
    assert asked >= {"play", "time", "speed", "clock", "now"}
    assert asked <= set(re.findall(r'class="(\w+)"', page))
    assert asked


def test_a_name_cannot_end_the_script() -> None:
    page = player(stored(**{"</script><b>": state(300, 5)}))
    assert "</script><b>" not in page
    data = page.partition('application/json">')[2].partition("</script>")[0]
    assert json.loads(data)["robots"][2]["name"] == "</script><b>"
