"""One Zenoh session: what it dials, and that it is given up when it does not close."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import pytest

from network.zenoh_session import ZenohSession, ZenohSettings, link_pair

CONNECT = tuple((f"r{k}", link_pair("127.0.0.1", 20_000 + k)) for k in (1, 2, 3))


def test_only_lower_ids_are_dialled() -> None:
    own = {robot: ZenohSettings("f", robot, 1, links, CONNECT) for robot, links in CONNECT}
    assert own["r1"].dialled() == []
    assert own["r2"].dialled() == list(own["r1"].listen)
    assert own["r3"].dialled() == [*own["r1"].listen, *own["r2"].listen]
    assert own["r2"].peers() == {"r1": own["r1"].listen, "r3": own["r3"].listen}


@pytest.mark.parametrize("bad", [{"fleet": "a/b"}, {"robot": "*"}, {"lease_ms": 0}, {"queue_depth": 0}])
def test_settings_that_make_no_sense_name_their_key(bad: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        ZenohSettings(**({"fleet": "f", "robot": "r1", "boot_id": 1, "listen": ()} | bad))


def test_a_session_that_does_not_close_is_given_up() -> None:
    release = threading.Event()

    class Stuck:
        def close(self) -> None:
            release.wait(15.0)

    async def scene() -> tuple[bool, bool]:
        session = ZenohSession(ZenohSettings("f", "r1", 1, (), close_timeout_s=0.05), (), ())
        session._session = Stuck()
        return await session.close(), await session.close()

    try:
        assert asyncio.run(scene()) == (False, True)
    finally:
        release.set()
