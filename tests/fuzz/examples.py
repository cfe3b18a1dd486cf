"""Messages made by hypothesis: any value in any place of a message of any kind."""

from __future__ import annotations

from collections import Counter
from typing import Any

import msgpack
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st

from network.endpoint import Endpoint
from network.messages import Channel, Header, Packet
from network.wire import encode
from tests.fuzz.floods import SETTINGS, assert_books_close, outcomes
from tests.network.test_wire import EXAMPLES

NOW_NS = 10**12
CHANNELS = st.sampled_from((Channel.HELLO, Channel.BELIEF, Channel.PAIR))

leaves = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**63), 2**64 - 1),
    st.integers(0, 9),
    st.floats(),
    st.text(max_size=8),
    st.sampled_from(("r1", "r2", "unicycle", "range", "t1")),
    st.binary(max_size=72),
    st.lists(st.floats(), max_size=9).map(lambda values: b"".join(map(_double, values))),
)
trees = st.recursive(leaves, lambda inner: st.lists(inner, max_size=8), max_leaves=20)


def _double(value: float) -> bytes:
    return bytes(msgpack.packb(value))[:0:-1]


@st.composite
def messages(draw: st.DrawFn) -> bytes:
    """A genuine message of any kind with up to three of its parts replaced by anything."""
    name = draw(st.sampled_from(sorted(EXAMPLES)))
    header = Header("r1", 7, 1, draw(st.integers(0, 10**6)), NOW_NS, NOW_NS)
    message: Any = msgpack.unpackb(encode(header, EXAMPLES[name]), use_list=True)
    for _ in range(draw(st.integers(0, 3))):
        here = message
        while True:
            index = draw(st.integers(0, len(here) - 1))
            if not isinstance(here[index], list) or not here[index] or draw(st.booleans()):
                break
            here = here[index]
        here[index] = draw(trees)
        if not isinstance(message, list) or not message:
            break
    return bytes(msgpack.packb(message))


def play_examples(number: int, count: int) -> Counter[str]:
    """Give an endpoint `count` messages of a seed; returns what became of them. Raises what escapes."""
    endpoint = Endpoint(robot="r2", boot_id=1, incarnation=1, settings=SETTINGS, software="1")

    @seed(number)
    @settings(max_examples=count, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(st.one_of(messages(), messages(), st.binary(max_size=1300)), CHANNELS)
    def check(payload: bytes, channel: str) -> None:
        endpoint.receive(NOW_NS, Packet("r1", channel, "r2" if channel == Channel.PAIR else None, payload))

    check()
    assert_books_close(endpoint)
    return outcomes(endpoint)
