"""One agent per network namespace, as on separate computers: links that fall, and how soon all talk again.

For `make check-matrix` (COFIX_MATRIX=1); needs root and `ip`.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.deploy.lan import Lan, firewall, missing
from tests.deploy.played import Live, play, scenario

ALL = ("r1", "r2", "r3", "r4")
AWAY_S = 5.0, 5.0, 20.0
"""By the last one sessions that hear nobody have been opened anew."""

pytestmark = pytest.mark.skipif(not os.environ.get("COFIX_MATRIX"), reason="long: make check-matrix")


@pytest.fixture
def lan() -> Lan:
    reason = missing()
    if reason is not None:
        pytest.skip(reason)
    return Lan(ALL)


CUTS: dict[str, tuple[Callable[[Lan, str], None], Callable[[Lan, str], None]]] = {
    "link": (Lan.link_down, Lan.link_up),
    "radio": (Lan.vanish, Lan.appear),
    "firewall": (Lan.drop, Lan.let_through),
}


@pytest.mark.parametrize("cut", sorted(CUTS))
@pytest.mark.parametrize("robot", ["r1", "r3"], ids=["dialled", "dials"])
def test_a_robot_that_was_away_is_heard_again(tmp_path: Path, lan: Lan, cut: str, robot: str) -> None:
    """Three times; `r1` is dialled by all others, `r3` dials two and is dialled by one."""
    if cut == "firewall" and firewall() is None:
        pytest.skip("neither nft nor iptables is here")
    away, back = CUTS[cut]
    others = [name for name in ALL if name != robot]

    async def disturb(live: Live) -> None:
        await live.until(4.0)
        times = live.notes["times"] = []

        def heard() -> list[bool]:
            here = live.status(robot)["peers"]
            return [here.get(name, False) and live.status(name)["peers"].get(robot, False) for name in others]

        for away_s in AWAY_S:
            await live.wait(lambda: all(heard()))
            away(lan, robot)
            await asyncio.sleep(away_s)
            assert not any(heard())
            back(lan, robot)
            times.append(await live.wait(lambda: all(heard())))
        await live.end()

    with lan:
        played = play(tmp_path, scenario(120.0), 1.0, disturb, lan.hosts)
    assert lan.left == lan.namespaces() == []
    assert played.outcome.exits == dict.fromkeys(ALL, 0), played.outcome.messages
    played.assert_honest()
    assert len(played.notes["times"]) == 3
    told = ", ".join(f"{wall_s:.2f}" for wall_s in played.notes["times"])
    print(f"all talk again after ({cut}, {robot}): {told} s")


def test_nothing_is_left_when_a_scene_fails(tmp_path: Path, lan: Lan) -> None:
    async def disturb(live: Live) -> None:
        await live.until(0.5)
        raise RuntimeError("the scene failed")

    with pytest.raises(RuntimeError, match="the scene failed"), lan:
        play(tmp_path, scenario(20.0), 1.0, disturb, lan.hosts)
    assert lan.left == lan.namespaces() == []


def test_messages_beyond_loopback_are_warned_of(tmp_path: Path, lan: Lan) -> None:
    with lan:
        play(tmp_path, scenario(4.0), 1.0, lambda live: live.end(0.0), lan.hosts)
    for robot in ALL:
        said = (tmp_path / "run" / "logs" / f"{robot}.log").read_text()
        assert "zenoh.insecure_lan: messages to peers are neither encrypted nor authenticated" in said
