"""What is written to registers, for those who subscribe to their ``/in``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from shmio.endpoints.grpc.commands.command_client import CommandClient
from shmio.endpoints.grpc.commands.pending_image import PendingImage, ones
from shmio.endpoints.grpc.shmio_v1.columns import Columns, pack_slots
from shmio.endpoints.grpc.shmio_v1.send_queue import SendQueue
from shmio.endpoints.grpc.streams.encoding import field
from shmio.layout.model import Register
from shmio.layout.values.write import covering
from shmio.segment import Block, Event
from shmio.segment.events import EVENT_DATA_SIZE
from shmio.segment.pending_commands import apply
from shmio.wire import shmio_v1_pb2 as wire

_VALUES: Final = wire.Update.DESCRIPTOR.fields_by_name["values"].number
_NOBODY: Final = (0, 0, 0)


def head_of(table: int, event: Event) -> bytes:
    """A serialised ``Update`` without values, about what an event tells of."""
    return wire.Update(
        table=table,
        frame=event.frame,
        cycle=event.cycle,
        incarnation=event.incarnation,
        clock_ns=event.clock_ns,
        source_ns=event.utc_ns,
        quality=wire.QUALITY_GOOD,
    ).SerializeToString()


class WriteUpdates:
    """What is written to a table's registers, each part of a command once for all who listen. For the loop's thread."""

    def __init__(self, number: int, block: Block, registers: Sequence[Register], columns: Columns) -> None:
        """``number``: the table's."""
        self._number = number
        self._block = block
        self._columns = columns
        self._cover = np.frombuffer(covering(registers, block.layout.size), np.uint8)
        self._pending_image = PendingImage(block)
        self._command = _NOBODY
        self._event = 0
        self._update = b""

    def of(self, event: Event) -> bytes:
        """The serialised ``Update`` of what a source has accepted by an event; empty: nothing of the table.

        Of an element that is written in part, the rest is as in the frame before the command. An element whose other
        part is in the command's next event comes with that.
        """
        if event.number != self._event:
            self._event, self._update = event.number, self._make(event)
        return self._update

    def _make(self, event: Event) -> bytes:
        command = event.incarnation, event.writer, event.command
        if command != self._command:
            self._command = command
            self._pending_image.begin(event.frame)
        self._pending_image.put(event)
        image, mask = self._pending_image.image, self._pending_image.mask
        part = bytearray(len(mask))
        apply(part, (ones(event),))
        if not (np.frombuffer(part, np.uint8) & self._cover).any():
            return b""
        slots = self._columns.touched(bytes(part))
        if len(event.data) == EVENT_DATA_SIZE:
            left = self._columns.touched(bytes(bits ^ 0xFF for bits in mask))
            whole = {column: np.setdiff1d(found, left[column]) for column, found in slots.items() if column in left}
            slots = {column: found for column, found in (slots | whole).items() if len(found)}
        if not slots:
            return b""
        return head_of(self._number, event) + field(_VALUES, pack_slots(self._columns.decode(bytes(image)), slots))


class WriteFollower:
    """A subscriber's place in what is written: a queue, for none of it may be left out."""

    def __init__(self, writes: WriteUpdates, commands: CommandClient, ring: Callable[[], None]) -> None:
        """``ring``: called when there is something."""
        self.failure = ""
        """Why what comes next is not all there was; empty: it is."""
        self._writes = writes
        self._commands = commands
        self._ring = ring
        self._waiting = SendQueue()
        commands.followers.listen(self)

    def leave(self) -> None:
        """Listen no more."""
        self._commands.followers.leave(self)

    @property
    def waits(self) -> bool:
        """Whether there is something."""
        return bool(self._waiting)

    def next(self) -> bytes | None:
        """The next serialised ``Update``, if there is one."""
        return self._waiting.pop() if self._waiting else None

    def accept(self, event: Event) -> None:
        """The source has accepted this part of a command."""
        if not self.failure and (update := self._writes.of(event)):
            if reason := self._waiting.add(update):
                self.fail(reason)
            self._ring()

    def fail(self, reason: str) -> None:
        """What comes next is not all there was: what waits is not given either, and nothing more is kept."""
        self.failure = self.failure or reason
        self._waiting = SendQueue()
        self.leave()
        self._ring()
