"""Values: fixed bytes from Siemens' definitions, and round trips over every type."""

from __future__ import annotations

import math
import struct
from datetime import date, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.errors import ValueRangeError
from shmio.layout.model import Dims, Register, array_size, element_type
from shmio.layout.values.codec import Value, codec


def register(type_: str, dims: Dims = (), offset: int = 0, bit: int | None = None) -> Register:
    element = element_type(type_)
    assert element is not None
    shape = tuple(high - low + 1 for low, high in dims)
    return Register(
        path="r",
        type=element.name,
        dims=dims,
        offset=offset,
        bit=(bit or 0) if type_ == "BOOL" else None,
        size=array_size(element, shape),
        count=math.prod(shape),
    )


def encode(value: object, r: Register, byte_order: Any = "big", fill: int = 0) -> bytes:
    frame = bytearray([fill]) * (r.offset + r.size)
    codec(r, byte_order).encode_into(value, frame)
    return bytes(frame)


# Type, value, bytes: worked out by hand from the format descriptions, or taken from Siemens' examples.
VECTORS: list[tuple[str, Value, str]] = [
    ("BYTE", 255, "ff"),
    ("SINT", -128, "80"),
    ("USINT", 200, "c8"),
    ("WORD", 0x1234, "1234"),
    ("INT", -2, "fffe"),
    ("UINT", 65535, "ffff"),
    ("DWORD", 0xDEADBEEF, "deadbeef"),
    ("DINT", -2147483648, "80000000"),
    ("UDINT", 4294967295, "ffffffff"),
    ("LWORD", 0x0102030405060708, "0102030405060708"),
    ("LINT", -1, "ff" * 8),
    ("ULINT", (1 << 64) - 1, "ff" * 8),
    ("REAL", 1.5, "3fc00000"),
    ("REAL", -0.0, "80000000"),
    ("REAL", math.inf, "7f800000"),
    ("LREAL", 0.1, "3fb999999999999a"),
    ("CHAR", "A", "41"),
    ("CHAR", "\x00", "00"),
    ("CHAR", "ü", "fc"),
    ("WCHAR", "€", "20ac"),
    ("STRING[4]", "ab", "04026162" + "0000"),
    ("STRING[4]", "", "0400" + "00000000"),
    ("STRING[2]", "é\x00", "0202e900"),
    ("WSTRING[3]", "a€", "00030002" + "006120ac" + "0000"),
    ("WSTRING[2]", "😀", "00020002" + "d83dde00"),
    ("TIME", 1, "00000001"),
    ("TIME", -2147483648, "80000000"),
    ("LTIME", -1, "ff" * 8),
    ("S5TIME", 0, "0000"),
    ("S5TIME", 9990, "0999"),
    ("S5TIME", 10_000, "1100"),
    ("S5TIME", 99_900, "1999"),
    ("S5TIME", 127_000, "2127"),
    ("S5TIME", 9_990_000, "3999"),
    ("TIME_OF_DAY", 86_399_999, "05265bff"),
    ("LTOD", 86_399_999_999_999, "00004e94914effff"),
    ("DATE", "1990-01-01", "0000"),
    ("DATE", "1994-03-17", "0600"),
    ("DATE", "2169-06-06", "ffff"),
    ("DATE_AND_TIME", "1993-12-25T08:12:34.567", "9312250812345677"),  # a Saturday
    ("DATE_AND_TIME", "1990-01-01T00:00:00.000", "9001010000000002"),  # a Monday
    ("DATE_AND_TIME", "2089-12-31T23:59:59.999", "8912312359599997"),
    ("LDT", "1970-01-01T00:00:00.000000001", "0000000000000001"),
    ("LDT", "2262-04-11T23:47:16.854775807", "7fffffffffffffff"),
    ("DTL", "2024-02-29T12:34:56.123456789", "07e8021d050c2238075bcd15"),  # a Thursday
    ("DTL", "1970-01-01T00:00:00.000000000", "07b201010500000000000000"),
    ("DTL", "9999-12-31T23:59:59.999999999", "270f0c1f06173b3b3b9ac9ff"),  # a Friday, the usual "no end"
    ("POINTER", "0000840000c8", "0000840000c8"),
    ("ANY", "10020001000084000000", "10020001000084000000"),
]


@pytest.mark.parametrize(("type_", "value", "data"), VECTORS)
def test_fixed_bytes(type_: str, value: Value, data: str) -> None:
    r = register(type_, offset=3)
    assert encode(value, r)[3:].hex() == data
    decoded = codec(r).decode(b"\xaa" * 3 + bytes.fromhex(data) + b"\xaa")
    assert (decoded, type(decoded)) == (value, type(value))
    assert str(decoded) == str(value)  # -0.0 is not 0.0


def test_little_endian() -> None:
    assert encode(0x0102, register("INT"), "little").hex() == "0201"
    assert encode("a€", register("WSTRING[2]"), "little").hex() == "02000200" + "6100ac20"
    assert codec(register("DINT", ((0, 1),)), "little").decode(bytes.fromhex("0100000002000000")) == [1, 2]
    assert encode("2024-02-29T12:34:56.5", register("DTL"), "little")[:2].hex() == "e807"


@pytest.mark.parametrize(
    ("type_", "data"),
    [
        ("STRING[4]", "040561626364"),  # longer than its maximum
        ("STRING[4]", "ffff61626364"),
        ("WSTRING[1]", "000100020061"),
        ("S5TIME", "0a00"),
        ("S5TIME", "00a0"),
        ("S5TIME", "000a"),
        ("TIME_OF_DAY", "05265c00"),
        ("LTOD", "00004e94914f0000"),
        ("DATE_AND_TIME", "00" * 8),  # month 0
        ("DATE_AND_TIME", "9313250812345677"),
        ("DATE_AND_TIME", "9302300812345677"),
        ("DATE_AND_TIME", "93122508123456a7"),
        ("DATE_AND_TIME", "931225081234a677"),
        ("DATE_AND_TIME", "9312252412345677"),
        ("DATE_AND_TIME", "9312250860345677"),
        ("LDT", "8000000000000000"),
        ("DTL", "00" * 12),
        ("DTL", "07e8021e050c2238075bcd15"),  # 30 February
        ("DTL", "07e8021d05182238075bcd15"),
        ("DTL", "07e8021d050c22383b9aca00"),
        ("DTL", "271001010700000000000000"),  # the year 10000
        ("DTL", "07b10c1f050c2238075bcd15"),  # 1969
    ],
)
def test_invalid_bytes_decode_to_none(type_: str, data: str) -> None:
    assert codec(register(type_)).decode(bytes.fromhex(data)) is None
    element = register(type_).element
    pair = bytes.fromhex(data).ljust(element.stride, b"\0") + bytes.fromhex(data)
    assert codec(register(type_, ((0, 1),))).decode(pair) == [None, None]


def test_irregular_bytes_of_controllers_are_read() -> None:
    assert codec(register("STRING[4]")).decode(bytes.fromhex("000261620000")) == "ab"  # maximum length not set
    assert codec(register("DATE_AND_TIME")).decode(bytes.fromhex("9312250812345670")) == "1993-12-25T08:12:34.567"
    assert codec(register("DTL")).decode(bytes.fromhex("07e8021d000c2238075bcd15")) == "2024-02-29T12:34:56.123456789"
    assert codec(register("WCHAR")).decode(bytes.fromhex("d83d")) == "\U0010f83d"
    assert codec(register("WSTRING[2]")).decode(bytes.fromhex("00020001d83d0000")) == "\U0010f83d"
    assert codec(register("S5TIME")).decode(bytes.fromhex("c123")) == 1230  # the two highest bits mean nothing


REFUSED: list[tuple[str, object]] = [
    *(("BYTE", v) for v in (-1, 256, 1.5, "1", True, None, [1], 10**5000, math.nan, math.inf)),
    *(("INT", v) for v in (-32769, 32768)),
    *(("ULINT", v) for v in (-1, 1 << 64)),
    *(("LINT", v) for v in (-(1 << 63) - 1, 1 << 63)),
    *(("REAL", v) for v in (3.5e38, True, "1", None, [1.0], 10**400)),
    *(("LREAL", v) for v in (10**400, "NaN")),
    *(("BOOL", v) for v in (2, "true", None, 0.5, "")),
    *(("CHAR", v) for v in ("", "ab", "€", 65, None)),
    *(("WCHAR", v) for v in ("", "ab", "😀", "\ud83d")),
    *(("STRING[3]", v) for v in ("abcd", "€", 5, b"a", None)),
    *(("WSTRING[3]", v) for v in ("abcd", "😀😀", "\udc00")),
    *(("S5TIME", v) for v in (-10, 5, 10_005, 99_910, 9_990_001, 10_000_000, "T#1s")),
    *(("TIME", v) for v in (1 << 31, 0.5)),
    *(("TIME_OF_DAY", v) for v in (-1, 86_400_000)),
    *(("LTOD", v) for v in (-1, 86_400_000_000_000)),
    *(("DATE", v) for v in ("1989-12-31", "2169-06-07", "2024-02-30", "2024-02-29T01:00:00", 5, "", "x")),
    *(("DATE_AND_TIME", v) for v in ("1989-12-31T23:59:59", "2090-01-01", "2024-01-01T00:00:00.0001")),
    *(("LDT", v) for v in ("1969-12-31", "2262-04-11T23:47:16.854775808", "2024-01-01T24:00:00", 0)),
    *(("DTL", v) for v in ("1969-12-31", "10000-01-01", "2024-01-01T00:00:00.1234567890")),
    *(("POINTER", v) for v in ("00", "zz" * 6, 0, "00" * 7)),
]


@pytest.mark.parametrize(("type_", "value"), REFUSED, ids=[type_ for type_, _ in REFUSED])
def test_values_that_do_not_fit_write_nothing(type_: str, value: object) -> None:
    for r, item in ((register(type_), value), (register(type_, ((0, 1),)), [value, value])):
        frame = bytearray(b"\x55" * r.size)
        with pytest.raises(ValueRangeError) as caught:
            codec(r).encode_into(item, frame)
        assert len(str(caught.value)) < 200
        assert frame == b"\x55" * r.size


def test_numbers_of_other_types_are_accepted() -> None:
    assert encode(5.0, register("INT")) == encode(np.int16(5), register("INT")) == b"\x00\x05"
    assert encode(2, register("REAL")) == encode(np.float32(2), register("REAL")) == b"\x40\x00\x00\x00"
    assert encode(1, register("BOOL")) == encode(np.True_, register("BOOL")) == b"\x01"


@pytest.mark.parametrize("bit", range(8))
def test_bool_changes_only_its_bit(bit: int) -> None:
    r = register("BOOL", offset=1, bit=bit)
    assert encode(True, r) == bytes([0, 1 << bit])
    assert encode(False, r, fill=0xFF) == bytes([0xFF, 0xFF & ~(1 << bit)])
    assert codec(r).decode(bytes([0, 1 << bit])) is True
    assert codec(r).decode(bytes([0xFF, 0xFF & ~(1 << bit)])) is False


def test_rows_of_bits() -> None:
    r = register("BOOL", ((0, 1), (1, 9)))
    value: list[Value] = [[True, *[False] * 7, True], [False, True, *[False] * 7]]
    assert encode(value, r).hex() == "01010200"
    assert codec(r).decode(bytes.fromhex("01010200")) == value
    assert encode(value, r, fill=0xFF).hex() == "01ff02fe"  # padding bits are unchanged


def test_arrays() -> None:
    r = register("INT", ((0, 1), (0, 2)))
    assert codec(r).decode(struct.pack(">6h", *range(6))) == [[0, 1, 2], [3, 4, 5]]
    assert encode([[0, 1, 2], [3, 4, 5]], r) == struct.pack(">6h", *range(6))
    odd = register("STRING[1]", ((1, 2),))
    assert encode(["a", ""], odd, fill=0x77).hex() == "010161" + "77" + "010000"
    for wrong in ([1, 2, 3, 4, 5, 6], [[1, 2, 3]], [[1, 2], [3, 4]], 5, "123456", [[1, 2, 3], [4, 5, "x"]], None):
        with pytest.raises(ValueRangeError):
            encode(wrong, r)


def test_a_register_has_one_codec() -> None:
    assert codec(register("INT")) is codec(register("INT"))
    assert codec(register("INT")) is not codec(register("INT"), "little")


def test_frames_of_any_buffer_type() -> None:
    data = bytes.fromhex("0105" + "020161620000")
    for frame in (data, bytearray(data), memoryview(data)):
        assert codec(register("BOOL", ((0, 9),))).decode(frame) == [True, *[False] * 7, True, False]
        assert codec(register("STRING[4]", offset=2)).decode(frame) == "a"


# -- round trips ---------------------------------------------------------------------------------------------

LAST_MOMENT = datetime(2262, 4, 11, 23, 47, 16)
ns_digits = st.integers(0, 999_999_999)
moments = st.builds(
    lambda moment, ns: f"{moment.replace(microsecond=0).isoformat()}.{ns:09}",
    st.datetimes(datetime(1970, 1, 1), LAST_MOMENT - timedelta(seconds=1)),
    ns_digits,
)
VALUES: dict[str, st.SearchStrategy[Any]] = {
    "BOOL": st.booleans(),
    **{
        name: st.integers(0, (1 << bits) - 1)
        for name, bits in {"BYTE": 8, "WORD": 16, "DWORD": 32, "LWORD": 64}.items()
    },
    **{name: st.integers(0, (1 << n) - 1) for name, n in {"USINT": 8, "UINT": 16, "UDINT": 32, "ULINT": 64}.items()},
    **{
        name: st.integers(-(1 << n - 1), (1 << n - 1) - 1)
        for name, n in {"SINT": 8, "INT": 16, "DINT": 32, "LINT": 64, "TIME": 32, "LTIME": 64}.items()
    },
    "REAL": st.floats(width=32, allow_nan=False),
    "LREAL": st.floats(allow_nan=False),
    "CHAR": st.characters(max_codepoint=255),
    "WCHAR": st.characters(max_codepoint=0xFFFF, exclude_categories=["Cs"]),
    "STRING[7]": st.text(st.characters(max_codepoint=255), max_size=7),
    "WSTRING[8]": st.text(st.characters(exclude_categories=["Cs"]), max_size=4),
    "S5TIME": st.builds(lambda n, base: n * base, st.integers(0, 999), st.sampled_from([10, 100, 1000, 10_000])),
    "TIME_OF_DAY": st.integers(0, 86_399_999),
    "LTOD": st.integers(0, 86_399_999_999_999),
    "DATE": st.dates(date(1990, 1, 1), date(2169, 6, 6)).map(date.isoformat),
    "DATE_AND_TIME": st.datetimes(datetime(1990, 1, 1), datetime(2089, 12, 31, 23, 59, 59)).map(
        lambda moment: moment.isoformat(timespec="milliseconds")
    ),
    "LDT": moments,
    "DTL": moments | st.sampled_from(["2262-04-12T00:00:00.000000000", "9999-12-31T23:59:59.999999999"]),
    "POINTER": st.binary(min_size=6, max_size=6).map(bytes.hex),
    "ANY": st.binary(min_size=10, max_size=10).map(bytes.hex),
}


@pytest.mark.parametrize("type_", VALUES)
@given(data=st.data(), byte_order=st.sampled_from(["big", "little"]))
def test_every_value_survives_a_round_trip(type_: str, data: st.DataObject, byte_order: Any) -> None:
    value = data.draw(VALUES[type_])
    r = register(type_, offset=2)
    assert codec(r, byte_order).decode(encode(value, r, byte_order, fill=0xAA)) == value


@pytest.mark.parametrize("type_", VALUES)
@given(data=st.data())
def test_arrays_survive_a_round_trip_and_change_nothing_else(type_: str, data: st.DataObject) -> None:
    r = register(type_, ((-1, 0), (1, 3)), offset=4)
    value = data.draw(st.lists(st.lists(VALUES[type_], min_size=3, max_size=3), min_size=2, max_size=2))
    frame = bytearray(b"\x99" * (r.offset + r.size + 4))
    codec(r).encode_into(value, frame)
    assert codec(r).decode(frame) == value
    assert frame[:4] == frame[-4:] == b"\x99" * 4


@pytest.mark.parametrize("type_", VALUES)
@given(data=st.data())
def test_any_bytes_decode_to_none_or_to_a_value_that_can_be_encoded(type_: str, data: st.DataObject) -> None:
    r = register(type_)
    frame = data.draw(st.binary(min_size=r.size, max_size=r.size))
    value = codec(r).decode(frame)
    if value is not None:
        again = codec(r).decode(encode(value, r))
        assert again == value or (isinstance(value, float) and math.isnan(value))
