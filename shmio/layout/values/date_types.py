"""Convert DATE, DATE_AND_TIME, LDT and DTL between bytes and ISO 8601 text.

Formats: Siemens, "STEP 7 Professional", chapter "Data types".
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from shmio.errors import ValueRangeError
from shmio.layout.values import calendar
from shmio.layout.values.checks import brief, out_of_range

Buffer = bytes | bytearray | memoryview


class Moment:
    """Codec between ISO text and one of the four formats; a ``ScalarCodec``."""

    plain = ""

    def __init__(
        self,
        name: str,
        bounds_ns: tuple[int, int],
        step_ns: int,
        to_ns: Callable[[Buffer, int], int | None],
        from_ns: Callable[[int], bytes],
    ) -> None:
        self._name, self._bounds, self._step = name, bounds_ns, step_ns
        self._to_ns, self._from_ns = to_ns, from_ns
        self._digits = {calendar.NS_PER_MS: 3, 1: 9}.get(step_ns)

    def decode(self, data: Buffer, offset: int) -> str | None:
        """Return the text, or None for bytes that are not a valid date or time."""
        ns = self._to_ns(data, offset)
        if ns is None or not self._bounds[0] <= ns <= self._bounds[1]:
            return None
        return self._text(ns)

    def _text(self, ns: int) -> str:
        if self._digits is None:
            return calendar.format_day(ns // calendar.NS_PER_DAY)
        return calendar.format_moment(ns, self._digits)

    def encode(self, value: object) -> bytes:
        """Return the bytes of an ISO text; ValueRangeError if the type cannot hold it."""
        ns = calendar.parse_moment(value) if isinstance(value, str) else None
        if ns is None:
            example = "2024-02-29" + ("" if self._digits is None else "T12:34:56.789")
            raise ValueRangeError(f"{self._name}: expected text such as {example!r}, found {brief(value)}")
        if not self._bounds[0] <= ns <= self._bounds[1]:
            raise out_of_range(value, self._name, *map(self._text, self._bounds))
        if ns % self._step:
            raise ValueRangeError(f"{self._name}: {brief(value)} is too precise; {self._text(ns)} fits")
        return self._from_ns(ns)


# -- the four formats of a moment ----------------------------------------------------------------------------


def date_to_ns(unpack: struct.Struct) -> Callable[[Buffer, int], int]:
    """Return the decoder of DATE: 16 bits, days since 1990-01-01."""
    return lambda data, at: (unpack.unpack_from(data, at)[0] + calendar.DATE_EPOCH_DAYS) * calendar.NS_PER_DAY


def date_from_ns(pack: struct.Struct) -> Callable[[int], bytes]:
    """Return the encoder of DATE."""
    return lambda ns: pack.pack(ns // calendar.NS_PER_DAY - calendar.DATE_EPOCH_DAYS)


def dt_to_ns(data: Buffer, offset: int) -> int | None:
    """Decode DATE_AND_TIME: BCD bytes year, month, day, hour, minute, second, milliseconds.

    The last half-byte is the day of the week.
    """
    digits = [from_bcd(0, byte) for byte in data[offset : offset + 7]]
    last = data[offset + 7] >> 4
    if None in digits or last > 9:
        return None
    year, month, day, hour, minute, second, hundredths = (digit or 0 for digit in digits)
    date_days = calendar.days(year + (1900 if year >= 90 else 2000), month, day)
    if date_days is None or hour > 23 or minute > 59 or second > 59:
        return None
    ms = ((hour * 60 + minute) * 60 + second) * 1000 + hundredths * 10 + int(last)
    return int(date_days * calendar.NS_PER_DAY + ms * calendar.NS_PER_MS)


def dt_from_ns(ns: int) -> bytes:
    """Encode DATE_AND_TIME."""
    text = calendar.format_moment(ns, 3)  # 2024-02-29T12:34:56.789
    digits = text[2:].translate(str.maketrans("", "", "-T:."))
    return bytes.fromhex(f"{digits}{calendar.weekday(ns)}")


def dtl_to_ns(layout: struct.Struct) -> Callable[[Buffer, int], int | None]:
    """Return the decoder of DTL.

    Its fields are UINT year; USINT month, day, weekday, hour, minute, second; UDINT nanosecond.
    """

    def decode(data: Buffer, offset: int) -> int | None:
        year, month, day, _, hour, minute, second, ns = layout.unpack_from(data, offset)
        date_days = calendar.days(year, month, day)
        if date_days is None or hour > 23 or minute > 59 or second > 59 or ns >= calendar.NS_PER_SECOND:
            return None
        seconds = (hour * 60 + minute) * 60 + second
        return int((date_days * 86_400 + seconds) * calendar.NS_PER_SECOND + ns)

    return decode


def dtl_from_ns(layout: struct.Struct) -> Callable[[int], bytes]:
    """Return the encoder of DTL."""

    def encode(ns: int) -> bytes:
        text = calendar.format_moment(ns, 0)
        year, month, day, hour, minute, second = (
            int(text[a:b]) for a, b in ((0, 4), (5, 7), (8, 10), (11, 13), (14, 16), (17, 19))
        )
        rest = ns % calendar.NS_PER_SECOND
        return layout.pack(year, month, day, calendar.weekday(ns), hour, minute, second, rest)

    return encode


def from_bcd(hundreds: int, byte: int) -> int | None:
    """Return ``hundreds`` plus the number of two BCD digits, or None if a digit is above 9."""
    tens, ones = byte >> 4, byte & 0xF
    return None if max(hundreds, tens, ones) > 9 else int(hundreds * 100 + tens * 10 + ones)


# -- choosing ------------------------------------------------------------------------------------------------


def moment_codec(base: str, order: str) -> Moment:
    """Return the codec of DATE, DATE_AND_TIME, LDT or DTL; ``order`` is ``>`` or ``<``."""
    if base == "DATE":
        days = struct.Struct(order + "H")
        bounds = (calendar.FIRST_DT_NS, calendar.FIRST_DT_NS + 0xFFFF * calendar.NS_PER_DAY)
        return Moment(base, bounds, calendar.NS_PER_DAY, date_to_ns(days), date_from_ns(days))
    if base == "DATE_AND_TIME":
        return Moment(base, (calendar.FIRST_DT_NS, calendar.LAST_DT_NS), calendar.NS_PER_MS, dt_to_ns, dt_from_ns)
    since_1970 = (0, calendar.LAST_NS)
    if base == "LDT":
        ns = struct.Struct(order + "q")
        return Moment(base, since_1970, 1, lambda data, at: int(ns.unpack_from(data, at)[0]), ns.pack)
    fields = struct.Struct(order + "HBBBBBBI")
    return Moment(base, since_1970, 1, dtl_to_ns(fields), dtl_from_ns(fields))
