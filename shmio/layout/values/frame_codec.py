"""Decode many whole frames at once into numpy arrays.

============================  ==========================================================================
BOOL                          ``?``
integers, BYTE … LWORD        ``i1`` … ``u8``
REAL, LREAL                   ``f4``, ``f8``
CHAR, STRING, WCHAR, WSTRING  ``U``, of the declared length; numpy drops trailing NULs
TIME, S5TIME, TIME_OF_DAY     ``m8[ms]``
LTIME, LTOD                   ``m8[ns]`` (the least LTIME is numpy's NaT)
DATE                          ``M8[D]``
DATE_AND_TIME                 ``M8[ms]``
LDT, DTL                      ``M8[ns]``
POINTER, ANY                  ``V6``, ``V10``
============================  ==========================================================================

Values have native byte order. The field of an array register has the array's shape. Bytes that are
not a valid value of their type become NaT or empty text, and so does a DTL after 2262, where ``M8[ns]``
ends.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from shmio.layout.encodings import UNIT_STAND_INS, TextEncoding, text_encoding
from shmio.layout.model import ElementType, Layout, Register, bit_positions
from shmio.layout.values.calendar import DATE_EPOCH_DAYS, FIRST_DT_NS, LAST_DT_NS, NS_PER_DAY, NS_PER_MS, NS_PER_SECOND
from shmio.layout.values.codec import MAX_LTOD_NS, MAX_TOD_MS

Bytes = npt.NDArray[np.uint8]
Array = npt.NDArray[Any]
# Converts bytes of shape (…, size of an element) to values of shape (…).
_Decode = Callable[[Bytes], Array]

# fmt: off
_PLAIN = {
    "BYTE": "u1", "WORD": "u2", "DWORD": "u4", "LWORD": "u8",
    "USINT": "u1", "UINT": "u2", "UDINT": "u4", "ULINT": "u8",
    "SINT": "i1", "INT": "i2", "DINT": "i4", "LINT": "i8",
    "REAL": "f4", "LREAL": "f8",
}
_SPECIAL = {
    "BOOL": "?", "CHAR": "U1", "WCHAR": "U1",
    "TIME": "m8[ms]", "S5TIME": "m8[ms]", "TIME_OF_DAY": "m8[ms]", "LTIME": "m8[ns]", "LTOD": "m8[ns]",
    "DATE": "M8[D]", "DATE_AND_TIME": "M8[ms]", "LDT": "M8[ns]", "DTL": "M8[ns]",
    "POINTER": "V6", "ANY": "V10",
}
# fmt: on
_NAT = np.iinfo(np.int64).min


class FrameCodec:
    """Decodes frames of one layout. Creating the codec is slow; decoding is fast."""

    def __init__(self, layout: Layout) -> None:
        registers = layout.registers
        self.size = layout.size
        self.dtype = np.dtype([(register.path, *_field(register)) for register in registers])
        order = ">" if layout.byte_order == "big" else "<"
        plain = [register for register in registers if register.type in _PLAIN]
        # Views of frame and result as records with the same fields: one assignment converts them all.
        runs = _runs(plain, self.dtype)
        self._plain_in = _record([(order + kind, count, start) for kind, count, start, _ in runs], layout.size)
        self._plain_out = _record([(kind, count, start) for kind, count, _, start in runs], self.dtype.itemsize)
        bits = [register for register in registers if register.type == "BOOL" and not register.dims]
        self._bits = [register.path for register in bits]
        self._bit_bytes = np.array([register.offset for register in bits], dtype=np.intp)
        self._bit_shifts = np.array([register.bit for register in bits], dtype=np.uint8)
        done = {register.path for register in (*plain, *bits)}
        self._others = [(r, _decoder(r, order)) for r in registers if r.path not in done]

    def decode(self, frames: bytes | bytearray | memoryview | Bytes) -> Array:
        """Decode any number of frames at once.

        Args:
            frames: The bytes of n frames, or a uint8 array of shape (n, size).

        Returns:
            A structured array of shape (n,) with a field for each register, named by its path.

        Raises:
            ValueError: The bytes are not whole frames of the layout.

        """
        raw = np.asarray(frames, np.uint8) if isinstance(frames, np.ndarray) else np.frombuffer(frames, np.uint8)
        if raw.ndim == 1 and self.size and raw.size % self.size == 0:
            raw = raw.reshape(-1, self.size)
        if raw.ndim != 2 or raw.shape[1] != self.size:
            raise ValueError(f"expected frames of {self.size} bytes, found an array of shape {raw.shape}")
        raw = np.ascontiguousarray(raw)
        if not self.dtype.names:
            return np.empty(len(raw), self.dtype)
        record = np.empty(len(raw), self._plain_out)  # creating thousands of fields is slow
        if self._plain_in.names:
            record[:] = raw.view(self._plain_in)[:, 0]
        out: Array = record.view(self.dtype)
        if self._bits:
            bits = raw[:, self._bit_bytes] >> self._bit_shifts & 1
            for column, path in enumerate(self._bits):
                out[path] = bits[:, column]
        for register, decode in self._others:
            out[register.path] = decode(raw)
        return out


def _runs(plain: list[Register], dtype: np.dtype[Any]) -> list[tuple[str, int, int, int]]:
    """Join adjacent registers of one type into runs (type, elements, offset in frame, offset in result)."""
    fields: Mapping[str, Any] = dtype.fields or {}
    runs: list[tuple[str, int, int, int]] = []
    ends = kind_before = None
    for register in plain:
        kind, start, result = _PLAIN[register.type], register.offset, int(fields[register.path][1])
        if ends == (start, result) and kind == kind_before:
            _, count, *starts = runs.pop()
            runs.append((kind, count + register.count, starts[0], starts[1]))
        else:
            runs.append((kind, register.count, start, result))
        ends, kind_before = (start + register.size, result + register.size), kind
    return runs


def _record(fields: list[tuple[str, int, int]], size: int) -> np.dtype[Any]:
    """Return a record type of ``size`` bytes with fields (type, elements, offset)."""
    return np.dtype(
        {
            "names": [f"f{position}" for position in range(len(fields))],
            "formats": [(kind, (count,)) for kind, count, _ in fields],
            "offsets": [start for _, _, start in fields],
            "itemsize": size,
        }
    )


def _field(register: Register) -> tuple[str, tuple[int, ...]]:
    element = register.element
    kind = _PLAIN.get(element.name) or _SPECIAL.get(element.name) or f"U{element.length}"
    return kind, register.shape


def _decoder(register: Register, order: str) -> Callable[[Bytes], Array]:
    """Return a function that decodes frames (n, size) into one register's values (n, *shape)."""
    element, shape = register.element, register.shape
    if element.base == "BOOL":
        places = bit_positions(register)
        where = np.array([register.offset + byte for byte, _ in places], dtype=np.intp)
        shifts = np.array([bit for _, bit in places], dtype=np.uint8)
        return lambda raw: (raw[:, where] >> shifts & 1).astype(bool).reshape(-1, *shape)
    decode = _element_decoder(element, order)
    starts = register.offset + np.arange(register.count) * element.stride
    gather = starts[:, None] + np.arange(element.size)

    return lambda raw: decode(raw[:, gather]).reshape(-1, *shape)


def _element_decoder(element: ElementType, order: str) -> _Decode:
    milliseconds, nanoseconds = "m8[ms]", "m8[ns]"
    wide = f"{order}u2"
    table: dict[str, _Decode] = {
        "TIME": lambda raw: _view(raw, f"{order}i4").astype(np.int64).view(milliseconds),
        "LTIME": lambda raw: _view(raw, f"{order}i8").astype(np.int64).view(nanoseconds),
        "TIME_OF_DAY": lambda raw: _limited(_view(raw, f"{order}u4"), MAX_TOD_MS).view(milliseconds),
        "LTOD": lambda raw: _limited(_view(raw, f"{order}u8"), MAX_LTOD_NS).view(nanoseconds),
        "S5TIME": lambda raw: _s5time(_view(raw, wide)).view(milliseconds),
        "DATE": lambda raw: (_view(raw, wide).astype(np.int64) + DATE_EPOCH_DAYS).view("M8[D]"),
        "DATE_AND_TIME": _date_and_time,
        "LDT": lambda raw: _not_negative(_view(raw, f"{order}i8").astype(np.int64)).view("M8[ns]"),
        "DTL": lambda raw: _dtl(raw, order),
        "CHAR": lambda raw: _characters(raw, text_encoding(element.encoding)),
        "WCHAR": lambda raw: _utf16(_view(raw, wide)[..., None]),
        "STRING": lambda raw: _string(raw, element.length, text_encoding(element.encoding)),
        "WSTRING": lambda raw: _wide_text(np.ascontiguousarray(raw).view(wide), element.length),
        "POINTER": lambda raw: _view(raw, "V6"),
        "ANY": lambda raw: _view(raw, "V10"),
    }
    return table[element.base]


def _view(raw: Array, dtype: str) -> Array:
    """View bytes of shape (…, size) as values of shape (…)."""
    return np.ascontiguousarray(raw).view(dtype)[..., 0]


def _limited(values: Array, limit: int) -> Array:
    return np.where(values <= limit, values, np.uint64(0)).astype(np.int64) + np.where(values <= limit, 0, _NAT)


def _not_negative(values: Array) -> Array:
    return np.where(values >= 0, values, _NAT)


def _bcd(values: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return the numbers that bytes of two BCD digits encode, and whether both digits are valid."""
    tens, ones = values.astype(np.int64) >> 4, values.astype(np.int64) & 0xF
    return tens * 10 + ones, (tens <= 9) & (ones <= 9)


def _s5time(words: Array) -> Array:
    number, good = _bcd(words & 0xFF)
    hundreds = (words >> 8 & 0xF).astype(np.int64)
    base_ms = np.array([10, 100, 1000, 10_000])[words >> 12 & 3]
    return np.where(good & (hundreds <= 9), (hundreds * 100 + number) * base_ms, _NAT)


def _days(year: Array, month: Array, day: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return the days since 1970-01-01, and whether each date exists and is in the years 1970 to 2262."""
    inside = (month >= 1) & (month <= 12) & (day >= 1) & (year >= 1970) & (year <= 2262)
    months = np.where(inside, (year - 1970) * 12 + month - 1, 0)
    first = months.view("M8[M]").astype("M8[D]").astype(np.int64)
    after = (months + 1).view("M8[M]").astype("M8[D]").astype(np.int64)
    return first + day - 1, inside & (day <= after - first)


def _date_and_time(raw: Bytes) -> Array:
    fields, good = _bcd(raw[..., :7])
    year, month, day, hour, minute, second, hundredths = np.moveaxis(fields, -1, 0)
    last = raw[..., 7].astype(np.int64) >> 4
    days, valid = _days(np.where(year >= 90, year + 1900, year + 2000), month, day)
    valid &= good.all(-1) & (last <= 9) & (hour < 24) & (minute < 60) & (second < 60)
    ms = days * (NS_PER_DAY // NS_PER_MS) + ((hour * 60 + minute) * 60 + second) * 1000 + hundredths * 10 + last
    valid &= (ms >= FIRST_DT_NS // NS_PER_MS) & (ms <= LAST_DT_NS // NS_PER_MS)
    return np.where(valid, ms, _NAT).view("M8[ms]")


def _dtl(raw: Bytes, order: str) -> Array:
    year = _view(raw[..., 0:2], f"{order}u2").astype(np.int64)
    month, day, _, hour, minute, second = np.moveaxis(raw[..., 2:8].astype(np.int64), -1, 0)
    rest = _view(raw[..., 8:12], f"{order}u4").astype(np.int64)
    days, valid = _days(year, month, day)
    valid &= (hour < 24) & (minute < 60) & (second < 60) & (rest < NS_PER_SECOND)
    # The last nanosecond that 63 bits can count is in the year 2262; later ones wrap to negative.
    ns = days * NS_PER_DAY + ((hour * 60 + minute) * 60 + second) * NS_PER_SECOND + rest
    valid &= ns >= 0
    return np.where(valid, ns, _NAT).view("M8[ns]")


def _text(units: Array, actual: Array) -> Array:
    """Replace code points (…, length) after the actual length by NUL; if that is invalid, replace all."""
    length = units.shape[-1]
    inside = (np.arange(length) < actual[..., None]) & (actual <= length)[..., None]
    return np.ascontiguousarray(np.where(inside, units, 0).astype(np.uint32))


def _characters(raw: Bytes, encoding: TextEncoding) -> Array:
    """Return bytes (…, 1) as single characters."""
    points = [ord(encoding.decode(bytes((byte,)))) for byte in range(256)]
    return _view(np.array(points, np.uint32)[raw], "U1")


def _string(raw: Bytes, length: int, encoding: TextEncoding) -> Array:
    """Return STRINGs (…, 2 + length) as texts."""
    if encoding.points:
        points = np.array([*map(ord, encoding.points)], np.uint32)
        return _text(points[raw[..., 2:]], raw[..., 1]).view(f"U{length}")[..., 0]
    flat = raw.reshape(-1, raw.shape[-1])
    texts = [encoding.decode(bytes(row[2 : 2 + row[1]])) if row[1] <= length else "" for row in flat]
    return np.array(texts, f"U{length}").reshape(raw.shape[:-1])


def _utf16(units: Array) -> Array:
    """Return (…, 1) UTF-16 units as single characters; lone surrogates become stand-ins."""
    points = units.astype(np.uint32)
    points = np.where((units >= 0xD800) & (units <= 0xDFFF), points + (UNIT_STAND_INS - 0xD800), points)
    return _view(points.astype(np.uint32), "U1")


def _wide_text(words: Array, length: int) -> Array:
    points = _text(words[..., 2:], words[..., 1])
    if not ((points >= 0xD800) & (points <= 0xDFFF)).any():
        return points.view(f"U{length}")[..., 0]
    # A surrogate pair is one character, so the text gets shorter. Such texts are rare; convert each alone.
    flat = points.reshape(-1, length).astype("<u2")
    actual = np.where(words[..., 1] <= length, words[..., 1], 0).reshape(-1)
    texts = [text_encoding("utf-16-le").decode(bytes(row[:n])) for row, n in zip(flat, actual, strict=True)]
    return np.array(texts, dtype=f"U{length}").reshape(points.shape[:-1])
