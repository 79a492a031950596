"""Encoding of values for version 2."""

from __future__ import annotations

import math
from typing import Any

import pytest
from google.protobuf.struct_pb2 import Value

from shmio.endpoints.grpc.services.simlog_v1 import time_stamp as time_stamp_v1
from shmio.endpoints.grpc.services.simlog_v2 import (
    MAX_LEVELS,
    EncodedMessage,
    encoder,
    from_wire,
    path_field,
    time_stamp,
    to_wire,
)
from shmio.endpoints.grpc.topics import Shape, shape
from shmio.errors import ValueRangeError
from shmio.layout.model import ByteOrder, Layout, Register, array_size, element_type
from shmio.layout.topic import Topic
from shmio.layout.values.codec import codec
from shmio.wire import simlog_v1_pb2 as v1
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
        [1, [2.5, "a"], None],
    ],
)
def test_values_encode_to_equal_protobuf_values(value: Any) -> None:
    assert plain(to_wire(value)) == value


class Picture:
    """An image and its time."""

    number = 1
    clock_ns = 3_000_000_007

    def __init__(self, image: bytes) -> None:
        self.image = image


@pytest.mark.parametrize("order", ["big", "little"])
@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("REAL", [0.5, -0.0, math.nan, math.inf, -math.inf]),
        ("LREAL", [0.1, 1e300, -1.5]),
        ("BYTE", list(range(256)) * 8),
        ("SINT", [-128, 127]),
        ("UINT", [0, 65535]),
        ("DINT", [-(2**31), 2**31 - 1]),
        ("LINT", [-(2**63), 2**53]),
        ("ULINT", [2**64 - 1]),
        ("TIME", [-1, 5]),
        ("TIME_OF_DAY", [1, None]),
        ("STRING[3]", ["a", None]),
        ("BOOL", [True, False] * 5),
    ],
)
def test_an_array_is_encoded_as_a_list_of_its_values(kind: str, values: list[Any], order: ByteOrder) -> None:
    element = element_type(kind)
    assert element is not None
    bit = 0 if kind == "BOOL" else None
    size = array_size(element, (len(values),))
    register = Register("a", kind, ((1, len(values)),), 2, bit, size, len(values))
    known = [next(value for value in values if value is not None) if value is None else value for value in values]
    image = bytearray(2 + size)
    codec(register, order).encode_into(known, image)
    if None in values:
        image[2 + element.stride : 2 + element.stride + 4] = b"\xff" * 4
    layout = Layout("DB1", 1, len(image), False, (register,), order)
    encoded = encoder(shape(layout, Topic("cell", "a")), layout)(Picture(bytes(image)))
    assert encoded is not None
    message = v2.SimlogMessage.FromString(encoded.under(b""))
    assert message.type == v2.LIST
    assert repr(plain(message.value)) == repr([float(v) if type(v) is int else v for v in plain(to_wire(values))])


def test_a_structure_has_its_members_names_and_null_for_invalid_bytes() -> None:
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
    again = encode(Picture(b"\xff\xfe\2\1x\0\1\2\0"))
    assert first is not None
    assert again is not None
    assert again.rest == first.rest
    assert second is not None
    message = v2.SimlogMessage.FromString(first.under(path_field("SIM://zone")))
    assert (message.header.path, message.header.timestamp.ToNanoseconds()) == ("SIM://zone", 3_000_000_007)
    assert message.type == v2.STRUCT
    assert plain(message.value) == {"level": -2.0, "a/b": {"out": "x", "1": [1.0, 2.0]}}
    message = v2.SimlogMessage.FromString(second.under(path_field("")))
    assert plain(message.value) == {"level": 1.0, "a/b": {"out": None, "1": [1.0, 2.0]}}


def test_structures_are_readable_up_to_the_limit_of_depth() -> None:
    for levels in (MAX_LEVELS, MAX_LEVELS + 1, 5000):
        path = "/".join(["a"] * levels + ["b"])
        register = Register(path, "BYTE", ((0, 0),) * 6, 0, None, 1, 1)
        layout = Layout("DB1", 1, 1, False, (register,))
        found = shape(layout, Topic("cell", "a"))
        if levels > MAX_LEVELS:
            with pytest.raises(ValueRangeError, match="structures are nested in more than"):
                encoder(found, layout)
            continue
        encoded = encoder(found, layout)(Picture(b"\7"))
        assert encoded is not None
        message = v2.SimlogMessage.FromString(encoded.under(path_field("a")))
        assert "7.0" in str(plain(message.value))


def test_a_large_integer_can_be_given_exactly_as_text() -> None:
    counter = Shape("counter", (Register("counter", "LINT", (), 0, None, 8, 1),), whole=True)
    assert from_wire(Value(string_value=str(2**63 - 1)), counter) == {"counter": 2**63 - 1}
    assert from_wire(Value(number_value=2**53), counter) == {"counter": 2**53}


@pytest.mark.parametrize("clock_ns", [0, 1, 999_999_999, 1_000_000_000, 3_000_000_007, 2**62])
def test_time_stamps_of_both_versions_decode_to_the_same_time(clock_ns: int) -> None:
    seconds, nanos = divmod(clock_ns, 1_000_000_000)
    header = v2.SimlogMessage.FromString(EncodedMessage(time_stamp(clock_ns), b"").under(b"")).header
    assert (header.timestamp.seconds, header.timestamp.nanos) == (seconds, nanos)
    stamp = v1.ROSMessage.FromString(time_stamp_v1(2**32 + 5, clock_ns)).timeStamp
    assert (stamp.seq, stamp.stamp.sec, stamp.stamp.nsec) == (5, seconds, clock_ns)


def test_an_encoded_value_can_be_sent_under_several_paths() -> None:
    encoded = EncodedMessage(time_stamp(5), b"")
    paths = ["cell/a", "CELL://a", "cell/a", ""]
    found = [v2.SimlogMessage.FromString(encoded.under(path_field(path))).header.path for path in paths]
    assert found == paths
