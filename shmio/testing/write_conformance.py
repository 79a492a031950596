"""Test suite for connectors that can write, in addition to the tests of reading. It needs pytest.

It checks that the reported outcomes are true, and that writing a bit does not change its
neighbours. After any fault, a connector must not take a confirmation for that of another write.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from typing import ClassVar, Protocol

import pytest

from shmio.connectors.base import Connector, Lost, WriteLostError
from shmio.errors import ConnectorError
from shmio.local.writer import CommandSender
from shmio.segment import Event, EventKind, Frame, Quality, Write
from shmio.testing.conformance import PATIENCE_S, ConnectorConformance, Rig, Run, connect

ENDS = {EventKind.WRITTEN, EventKind.REFUSED, EventKind.EXPIRED, EventKind.UNKNOWN}
FAR_S = 60.0
SPARE = 8


class WriteRig(Rig, Protocol):
    """A device that accepts writes."""

    spare: int
    """Offset of ``SPARE`` bytes that are zero at first. The device itself never changes them."""
    flags: int
    """Offset of a byte in whose upper bits the device counts. The tests write the lowest bit.

    ``generation`` checks that no count is lost.
    """
    refused: Write
    """A write that the device refuses."""


def write(connector: Connector, writes: Sequence[Write]) -> list[str]:
    """Write as a source's loop does, and return the outcomes."""
    connector.send(writes)
    return confirm(connector)


def confirm(connector: Connector) -> list[str]:
    """Wait for the outcomes of the writes that the connector has sent."""
    while (found := connector.confirm(time.monotonic_ns() + 1_000_000_000)) is None:
        pass
    return list(found)


class Writer:
    """Sends commands to a running source, and waits for their outcomes."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._sender = CommandSender(run.block, 0)
        self._events = run.block.events.cursor()

    def write(self, *writes: Write) -> Event:
        """Send a command, and wait for the outcomes of all items.

        Return the outcome of the first item.
        """
        return self.end(self.send(*writes), len(writes))

    def send(self, *writes: Write) -> int:
        """Send a command; return its number."""
        return self._sender.submit(writes, time.monotonic_ns() + round(FAR_S * 1e9))

    def accepted(self, number: int) -> None:
        """Wait until the source has accepted a command. Call this before :meth:`end`."""
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            event = self._events.next(max(0.0, deadline_s - time.monotonic()))
            assert event is not None, f"command {number} is not accepted"
            if (event.command, event.kind) == (number, EventKind.ACCEPTED):
                return

    def end(self, number: int, items: int = 1) -> Event:
        """Wait for the outcomes of all items of a command; return the outcome of the first item."""
        ends: list[Event] = []
        deadline_s = time.monotonic() + PATIENCE_S
        while sum(event.items for event in ends) < items:
            event = self._events.next(max(0.0, deadline_s - time.monotonic()))
            assert event is not None, f"command {number} has no end; so far: {ends}"
            if event.command == number and event.kind == EventKind.REJECTED:
                raise ConnectorError(event.text)
            if event.command == number and event.kind in ENDS:
                ends.append(event)
        assert sorted(event.item for event in ends)[0] == 0
        return min(ends, key=lambda event: event.item)

    def written(self, *writes: Write) -> Frame:
        """Send a command that must succeed.

        Return the first good frame that was requested after the command's end.
        """
        end = self.write(*writes)
        assert end.kind == EventKind.WRITTEN, end
        return self.after(end)

    def after(self, end: Event) -> Frame:
        """Return the first good frame that was requested after a command's end."""
        return self._run.until(lambda frame: frame.quality is Quality.GOOD and frame.source_ns > end.utc_ns)

    def once_open(self, *writes: Write) -> Event:
        """Send a command again and again until the source is connected, and return the outcome."""
        deadline_s = time.monotonic() + PATIENCE_S
        while True:
            try:
                return self.write(*writes)
            except ConnectorError:
                assert time.monotonic() < deadline_s
                self._run.good()


class WriteConformance(ConnectorConformance):
    """Tests of writing.

    Inherit from this class, and define a fixture ``rig``: a :class:`WriteRig`.
    """

    writable: ClassVar[tuple[str, ...]] = ("**",)

    @pytest.fixture
    def writer(self, run: Run) -> Writer:
        """Wait until the running source is connected, and provide a :class:`Writer` for it."""
        run.good()
        return Writer(run)

    @pytest.mark.usefixtures("patient")
    def test_a_value_written_is_in_the_next_frame(self, run: Run, writer: Writer, rig: WriteRig) -> None:
        """Every read that is requested after the confirmation returns the new value."""
        for number in range(1, 20):
            value = bytes([number]) * SPARE
            frame = writer.written(Write(rig.spare, 0, value))
            assert frame.raw[rig.spare : rig.spare + SPARE] == value

    @pytest.mark.usefixtures("patient")
    def test_several_writes_in_one_command(self, run: Run, writer: Writer, rig: WriteRig) -> None:
        """A command that writes bytes and bits has an outcome for each of them."""
        frame = writer.written(
            Write(rig.spare, 0, b"ab"), Write(rig.spare + 4, 0x40, b"\xff"), Write(rig.spare + 4, 0x02, b"\xff")
        )
        assert frame.raw[rig.spare : rig.spare + SPARE] == b"ab\0\0\x42\0\0\0"

    @pytest.mark.usefixtures("patient")
    def test_a_bit_is_written_without_its_neighbours(self, run: Run, writer: Writer, rig: WriteRig) -> None:
        """While the device counts in the other bits of the byte, writing one bit loses no count."""
        for number in range(50):
            frame = writer.written(Write(rig.flags, 1, bytes([number & 1])))
            assert frame.raw[rig.flags] & 1 == number & 1

    @pytest.mark.usefixtures("patient")
    def test_a_refused_item_among_good_ones(self, rig: WriteRig) -> None:
        """The device refuses one item, with a reason.

        It executes the others, and stays connected.
        """
        connector = rig.connector()
        try:
            connect(connector)
            writes = [Write(rig.spare, 0, b"one"), rig.refused, Write(rig.spare + 4, 0, b"two")]
            outcomes = write(connector, writes)
            assert [bool(outcome) for outcome in outcomes] == [False, True, False]
            assert connector.read()[rig.spare : rig.spare + SPARE] == b"one\0two\0"
        finally:
            connector.close()

    def test_a_late_confirmation_is_not_taken_for_the_next(self, rig: WriteRig) -> None:
        """A late confirmation on the next connection never confirms a write that is refused there."""
        connector = rig.connector()
        try:
            connect(connector)
            rig.proxy.hold()
            with pytest.raises(ConnectorError):
                write(connector, [Write(rig.spare, 0, b"late")])
            assert rig.proxy.wait_held()
            connector.close()
            rig.proxy.edit(lambda frame: frame)  # frames on hold stay on hold
            connect(connector)
            rig.proxy.release()
            with contextlib.suppress(ConnectorError):
                assert write(connector, [rig.refused])[0]
        finally:
            connector.close()

    @pytest.mark.parametrize("count", [1, 30])
    def test_lost_in_mid_write(self, run: Run, writer: Writer, rig: WriteRig, count: int) -> None:
        """If the connection breaks during a write, the reported outcome is true."""
        for number in range(1, 5):
            rig.proxy.cut_after(count * number)
            value = bytes([number]) * SPARE
            end = writer.once_open(Write(rig.spare, 0, value))
            assert end.kind in {EventKind.WRITTEN, EventKind.EXPIRED, EventKind.UNKNOWN}
            rig.proxy.pass_all()
            frame = writer.after(end)
            if end.kind != EventKind.UNKNOWN:
                done = frame.raw[rig.spare : rig.spare + SPARE] == value
                assert done == (end.kind == EventKind.WRITTEN), end
        deadline_s = time.monotonic() + PATIENCE_S
        while (end := writer.once_open(Write(rig.spare, 0, b"at last!"))).kind != EventKind.WRITTEN:
            assert time.monotonic() < deadline_s, end  # a busy source may notice the last cut only now
        assert writer.after(end).raw[rig.spare : rig.spare + SPARE] == b"at last!"

    @pytest.mark.parametrize("fault", ["cut before", "cut in the answer", "no answer"])
    def test_of_each_lost_write_what_is_said_is_true(self, rig: WriteRig, fault: str) -> None:
        """If the connection breaks during several writes, each reported outcome is true.

        A connector that raises a ConnectorError other than WriteLostError reports no outcome.
        """
        writes = [Write(rig.spare + place, 0, bytes([place + 1])) for place in range(SPARE)]
        connector = rig.connector()
        try:
            connect(connector)
            if fault == "cut before":
                rig.proxy.cut()
            elif fault == "cut in the answer":
                rig.proxy.cut_after(1)
            else:
                rig.proxy.hold()
            outcomes: Sequence[str | Lost] = [Lost.UNKNOWN] * len(writes)
            try:
                outcomes = write(connector, writes)
            except WriteLostError as lost:
                outcomes = lost.outcomes
            except ConnectorError:
                pass
            else:
                assert fault == "cut before", "the connector has no answer"  # it may connect again before it writes
            connector.close()
            rig.proxy.pass_all()
            connect(connector)
            found = connector.read()
        finally:
            connector.close()
        for (offset, _, data), outcome in zip(writes, outcomes, strict=True):
            if outcome is not Lost.UNKNOWN:
                assert (found[offset : offset + 1] == data) == (outcome == ""), (offset, outcome)

    @pytest.mark.parametrize("frozen_first", [False, True])
    def test_a_stop_in_the_middle_of_a_write(self, run: Run, writer: Writer, rig: WriteRig, frozen_first: bool) -> None:
        """The loop ends in time, and each command has an outcome."""
        if frozen_first:
            rig.proxy.freeze()
        number = writer.send(Write(rig.spare, 0, b"stop"))
        writer.accepted(number)
        rig.proxy.freeze()
        run.stop()
        end = writer.end(number)
        assert end.kind in ENDS
        assert end.kind != EventKind.WRITTEN or not frozen_first

    def test_without_a_connection_nothing_is_sent(self, rig: WriteRig) -> None:
        """A write before the first connect, or after a close, fails and changes nothing."""
        connector = rig.connector()
        try:
            for _ in range(2):
                with pytest.raises(ConnectorError) as raised:
                    write(connector, [Write(rig.spare, 0, b"lost")])
                if isinstance(raised.value, WriteLostError):
                    assert raised.value.outcomes == (Lost.UNSENT,)
                connect(connector)
                assert connector.read()[rig.spare : rig.spare + 4] == bytes(4)
                connector.close()
        finally:
            connector.close()
