"""What version 2 puts together by hand is what protobuf's own messages would be."""

from __future__ import annotations

import math
from typing import Any

import pytest
from google.protobuf.struct_pb2 import Value

from shmio.endpoints.grpc.values import MAX_LEVELS, encoder, from_wire, path_field, shape, time_stamp, to_wire
from shmio.errors import ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import Topic
from shmio.wire import simlog_v2_pb2 as v2
from tests.unit.endpoints.harness import plain


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        False,
        0,
        1,
        -1,
        0.5,
        1e300,
        2**63,
        "",
        "M\u00fcller \U0001f600",
        "x" * 300,
        [],
        [1, [2.5, "a"], None],
    ],
)
def test_a_value_is_protobufs_value(value: Any) -> None:
    assert plain(Value.FromString(to_wire(value))) == value


def test_numbers_that_are_none() -> None:
    assert math.isnan(Value.FromString(to_wire(math.nan)).number_value)
    assert Value.FromString(to_wire(-math.inf)).number_value == -math.inf
    assert math.copysign(1, Value.FromString(to_wire(-0.0)).number_value) == -1


class Picture:
    """An image and its time."""

    number = 1
    clock_ns = 3_000_000_007

    def __init__(self, image: bytes) -> None:
        self.image = image


def test_a_structure_has_the_names_of_its_members_and_null_for_bytes_that_are_no_value() -> None:
    registers = (
        Register("zone/level", "INT", (), 0, None, 2, 1),
        Register("zone/a%2Fb/%6Fut", "STRING[2]", (), 2, None, 4, 1),
        Register("zone/a%2Fb/1", "BYTE", ((0, 1),), 6, None, 2, 2),
        Register("other", "BYTE", (), 8, None, 1, 1),
    )
    layout = Layout("DB1", 1, 9, False, registers)
    found = shape(layout, Topic("cell", "zone"))
    encode = encoder(found, layout)
    first = encode(Picture(b"\xff\xfe\2\1x\0\1\2\0"))
    second = encode(Picture(b"\0\1\2\3x\0\1\2\0"))
    assert first is not None
    assert second is not None
    message = v2.SimlogMessage.FromString(first.under(path_field("SIM://zone")))
    assert (message.header.path, message.header.timestamp.ToNanoseconds()) == ("SIM://zone", 3_000_000_007)
    assert message.type == v2.STRUCT
    assert plain(message.value) == {"level": -2.0, "a/b": {"out": "x", "1": [1.0, 2.0]}}
    message = v2.SimlogMessage.FromString(second.under(path_field("")))
    assert plain(message.value) == {"level": 1.0, "a/b": {"out": None, "1": [1.0, 2.0]}}


def test_the_deepest_structure_can_be_read_and_a_deeper_one_is_refused() -> None:
    for levels in (MAX_LEVELS, MAX_LEVELS + 1, 5000):
        path = "/".join(["a"] * levels + ["b"])
        register = Register(path, "BYTE", ((0, 0),) * 6, 0, None, 1, 1)
        layout = Layout("DB1", 1, 1, False, (register,))
        found = shape(layout, Topic("cell", "a"))
        if levels > MAX_LEVELS:
            with pytest.raises(ValueRangeError, match="structures within each other"):
                encoder(found, layout)
            continue
        encoded = encoder(found, layout)(Picture(b"\7"))
        assert encoded is not None
        message = v2.SimlogMessage.FromString(encoded.under(path_field("a")))
        assert "7.0" in str(plain(message.value))


@pytest.mark.parametrize("clock_ns", [0, 1, 999_999_999, 10**9, 123_456_789_012_345_678])
def test_time_is_ns_since_the_start(clock_ns: int) -> None:
    assert v2.Header.FromString(time_stamp(clock_ns)).timestamp.ToNanoseconds() == clock_ns


def test_a_text_has_all_digits_of_a_long_number() -> None:
    register = Register("counter", "LINT", (), 0, None, 8, 1)
    assert from_wire(Value(string_value=str(2**63 - 1)), register) == 2**63 - 1
    assert from_wire(Value(number_value=2**53), register) == 2**53
