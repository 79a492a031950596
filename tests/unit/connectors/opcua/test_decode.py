"""Messages as asyncua encodes them, and every kind of damage to them."""

from __future__ import annotations

import contextlib
import struct
import time
import tracemalloc
import uuid
from datetime import UTC, datetime
from typing import Any

import pytest
from asyncua import ua
from asyncua.ua.ua_binary import struct_to_binary
from hypothesis import given
from hypothesis import strategies as st

from shmio.connectors.opcua import decode
from shmio.connectors.opcua.decode import Extension, FaultError, MalformedError, Sample
from shmio.connectors.opcua.values import ValueConverter
from shmio.connectors.register_image import RegisterImage
from shmio.errors import ValueRangeError
from shmio.layout.tags import place_tags
from shmio.layout.values import calendar
from shmio.layout.values.codec import codec
from shmio.model.statuses import BAD_DECODING_ERROR, BAD_OUT_OF_RANGE, StatusArea

NOON = datetime(2024, 2, 29, 12, 34, 56, 789012, UTC)
NOON_NS = 1_709_210_096_789_012_000
Type = ua.VariantType
GUID = uuid.UUID("72962b91-fa75-4ae6-8d28-b404dc7daf63")
VALUES: list[tuple[ua.Variant, Any]] = [
    (ua.Variant(True, Type.Boolean), True),
    (ua.Variant(-128, Type.SByte), -128),
    (ua.Variant(255, Type.Byte), 255),
    (ua.Variant(-32768, Type.Int16), -32768),
    (ua.Variant(65535, Type.UInt16), 65535),
    (ua.Variant(-1, Type.Int32), -1),
    (ua.Variant(4294967295, Type.UInt32), 4294967295),
    (ua.Variant(-(1 << 63), Type.Int64), -(1 << 63)),
    (ua.Variant((1 << 64) - 1, Type.UInt64), (1 << 64) - 1),
    (ua.Variant(0.5, Type.Float), 0.5),
    (ua.Variant(0.1, Type.Double), 0.1),
    (ua.Variant("Größe", Type.String), "Größe"),
    (ua.Variant(None, Type.String), ""),
    (ua.Variant(NOON, Type.DateTime), NOON_NS),
    (ua.Variant(GUID, Type.Guid), str(GUID)),
    (ua.Variant(b"\0\1", Type.ByteString), b"\0\1"),
    (ua.Variant(ua.NodeId("x", 3), Type.NodeId), "ns=3;s=x"),
    (ua.Variant(ua.NodeId(85, 0), Type.NodeId), "i=85"),
    (ua.Variant(ua.NodeId(70000, 300), Type.NodeId), "ns=300;i=70000"),
    (ua.Variant(ua.NodeId(GUID, 2), Type.NodeId), f"ns=2;g={GUID}"),
    (ua.Variant(ua.NodeId(b"\1\2", 2), Type.NodeId), "ns=2;b=AQI="),
    (ua.Variant(ua.StatusCode(0x80340000), Type.StatusCode), 0x80340000),
    (ua.Variant(ua.QualifiedName("Speed", 2), Type.QualifiedName), "Speed"),
    (ua.Variant(ua.LocalizedText("Tür", "de"), Type.LocalizedText), "Tür"),
    (ua.Variant([1, 2, 3], Type.Int16), [1, 2, 3]),
    (ua.Variant(["a", "b"], Type.String), ["a", "b"]),
]


def read(*values: ua.DataValue) -> bytes:
    response = ua.ReadResponse()
    response.Results = list(values)
    return bytes(struct_to_binary(response))


@pytest.mark.parametrize(("variant", "value"), VALUES)
def test_values_of_all_types(variant: ua.Variant, value: Any) -> None:
    (sample,) = decode.read_response(read(ua.DataValue(variant)))
    assert (sample.kind, sample.value, sample.code) == (variant.VariantType.value, value, 0)
    assert sample.dims == ((len(value),) if isinstance(value, list) else None)


def test_status_times_and_dimensions() -> None:
    several = ua.DataValue(
        ua.Variant([[1, 2, 3], [4, 5, 6]], Type.Int32, [2, 3]), ua.StatusCode(0x40900000), NOON, NOON, 7, 8
    )
    served = ua.DataValue(ua.Variant(1, Type.Byte), ServerTimestamp=NOON)
    structure = ua.DataValue(ua.Variant(ua.ExtensionObject(ua.NodeId("t", 2), b"abc"), Type.ExtensionObject))
    nothing = ua.DataValue(ua.Variant(None), ua.StatusCode(0x80340000))
    first, second, third, fourth = decode.read_response(read(several, served, structure, nothing))
    assert first == Sample(decode.INT32, [1, 2, 3, 4, 5, 6], (2, 3), 0x40900000, NOON_NS)
    assert second.source_ns == NOON_NS
    assert third.value == Extension(b"\3\2\0\1\0\0\0t", b"abc")
    assert (fourth.kind, fourth.code) == (0, 0x80340000)


def published(*notifications: Any) -> bytes:
    response = ua.PublishResponse()
    response.Parameters.SubscriptionId = 5
    response.Parameters.AvailableSequenceNumbers = [1, 2]
    response.Parameters.NotificationMessage.SequenceNumber = 9
    response.Parameters.NotificationMessage.NotificationData = list(notifications)
    response.Parameters.Results = [ua.StatusCode(0)]
    return bytes(struct_to_binary(response))


def test_publications() -> None:
    changes = ua.DataChangeNotification()
    changes.MonitoredItems = [ua.MonitoredItemNotification(n, ua.DataValue(ua.Variant(n, Type.Int32))) for n in (3, 4)]
    found = decode.publish_response(published(changes))
    assert (found.subscription, found.sequence, found.keep_alive, found.closed) == (5, 9, False, 0)
    assert [(index, sample.value) for index, sample in found.values] == [(3, 3), (4, 4)]
    assert decode.publish_response(published()).keep_alive
    ended = ua.StatusChangeNotification(ua.StatusCode(0x800A0000))
    assert decode.publish_response(published(ended)).closed == 0x800A0000


def test_faults_and_other_answers() -> None:
    fault = ua.ServiceFault()
    fault.ResponseHeader.ServiceResult = ua.StatusCode(0x80780000)
    with pytest.raises(FaultError) as raised:
        decode.publish_response(bytes(struct_to_binary(fault)))
    assert raised.value.code == 0x80780000
    with pytest.raises(MalformedError):
        decode.publish_response(read())


WHOLE = read(*(ua.DataValue(variant, ua.StatusCode(0), NOON, NOON) for variant, _ in VALUES))


def test_a_part_of_a_message_is_no_message() -> None:
    cut = len(WHOLE) - 4  # the array of diagnostics at the end is not read
    for size in range(cut):
        with pytest.raises(MalformedError):
            decode.read_response(WHOLE[:size])


@given(st.integers(0, len(WHOLE) - 1), st.binary(min_size=1, max_size=8))
def test_damaged_messages_are_values_or_malformed(at: int, noise: bytes) -> None:
    with contextlib.suppress(MalformedError, FaultError):
        decode.read_response(WHOLE[:at] + noise + WHOLE[at + len(noise) :])


HEADER = read()[:-8]


@pytest.mark.parametrize(
    "value",
    [
        struct.pack("<BBi", 1, 0x80, 0x7FFFFFFF),  # an array of nothing
        struct.pack("<BBi", 1, 0x80 | 1, 0x7FFFFFFF),
        struct.pack("<BBi", 1, 0x80 | 12, 0x7FFFFFFF),
        struct.pack("<BBi", 1, 12, 0x7FFFFFFF),
        struct.pack("<BBiBi", 1, 0x80 | 0x40 | 3, 1, 0, 0x7FFFFFFF),
        b"\1" + b"\x18" * 5000 + b"\1\1",
        b"\1\x17" * 5000 + b"\1\1",
        b"\1\x3f",
    ],
)
def test_what_asks_for_too_much_is_malformed_at_once(value: bytes) -> None:
    tracemalloc.start()
    begun = time.monotonic()
    try:
        with pytest.raises(MalformedError):
            decode.read_response(HEADER + struct.pack("<i", 1) + value)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()
    assert time.monotonic() - begun < 5


def test_a_value_whose_dimensions_do_not_fit_is_bad_alone() -> None:
    """OPC 10000-6, section 5.2.2.16: inconsistent dimensions are a decoding error."""
    good = b"\1\6\x2a\0\0\0"
    huge = struct.pack("<iii", 2, 0x7FFFFFFF, 0x7FFFFFFF)
    for dims in (
        bytes.fromhex("02000000 02000000 02000000"), bytes.fromhex("02000000 01000000 02000000"),
        bytes.fromhex("01000000 02000000"), struct.pack("<iii", 2, 3, 0), struct.pack("<iii", 2, -1, -3), huge,
        struct.pack("<iiii", 3, 3, 0x7FFFFFFF, 0x7FFFFFFF),
    ):  # fmt: skip
        wrong = bytes.fromhex("01 c1 03000000 00 01 00") + dims
        bad, fine = decode.read_response(HEADER + struct.pack("<i", 2) + wrong + good)
        assert (bad.kind, bad.value, bad.code) == (0, None, BAD_DECODING_ERROR)
        assert (fine.value, fine.code) == (42, 0)
    for dims, sizes in (
        (struct.pack("<i", 0), (3,)), (struct.pack("<ii", 1, 3), (3,)), (struct.pack("<iii", 2, 1, 3), (1, 3)),
    ):  # fmt: skip
        (found,) = decode.read_response(HEADER + struct.pack("<i", 1) + bytes.fromhex("01 c1 03000000 00 01 00") + dims)
        assert (found.dims, found.value, found.code) == (sizes, [False, True, False], 0)


TICKS = {  # 100 ns since 1601, computed with GNU date: the usual "no end", and what the standard sends for later times
    2_650_467_743_990_000_000: "9999-12-31T23:59:59.000000000",
    2_650_467_744_000_000_000 - 1: "9999-12-31T23:59:59.000000000",
    (1 << 63) - 1: "9999-12-31T23:59:59.000000000",
    208_678_456_368_547_758: "2262-04-11T23:47:16.854775800",
    208_678_456_368_547_759: "2262-04-11T23:47:16.854775900",
}


def test_times_after_2262_are_no_earlier_times() -> None:
    layout = place_tags("device", {n: {"type": n, "address": "i=1"} for n in ("DTL", "LDT")}).with_statuses()
    for ticks, text in TICKS.items():
        answer = HEADER + struct.pack("<iBBqqq", 1, 0x0D, decode.DATE_TIME, ticks, ticks, 116_444_736_000_000_010)
        (sample,) = decode.read_response(answer)
        assert calendar.format_moment(sample.value, 9) == text
        image = RegisterImage(layout)
        for index, register in enumerate(layout.registers):
            with contextlib.suppress(ValueRangeError):
                image.put(index, ValueConverter(register).value(sample), 0)
        dtl, ldt = (StatusArea(layout).get(bytes(image), index) for index in range(2))
        assert (codec(layout.registers[0], layout.byte_order).decode(bytes(image)), dtl.code) == (text, 0)
        assert ldt.code == (0 if text < "2262-04-11T23:47:16.8547758070" else BAD_OUT_OF_RANGE)
        # A status cannot hold such a timestamp, so the server's applies.
        assert sample.source_ns == (sample.value if text < "2262-04-11T23:47:16.8547758070" else 1000)
