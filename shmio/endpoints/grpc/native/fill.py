"""Values that a client sends put into an image of the block, by the slots of a table or by path."""

from __future__ import annotations

from typing import Any

import numpy as np

from shmio.endpoints.grpc.native.columns import KINDS, Column
from shmio.endpoints.grpc.native.values import FIELDS, MAX_VALUES, index_of, plain
from shmio.endpoints.grpc.native.views import Selection
from shmio.endpoints.grpc.turns import turns
from shmio.errors import PathError, ValueRangeError
from shmio.layout.codec import RegisterCodec, codec
from shmio.layout.model import Register
from shmio.layout.topic import find, holders, parse_topic, shorten
from shmio.wire import shmio_v1_pb2 as wire


class Fill:
    """Those of one table. What was found out about a slot or a path is kept."""

    def __init__(self, selection: Selection) -> None:
        self._selection = selection
        self._by_path = {register.path: register for register in selection.registers}
        self._slots: dict[tuple[Column, int], tuple[str, RegisterCodec]] = {}
        self._paths: dict[str, Register] = {}

    async def packed(self, values: wire.Values, image: bytearray) -> None:
        """Values by slots, in turns. ValueRangeError: not of this table, or of a register's type."""
        for column, name in FIELDS.items():
            if not values.HasField(name):
                continue
            part = getattr(values, name)
            columns = self._selection.columns
            most = columns.sizes[column]
            slots = np.fromiter(part.slots or range(most), np.int64)
            if len(slots) != len(part.values):
                raise ValueRangeError(f"{name}: {len(part.values)} values for {len(slots)} slots")
            if len(slots) > max(1, most):  # else one message could hold up everybody
                raise ValueRangeError(f"{name}: {len(slots)} values, the table has {most}: give each once")
            if len(wrong := np.flatnonzero(slots >= most)):
                raise ValueRangeError(f"{name}: the table has no slot {slots[wrong[0]]}")
            left = np.arange(len(slots))
            if column in KINDS:
                left = columns.encode(column, slots, np.fromiter(part.values, KINDS[column]), image)
            async for at in turns(left.tolist()):
                self._put(*self._at(column, int(slots[at])), part.values[at], image)

    async def assigned(self, assignments: Any, image: bytearray) -> None:
        """Values by paths, in turns. PathError: no such register in the table; ValueRangeError."""
        if len(assignments) > (most := self._selection.elements):
            raise ValueRangeError(f"assignments: {len(assignments)} values, the table has {most}: give each once")
        if len(assignments) > MAX_VALUES:  # each is put in by itself
            raise ValueRangeError(
                f"assignments: {len(assignments)} values, {MAX_VALUES} are the most by path: give them by slots"
            )
        order = self._selection.block.layout.byte_order
        async for assignment in turns(assignments):
            register = self._paths.get(assignment.path)
            if register is None:
                register = self._find(assignment.path)
                if len(self._paths) < self._selection.elements + len(self._by_path):
                    self._paths[assignment.path] = register
            self._put(register.path, codec(register, order), plain(assignment.value, register), image)

    @staticmethod
    def _put(path: str, encoder: RegisterCodec, value: object, image: bytearray) -> None:
        try:
            encoder.encode_into(value, image)
        except ValueRangeError as error:
            text = str(error)
            raise ValueRangeError(text if text.startswith(f"{path}:") else f"{path}: {text}") from None

    def _at(self, column: Column, slot: int) -> tuple[str, RegisterCodec]:
        found = self._slots.get((column, slot))
        if found is None:
            columns, layout = self._selection.columns, self._selection.block.layout
            place = columns.place(column, slot)
            if place is None:
                raise ValueRangeError(f"{FIELDS[column]}: the table has no slot {slot}")
            register = self._selection.registers[place]
            if register.dims:
                register = layout.element(register, tuple(index_of(register, slot - columns.places[place][1])))
            found = self._slots[column, slot] = register.path, codec(register, layout.byte_order)
        return found

    def _find(self, text: str) -> Register:
        block = self._selection.block
        topic = parse_topic(text, (block.source,), block.source)
        if topic.source != block.source:
            raise PathError(f"{shorten(text)}: {topic.source} is reserved; begin the path with {block.source}")
        register = find(block.layout, topic.path)
        if self._by_path.keys().isdisjoint(holders(register.path)) or topic.direction == "in":
            raise PathError(f"{shorten(text)}: it is none of the outputs of {block.source}")
        return register
