"""The image of a source whose device gives each register its own value, status and time."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from shmio.errors import CharacterError, ConnectorError, ValueRangeError
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout
from shmio.layout.values.codec import Value, codec, scalar_codec
from shmio.model.statuses import (
    BAD_OUT_OF_RANGE,
    BAD_WAITING_FOR_INITIAL_DATA,
    GOOD,
    StatusArea,
    character_missing,
)


class Copy(NamedTuple):
    """Registers whose bytes can be copied from a device's answer to the image in another order.

    Attributes:
        sources: For each byte, the offset in the answer.
        targets: For each byte, the offset in the image.
        indices: The indices of the registers in the layout.

    """

    sources: npt.NDArray[np.intp]
    targets: npt.NDArray[np.intp]
    indices: frozenset[int]


class Run(NamedTuple):
    """Registers of numbers that follow each other in the layout and in the image.

    Attributes:
        part: Their part of the values of a :class:`Batch`.
        pack: Returns the bytes of their values.
        target: Their bytes in the image.
        codes: The bytes of their status codes in the image.
        good: These bytes if all codes are good.
        times: The bytes of their source times in the image.
        length: Their number.

    """

    part: slice
    pack: Callable[..., bytes]
    target: slice
    codes: slice
    good: bytes
    times: slice
    length: int


class Batch(NamedTuple):
    """Registers of numbers whose values can be stored together.

    Attributes:
        types: The types of their values, all float or all int.
        indices: The indices of the registers in the layout.
        runs: The registers again, divided into as few runs as possible.

    """

    types: tuple[type, ...]
    indices: frozenset[int]
    runs: tuple[Run, ...]


def no_status_area() -> ConnectorError:
    """Return the error for a connector with ``register_quality`` whose layout has no status area."""
    return ConnectorError("this is a fault in shmio, please report it: the layout has no status area")


class RegisterImage:
    """Collects the registers of a block, and returns whole images for :meth:`Connector.read`.

    At first, each register has a bad status, because it waits for a value. If a register turns bad
    later, it keeps its last value. The layout must have a status area, as the layouts of connectors
    with ``register_quality`` do.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._area = StatusArea(layout)
        self._image, _ = initial_frame(layout)
        self._bytes = np.frombuffer(self._image, np.uint8)
        self._codecs = [codec(register, layout.byte_order) for register in layout.registers]
        self._not_good: set[int] = set()
        for index in range(len(layout.registers)):
            self.fail(index, BAD_WAITING_FOR_INITIAL_DATA)

    def __bytes__(self) -> bytes:
        """Return the present image, ``layout.size`` bytes."""
        return bytes(self._image)

    def put(self, index: int, value: Value, source_ns: int = 0, code: int = GOOD) -> str:
        """Store the value of a register.

        If the value does not fit the register's type, set a bad status.

        Args:
            index: The register's index in the layout.
            value: A value as for :meth:`Codec.encode_into`: text for times, lists for arrays.
            source_ns: Time at which the device had the value, UTC in ns since 1970. 0: the time is
                unknown, so readers use the time of the frame.
            code: OPC UA status code. The value is stored even if the code is bad.

        Returns:
            Why the value does not fit; "" if it does.

        """
        fault = ""
        try:
            self._codecs[index].encode_into(value, self._image)
        except CharacterError as error:
            code, fault = character_missing(error.place, error.character), str(error)
        except ValueRangeError as error:
            code, fault = BAD_OUT_OF_RANGE, str(error)
        if code == GOOD and index not in self._not_good:  # the usual case
            self._area.write_time(self._image, index, source_ns)
        else:
            self._set_status(index, code, source_ns)
        return fault

    def put_bytes(self, index: int, data: bytes, source_ns: int = 0, code: int = GOOD) -> None:
        """Store the value of a register, given as its bytes in the image."""
        register = self._layout.registers[index]
        self._image[register.offset : register.offset + register.size] = data
        self._set_status(index, code, source_ns)

    def batch(self, indices: Sequence[int]) -> Batch | None:
        """Return the batch of some registers, in this order; None if they are not numbers of one type, float or int."""
        registers = [self._layout.registers[index] for index in indices]
        if any(register.dims or register.type == "BOOL" for register in registers):
            return None
        order = self._layout.byte_order
        formats = [scalar_codec(register.element, order).plain for register in registers]
        types = tuple(float if code in ("f", "d") else int for code in formats)
        if not all(formats) or len({*types}) != 1:
            return None
        begins = [0] + [at for at in range(1, len(indices)) if not self._adjacent(indices[at - 1], indices[at])]
        runs = []
        for begin, end in pairwise([*begins, len(indices)]):
            packer = struct.Struct((">" if order == "big" else "<") + "".join(formats[begin:end]))
            first, count = indices[begin], end - begin
            code_at, code_size = self._area.code_range(first)
            time_at, time_size = self._area.time_range(first)
            runs.append(Run(
                slice(begin, end),
                packer.pack,
                slice(registers[begin].offset, registers[begin].offset + packer.size),
                slice(code_at, code_at + count * code_size),
                bytes(count * code_size),
                slice(time_at, time_at + count * time_size),
                count,
            ))  # fmt: skip
        return Batch(types, frozenset(indices), tuple(runs))

    def _adjacent(self, before: int, index: int) -> bool:
        """Return whether a register follows another one in the layout, and its bytes follow the other's bytes."""
        registers = self._layout.registers
        return index == before + 1 and registers[index].offset == registers[before].offset + registers[before].size

    def put_batch(self, batch: Batch, values: Sequence[object], source_ns: int = 0) -> bool:
        """Store the values of many registers with good statuses, which is faster than to :meth:`put` each of them.

        Args:
            batch: The registers.
            values: Their values, in the order of the batch.
            source_ns: The time of all values, as for :meth:`put`.

        Returns:
            Whether all values fit. If not, call :meth:`put` for each of them.

        """
        if (*map(type, values),) != batch.types:
            return False
        image = self._image
        time = self._area.time_bytes(source_ns)
        try:
            for part, pack, target, codes, good, times, length in batch.runs:
                image[target] = pack(*values[part])
                image[codes] = good
                image[times] = time * length
        except (struct.error, OverflowError):
            return False
        if self._not_good:
            self._not_good -= batch.indices
        return True

    def copy(self, copy: Copy, answer: bytes) -> None:
        """Store the values of many registers, and make their statuses good.

        Use this only for registers that never get a source time.
        """
        self._bytes[copy.targets] = np.frombuffer(answer, np.uint8)[copy.sources]
        for index in self._not_good & copy.indices:
            self._set_status(index, GOOD, 0)

    def fail(self, index: int, code: int, source_ns: int = 0) -> None:
        """Set a bad or uncertain status code; the register keeps its last value."""
        self._set_status(index, code, source_ns)

    def _set_status(self, index: int, code: int, source_ns: int) -> None:
        self._area.write(self._image, index, code, source_ns)
        if code == GOOD:
            self._not_good.discard(index)
        else:
            self._not_good.add(index)
