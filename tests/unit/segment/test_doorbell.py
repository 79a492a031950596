"""The relay that wakes an event loop when a doorbell in shared memory rings."""

from __future__ import annotations

import os
import select
import threading
from collections.abc import Iterator

import pytest

from shmio.layout.model import Layout, Register
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment, _atomics
from shmio.segment.doorbell import Relay

LAYOUT = Layout("DB1", 1, 4, False, (Register("count", "UDINT", (), 0, None, 4, 1),))
LONG_NS = 600_000_000_000
GIVE_UP_MS = 60_000


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    block = BlockSpec("cell", LAYOUT, 20_000_000, 500_000_000, 1 << 16, Attributes("test"))
    with Segment.create(instance, [block], [ProcessSpec("cell", "source")]) as segment:
        yield segment
        segment.unlink()


class WaitingLoop:
    """Waits for the relay's descriptor, as an event loop does."""

    def __init__(self, relay: Relay) -> None:
        self._relay = relay
        self._poll = select.poll()
        self._poll.register(relay.descriptor, select.POLLIN)

    def told(self, timeout_ms: int = GIVE_UP_MS) -> bool:
        """Wait for a wake-up, and acknowledge it. Return whether one came."""
        told = bool(self._poll.poll(timeout_ms))
        if told:
            self._relay.acknowledge()
        return told


def test_the_relay_wakes_the_loop_at_first_and_at_each_ring(segment: Segment) -> None:
    relay = Relay(segment.clock.bell, "relay", LONG_NS)
    loop = WaitingLoop(relay)
    for _ in range(100):
        assert loop.told()
        segment.clock.bell.ring()
    assert loop.told()
    relay.stop()
    relay.join()


def test_no_ring_is_lost_however_busy_the_loop_is(segment: Segment, instance: str) -> None:
    """A reader that looks once for each wake-up has seen the last frame in the end."""
    writer = segment.writer("cell")
    with Segment.open(instance) as reader:  # a read-only mapping
        block = reader.blocks["cell"]
        relay = Relay(block.ring, "relay", LONG_NS)
        loop, last = WaitingLoop(relay), 20_000
        publishing = threading.Thread(
            target=lambda: [writer.publish(bytes(4), cycle=number) for number in range(1, last + 1)]
        )
        publishing.start()
        seen = told = 0
        while seen < last:
            assert loop.told()
            told += 1
            seen = block.ring.head()
        publishing.join()
        relay.stop()
        relay.join()


def test_the_relay_wakes_the_loop_periodically_without_a_ring(segment: Segment) -> None:
    relay = Relay(segment.clock.bell, "relay", 1_000_000)
    loop = WaitingLoop(relay)
    assert [loop.told() for _ in range(3)] == [True] * 3
    relay.stop()
    relay.join()


@pytest.mark.parametrize("rings", [0, 1, 2])
def test_a_stopped_relay_ends_and_closes_its_descriptor(segment: Segment, rings: int) -> None:
    """The relay waits for a ring, or for the loop to acknowledge one ring or two."""
    relay = Relay(segment.clock.bell, "relay", 50_000_000)
    loop = WaitingLoop(relay)
    assert loop.told()
    for _ in range(rings):
        segment.clock.bell.ring()
        assert select.select([relay.descriptor], [], [], GIVE_UP_MS / 1000)[0]
    relay.stop()
    relay.join()
    assert not relay.alive
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(relay.descriptor)


def test_a_relay_stopped_before_it_runs_does_not_run(segment: Segment) -> None:
    shared = bytearray(_atomics.RELAY_SIZE)
    descriptor = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
    _atomics.relay_stop(shared)
    _atomics.relay_heard(shared, descriptor)
    segment.clock.bell.relay(shared, descriptor, LONG_NS)
    assert not select.select([descriptor], [], [], 0)[0]
    os.close(descriptor)


def test_join_repeats_the_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread that is just about to wait does not notice the first stop."""
    stops = threading.Semaphore(0)

    class JustAboutToWait:
        def relay(self, shared: bytearray, descriptor: int, turn_ns: int, /) -> None:
            for _ in range(2):
                assert stops.acquire(timeout=GIVE_UP_MS / 1000)

    monkeypatch.setattr(_atomics, "relay_stop", lambda _: stops.release())
    relay = Relay(JustAboutToWait(), "relay", LONG_NS)
    relay.stop()
    relay.join()
    assert not relay.alive


def test_after_the_stop_the_descriptor_is_not_read(segment: Segment) -> None:
    """By then, the descriptor's number may belong to another file."""
    relay = Relay(segment.clock.bell, "relay", LONG_NS)
    loop = WaitingLoop(relay)
    assert loop.told()
    relay.stop()
    relay.join()
    reading, writing = os.pipe()
    if reading != relay.descriptor:
        os.dup2(reading, relay.descriptor)
    os.write(writing, bytes(8))
    relay.acknowledge()
    assert os.read(reading, 8) == bytes(8)
    for descriptor in {reading, writing, relay.descriptor}:
        os.close(descriptor)
