"""Converts a register of a tag table between the controller's bytes and those of an image."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Final

from msgspec.structs import replace

from shmio.errors import ValueRangeError
from shmio.layout.model import ByteOrder, ElementType, Register
from shmio.layout.s7.address import Address, Area
from shmio.layout.values.codec import Value, codec, scalar_codec
from shmio.layout.values.write import Write, element_bits, merge

_LARGEST_COUNT: Final = 999
_S5_BASES_MS: Final = (10, 100, 1000, 10_000)
_TIMER: Final = scalar_codec(ElementType("S5TIME", "S5TIME", 2, 2), "big")


class Conversion:
    """A register with its address, which converts its values between the controller and the image."""

    def __init__(self, register: Register, address: Address, byte_order: ByteOrder) -> None:
        """Prepare the conversion.

        Args:
            register: The register in the image.
            address: The register's place in the controller.
            byte_order: The byte order of the image.

        """
        self.register, self.address = register, address
        self._order = byte_order
        unit = 2 if address.area.numbered else 1
        self.start = address.start * unit
        """Offset of the first byte in the area."""
        self.stop = self.start + address.size
        element = register.element
        self._converted = (
            address.kind is not element or register.scale is not None or address.area.numbered
        ) and element.base != "BOOL"
        plain = element.base == "BOOL" or element.size == 1 or bool(scalar_codec(element, byte_order).plain)
        self.swapped = 0 if self._converted or not plain else 1 if byte_order == "big" else element.size
        """If the image has the bytes of each element in reverse order, the size of an element in bytes.

        1 if the order is the same; 0 if values must be decoded and encoded again.
        """
        self._in = replace(
            register, type=address.kind.name, offset=0, bit=address.bit if not register.dims else register.bit,
            size=address.size, partial=False,
        )  # fmt: skip
        self._out = replace(register, offset=0)
        self._bits = bytes(element_bits(register))

    def image_bytes(self, data: bytes) -> bytes | None:
        """Convert the register's bytes from the controller's form to the image's.

        Return None if the bytes do not represent a value.
        """
        if self.address.bit is not None:
            bit = data[0] >> self.address.bit & 1
            return bytes((bit << (self.register.bit or 0),))
        if self.swapped:
            return _reversed(data, self.swapped)
        image = bytearray(self.register.size)
        try:
            value = self._number(data)
            codec(self._out, self._order).encode_into(value, image)
        except ValueRangeError:
            return None
        return bytes(image)

    def _number(self, data: bytes) -> Value:
        """Decode the controller's bytes to a value of the register."""
        if self.address.area.numbered and self.register.type != "WORD":
            return _scaled(_bcd(data, self.address.area), self._from_device)
        return _scaled(codec(self._in, "big").decode(data), self._from_device)

    def _from_device(self, number: Any) -> Any:
        factor, offset = self.register.scale or (1, 0)
        value = number * factor + offset if self.register.scale else number
        return value if self.register.type in ("REAL", "LREAL") or isinstance(value, int | str) else round(value)

    def device_writes(self, image: bytes, bits: bytes) -> Iterator[Write]:
        """Yield the writes that carry some bits of the register to the controller, and change no other bit there.

        Args:
            image: The register's bytes in the image.
            bits: The bits to write, as a mask of the register's size. All bits of a number, text or
                time must be set, or none.

        Yields:
            Writes whose offsets count from the start of the value in the controller.

        Raises:
            ValueError: The bytes are not a valid value, the controller cannot hold it, or ``bits``
                has only a part of a value.

        """
        if self.address.bit is not None:
            if bits[0] & self._bits[0]:
                value = bool(image[0] & self._bits[0])
                yield Write(0, 1 << self.address.bit, b"\xff" if value else b"\0")
            return
        wanted = bytes(one & own for one, own in zip(bits, self._bits, strict=True))
        if self.register.type == "BOOL":
            yield from merge(image, wanted, [(0, len(wanted))])
            return
        for first, count in self._runs(wanted):
            at, data = self.device_bytes(image, first, count)
            yield Write(at, 0, data)

    def _runs(self, bits: bytes) -> Iterator[tuple[int, int]]:
        """Yield (first, count) of each run of elements to write; the runs have no padding between elements."""
        size, stride = self.register.element.size, self.register.element.stride
        dense = size == stride and self.address.kind.size == self.address.kind.stride
        first = count = 0
        for place in range(self.register.count):
            part = bits[place * stride : place * stride + size]
            if part == b"\xff" * size:
                first, count = (first, count + 1) if count and dense else (place, 1)
                if dense:
                    continue
            elif any(part):
                raise ValueError("a part of a value cannot be written; write the whole value")
            if count:
                yield first, count
                count = 0
        if count:
            yield first, count

    def device_bytes(self, image: bytes, first: int, count: int) -> tuple[int, bytes]:
        """Convert elements of the register to the controller's form.

        Args:
            image: The register's bytes in the image.
            first: The first element.
            count: The number of elements.

        Returns:
            The offset from the start of the value in the controller, and the bytes.

        Raises:
            ValueError: The bytes are not a valid value, or the controller cannot hold it.

        """
        kind, element = self.address.kind, self.register.element
        part = image[first * element.stride : (first + count - 1) * element.stride + element.size]
        if self.swapped:
            return first * element.stride, _reversed(part, self.swapped)
        dims = ((0, count - 1),) if self.register.dims else ()
        out = replace(self._out, dims=dims, size=len(part), count=count)
        size = (count - 1) * kind.stride + kind.size
        inner = replace(self._in, dims=dims, size=size, count=count)
        data = bytearray(size)
        value = _scaled(codec(out, self._order).decode(part), self._to_device)
        if self.address.area.numbered and self.register.type != "WORD":
            return 0, _to_bcd(value, self.address.area)
        try:
            codec(inner, "big").encode_into(value, data)
        except ValueRangeError as error:
            raise ValueError(f"the controller cannot hold the value: {error}") from None
        return first * kind.stride, bytes(data)

    def _to_device(self, value: Any) -> Any:
        factor, offset = self.register.scale or (1, 0)
        number = (value - offset) / factor if self.register.scale else value
        if self.address.kind.base in ("REAL", "LREAL") or isinstance(number, int | str):
            return number
        try:
            return round(number)
        except (OverflowError, ValueError):
            raise ValueError(f"the controller cannot hold {value!r} as {self.address.kind.name}") from None

    def device_bit(self, byte: int) -> int:
        """Return the offset in the controller's value that corresponds to the offset ``byte`` in the register.

        Raises:
            ValueError: The value must be decoded and encoded, so its bits cannot be written.

        """
        if not self.swapped:
            raise ValueError("a bit of a converted value cannot be written; write the whole value")
        element, inner = divmod(byte, self.swapped)
        return element * self.swapped + self.swapped - 1 - inner


def _reversed(data: bytes, size: int) -> bytes:
    """Return the bytes with the order reversed in each group of ``size``."""
    if size == 1:
        return data
    if len(data) == size:
        return data[::-1]
    swapped = bytearray(len(data))
    for place in range(size):
        swapped[place::size] = data[size - 1 - place :: size]
    return bytes(swapped)


def _scaled(value: Value, convert: Callable[[Any], Any]) -> Value:
    if isinstance(value, list):
        return [_scaled(item, convert) for item in value]
    if value is None:
        raise ValueRangeError("the bytes are not a value of the type")
    try:
        converted: Value = convert(value)
    except (OverflowError, ValueError) as error:
        raise ValueRangeError(str(error)) from None
    return converted


def _bcd(data: bytes, area: Area) -> Value:
    """Decode a counter, or a timer to ms; both have three BCD digits."""
    word = int.from_bytes(data, "big")
    digits = [word >> shift & 0xF for shift in (8, 4, 0)]
    if max(digits) > 9:
        raise ValueRangeError(f"0x{word:04X} is not in BCD")
    number = 100 * digits[0] + 10 * digits[1] + digits[2]
    if area is Area.COUNTER:
        return number
    return number * _S5_BASES_MS[word >> 12 & 3]


def _to_bcd(value: Value, area: Area) -> bytes:
    """Encode the value of a counter, or of a timer in ms.

    Raises:
        ValueRangeError: The value has more than three digits.

    """
    if area is Area.TIMER:
        return _TIMER.encode(value)
    if not isinstance(value, int) or not 0 <= value <= _LARGEST_COUNT:
        raise ValueRangeError(f"a counter counts from 0 to {_LARGEST_COUNT}, not {value}")
    return int(str(value), 16).to_bytes(2, "big")
