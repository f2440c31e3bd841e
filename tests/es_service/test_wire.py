"""Messages over sockets: whatever the pieces in which they travel, whoever stops, whatever is left unread."""

from __future__ import annotations

import socket
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from es_service.protocol.wire import Channel, framed, receive


@pytest.fixture
def ends():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        theirs.settimeout(10.0)
        yield Channel(ours), theirs


messages = st.lists(st.one_of(st.none(), st.binary(max_size=60), st.integers(), st.tuples(st.text(max_size=5))))


@given(messages, st.lists(st.integers(1, 40), min_size=1, max_size=40))
def test_messages_come_whole_and_in_order_whatever_the_pieces(sent, sizes):
    ours, theirs = socket.socketpair()
    with ours, theirs:
        channel, data, found = Channel(ours), b"".join(map(framed, sent)), []
        start = 0
        for size in sizes * (len(data) // sum(sizes) + 1):
            theirs.sendall(data[start : start + size])
            start += size
            came, is_open = channel.receive()
            assert is_open
            found += came
        assert found == sent


def test_a_channel_never_waits_and_loses_nothing(ends):
    """Much more than a socket holds, to an end that does not read, and back from one that does not stop writing."""
    channel, theirs = ends
    large = bytes(range(256)) * 20_000
    channel.send(framed(large), framed("behind it"))
    assert channel.is_full
    assert channel.receive() == ([], True)

    def other_end():
        echoes.extend(receive(theirs) for _ in range(2))
        theirs.sendall(framed(large))

    echoes, came = [], []
    thread = threading.Thread(target=other_end)
    thread.start()
    until = time.monotonic() + 10.0
    while not came:
        assert time.monotonic() < until
        channel.flush()
        came = channel.receive()[0]
    thread.join()
    assert not channel.is_full
    assert (echoes, came) == ([large, "behind it"], [large])


def test_what_was_said_before_the_end_is_heard_and_half_a_message_is_not(ends):
    channel, theirs = ends
    theirs.sendall(framed("last words") + framed("half of this")[:-3])
    theirs.close()
    assert channel.receive()[0] == ["last words"]
    assert channel.receive() == ([], False)
    channel.send(framed("to nobody"))
    assert not channel.is_full


def test_an_end_closed_with_unread_messages_in_it_is_an_end(ends):
    """Of a killed process: the socket is reset rather than closed."""
    channel, theirs = ends
    channel.send(framed("unread"))
    theirs.close()
    assert channel.receive() == ([], False)


def test_the_waiting_end_says_that_the_other_is_gone(ends):
    channel, theirs = ends
    channel.send(framed(1))
    channel.close()
    assert receive(theirs) == 1
    with pytest.raises(EOFError):
        receive(theirs)
