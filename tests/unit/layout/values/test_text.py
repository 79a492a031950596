from __future__ import annotations

import json
import math
import struct

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from shmio.errors import ValueRangeError
from shmio.layout.model import Dims, Register
from shmio.layout.values.codec import Value
from shmio.layout.values.text import from_text, texts, to_text, wire_type


def register(type_: str, dims: Dims = (), count: int = 1) -> Register:
    return Register("r", type_, dims, 0, 0 if type_ == "BOOL" else None, 0, count)


@pytest.mark.parametrize(
    ("value", "type_", "text"),
    [
        (0.10000000149011612, "REAL", "0.1"),
        (0.1, "LREAL", "0.1"),
        (0.10000000149011612, "LREAL", "0.10000000149011612"),
        (1.0, "REAL", "1.0"),
        (-0.0, "REAL", "-0.0"),
        (3.4028234663852886e38, "REAL", "3.4028235e+38"),
        (1.401298464324817e-45, "REAL", "1e-45"),
        (16777216.0, "REAL", "16777216.0"),
        (math.nan, "REAL", "NaN"),
        (math.inf, "LREAL", "Infinity"),
        (-math.inf, "REAL", "-Infinity"),
        (True, "BOOL", "true"),
        (False, "BOOL", "false"),
        (-5, "INT", "-5"),
        ((1 << 64) - 1, "LWORD", "18446744073709551615"),
        (1500, "TIME", "1500"),
        ("it's", "STRING[9]", "it's"),
        ("true", "STRING[9]", "true"),
        ("2024-02-29", "DATE", "2024-02-29"),
    ],
)
def test_to_text_and_back(value: Value, type_: str, text: str) -> None:
    assert to_text(value, register(type_)) == texts(register(type_))(value) == text
    again = from_text(text, register(type_))
    assert type(again) is type(value)
    stored = struct.unpack(">f", struct.pack(">f", again))[0] if type_ == "REAL" else again
    assert repr(stored) == repr(value)


def test_no_value() -> None:
    assert to_text(None, register("DATE_AND_TIME")) == ""
    assert to_text([None, "a"], register("STRING[3]", ((0, 1),), 2)) == '[null,"a"]'


@given(st.floats(width=32, allow_nan=False))
def test_real_is_the_shortest_text(value: float) -> None:
    text = to_text(value, register("REAL"))
    assert texts(register("REAL"))(value) == text
    assert np.float32(float(text)) == np.float32(value)
    if math.isfinite(value):
        digits = len(str(np.float32(value)).partition("e")[0].strip("-").replace(".", "").strip("0"))
        fewer = f"{value:.{max(digits - 2, 0)}e}"
        assert digits <= 1 or np.float32(float(fewer)) != np.float32(value)


def test_real_has_the_same_digits_as_in_numpy() -> None:
    """At powers of two, the REALs below are nearer than those above; the least REALs have fewer digits."""
    patterns = [exponent << 23 | least for exponent in range(255) for least in (0, 1, 2, (1 << 23) - 1)]
    numbers = np.array([*patterns, *range(1000), 0x3DCCCCCD, 0x7F7FFFFF], np.uint32).view(np.float32)
    for number in [*numbers, *-numbers]:
        assert to_text(float(number), register("REAL")) == repr(float(str(number)))


@given(st.floats(-3.4e38, 3.4e38))
@example(0.1)
def test_a_number_that_is_no_real_has_the_text_of_the_nearest_one(value: float) -> None:
    assert to_text(value, register("REAL")) == repr(float(str(np.float32(value))))


@given(st.floats(allow_nan=False))
def test_lreal_survives_a_round_trip(value: float) -> None:
    assert from_text(to_text(value, register("LREAL")), register("LREAL")) == value


@pytest.mark.parametrize(
    ("text", "type_", "value"),
    [
        ("1.0E-4", "LREAL", 1e-4),
        ("4.9E-324", "LREAL", 5e-324),
        ("1.0E10", "REAL", 1e10),
        ("5", "REAL", 5.0),
        (".5", "REAL", 0.5),
        ("5.", "REAL", 5.0),
        ("+Infinity", "REAL", math.inf),
        ("INF", "REAL", math.inf),
        ("-inf", "LREAL", -math.inf),
        ("5.0", "INT", 5),
        ("1.0E2", "BYTE", 100),
        ("9223372036854775807.0", "LINT", (1 << 63) - 1),
        ("-0.0", "INT", 0),
        (" 5 ", "INT", 5),
        ("TRUE", "BOOL", True),
        ("0", "BOOL", False),
    ],
)
def test_numbers_as_java_and_others_print_them(text: str, type_: str, value: Value) -> None:
    found = from_text(text, register(type_))
    assert (found, type(found)) == (value, type(value))


@pytest.mark.parametrize(
    ("text", "type_"),
    [
        *(
            (text, "INT")
            for text in ("", "x", "32768", "5.5", "1e5", "NaN", "1_0", "0x5", "9" * 5000, "1e9999", "\u0665")
        ),
        *((text, "REAL") for text in ("", "nans", "in", "1e39", "1e999", "1,5", "1_0", "true", "1.0f", "0x1p3")),
        *((text, "LREAL") for text in ("1e309", "Infinit")),
        *((text, "BOOL") for text in ("", "2", "yes", "1.0")),
        *((text, "STRING[3]") for text in ("abcd", "€")),
        *((text, "DATE") for text in ("", "2024-02-30")),
        ("", "DATE_AND_TIME"),
        ("x" * (1 << 21), "STRING[3]"),
    ],
)
def test_refused(text: str, type_: str) -> None:
    with pytest.raises(ValueRangeError) as caught:
        from_text(text, register(type_))
    assert len(str(caught.value)) < 200


def test_arrays() -> None:
    reals = register("REAL", ((0, 1), (0, 1)), 4)
    value: Value = [[0.10000000149011612, math.nan], [math.inf, -0.0]]
    assert to_text(value, reals) == '[[0.1,"NaN"],["Infinity",-0.0]]'
    assert repr(from_text(to_text(value, reals), reals)) == "[[0.1, nan], [inf, -0.0]]"
    assert repr(from_text("[[0.1,NaN],[Infinity,-0.0]]", reals)) == "[[0.1, nan], [inf, -0.0]]"
    bits = register("BOOL", ((0, 1),), 2)
    assert to_text([True, False], bits) == "[true,false]"
    assert from_text("[true, false]", bits) == [True, False]
    strings = register("WSTRING[5]", ((0, 1),), 2)
    assert to_text(['a"b', "€"], strings) == '["a\\"b","€"]'
    assert from_text('["a\\"b","\\u20ac"]', strings) == ['a"b', "€"]


@pytest.mark.parametrize(
    "text",
    ["", "5", "[1]", "[1,2,3]", "[1,[2]]", '["1",2]', "[1,256]", "[1,null]", "{}", "[" * 100_000, "[1,2", "[1,true]"],
)
def test_refused_arrays(text: str) -> None:
    with pytest.raises(ValueRangeError) as caught:
        from_text(text, register("BYTE", ((0, 1),), 2))
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize(
    ("types", "wire"),
    [
        (["REAL", "LREAL"], "double"),
        (["BOOL"], "bool"),
        (["BYTE", "LWORD", "SINT", "ULINT", "TIME", "LTIME", "S5TIME", "TIME_OF_DAY", "LTOD"], "int"),
        (
            ["CHAR", "WCHAR", "STRING[3]", "WSTRING[3]", "DATE", "DATE_AND_TIME", "LDT", "DTL", "POINTER", "ANY"],
            "string",
        ),
    ],
)
def test_wire_types(types: list[str], wire: str) -> None:
    assert {wire_type(register(type_)) for type_ in types} == {wire}


def test_json_numbers_are_valid_json_when_finite() -> None:
    assert json.loads(to_text([0.5, 1e30], register("LREAL", ((0, 1),), 2))) == [0.5, 1e30]
