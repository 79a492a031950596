"""Threads that wait in the extension while the segment is closed or the interpreter ends.

These tests also run on a sanitized build: scripts/test-sanitized.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator

import pytest

from shmio.layout.model import Layout, Register
from shmio.segment import Attributes, BlockSpec, ProcessSpec, Segment, _atomics

LAYOUT = Layout("DB1", 1, 4, False, (Register("count", "UDINT", (), 0, None, 4, 1),))


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    block = BlockSpec("sim", LAYOUT, 20_000_000, 500_000_000, 1 << 16, Attributes("memory"))
    with Segment.create(instance, [block], [ProcessSpec("sim", "source")]) as segment:
        yield segment
        segment.unlink()


class Waiting:
    """A thread that waits repeatedly until it is stopped. It keeps the error that ended it."""

    def __init__(self, wait: Callable[[], object], stopping: threading.Event) -> None:
        self.begun = threading.Event()
        self.error: Exception | None = None
        self._wait, self._stopping = wait, stopping
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        while not self._stopping.is_set():
            self.begun.set()
            try:
                self._wait()
            except Exception as error:  # noqa: BLE001 - any error of a use after close
                self.error = error
                return


def waiting(segment: Segment, pause_ns: int) -> list[Callable[[], object]]:
    """Return a function for each way to wait for something in a segment."""
    page, block = segment.clock, segment.blocks["sim"]
    frames, events, commands = block.ring, block.events.ring, block.commands
    waits: list[Callable[[], object]] = [
        lambda: page.bell.wait(page.bell.value(), pause_ns),
        lambda: page.slot_bell(0).wait(page.slot_bell(0).value(), pause_ns),
        lambda: page.delivered_bell.wait(page.delivered_bell.value(), pause_ns),
        lambda: frames.wait(frames.doorbell(), pause_ns),
        lambda: events.wait(events.doorbell(), pause_ns),
        lambda: commands.wait(commands.bell(), pause_ns),
    ]
    return waits


def test_a_segment_is_closed_while_threads_wait(segment: Segment, instance: str) -> None:
    """The mapping remains while threads wait. A thread that waits again gets an error."""
    for turn in range(20):
        reader, stopping = Segment.open(instance), threading.Event()
        waits = waiting(reader, (-1, 100_000)[turn % 2])
        threads = [Waiting(wait, stopping) for wait in waits]
        for one in threads:
            one.begun.wait()
        reader.close()
        stopping.set()
        while any(one.thread.is_alive() for one in threads):  # a thread with an endless wait may start it only now
            for bell in (segment.clock.bell, segment.clock.slot_bell(0), segment.clock.delivered_bell):
                bell.ring()
            segment.blocks["sim"].ring.wake()
            segment.blocks["sim"].events.ring.wake()
            segment.blocks["sim"].commands.wake()
        assert {type(one.error) for one in threads} <= {type(None), ValueError}, [one.error for one in threads]


def test_a_buffer_with_a_waiting_thread_cannot_be_resized() -> None:
    data = bytearray(64)
    thread = threading.Thread(target=_atomics.bell_wait, args=(data, 0, 0, -1))
    thread.start()

    def grow() -> None:
        while thread.is_alive():  # until the thread waits
            data.append(0)

    try:
        with pytest.raises(BufferError, match="cannot be re-sized"):
            grow()
    finally:
        _atomics.bell_ring(data, 0)
        thread.join()
    data.append(0)


ENDING = """
import sys, threading, time
from shmio.segment import Segment, _atomics

segment = Segment.open(sys.argv[1], writable=True)
block, how = segment.blocks["sim"], sys.argv[2]
begun = threading.Barrier(7)

def wait(work):
    begun.wait()
    while True:
        work()

def publish(ring):
    ring.wake()
    ring.latest()

pause_ns = -1 if how == "for ever" else 50_000
works = [
    lambda: block.ring.wait(block.ring.doorbell(), pause_ns),
    lambda: block.events.ring.wait(block.events.ring.doorbell(), pause_ns),
    lambda: segment.clock.bell.wait(segment.clock.bell.value(), pause_ns),
    lambda: segment.clock.slot_bell(0).wait(segment.clock.slot_bell(0).value(), pause_ns),
    lambda: (segment.clock.bell.ring(), publish(block.ring), time.sleep(0)),
    lambda: (segment.clock.read(), block.latest(), block.commands.wake()),
]
for work in works:
    threading.Thread(target=wait, args=(work,), daemon=True).start()
begun.wait()
if how == "closed":
    segment.close()
"""


@pytest.mark.parametrize("how", ["for ever", "in turns", "closed"])
def test_an_interpreter_ends_with_daemon_threads_in_the_extension(segment: Segment, instance: str, how: str) -> None:
    for _ in range(5):
        command = [sys.executable, "-X", "faulthandler", "-c", ENDING, instance, how]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stderr
        if how != "closed":  # after closing, a thread may print an error
            assert done.stderr == ""
