"""Commands: each is judged at once, carried out in the next cycle, and gets a true outcome."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shmio.connectors.base import Lost, WriteLostError
from shmio.connectors.commands import MAX_WAITING, CommandProcessor, Item, coalesce
from shmio.connectors.injection_layers import DeclaredLayer
from shmio.connectors.output import Output
from shmio.errors import ConnectorError
from shmio.layout.model import Layout, Register
from shmio.local.writer import CommandSender
from shmio.segment import (
    BlockSpec,
    BlockWriter,
    Command,
    CommandKind,
    Cursor,
    Event,
    EventKind,
    ProcessSpec,
    Record,
    Segment,
    Write,
)

LAYOUT = Layout(
    "DB1",
    1,
    400,
    False,
    (
        Register("count", "INT", (), 0, None, 2, 1),
        Register("a", "BOOL", (), 2, 0, 1, 1),
        Register("b", "BOOL", (), 2, 1, 1, 1),
        Register("secret", "INT", (), 4, None, 2, 1),
        Register("long", "BYTE", ((1, 300),), 6, None, 300, 300),
    ),
)
WRITABLE = ("count", "a", "b", "long")
FAR = 10**18


class Bench:
    """A command processor with its thread, a sender, and the events."""

    def __init__(self, writer: BlockWriter, writable: Sequence[str] | None = WRITABLE) -> None:
        self.now_ns = 0
        self.processor = CommandProcessor(Output(writer), writable, lambda: self.now_ns)
        self.sender = CommandSender(writer.block, 4)
        self._events: Cursor[Event] = writer.block.events.cursor()
        self._thread = threading.Thread(target=self.processor.run)
        self._thread.start()

    def send(self, *writes: Write, deadline_ns: int = FAR) -> int:
        return self.sender.submit(writes, deadline_ns)

    def event(self) -> Event:
        event = self._events.next(20)
        assert event is not None, "no event came"
        return event

    def accepted(self, *writes: Write, deadline_ns: int = FAR) -> int:
        """Send a command, wait until it is queued for the next cycle, and return its number."""
        number = self.send(*writes, deadline_ns=deadline_ns)
        for place in range(len(writes)):
            event = self.event()
            assert (event.kind, event.command, event.item) == (EventKind.ACCEPTED, number, place)
        # The event comes before the command is queued; the next command is judged after both.
        self.send(Write(4, 0, b"\0\0"))
        assert self.event().kind == EventKind.REJECTED
        return number

    def stop(self) -> None:
        self.processor.stop()
        self._thread.join(20)
        assert not self._thread.is_alive()


@pytest.fixture
def writer(instance: str) -> Iterator[BlockWriter]:
    block = BlockSpec("cell", LAYOUT, 20_000_000, 10**9, 1 << 16)
    with Segment.create(instance, [block], [ProcessSpec("cell", "source")]) as segment:
        yield segment.writer("cell")
        segment.unlink()


@pytest.fixture
def bench(writer: BlockWriter) -> Iterator[Bench]:
    bench = Bench(writer)
    bench.processor.open()
    yield bench
    bench.stop()


def confirm(device: list[Write]) -> Callable[[Sequence[Write]], list[str]]:
    def write(writes: Sequence[Write]) -> list[str]:
        device.extend(writes)
        return [""] * len(writes)

    return write


def test_a_command_is_accepted_carried_out_and_confirmed(bench: Bench) -> None:
    number = bench.accepted(Write(0, 0, b"\1\2"), Write(2, 2, b"\2"))
    assert bench.processor.waiting
    device: list[Write] = []
    bench.processor.carry_out(confirm(device))
    assert device == [Write(0, 0, b"\1\2"), Write(2, 2, b"\2")]
    done = bench.event()
    assert (done.kind, done.command, done.writer, done.item, done.items) == (EventKind.WRITTEN, number, 4, 0, 2)
    assert not bench.processor.waiting


def test_note_is_an_event_even_without_the_device(bench: Bench) -> None:
    bench.processor.close("cable out")
    number = bench.sender.submit([], FAR, CommandKind.NOTE, name="Greifer getauscht")
    event = bench.event()
    assert (event.kind, event.text, event.writer, event.command) == (EventKind.NOTED, "Greifer getauscht", 4, number)
    assert (event.data, event.size, event.items) == (b"", 0, 1)


def test_late_note_is_rejected(bench: Bench) -> None:
    bench.now_ns = FAR
    bench.sender.submit([], FAR - 1, CommandKind.NOTE, name="late")
    assert bench.event().kind == EventKind.REJECTED


def test_last_value_of_a_cycle_wins_and_is_written_once(bench: Bench) -> None:
    first = bench.accepted(Write(0, 0, b"\0\1"), Write(2, 1, b"\1"))
    second = bench.accepted(Write(0, 0, b"\0\2"))
    device: list[Write] = []
    bench.processor.carry_out(confirm(device))
    assert device == [Write(2, 1, b"\1"), Write(0, 0, b"\0\2")], "in the order of the writes that count"
    ends = [bench.event() for _ in range(3)]
    assert [(end.command, end.item, end.kind, end.text) for end in ends] == [
        (first, 0, EventKind.WRITTEN, "superseded by a later write of the same cycle"),
        (first, 1, EventKind.WRITTEN, ""),
        (second, 0, EventKind.WRITTEN, ""),
    ]


def test_neighbouring_bits_of_two_writers_both_arrive(bench: Bench, writer: BlockWriter) -> None:
    bench.accepted(Write(2, 1, b"\1"))
    CommandSender(writer.block, 1).submit([Write(2, 2, b"\0")], FAR)
    assert bench.event().writer == 1
    bench.send(Write(4, 0, b"\0\0"))
    bench.event()
    device: list[Write] = []
    bench.processor.carry_out(confirm(device))
    assert [(write.offset, write.mask, write.data[0] & write.mask) for write in device] == [(2, 1, 1), (2, 2, 0)]


@pytest.mark.parametrize(
    ("write", "reason"),
    [
        (Write(4, 0, b"\0\0"), "cell/secret is not writable; name it in the source's `writable`"),
        (Write(2, 4, b"\4"), "byte 2 is not writable"),
        (Write(2, 0, b"\3"), "byte 2 is not writable"),
        (Write(399, 0, b"\0\0"), "byte 400 lies outside the block"),
        (Write(2**32 - 1, 0, b"\0\0"), "lies outside the block"),
    ],
)
def test_command_with_a_forbidden_write_is_rejected_as_a_whole(bench: Bench, write: Write, reason: str) -> None:
    number = bench.send(Write(0, 0, b"\0\0"), write)
    event = bench.event()
    assert (event.kind, event.command, event.items) == (EventKind.REJECTED, number, 2)
    assert reason in event.text
    assert not bench.processor.waiting


def test_command_for_an_earlier_process_is_rejected(writer: BlockWriter, instance: str) -> None:
    sender = CommandSender(writer.block, 4)
    sender.submit([Write(0, 0, b"\0\0")], FAR)
    with Segment.open(instance, writable=True) as segment:
        successor = segment.writer("cell")
        bench = Bench(successor)
        bench.processor.open()
        try:
            assert bench.event().kind == EventKind.REJECTED
        finally:
            bench.stop()
        last = successor.block.events.read(successor.block.events.head())
        assert last is not None
        assert "restarted after the command was sent" in last.text


def test_late_command_is_rejected(bench: Bench) -> None:
    bench.now_ns = 5_000_000
    bench.send(Write(0, 0, b"\0\0"), deadline_ns=2_000_000)
    event = bench.event()
    assert (event.kind, event.text) == (EventKind.REJECTED, "the command came 3 ms after its deadline")


def test_command_that_no_cycle_carries_out_in_time_expires(bench: Bench) -> None:
    number = bench.accepted(Write(0, 0, b"\0\0"), deadline_ns=1_000)
    bench.now_ns = 2_000
    device: list[Write] = []
    bench.processor.carry_out(confirm(device))
    event = bench.event()
    assert (event.kind, event.command) == (EventKind.EXPIRED, number)
    assert device == []


def test_command_is_carried_out_exactly_at_its_deadline(bench: Bench) -> None:
    bench.now_ns = 1_000
    number = bench.accepted(Write(0, 0, b"\1\2"), deadline_ns=1_000)
    device: list[Write] = []
    bench.processor.carry_out(confirm(device))
    event = bench.event()
    assert (event.kind, event.command) == (EventKind.WRITTEN, number)
    assert device == [Write(0, 0, b"\1\2")]


def test_disconnection_expires_waiting_commands_and_rejects_new_ones(bench: Bench) -> None:
    number = bench.accepted(Write(0, 0, b"\0\0"))
    bench.processor.close("cable out")
    event = bench.event()
    assert (event.kind, event.command, event.text) == (EventKind.EXPIRED, number, "cable out")
    bench.send(Write(0, 0, b"\0\0"))
    event = bench.event()
    assert (event.kind, event.text) == (EventKind.REJECTED, "the source is not connected: cable out")
    bench.processor.open()
    assert not bench.processor.waiting
    bench.accepted(Write(0, 0, b"\0\0"))


def test_lost_connection_leaves_the_outcome_unknown(bench: Bench) -> None:
    bench.accepted(Write(0, 0, b"\0\0"))

    def lost(_: Sequence[Write]) -> list[str]:
        raise ConnectorError("cut")

    with pytest.raises(ConnectorError):
        bench.processor.carry_out(lost)
    event = bench.event()
    assert (event.kind, event.text) == (EventKind.UNKNOWN, "the write was sent, but the device did not confirm it: cut")


def test_each_item_of_a_lost_batch_has_its_known_outcome(bench: Bench) -> None:
    """The items are written, refused, under way at the loss, never sent, or superseded."""
    first = bench.accepted(Write(0, 0, b"\0\0"), Write(6, 0, b"a"), Write(8, 0, b"b"), Write(10, 0, b"c"))
    second = bench.accepted(Write(10, 0, b"d"), Write(2, 1, b"\1"), Write(2, 2, b"\2"))

    def lost(writes: Sequence[Write]) -> list[str]:
        assert len(writes) == 6
        raise WriteLostError("cut", ["", "no", Lost.UNKNOWN, Lost.UNSENT, Lost.UNSENT, Lost.UNSENT])

    with pytest.raises(ConnectorError):
        bench.processor.carry_out(lost)
    ends = [bench.event() for _ in range(5)]
    assert [(end.command, end.item, end.items, end.kind, end.text) for end in ends] == [
        (first, 0, 1, EventKind.WRITTEN, ""),
        (first, 1, 1, EventKind.REFUSED, "no"),
        (first, 2, 1, EventKind.UNKNOWN, "the write was sent, but the device did not confirm it: cut"),
        (first, 3, 1, EventKind.EXPIRED, "the write was not sent: cut"),
        (second, 0, 3, EventKind.EXPIRED, "the write was not sent: cut"),
    ]


def test_partly_written_item_is_unknown_not_expired(bench: Bench) -> None:
    """The first two bytes are written. A later item, which is not sent, supersedes the other bytes."""
    bench.accepted(Write(6, 0, b"abcd"))
    bench.accepted(Write(8, 0, b"xy"))

    def lost(writes: Sequence[Write]) -> list[str]:
        assert writes == [Write(6, 0, b"ab"), Write(8, 0, b"xy")]
        raise WriteLostError("", ["", Lost.UNSENT])

    with pytest.raises(ConnectorError):
        bench.processor.carry_out(lost)
    assert [bench.event().kind for _ in range(2)] == [EventKind.UNKNOWN, EventKind.EXPIRED]


@pytest.mark.parametrize("lost", [True, False])
def test_too_few_outcomes_leave_all_items_unknown(bench: Bench, lost: bool) -> None:
    number = bench.send(Write(0, 0, b"\0\1"), Write(6, 0, b"\1"))
    for _ in range(2):
        assert bench.event().kind == EventKind.ACCEPTED

    def write(_: Sequence[Write]) -> list[str]:
        if lost:
            raise WriteLostError("cut", [""])
        return [""]

    with pytest.raises(ConnectorError, match="1 outcomes for 2 writes"):
        bench.processor.carry_out(write)
    end = bench.event()
    assert (end.command, end.item, end.items, end.kind) == (number, 0, 2, EventKind.UNKNOWN)


def test_refusal_concerns_only_its_item(bench: Bench) -> None:
    bench.accepted(Write(0, 0, b"\0\0"), Write(2, 1, b"\1"), Write(2, 2, b"\2"), Write(6, 0, b"\0"))
    bench.processor.carry_out(lambda writes: ["access denied" if write.mask == 2 else "" for write in writes])
    ends = [bench.event() for _ in range(3)]
    assert [(end.kind, end.item, end.items, end.text) for end in ends] == [
        (EventKind.WRITTEN, 0, 2, ""),
        (EventKind.REFUSED, 2, 1, "access denied"),
        (EventKind.WRITTEN, 3, 1, ""),
    ]


def test_long_write_is_reported_in_parts(bench: Bench) -> None:
    data = bytes(range(256)) + bytes(44)
    bench.send(Write(6, 0, data))
    first, second = bench.event(), bench.event()
    assert first.data + second.data == data
    assert [(part.item, part.offset, part.size) for part in (first, second)] == [(0, 6, 256), (0, 262, 44)]


def test_number_of_waiting_items_is_bounded_and_the_rest_is_accepted_later(bench: Bench) -> None:
    numbers = [bench.send(*[Write(0, 0, b"\0\0")] * 100) for _ in range(5)]
    device: list[Write] = []
    seen: list[tuple[int, EventKind]] = []

    def until(commands: int) -> None:
        while sum(kind is EventKind.ACCEPTED for _, kind in seen) < 100 * commands:
            event = bench.event()
            seen.append((event.command, EventKind(event.kind)))

    until(2)
    assert len(bench.processor._items) <= MAX_WAITING
    for commands in (2, 4, 5):
        until(commands)
        while not bench.processor.waiting:  # the event comes before the command is queued
            pass
        bench.processor.carry_out(confirm(device))
    accepted = [command for command, kind in seen if kind is EventKind.ACCEPTED]
    assert accepted == [number for number in numbers for _ in range(100)]


def test_size_of_waiting_commands_is_bounded(
    bench: Bench, writer: BlockWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The limit is four times the block's 400 bytes: five writes of 300 bytes fit."""
    commands, looked = writer.block.commands, threading.Semaphore(0)
    wait = commands.wait

    def rest(seen: int, timeout_ns: int) -> None:
        looked.release()
        wait(seen, timeout_ns)

    monkeypatch.setattr(commands, "wait", rest)
    numbers = [bench.send(Write(6, 0, bytes(300))) for _ in range(6)]
    accepted = [bench.event().command for _ in range(10)]  # two parts each
    assert accepted == [number for number in numbers[:5] for _ in range(2)]
    while looked.acquire(blocking=False):
        pass
    for _ in range(2):  # one wait may have been under way
        commands.wake()
        assert looked.acquire(timeout=20)
    assert bench._events.next(0) is None
    bench.processor.carry_out(confirm([]))
    after = [bench.event() for _ in range(7)]
    assert [event.command for event in after if event.kind == EventKind.WRITTEN] == numbers[:5]
    assert [event.command for event in after if event.kind == EventKind.ACCEPTED] == numbers[5:] * 2


def test_a_connection_lost_while_a_command_is_being_accepted(
    bench: Bench, writer: BlockWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command is judged but not yet queued when the connection is lost.

    It expires, and is not carried out later.
    """
    tell = writer.event

    def told(record: Record) -> int:
        number = tell(record)
        if record.kind is EventKind.ACCEPTED:
            bench.processor.close("cable out")
        return number

    monkeypatch.setattr(writer, "event", told)
    number = bench.send(Write(0, 0, b"\0\1"))
    ends = [bench.event() for _ in range(2)]
    assert [(end.command, end.kind, end.text) for end in ends] == [
        (number, EventKind.ACCEPTED, ""),
        (number, EventKind.EXPIRED, "the source is not connected: cable out"),
    ]
    bench.processor.open()
    assert not bench.processor.settle()
    assert not bench.processor.waiting


def test_refusal_of_the_later_value_applies_to_the_superseded_one(bench: Bench) -> None:
    first, second = bench.accepted(Write(0, 0, b"\0\1")), bench.accepted(Write(0, 0, b"\0\2"))
    assert bench.processor.settle()
    bench.processor.carry_out(lambda writes: ["no"] * len(writes))
    ends = [bench.event() for _ in range(2)]
    assert [(end.command, end.kind, end.text) for end in ends] == [
        (first, EventKind.REFUSED, "no"),
        (second, EventKind.REFUSED, "no"),
    ]


def test_writes_keep_the_order_of_acceptance(bench: Bench) -> None:
    """Data are written before their strobe, although the strobe has a lower offset."""
    bench.accepted(Write(100, 0, b"DATA"))
    bench.accepted(Write(2, 1, b"\1"))
    bench.accepted(Write(104, 0, b"MORE"))
    device: list[Write] = []
    bench.processor.carry_out(confirm(device))
    assert device == [Write(100, 0, b"DATA"), Write(2, 1, b"\1"), Write(104, 0, b"MORE")]


def test_waiting_command_expires_at_its_deadline_without_a_cycle(bench: Bench) -> None:
    number = bench.accepted(Write(0, 0, b"\0\0"), deadline_ns=1_000)
    bench.now_ns = 2_000
    bench.processor._writer.block.commands.wake()
    event = bench.event()
    assert (event.kind, event.command) == (EventKind.EXPIRED, number)
    assert not bench.processor.waiting


def test_outcome_is_reported_whatever_the_write_raises(bench: Bench) -> None:
    bench.accepted(Write(0, 0, b"\0\0"))

    def defect(_: Sequence[Write]) -> list[str]:
        raise ZeroDivisionError("a defect")

    with pytest.raises(ZeroDivisionError):
        bench.processor.carry_out(defect)
    assert bench.event().kind == EventKind.UNKNOWN


def test_garbage_is_reported_once_a_second(bench: Bench, writer: BlockWriter) -> None:
    for _ in range(50):
        while not writer.block.commands.push(2, b"garbage"):
            pass
    assert bench.event().kind == EventKind.REJECTED
    bench.accepted(Write(0, 0, b"\0\0"))  # the next event is about this one


def test_invalid_command_is_rejected_and_skipped(bench: Bench, writer: BlockWriter) -> None:
    writer.block.commands.push(2, b"garbage")
    event = bench.event()
    assert (event.kind, event.writer) == (EventKind.REJECTED, 2)
    assert "invalid command" in event.text
    bench.accepted(Write(0, 0, b"\0\0"))


def test_connector_that_cannot_write_rejects_commands(writer: BlockWriter) -> None:
    bench = Bench(writer, None)
    bench.processor.open()
    try:
        bench.send(Write(0, 0, b"\0\0"))
        assert "connector cannot write" in bench.event().text
    finally:
        bench.stop()


single = st.tuples(
    st.integers(0, 9), st.sampled_from([1 << bit for bit in range(8)]), st.binary(min_size=1, max_size=1)
)
whole = st.tuples(st.integers(0, 5), st.just(0), st.binary(min_size=1, max_size=5))


@given(st.lists(st.one_of(single, whole), max_size=12), st.binary(min_size=10, max_size=10))
@settings(max_examples=300)
def test_coalesced_writes_have_the_effect_of_the_single_ones(
    items: list[tuple[int, int, bytes]], before: bytes
) -> None:
    def apply(image: bytes, writes: Sequence[Write]) -> bytes:
        changed = bytearray(image)
        for offset, mask, data in writes:
            for at, byte in enumerate(data, offset):
                bits = mask or 0xFF
                changed[at] = changed[at] & ~bits | byte & bits
        return bytes(changed)

    writes = [Write(*item) for item in items]
    commands = [
        Command(0, place // 3, 1, FAR, tuple(writes[place - place % 3 : place - place % 3 + 3]))
        for place in range(len(writes))
    ]
    first = {command.id: command for command in commands}
    merged, superseded = coalesce([Item(first[place // 3], place % 3) for place in range(len(writes))], 10)
    assert apply(before, merged) == apply(before, writes)
    assert apply(before, [w for place, w in enumerate(writes) if place not in superseded]) == apply(before, writes)


def test_commands_of_one_writer_are_judged_in_order(writer: BlockWriter) -> None:
    sender = CommandSender(writer.block, 0)
    numbers = [sender.submit([Write(0, 0, bytes([0, n]))], FAR) for n in range(50)]
    bench = Bench(writer)
    bench.processor.open()
    try:
        seen = [bench.event().command for _ in range(50)]
    finally:
        bench.stop()
    assert seen == numbers


class SlowInjections:
    """Takes commands so slowly that the next one has come meanwhile, and changes must be followed after each."""

    overload = ""
    patience_ns = 0

    def __init__(self, sender: CommandSender) -> None:
        self._sender = sender
        self.stop: Callable[[], None] = lambda: None
        self.calls: list[str] = []

    def toward_device(self, _command: Command) -> None:
        return None

    def take(self, _command: Command) -> str:
        self.calls.append("take")
        if self.calls.count("take") < 4:
            self._sender.submit([], FAR, kind=CommandKind.LIFT, injection=1)
        else:
            self.stop()
        return ""

    def release(self, _cycle: int) -> list[tuple[DeclaredLayer, Write]]:
        return []

    def forget(self, reason: str) -> None:
        raise AssertionError(reason)

    def follow_changes(self) -> None:
        self.calls.append("follow")


def test_commands_that_come_without_pause_do_not_delay_following_changes(writer: BlockWriter) -> None:
    sender = CommandSender(writer.block, 4)
    slow = SlowInjections(sender)
    processor = CommandProcessor(Output(writer), WRITABLE, lambda: 0, injections=lambda *_: slow)
    slow.stop = processor.stop
    sender.submit([], FAR, kind=CommandKind.LIFT, injection=1)
    processor.run()
    assert slow.calls[:8] == ["take", "follow"] * 4
