"""The table of who hears whom, from the world to the link models, over real sessions on loopback."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Iterable

import pytest

from network.link_feed import KEY, LinkFeed
from network.links import Pair, RangeTable
from network.transport import TransportError, free_port

DEADLINE_S = 15.0
PAIRS = [("r1", "r2"), ("r3", "r1")]


class Receiver:
    """A receiver's table, and what it was told."""

    def __init__(self) -> None:
        self.feed = LinkFeed()
        self.table = RangeTable()
        self.told: list[tuple[int, frozenset[Pair]]] = []

    def __call__(self, t_ns: int, pairs: Iterable[Pair]) -> None:
        self.told.append((t_ns, frozenset(pairs)))
        self.table.publish(t_ns, pairs)


def test_every_receiver_is_told_who_hears_whom() -> None:
    async def scene() -> list[Receiver]:
        world, receivers = LinkFeed(), [Receiver(), Receiver()]
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        try:
            await world.serve(endpoint)
            for receiver in receivers:
                await receiver.feed.follow(endpoint, receiver)
            deadline = time.monotonic() + DEADLINE_S
            t_ns = 0
            # The first tables may go to nobody: sessions take a moment to find each other.
            while not all({t % 2 for t, _ in receiver.told} == {0, 1} for receiver in receivers):
                assert time.monotonic() < deadline, "no table came"
                t_ns += 1
                world.publish(t_ns, ["r1", "r2", "r3"], PAIRS if t_ns % 2 else [])
                await asyncio.sleep(0.02)
        finally:
            for receiver in receivers:
                await receiver.feed.close()
            await world.close()
        return receivers

    for receiver in asyncio.run(scene()):
        for t_ns, pairs in receiver.told:
            assert pairs == frozenset(PAIRS if t_ns % 2 else [])
        odd = next(t_ns for t_ns, _ in receiver.told if t_ns % 2)
        assert receiver.table.state("r1", "r2", odd)
        assert receiver.table.state("r3", "r1", odd)
        assert not receiver.table.state("r2", "r1", odd)


def test_what_is_no_table_is_not_told() -> None:
    async def scene() -> Receiver:
        world, receiver = LinkFeed(), Receiver()
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        try:
            await world.serve(endpoint)
            await receiver.feed.follow(endpoint, receiver)
            deadline = time.monotonic() + DEADLINE_S
            while len(receiver.told) < 2:
                assert time.monotonic() < deadline, "no table came"
                world._session.put(KEY, b"rubbish")
                world.publish(5, ["r1", "r2"], [("r1", "r2")])
                await asyncio.sleep(0.02)
        finally:
            await receiver.feed.close()
            await world.close()
        return receiver

    receiver = asyncio.run(scene())
    assert set(receiver.told) == {(5, frozenset({("r1", "r2")}))}


def test_a_port_that_is_taken_is_named_with_the_remedy() -> None:
    async def scene(endpoint: str) -> None:
        feed = LinkFeed()
        with pytest.raises(TransportError, match="choose another") as caught:
            await feed.serve(endpoint)
        assert endpoint in str(caught.value)
        await feed.close()

    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as taken:
        port = free_port()
        taken.bind(("127.0.0.1", port))
        taken.listen()
        asyncio.run(scene(f"tcp/127.0.0.1:{port}"))


def test_closing_twice_or_before_opening_is_no_error() -> None:
    async def scene() -> None:
        feed = LinkFeed()
        await feed.close()
        await feed.close()

    asyncio.run(scene())
