"""The memory areas of an emulated S7 controller that hold the registers of a tag table."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import suppress
from typing import Final

from shmio.errors import ConfigError, ValueRangeError
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout
from shmio.layout.s7.address import Area, is_of_cpu, parse
from shmio.layout.s7.conversion import Conversion
from shmio.layout.values.write import apply, changed_bits

Place = tuple[Area, int]
"""An area, and the number of the data block; 0 for other areas."""

_LETTERS: Final = {Area.INPUT: "%I", Area.OUTPUT: "%Q", Area.MARKER: "%M", Area.TIMER: "%T", Area.COUNTER: "%C"}
_LEAST: Final = dict.fromkeys(_LETTERS, 1024) | {Area.TIMER: 512, Area.COUNTER: 512}
"""Minimum sizes of these areas in bytes, about those of an S7-300."""


def place_name(place: Place) -> str:
    """Return the name of an area in TIA Portal's notation."""
    return f"DB{place[1]}" if place[0] is Area.BLOCK else _LETTERS[place[0]]


class TableMemory:
    """The registers of a tag table in the controller's memory."""

    def __init__(self, layout: Layout) -> None:
        """Find the place of each register. Values of the CPU itself have no place.

        Raises:
            ConfigError: An address is wrong.

        """
        self.layout = layout
        self._conversions: list[Conversion] = []
        for register in layout.registers:
            if is_of_cpu(register.address):
                continue
            try:
                self._conversions.append(Conversion(register, parse(register), layout.byte_order))
            except ValueError as error:
                raise ConfigError(f"layout: {register.path}: {error}") from None

    @property
    def needs(self) -> dict[Place, int]:
        """The areas that the registers need, each with its size in bytes, which is an even number."""
        sizes: dict[Place, int] = {}
        for one in self._conversions:
            place = _place(one)
            sizes[place] = max(sizes.get(place, _LEAST.get(place[0], 0)), one.stop + (one.stop & 1))
        return sizes

    @property
    def keys(self) -> frozenset[tuple[object, ...]]:
        """A key for each register, which is equal for the same register in another table."""
        return frozenset(map(_key, self._conversions))

    def fill(
        self,
        memory: Mapping[Place, bytearray],
        present: Collection[Place] = (),
        known: Collection[tuple[object, ...]] = (),
    ) -> None:
        """Store the initial values. Those of the tag table override the defaults of the types.

        Args:
            memory: The memory areas to write to.
            present: Areas that already have values. Defaults do not overwrite these.
            known: The ``keys`` of registers that already have values, which stay unchanged.

        """
        frame, _ = initial_frame(self.layout)
        for given in (False, True):
            for one in self._conversions:
                if _key(one) in known:
                    continue
                if given is (one.register.initial is not None) and (given or _place(one) not in present):
                    with suppress(ValueError, ValueRangeError):  # for example, the scale has no raw value for 0
                        _store(one, frame, b"\xff" * one.register.size, memory)

    def load(self, frame: bytearray, memory: Mapping[Place, bytearray]) -> None:
        """Copy the registers' values from the memory to an image, except for invalid values."""
        for one in self._conversions:
            found = one.image_bytes(bytes(memory[_place(one)][one.start : one.stop]))
            if found is not None:
                offset = one.register.offset
                frame[offset : offset + len(found)] = found

    def store(self, before: bytes, frame: bytearray, memory: Mapping[Place, bytearray]) -> None:
        """Copy the values that differ between ``before`` and ``frame`` to the memory if it can hold them.

        Of an array, copy only the elements that differ.
        """
        for one in self._conversions:
            start, stop = one.register.offset, one.register.offset + one.register.size
            if before[start:stop] != frame[start:stop]:
                with suppress(ValueError, ValueRangeError):
                    _store(one, frame, changed_bits(one.register, before, frame), memory)


def _place(one: Conversion) -> Place:
    area = one.address.area
    return (Area.INPUT if area is Area.PERIPHERAL else area), one.address.db


def _key(one: Conversion) -> tuple[object, ...]:
    return one.register.path, one.register.type, one.register.dims, one.register.address


def _store(one: Conversion, frame: bytearray, bits: bytes, memory: Mapping[Place, bytearray]) -> None:
    """Store some bits of a register of an image.

    Raises:
        ValueError: The controller cannot hold the value.

    """
    register, area = one.register, memory[_place(one)]
    own = bytes(frame[register.offset : register.offset + register.size])
    for write in list(one.device_writes(own, bits)):
        apply(write._replace(offset=one.start + write.offset), area)
