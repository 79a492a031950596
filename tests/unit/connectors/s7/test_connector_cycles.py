"""Several reads are under way at once: each image is complete, in order, and made of its own answers."""

from __future__ import annotations

import threading
import time

import pytest

from shmio.connectors.s7.connector import S7Client
from shmio.emulators.s7 import ServerOptions
from shmio.errors import ConnectorError
from shmio.layout.values.write import Write
from tests.unit.connectors.s7.harness import SIZE, MakePlc, Plc, assert_recovers

JOBS = 5  # of one read of DB201 in PDUs of 480 bytes


def in_ns(seconds: float) -> int:
    return time.monotonic_ns() + round(seconds * 1e9)


def image(client: S7Client) -> bytes:
    collected = client.collect(in_ns(10))
    assert collected is not None
    return collected


@pytest.fixture
def wide(make_plc: MakePlc) -> Plc:
    return make_plc(ServerOptions(max_pdu_size=480, max_jobs=24))


class Answers:
    """Counts the controller's answers."""

    def __init__(self, plc: Plc) -> None:
        self._count = 0
        self._changed = threading.Condition()
        plc.proxy.edit(self._see)

    def _see(self, frame: bytes) -> bytes:
        with self._changed:
            self._count += 1
            self._changed.notify_all()
        return frame

    def wait(self, count: int) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: self._count >= count, 10)


@pytest.mark.parametrize(
    ("pdu_size", "jobs", "most", "depth"),
    [
        (480, 4, 24, 1),
        (480, 9, 24, 1),
        (480, 10, 24, 2),
        (480, 24, 24, 4),
        (960, 24, 24, 4),
        (960, 24, 7, 2),
        (960, 24, None, 2),
    ],
)
def test_depth_follows_the_granted_jobs_and_pdu_size(
    make_plc: MakePlc, pdu_size: int, jobs: int, most: int | None, depth: int
) -> None:
    plc = make_plc(ServerOptions(max_pdu_size=pdu_size, max_jobs=jobs))
    client = plc.client(maxJobs=most)
    assert client.depth == 1
    client.connect()
    assert client.depth == depth
    for _ in range(2):
        for _ in range(depth):
            client.submit()
        assert client.depth == depth
        assert [image(client) for _ in range(depth)] == [plc.block] * depth


def test_images_come_in_order_with_the_values_of_their_time(wide: Plc) -> None:
    client = wide.connected()
    answers = Answers(wide)
    for generation in range(4):
        wide.block[:] = bytes([generation]) * SIZE
        client.submit()
        answers.wait(JOBS * (generation + 1))
    assert [image(client) for _ in range(4)] == [bytes([generation]) * SIZE for generation in range(4)]


def test_answers_of_two_reads_in_reverse(wide: Plc) -> None:
    client = wide.connected()
    held: list[bytes] = []

    def reverse(frame: bytes) -> bytes | None:
        held.append(frame)
        return b"".join(reversed(held)) if len(held) == 2 * JOBS else None

    wide.proxy.edit(reverse, frames=2 * JOBS)
    client.submit()
    client.submit()
    assert image(client) == wide.block
    assert image(client) == wide.block


def test_no_image_yet(wide: Plc) -> None:
    client = wide.connected()
    wide.proxy.freeze()
    client.submit()
    client.submit()
    assert client.collect(in_ns(-1)) is None
    assert client.collect(in_ns(0.001)) is None
    wide.proxy.thaw()
    assert image(client) == wide.block
    assert image(client) == wide.block


def test_incomplete_image_is_not_returned(wide: Plc) -> None:
    client = wide.connected()
    answers = Answers(wide)
    wide.proxy.hold()  # ends the counting
    client.submit()
    assert wide.proxy.wait_held()
    assert client.collect(in_ns(0.01)) is None
    wide.proxy.release()
    assert image(client) == wide.block
    del answers


def test_each_read_has_its_own_time_out(wide: Plc) -> None:
    """The first read gets its answer. The second read times out although the connection is open."""
    client = wide.connected(timeout=300)
    client.submit()
    assert image(client) == wide.block
    wide.proxy.freeze()
    client.submit()
    with pytest.raises(ConnectorError, match="no answer within 300 ms"):
        client.collect(in_ns(60))
    assert_recovers(wide, client)


def test_an_answer_in_time_counts_even_if_it_is_collected_late(wide: Plc) -> None:
    """A write receives the answers of the read under way. The write's duration does not make them late."""
    client = wide.connected(timeout=200)
    client.submit()
    Answers(wide)
    assert client.write([Write(0, 0, bytes(wide.block[:1]))]) == [""]
    while client.collect(in_ns(0)) is None:
        pass
    assert client.connected


def test_an_answer_of_a_read_that_is_complete_is_refused(wide: Plc) -> None:
    client = wide.connected()
    frames: list[bytes] = []

    def again(frame: bytes) -> bytes:
        frames.append(frame)
        return frame if len(frames) <= JOBS else frames[0]  # to the second read, an answer of the first

    wide.proxy.edit(again)
    client.submit()
    client.submit()

    def both() -> None:  # the answer may come with the first image, or after it
        image(client)
        image(client)

    with pytest.raises(ConnectorError, match="not in flight"):
        both()
    assert_recovers(wide, client)


def test_the_connection_is_lost_with_reads_under_way(wide: Plc) -> None:
    client = wide.connected()
    wide.proxy.hold()
    client.submit()
    client.submit()
    assert wide.proxy.wait_held()
    wide.proxy.cut()
    with pytest.raises(ConnectorError, match="closed the connection"):
        client.collect(in_ns(10))
    with pytest.raises(ConnectorError, match="not connected"):
        client.submit()
    with pytest.raises(ConnectorError, match="not connected"):
        client.collect(in_ns(10))
    assert_recovers(wide, client)


def test_too_many_or_no_reads_under_way_are_errors_of_the_caller(wide: Plc) -> None:
    client = wide.connected(maxJobs=5)
    with pytest.raises(RuntimeError, match="no read is in flight"):
        client.collect(in_ns(10))
    client.submit()
    with pytest.raises(RuntimeError, match="no more than 1 "):
        client.submit()
    assert image(client) == wide.block
