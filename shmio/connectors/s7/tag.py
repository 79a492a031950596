"""A register of a tag table, with the bytes in the controller's memory to read for it."""

from __future__ import annotations

from shmio.connectors.s7.plan import Field
from shmio.layout.model import ByteOrder, Register
from shmio.layout.s7.address import Address
from shmio.layout.s7.conversion import Conversion


class Tag(Conversion):
    """A register with its address, the conversion of its values, and the rate at which it is read."""

    def __init__(self, index: int, register: Register, address: Address, byte_order: ByteOrder, every: int = 1) -> None:
        super().__init__(register, address, byte_order)
        self.index = index
        self.field = Field(index, address.area, address.db, self.start, self.stop, every)
