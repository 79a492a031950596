"""The image of a source whose device gives each register a value, a status and a time of its own."""

from __future__ import annotations

from shmio.errors import ValueRangeError
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout
from shmio.layout.values.codec import Value, codec
from shmio.model.statuses import (
    BAD_OUT_OF_RANGE,
    BAD_WAITING_FOR_INITIAL_DATA,
    GOOD,
    RegisterStatus,
    StatusArea,
)


class RegisterImage:
    """Collects the registers of a block, and returns whole images for :meth:`Connector.read`.

    At first, each register is bad and waits for its first value. A register that turns bad keeps
    its last value. The layout must have a status area, which the layouts of connectors with
    ``register_quality`` have.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._area = StatusArea(layout)
        self._image, _ = initial_frame(layout)
        for index in range(len(layout.registers)):
            self.fail(index, BAD_WAITING_FOR_INITIAL_DATA)

    def __bytes__(self) -> bytes:
        """Return the present image, ``layout.size`` bytes."""
        return bytes(self._image)

    def put(self, index: int, value: Value, source_ns: int = 0, code: int = GOOD) -> str:
        """Store the value of a register; a value that does not fit its type turns it bad.

        Args:
            index: The register's index in the layout.
            value: The value: see :meth:`Codec.encode_into`; text for times, lists for arrays.
            source_ns: UTC time of the value in the device, ns since 1970; 0: unknown, the frame's
                time counts.
            code: OPC UA status code. If it is bad, the value is stored nevertheless.

        Returns:
            Why the value does not fit; "" if it does.

        """
        fault = ""
        try:
            codec(self._layout.registers[index], self._layout.byte_order).encode_into(value, self._image)
        except ValueRangeError as error:
            code, fault = BAD_OUT_OF_RANGE, str(error)
        self._area.put(self._image, index, RegisterStatus(code, source_ns))
        return fault

    def put_bytes(self, index: int, data: bytes, source_ns: int = 0, code: int = GOOD) -> None:
        """Store the value of a register as its bytes in the layout, which must be ``size`` bytes."""
        register = self._layout.registers[index]
        self._image[register.offset : register.offset + register.size] = data
        self._area.put(self._image, index, RegisterStatus(code, source_ns))

    def fail(self, index: int, code: int, source_ns: int = 0) -> None:
        """Turn a register bad, or uncertain, with a status code; its last value stays."""
        self._area.put(self._image, index, RegisterStatus(code, source_ns))
