"""A program that writes: values by path, and their true outcomes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest

import shmio
from shmio.errors import CommandError, PathError, SegmentError, ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.local.injection import Shadow
from shmio.local.writer import SourceWriter
from shmio.model.values import OutcomeKind
from shmio.segment import (
    Attributes,
    BlockSpec,
    BlockWriter,
    Command,
    Direction,
    EventKind,
    ProcessSpec,
    Record,
    Segment,
)

LAYOUT = Layout(
    "DB1",
    1,
    8,
    False,
    (
        Register("count", "INT", (), 0, None, 2, 1),
        Register("bits", "BOOL", ((0, 10),), 2, 0, 2, 11),
        Register("secret", "INT", (), 4, None, 2, 1),
    ),
)
PROCESSES = [ProcessSpec("cell", "source")]


@pytest.fixture
def writer(instance: str) -> Iterator[BlockWriter]:
    attributes = Attributes("s7", ("count", "bits"))
    block = BlockSpec("cell", LAYOUT, 20_000_000, 10**9, 1 << 16, attributes)
    with Segment.create(instance, [block], PROCESSES) as segment:
        yield segment.writer("cell")
        segment.unlink()


Answer = Callable[[BlockWriter, Command], None]


@pytest.fixture
def source(writer: BlockWriter) -> Iterator[list[Answer]]:
    """Run a source that answers each command with the next function of the list."""
    answers: list[Answer] = []
    stop = threading.Event()

    def serve() -> None:
        queues = writer.block.commands
        while not stop.is_set():
            seen = queues.bell()
            for number in range(queues.writers):
                while (record := queues.pop(number)) is not None:
                    answers.pop(0)(writer, Command.unpack(number, record))
            queues.wait(seen, 10**9)

    thread = threading.Thread(target=serve)
    thread.start()
    yield answers
    stop.set()
    writer.block.commands.wake()
    thread.join(20)


def tell(kind: EventKind, first: int = 0, items: int | None = None, text: str = "") -> Answer:
    def answer(writer: BlockWriter, command: Command) -> None:
        count = len(command.writes) if items is None else items
        writer.event(Record(kind, text, command.writer, command.id, first, count))

    return answer


def both(*answers: Answer) -> Answer:
    def answer(writer: BlockWriter, command: Command) -> None:
        for each in answers:
            each(writer, command)

    return answer


def test_each_value_has_its_outcome_in_the_order_given(writer: BlockWriter, source: list[Answer]) -> None:
    source.append(both(tell(EventKind.REFUSED, 0, 1, "no"), tell(EventKind.WRITTEN, 1, 1)))
    outcomes = SourceWriter(writer.block, 5).write({"count": 7, "bits": [True] * 11})
    assert [(o.path, o.kind, o.text, o.done) for o in outcomes] == [
        ("count", OutcomeKind.REFUSED, "no", False),
        ("bits", OutcomeKind.WRITTEN, "", True),
    ]


def test_rejected_command_rejects_all_values(writer: BlockWriter, source: list[Answer]) -> None:
    source.append(tell(EventKind.REJECTED, text="not connected"))
    outcomes = SourceWriter(writer.block, 5).write({"count": 7, "bits/3": True})
    assert [(o.kind, o.text) for o in outcomes] == [(OutcomeKind.REJECTED, "not connected")] * 2


def test_forked_writer_cannot_write(writer: BlockWriter, monkeypatch: pytest.MonkeyPatch) -> None:
    source_writer = SourceWriter(writer.block, 5)
    monkeypatch.setattr("os.getpid", lambda: 1)
    with pytest.raises(CommandError, match="attach again"):
        source_writer.submit({"count": 7})
    assert writer.block.commands.pop(5) is None


def test_time_out_for_a_slow_source_covers_several_cycles(instance: str) -> None:
    block = BlockSpec("cell", LAYOUT, 5_000_000_000, 10**11, 1 << 16)
    with Segment.create(instance, [block], PROCESSES) as segment:
        assert SourceWriter(segment.blocks["cell"], 5).timeout_s == 15
        segment.unlink()


def test_silence_is_an_unknown_outcome_after_the_time_out(writer: BlockWriter) -> None:
    (outcome,) = SourceWriter(writer.block, 5).write({"count": 7}, timeout_s=-0.95)
    assert outcome.kind is OutcomeKind.UNKNOWN
    assert "gave no answer in time" in outcome.text


def test_restart_of_the_source_ends_the_wait(writer: BlockWriter, source: list[Answer], instance: str) -> None:
    def die(_: BlockWriter, command: Command) -> None:
        tell(EventKind.ACCEPTED)(writer, command)
        with Segment.open(instance, writable=True) as segment:
            segment.writer("cell")

    source.append(die)
    began = time.monotonic()
    (outcome,) = SourceWriter(writer.block, 5).write({"count": 7}, timeout_s=600)
    assert outcome.kind is OutcomeKind.UNKNOWN
    assert "the source was restarted meanwhile" in outcome.text
    assert time.monotonic() - began < 60


def test_invalid_values_are_refused_before_they_are_sent(writer: BlockWriter) -> None:
    source_writer = SourceWriter(writer.block, 5)
    with pytest.raises(CommandError, match=r"cell/secret is not writable; .*`writable`"):
        source_writer.submit({"count": 1, "secret": 1})
    with pytest.raises(PathError):
        source_writer.submit({"nothing": 1})
    with pytest.raises(ValueRangeError, match="cell/count: "):
        source_writer.submit({"count": 70_000})
    assert writer.block.commands.pop(5) is None


def test_a_local_program_writes_as_a_guest(writer: BlockWriter, source: list[Answer], instance: str) -> None:
    source += [tell(EventKind.WRITTEN), tell(EventKind.WRITTEN)]
    with shmio.attach(instance, writable=True) as cell:
        assert [outcome.done for outcome in cell.write({"cell/count": 5, "bits/2/in": True})] == [True, True]
        assert cell.write({"CELL://count": 6})[0].path == "count"
        with pytest.raises(PathError, match="leave out /out"):
            cell.write({"cell/count/out": 5})
        with pytest.raises(PathError, match="none"):
            cell.write({})


def test_a_register_that_is_given_twice_is_refused(writer: BlockWriter, instance: str) -> None:
    """The command is refused before it is sent: no source runs here that could answer."""
    twice = {"cell/count": 1, "count": 2}
    with shmio.attach(instance, writable=True) as cell:
        source_writer = SourceWriter(writer.block, 5)
        shadow = Shadow(source_writer, 1, Direction.OUT, writer.block.events.cursor(), lambda *_: None, keep=True)
        for write in (cell.set, cell.write, shadow.set):
            with pytest.raises(ValueRangeError, match="count: this path is given twice"):
                write(twice)


def test_at_most_four_guests_write_at_a_time(writer: BlockWriter, source: list[Answer], instance: str) -> None:
    source += [tell(EventKind.WRITTEN)] * 5
    guests = [shmio.attach(instance, writable=True) for _ in range(5)]
    try:
        for guest in guests[:4]:
            guest.write({"cell/count": 1})
        with pytest.raises(SegmentError, match="allows only 4 programs that write; end one of pids"):
            guests[4].write({"cell/count": 1})
        guests[0].close()
        assert guests[4].write({"cell/count": 1})[0].done
    finally:
        for guest in guests:
            guest.close()


def test_read_only_attachment_cannot_write(writer: BlockWriter, instance: str) -> None:
    with shmio.attach(instance) as cell, pytest.raises(CommandError, match="writable=True"):
        cell.write({"cell/count": 5})


@pytest.mark.parametrize(("text", "complaint"), [("", "0"), ("ü" * 129, "258")], ids=["empty", "long"])
def test_length_of_a_note_is_limited(writer: BlockWriter, instance: str, text: str, complaint: str) -> None:
    """The note is refused before it is sent: no source runs here that could answer."""
    with shmio.attach(instance, writable=True) as cell, pytest.raises(ValueRangeError, match=rf"256 .*{complaint}"):
        cell.note(text, "cell")
