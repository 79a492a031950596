"""Updates about writes, for subscribers to ``/in``."""

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
from shmio.segment.pending_commands import NO_COMMAND, apply
from shmio.wire import shmio_v1_pb2 as wire

_VALUES: Final = wire.Update.DESCRIPTOR.fields_by_name["values"].number


def head_of(table: int, event: Event) -> bytes:
    """Return a serialised ``Update`` for an event, without values."""
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
    """Encodes writes to a table's registers, once for all subscribers. For the loop's thread."""

    def __init__(self, number: int, block: Block, registers: Sequence[Register], columns: Columns) -> None:
        """``number`` is that of the table."""
        self._number = number
        self._block = block
        self._columns = columns
        self._cover = np.frombuffer(covering(registers, block.layout.size), np.uint8)
        self._pending_image = PendingImage(block)
        self._command = NO_COMMAND
        self._event = 0
        self._update = b""

    def of(self, event: Event) -> bytes:
        """Return the serialised ``Update`` of an accepted write; empty: it is not in the table.

        If an element is written in part, the rest is taken from the frame before the command. An
        element that the command's next event completes is left to that event.
        """
        if event.number != self._event:
            self._event, self._update = event.number, self._make(event)
        return self._update

    def _make(self, event: Event) -> bytes:
        if event.command_key != self._command:
            self._command = event.command_key
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
    """Follows the writes to a table for one subscriber, in a queue from which none is dropped."""

    def __init__(self, writes: WriteUpdates, commands: CommandClient, ring: Callable[[], None]) -> None:
        """``ring`` is called when there is an update."""
        self.failure = ""
        """Why writes are missing; empty: none are."""
        self._writes = writes
        self._commands = commands
        self._ring = ring
        self._waiting = SendQueue()
        commands.followers.listen(self)

    def leave(self) -> None:
        """Stop following writes."""
        self._commands.followers.leave(self)

    @property
    def waits(self) -> bool:
        """Whether an update waits."""
        return bool(self._waiting)

    def next(self) -> bytes | None:
        """Return the next serialised ``Update``, or None."""
        return self._waiting.pop() if self._waiting else None

    def accept(self, event: Event) -> None:
        """Queue a part of a command that the source has accepted."""
        if not self.failure and (update := self._writes.of(event)):
            if reason := self._waiting.add(update):
                self.fail(reason)
            self._ring()

    def fail(self, reason: str) -> None:
        """Fail because writes are missing; discard what waits, and stop following."""
        self.failure = self.failure or reason
        self._waiting = SendQueue()
        self.leave()
        self._ring()
