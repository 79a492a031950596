"""The image of a source whose device gives each register its own value, status and time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from shmio.errors import ConnectorError, ValueRangeError
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout
from shmio.layout.values.codec import Value, codec
from shmio.model.statuses import (
    BAD_OUT_OF_RANGE,
    BAD_WAITING_FOR_INITIAL_DATA,
    GOOD,
    StatusArea,
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
