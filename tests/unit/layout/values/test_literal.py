from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.errors import ValueRangeError
from shmio.layout.model import Dims, Register, element_type
from shmio.layout.values.codec import Value, scalar_codec
from shmio.layout.values.literal import default_text, literal_text, parse_literal, scalar_literal, split_array


def array(type_: str, dims: Dims, count: int) -> Register:
    return Register("r", type_, dims, 0, None, 0, count)


def read(text: str, type_: str) -> Value:
    element = element_type(type_)
    assert element is not None
    return scalar_literal(text, element)


@pytest.mark.parametrize(
    ("text", "type_", "value"),
    [
        ("TRUE", "BOOL", True),
        ("false", "BOOL", False),
        ("BOOL#1", "BOOL", True),
        ("0", "BOOL", False),
        ("2#1", "BOOL", True),
        ("5", "INT", 5),
        (" +5 ", "INT", 5),
        ("-32_768", "INT", -32768),
        ("INT#5", "INT", 5),
        ("INT#16#FFFF", "INT", -1),
        ("16#8000", "INT", -32768),
        ("2#1111_0000", "BYTE", 240),
        ("8#17", "BYTE", 15),
        ("B#16#fF", "BYTE", 255),
        ("DW#16#DEAD_BEEF", "DWORD", 0xDEADBEEF),
        ("L#-5", "DINT", -5),
        ("18446744073709551615", "ULINT", (1 << 64) - 1),
        ("1.5", "REAL", 1.5),
        ("-1", "REAL", -1.0),
        ("1_000.5e-3", "LREAL", 1.0005),
        ("REAL#1.0E+2", "REAL", 100.0),
        ("T#1s", "TIME", 1000),
        ("t#-24d_20h_31m_23s_648ms", "TIME", -(1 << 31)),
        ("TIME#1.5s", "TIME", 1500),
        ("T#1h30m", "TIME", 5_400_000),
        ("1d", "TIME", 86_400_000),
        ("250", "TIME", 250),
        ("LT#106751d23h47m16s854ms775us807ns", "LTIME", (1 << 63) - 1),
        ("LTIME#1us", "LTIME", 1000),
        ("S5T#2h46m30s", "S5TIME", 9_990_000),
        ("S5TIME#10ms", "S5TIME", 10),
        ("TOD#23:59:59.999", "TIME_OF_DAY", 86_399_999),
        ("TIME_OF_DAY#1:2:3", "TIME_OF_DAY", 3_723_000),
        ("LTOD#00:00:00.000000001", "LTOD", 1),
        ("D#2024-2-9", "DATE", "2024-02-09"),
        ("2024-02-29", "DATE", "2024-02-29"),
        ("DT#2024-02-29-12:34:56.7", "DATE_AND_TIME", "2024-02-29T12:34:56.700"),
        ("DATE_AND_TIME#1990-01-01-0:0:0", "DATE_AND_TIME", "1990-01-01T00:00:00.000"),
        ("2024-02-29T12:34:56", "DATE_AND_TIME", "2024-02-29T12:34:56.000"),
        ("LDT#2024-02-29-12:34:56.123456789", "LDT", "2024-02-29T12:34:56.123456789"),
        ("DTL#1970-01-01-00:00:00", "DTL", "1970-01-01T00:00:00.000000000"),
        ("'a'", "CHAR", "a"),
        ("CHAR#'$$'", "CHAR", "$"),
        ("'it$'s $41$N'", "STRING[20]", "it's A\r\n"),
        ("''", "STRING[5]", ""),
        ("'#'", "STRING[5]", "#"),
        ("STRING#'a#b'", "STRING[5]", "a#b"),
        ("'$4142'", "STRING[5]", "A42"),
        ("WSTRING#'$20ACä'", "WSTRING[5]", "€ä"),
        ("'a$80'", "STRING[5]", "a\x80"),
        ("WSTRING#'$D83D$DE00'", "WSTRING[5]", "😀"),
        ("WCHAR#'轴'", "WCHAR", "轴"),
    ],
)
def test_literals(text: str, type_: str, value: Value) -> None:
    found = read(text, type_)
    assert (found, type(found)) == (value, type(value))


def test_an_escaped_byte_is_in_the_encoding_of_the_register() -> None:
    for encoding, text, value in (  # WHATWG, index-windows-1252 and index-gb18030
        ("windows-1252", "'$80'", "€"), ("windows-1252", "'$81'", "\x81"), ("gbk", "'a$B5$E7$BB$FA'", "a电机"),
    ):  # fmt: skip
        element = element_type("STRING[5]")
        assert element is not None
        assert scalar_literal(text, msgspec.structs.replace(element, encoding=encoding)) == value


@pytest.mark.parametrize(
    ("text", "type_"),
    [
        *(
            (text, "INT")
            for text in ("", "x", "1.0", "32768", "16#10000", "1__0", "_1", "2#2", "T#1s", "9" * 5000, "--1")
        ),
        *((text, "BYTE") for text in ("-1", "256", "'a'", "TRUE")),
        *((text, "BOOL") for text in ("2", "yes", "")),
        *((text, "REAL") for text in ("1e99", "NaN", "0x1", "1.", "1e", "1e9999999999")),
        *((text, "TIME") for text in ("T#", "T#1x", "T#1us", "T#25d", "TOD#1:00:00", "T#-", "T#1s-1s")),
        *((text, "S5TIME") for text in ("T#5ms", "S5T#3h", "S5T#-1s", "S5T#1m1s10ms")),
        *((text, "TIME_OF_DAY") for text in ("TOD#24:00:00", "TOD#12", "TOD#0:0:0.0001")),
        *((text, "DATE") for text in ("D#2024-02-30", "D#1989-12-31", "D#x", "DT#2024-01-01-12:00:00")),
        *((text, "DATE_AND_TIME") for text in ("DT#2024-01-01-25:00:00", "DT#2024-01-01-00:00:00.0001")),
        *((text, "STRING[3]") for text in ("abc", "'abcd'", "'€'", "'", "INT#'a'")),
        *((text, "CHAR") for text in ("''", "'ab'", "65")),
        *((text, "POINTER") for text in ("P#DB1.DBX0.0", "'a'")),
        ('"CONSTANT"', "INT"),
    ],
)
def test_invalid_literals_are_refused(text: str, type_: str) -> None:
    with pytest.raises(ValueRangeError) as caught:
        read(text, type_)
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize(
    ("text", "dims", "count", "value"),
    [
        ("[1, 2, 3]", ((0, 2),), 3, [1, 2, 3]),
        ("1, 2, 3", ((0, 2),), 3, [1, 2, 3]),
        ("[1]", ((0, 2),), 3, [1, 0, 0]),
        ("[2(7), 1]", ((0, 3),), 4, [7, 7, 1, 0]),
        ("2(1, 2)", ((0, 4),), 5, [1, 2, 1, 2, 0]),
        ("[9999999999(5)]", ((0, 1),), 2, [5, 5]),
        ("[1, 2, 3]", ((0, 0),), 1, [1]),
        ("[1, 2, 3, 4]", ((0, 1), (0, 1)), 4, [[1, 2], [3, 4]]),
        ("[[1, 2], [3]]", ((0, 1), (0, 1)), 4, [[1, 2], [3, 0]]),
        ("[2([1, 2])]", ((0, 1), (0, 1)), 4, [[1, 2], [1, 2]]),
        ("[[1], [2]]", ((0, 1), (0, 1)), 4, [[1, 0], [2, 0]]),
        ("", ((0, 1),), 2, [0, 0]),
    ],
)
def test_arrays(text: str, dims: Dims, count: int, value: Value) -> None:
    assert parse_literal(text, array("INT", dims, count)) == value


def test_commas_in_texts() -> None:
    assert parse_literal("['a,b', '$'', ')']", array("STRING[5]", ((0, 2),), 3)) == ["a,b", "'", ")"]


@pytest.mark.parametrize("text", ["[x]", "[1, [2]]", "[(1)]", "[1", "1(1(1))", "[" * 5000])
def test_malformed_arrays(text: str) -> None:
    with pytest.raises(ValueRangeError):
        parse_literal(text, array("INT", ((0, 3),), 4))


@given(st.text("[](),1a'$ ", max_size=40))
def test_any_text_splits_within_the_array(text: str) -> None:
    position = 0
    for start, count, _ in split_array(text, (2, 3)):
        assert start >= position
        position = start + count
    assert position <= 6


@pytest.mark.parametrize(
    "type_",
    [
        "BYTE",
        "WORD",
        "DWORD",
        "LWORD",
        "SINT",
        "USINT",
        "INT",
        "UINT",
        "DINT",
        "UDINT",
        "LINT",
        "ULINT",
        "REAL",
        "LREAL",
        "CHAR",
        "WCHAR",
        "STRING[3]",
        "WSTRING[3]",
        "S5TIME",
        "TIME",
        "LTIME",
        "TIME_OF_DAY",
        "LTOD",
        "DATE",
        "DATE_AND_TIME",
        "LDT",
        "DTL",
        "POINTER",
        "ANY",
        "BOOL",
    ],
)
def test_every_type_has_a_default(type_: str) -> None:
    element = element_type(type_)
    assert element is not None
    value = scalar_literal(default_text(element), element)
    if type_ != "BOOL":
        codec = scalar_codec(element)
        assert codec.decode(codec.encode(value), 0) == value


def test_error_for_a_bool_lists_the_valid_texts() -> None:
    with pytest.raises(ValueRangeError, match="BOOL: expected TRUE, FALSE, 1 or 0, found"):
        parse_literal("yes", Register("run", "BOOL", (), 0, 0, 1, 1))


@pytest.mark.parametrize(
    ("value", "type_", "text"),
    [
        (1500, "TIME", "T#1s500ms"),
        (-90_061_001, "TIME", "T#-1d1h1m1s1ms"),
        (0, "TIME", "T#0ms"),
        (10_000, "S5TIME", "S5T#10s"),
        (0, "LTIME", "LT#0ns"),
        (1_000_002_003, "LTIME", "LT#1s2us3ns"),
        (43_200_000, "TIME_OF_DAY", "TOD#12:00:00"),
        (86_399_990, "TIME_OF_DAY", "TOD#23:59:59.99"),
        (1, "LTOD", "LTOD#00:00:00.000000001"),
        ("2026-11-22", "DATE", "D#2026-11-22"),
        ("2026-11-22T00:00:00.000", "DATE_AND_TIME", "DT#2026-11-22-00:00:00"),
        ("2026-11-22T10:20:30.100000000", "DTL", "DTL#2026-11-22-10:20:30.1"),
        ("2026-11-22T10:20:30.000000001", "LDT", "LDT#2026-11-22-10:20:30.000000001"),
    ],
)
def test_literal_texts_of_times_are_read_back(value: Value, type_: str, text: str) -> None:
    register = Register("r", type_, (), 0, None, 0, 1)
    assert literal_text(value, register) == text
    assert parse_literal(text, register) == value
    row = array(type_, ((0, 1),), 2)
    assert literal_text([value, value], row) == f"[{text},{text}]"
    assert parse_literal(f"[{text},{text}]", row) == [value, value]


def test_literal_texts_of_other_values() -> None:
    assert literal_text(0.1, Register("r", "REAL", (), 0, None, 0, 1)) == "0.1"
    assert literal_text(None, Register("r", "DATE", (), 0, None, 0, 1)) == ""
    assert literal_text([None, "2026-11-22"], array("DATE", ((0, 1),), 2)) == "[null,D#2026-11-22]"
