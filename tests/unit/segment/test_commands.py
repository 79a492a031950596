"""Command queues: commands are complete and in order, and hostile records are refused."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.audit.trail import Actor, acting
from shmio.errors import CommandError
from shmio.layout.model import Layout, Register
from shmio.local.writer import CommandSender
from shmio.segment import BlockSpec, Command, ProcessSpec, Segment, Write
from shmio.segment._atomics import QUEUE_HEADER_SIZE, queue_pop, queue_push, store64
from shmio.segment.commands import MAX_WRITES, CommandQueues, capacity_for

LAYOUT = Layout("DB1", 1, 2, False, (Register("count", "INT", (), 0, None, 2, 1),))
writes_strategy = st.lists(
    st.one_of(
        st.builds(Write, st.integers(0, 2**32 - 1), st.just(0), st.binary(min_size=1, max_size=40)),
        st.builds(
            Write,
            st.integers(0, 2**32 - 1),
            st.sampled_from([1 << bit for bit in range(8)]),
            st.binary(min_size=1, max_size=1),
        ),
    ),
    min_size=1,
    max_size=20,
)


@pytest.fixture
def segment(instance: str) -> Iterator[Segment]:
    block = BlockSpec("cell", LAYOUT, 20_000_000, 10**9, 1 << 16)
    with Segment.create(instance, [block], [ProcessSpec("cell", "source")]) as segment:
        yield segment
        segment.unlink()


@given(writes_strategy, st.integers(0, 2**64 - 1), st.integers(0, 2**32 - 1), st.integers(-(2**63), 2**63 - 1))
def test_a_command_survives_a_round_trip(writes: list[Write], number: int, incarnation: int, deadline_ns: int) -> None:
    command = Command(3, number, incarnation, deadline_ns, tuple(writes))
    assert Command.unpack(3, command.pack()) == command
    told = Command(3, number, incarnation, deadline_ns, tuple(writes), by="web: anonymous (127.0.0.1)")
    assert told.pack().startswith(command.pack()), "readers of earlier versions ignore what follows the items"
    assert Command.unpack(3, told.pack()) == told


@given(st.binary(max_size=200))
def test_invalid_commands_are_refused(record: bytes) -> None:
    try:
        command = Command.unpack(0, record)
    except ValueError:
        return
    assert command.pack()[: len(record)] == record[: len(command.pack())] or command.writes


@given(st.lists(st.one_of(st.binary(max_size=120), st.none()), max_size=60))
def test_a_queue_returns_its_records_in_order(actions: list[bytes | None]) -> None:
    """Bytes are pushed, and None pops. A list is the model. The small queue wraps and fills up."""
    capacity = 256
    memory = bytearray(QUEUE_HEADER_SIZE + capacity)
    expected: list[bytes] = []
    for action in actions:
        if action is None:
            assert queue_pop(memory, 0, capacity) == (expected.pop(0) if expected else None)
            continue
        used = sum(8 + -(-len(record) // 8) * 8 for record in expected)
        room = used + 8 + -(-len(action) // 8) * 8 <= capacity
        assert queue_push(memory, 0, capacity, action) is room
        if room:
            expected.append(action)


@given(st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1), st.binary(min_size=256, max_size=256))
def test_a_broken_queue_is_emptied_and_then_works(head: int, tail: int, data: bytes) -> None:
    memory = bytearray(QUEUE_HEADER_SIZE) + bytearray(data)
    store64(memory, 0, head)
    store64(memory, 64, tail)
    for _ in range(40):
        try:
            if queue_pop(memory, 0, 256) is None:
                break
        except ValueError:
            assert queue_pop(memory, 0, 256) is None
            break
    else:
        raise AssertionError("the queue never becomes empty")
    assert queue_push(memory, 0, 256, b"next")
    assert queue_pop(memory, 0, 256) == b"next"


def test_each_writer_has_a_queue_and_all_share_one_doorbell(segment: Segment) -> None:
    queues = segment.blocks["cell"].commands
    seen = queues.bell()
    assert queues.push(0, b"zero")
    assert queues.push(5, b"five")
    assert queues.bell() != seen
    assert (queues.pop(0), queues.pop(5), queues.pop(5)) == (b"zero", b"five", None)
    with pytest.raises(ValueError, match="writer 8"):
        queues.push(8, b"")


def test_a_full_queue_is_an_error_for_the_sender(segment: Segment) -> None:
    sender = CommandSender(segment.blocks["cell"], 2)
    write = Write(0, 0, bytes(3800))
    for _ in range(capacity_for(2) // 4096):
        sender.submit([write], 0)
    with pytest.raises(CommandError, match="cell: its command queue is full"):
        sender.submit([write], 0)
    with pytest.raises(CommandError, match="at most"):
        sender.submit([Write(0, 0, bytes(capacity_for(2)))], 0)
    with pytest.raises(CommandError, match=f"1 to {MAX_WRITES} items"):
        sender.submit([], 0)


def test_a_command_names_the_process_it_is_for(segment: Segment) -> None:
    block = segment.blocks["cell"]
    segment.writer("cell")
    segment.writer("cell")
    number = CommandSender(block, 1).submit([Write(0, 0, b"\0\1")], 17)
    record = block.commands.pop(1)
    assert record is not None
    command = Command.unpack(1, record)
    assert command == Command(1, number, 2, 17, (Write(0, 0, b"\0\1"),), by=command.by)
    assert re.fullmatch(rf"local: uid {os.getuid()} \(pid {os.getpid()} \S.*\)", command.by)


def test_a_command_says_who_sends_it(segment: Segment) -> None:
    """The text comes from clients: it is bounded, and has no control characters. The right texts are written here."""
    block = segment.blocks["cell"]
    actors = {
        ("anonymous", "", "127.0.0.1", "web"): "web: anonymous (127.0.0.1)",
        ("token", "a\x1b[2J\x1f\nb", "", "grpc"): r"grpc: token a\x1b[2J\x1f\nb",
        ("account", "ü" * 500, "", "opcua"): f"opcua: account {'ü' * 52}",  # 16 bytes, and 104 of 120
    }
    for (kind, name, origin, endpoint), text in actors.items():
        with acting(Actor(kind, name, origin), endpoint):
            CommandSender(block, 1).submit([Write(0, 0, b"\0\1")], 17)
        assert Command.unpack(1, block.commands.pop(1) or b"").by == text
    CommandSender(block, 4).submit([Write(0, 0, b"\0\1")], 17)
    assert Command.unpack(4, block.commands.pop(4) or b"").by == "", "readers name the endpoint by its queue"


@pytest.mark.parametrize("geometry", [(0, 0, 0, 0), (8, 128, 100, 0), (8, 64, 128, 0), (2000, 256, 128, 0)])
def test_a_contradictory_section_is_refused(geometry: tuple[int, ...]) -> None:
    memory = bytearray(4096)
    for place, word in enumerate(geometry):
        memory[4 * place : 4 * place + 4] = word.to_bytes(4, "little")
    with pytest.raises(ValueError, match="queues"):
        CommandQueues(memoryview(memory), 0, len(memory))
