"""What tells an event loop that a bell in shared memory rings."""

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


class Ear:
    """Listens as an event loop does."""

    def __init__(self, relay: Relay) -> None:
        self._relay = relay
        self._poll = select.poll()
        self._poll.register(relay.descriptor, select.POLLIN)

    def told(self, timeout_ms: int = GIVE_UP_MS) -> bool:
        """Wait to be told, and heed it."""
        told = bool(self._poll.poll(timeout_ms))
        if told:
            self._relay.heard()
        return told


def test_it_tells_at_first_and_of_each_ring(segment: Segment) -> None:
    relay = Relay(segment.clock.bell, "relay", LONG_NS)
    ear = Ear(relay)
    for _ in range(100):
        assert ear.told()
        segment.clock.bell.ring()
    assert ear.told()
    relay.stop()
    relay.join()


def test_no_ring_is_lost_however_busy_the_loop_is(segment: Segment, instance: str) -> None:
    """Whoever looks when he is told has seen, in the end, the last frame."""
    writer = segment.writer("cell")
    with Segment.open(instance) as reader:  # a mapping that cannot be written
        block = reader.blocks["cell"]
        relay = Relay(block.ring, "relay", LONG_NS)
        ear, last = Ear(relay), 20_000
        publishing = threading.Thread(
            target=lambda: [writer.publish(bytes(4), cycle=number) for number in range(1, last + 1)]
        )
        publishing.start()
        seen = told = 0
        while seen < last:
            assert ear.told()
            told += 1
            seen = block.ring.head()
        publishing.join()
        relay.stop()
        relay.join()


def test_it_tells_now_and_then_without_a_ring(segment: Segment) -> None:
    relay = Relay(segment.clock.bell, "relay", 1_000_000)
    ear = Ear(relay)
    assert [ear.told() for _ in range(3)] == [True] * 3
    relay.stop()
    relay.join()


@pytest.mark.parametrize("rings", [0, 1, 2])
def test_one_that_is_stopped_ends_with_its_descriptor_whatever_it_waits_for(segment: Segment, rings: int) -> None:
    """Without a ring for the bell; with one that nobody has heard for the next; with two for the loop."""
    relay = Relay(segment.clock.bell, "relay", 50_000_000)
    ear = Ear(relay)
    assert ear.told()
    for _ in range(rings):
        segment.clock.bell.ring()
        assert select.select([relay.descriptor], [], [], GIVE_UP_MS / 1000)[0]
    relay.stop()
    relay.join()
    assert not relay.alive
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(relay.descriptor)


def test_one_that_is_stopped_before_it_runs_or_heard_after_that_does_not_run(segment: Segment) -> None:
    shared = bytearray(_atomics.RELAY_SIZE)
    descriptor = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
    _atomics.relay_stop(shared)
    _atomics.relay_heard(shared, descriptor)
    segment.clock.bell.relay(shared, descriptor, LONG_NS)
    assert not select.select([descriptor], [], [], 0)[0]
    os.close(descriptor)


def test_whoever_waits_for_the_end_stops_it_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thread that is just about to wait does not notice that it is woken."""
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


def test_what_is_told_after_the_stop_is_not_heard(segment: Segment) -> None:
    """The descriptor's number may be that of another file by then."""
    relay = Relay(segment.clock.bell, "relay", LONG_NS)
    ear = Ear(relay)
    assert ear.told()
    relay.stop()
    relay.join()
    reading, writing = os.pipe()
    if reading != relay.descriptor:
        os.dup2(reading, relay.descriptor)
    os.write(writing, bytes(8))
    relay.heard()
    assert os.read(reading, 8) == bytes(8)
    for descriptor in {reading, writing, relay.descriptor}:
        os.close(descriptor)
