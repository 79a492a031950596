"""Layouts of sources, received from an endpoint. They decode raw frames."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Final

import numpy as np

from shmio.client.table import Array, Register, unknown
from shmio.errors import RemoteError
from shmio.layout.model import Layout

_NUMBERS: Final = {
    "BYTE": "u1", "WORD": "u2", "DWORD": "u4", "LWORD": "u8", "USINT": "u1", "UINT": "u2", "UDINT": "u4", "ULINT": "u8",
    "SINT": "i1", "INT": "i2", "DINT": "i4", "LINT": "i8", "REAL": "f4", "LREAL": "f8", "TIME": "i4", "LTIME": "i8",
    "TIME_OF_DAY": "u4", "LTOD": "u8", "CHAR": "S1",
}  # fmt: skip
MAX_REGISTERS: Final = 1 << 20


@dataclass(frozen=True, kw_only=True)
class BlockLayout(Layout):
    """Layout of a source's block, with further properties of the source.

    Attributes:
        source: Name of the source.
        section: Number of the source's block. It changes if a reload replaces the block.
        hash: Hash of the layout.
        period_ns: Time between two cycles, in ns.
        stale_ns: Age above which a frame's quality is bad, in ns.
        writable: Patterns of the registers that may be written.
        armed: True if injections may change what is written to the device.
    """

    registers: tuple[Register, ...]
    source: str
    section: int
    hash: bytes = field()
    period_ns: int
    stale_ns: int
    writable: tuple[str, ...]
    armed: bool

    @property
    def big_endian(self) -> bool:
        """True if numbers are stored big-endian."""
        return self.byte_order == "big"

    @property
    def places(self) -> Mapping[str, int]:
        """Index of each register, by its path without the source."""
        return self.by_path

    def array(self, image: bytes) -> Array:
        """View a raw frame as a numpy record with a field for each register, named by its path.

        Nothing is copied. Numbers have the source's byte order. A BOOL is the byte that holds it
        (:meth:`value` returns the bit); arrays of BOOL, texts and dates are bytes.

        Raises:
            ValueError: The image has the wrong size.
        """
        if len(image) != self.size:
            raise ValueError(f"{self.source}: a frame has {self.size} bytes, but the image has {len(image)}")
        return np.frombuffer(image, self._dtype)[0]  # type: ignore[no-any-return]

    def value(self, image: bytes, path: str) -> Any:
        """Return a register's value from a raw frame: as in :meth:`array`, but a BOOL is a bool.

        Raises:
            PathError: There is no such register.
        """
        place = self.places.get(path.removeprefix(f"{self.source}/"), self.places.get(path))
        if place is None:
            paths = [f"{self.source}/{register.path}" for register in self.registers]
            raise unknown(path, paths, f"the registers of {self.source}")
        register = self.registers[place]
        if register.type != "BOOL":
            return self.array(image)[register.path]
        if not register.dims:
            return bool(image[register.offset] >> (register.bit or 0) & 1)
        *rows, length = register.shape
        if register.partial:  # a row of a tag table over the block, which may begin within a byte
            bits = np.frombuffer(image, np.uint8, register.size, register.offset)
            return np.unpackbits(bits, bitorder="little")[(register.bit or 0) :][:length].astype(bool)
        packed = np.frombuffer(image, np.uint8, register.size, register.offset).reshape(*rows, -(-length // 8))
        return np.unpackbits(packed, axis=-1, count=length, bitorder="little").astype(bool)

    @cached_property
    def _dtype(self) -> np.dtype[Any]:
        order = ">" if self.big_endian else "<"
        formats = []
        for register in self.registers:
            kind = _NUMBERS.get(register.type)
            if kind is None or register.size != register.count * np.dtype(kind).itemsize:
                formats.append("u1" if register.bit is not None and not register.dims else f"V{register.size}")
            else:
                formats.append((order + kind, register.shape) if register.dims else order + kind)  # type: ignore[arg-type]
        return np.dtype(
            {
                "names": [register.path for register in self.registers],
                "formats": formats,
                "offsets": [register.offset for register in self.registers],
                "itemsize": self.size,
            }
        )


def layouts(parts: Iterable[Any]) -> Iterator[BlockLayout]:
    """Yield the layouts in the messages of GetLayouts. Raise RemoteError if one is invalid."""
    registers: list[Register] = []
    for part in parts:
        registers += map(Register.of, part.registers)
        if len(registers) > MAX_REGISTERS:
            raise RemoteError(
                f"source {part.source}: the endpoint sent a layout of more than {MAX_REGISTERS} registers"
            )
        if part.last:
            if any(register.offset + register.size > part.size for register in registers):
                raise RemoteError(
                    f"source {part.source}: the endpoint sent registers that exceed the block's {part.size} bytes"
                )
            yield BlockLayout(
                name=part.name,
                number=part.number if part.HasField("number") else None,
                size=part.size,
                optimized=part.optimized,
                registers=tuple(registers),
                byte_order="big" if part.big_endian else "little",
                status_offset=part.status_offset if part.HasField("status_offset") else None,
                source=part.source,
                section=part.section,
                hash=part.hash,
                period_ns=part.period_ns,
                stale_ns=part.stale_ns,
                writable=tuple(part.writable),
                armed=part.armed,
            )
            registers = []
