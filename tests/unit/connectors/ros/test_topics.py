"""What messages mean, without a server: shapes, layouts, base64 and stamps."""

from __future__ import annotations

import base64
import logging
from typing import Any

import pytest

from shmio.connectors.browsing import Wanted
from shmio.connectors.ros.browse import Seen, browsed
from shmio.connectors.ros.commands import plan
from shmio.connectors.ros.options import TopicOptions
from shmio.connectors.ros.topics import Topics
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.write import encode
from shmio.model.statuses import (
    BAD_INDEX_RANGE_NO_DATA,
    BAD_OUT_OF_RANGE,
    BAD_TYPE_MISMATCH,
    GOOD,
    UNREADABLE_TIME,
    RegisterStatus,
    StatusArea,
)
from tests.unit.connectors.source import layout_of

TABLE = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
FLAT = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]


class Robot:
    """Topics, and the messages that they get."""

    def __init__(self, tags: dict[str, Any]) -> None:
        self.topics = Topics(layout_of(tags), TopicOptions(max_age=0), known_types=False)

    def publish(self, topic: str, message: Any) -> None:
        self.topics.take(topic, message, 1, 5)

    def status(self, path: str) -> RegisterStatus:
        layout = self.topics.layout
        return StatusArea(layout).get(self.topics.image(2), layout.by_path[path])

    def value(self, path: str) -> Value:
        layout = self.topics.layout
        return codec(layout.registers[layout.by_path[path]], layout.byte_order).decode(self.topics.image(2))


def multi(data: list[float], *dims: tuple[int, int], offset: int = 0) -> dict[str, Any]:
    """Return a MultiArray; each dimension is (size, stride)."""
    sizes = [{"label": "", "size": size, "stride": stride} for size, stride in dims]
    return {"layout": {"dim": sizes, "data_offset": offset}, "data": data}


def test_shapes() -> None:
    """The element (i, j) of a MultiArray is data[data_offset + dim[1].stride * i + j], as its definition says."""
    shape = "ARRAY[0..1, 0..2] OF LREAL"
    robot = Robot({"m": (shape, "/m std_msgs/Float64MultiArray data"), "u": (shape, "/u any_msgs/Thing inner.data")})
    padded = [0.0, 1.0, 2.0, 3.0, 0.0, 4.0, 5.0, 6.0]
    for message, code in (
        (multi(FLAT), GOOD), (multi(FLAT, (6, 6)), GOOD), (multi(FLAT, (2, 6), (3, 3)), GOOD),
        (multi(FLAT, (2, 0), (3, 0)), GOOD), (multi([9.0, *FLAT], (2, 6), (3, 3), offset=1), GOOD),
        (multi(padded, (2, 8), (3, 4), offset=1), GOOD),
        (multi(FLAT, (3, 6), (2, 2)), BAD_INDEX_RANGE_NO_DATA), (multi(FLAT, (1, 6), (6, 6)), BAD_INDEX_RANGE_NO_DATA),
        (multi(FLAT, (2, 6), (3, 4)), BAD_INDEX_RANGE_NO_DATA), (multi(FLAT, (3, 3)), BAD_INDEX_RANGE_NO_DATA),
        (multi(FLAT, (2, 6), (3, 3), offset=1), BAD_INDEX_RANGE_NO_DATA),
        (multi(FLAT, (-2, 6), (-3, 3)), BAD_INDEX_RANGE_NO_DATA), (multi(FLAT, (0, 0)), BAD_INDEX_RANGE_NO_DATA),
        (multi(FLAT, *[(2, 2)] * 40), BAD_INDEX_RANGE_NO_DATA),
        (multi(FLAT, (1 << 62, 6), (3, 3)), BAD_INDEX_RANGE_NO_DATA),
        (multi(TABLE[0], (2, 6), (3, 3)), BAD_INDEX_RANGE_NO_DATA),
        (multi([*FLAT, 7.0, 8.0], (2, 6), (3, 3)), BAD_INDEX_RANGE_NO_DATA),
    ):  # fmt: skip
        for path, topic, given in (("m", "/m", message), ("u", "/u", {"inner": message})):
            robot.publish(topic, given)
            assert robot.status(path).code == code, (path, message)
            assert robot.value(path) == TABLE
    nested: tuple[Any, ...] = ((TABLE, GOOD), ([[1, 2], [3, 4], [5, 6]], BAD_INDEX_RANGE_NO_DATA))
    for found, code in (*nested, ([1, [2]], BAD_INDEX_RANGE_NO_DATA), ([TABLE[0], [4, 5, [6]]], BAD_TYPE_MISMATCH)):
        robot.publish("/u", {"inner": {"data": found}})
        assert robot.status("u").code == code, found


def test_browsing_offers_the_shape_that_a_layout_states() -> None:
    for message, kind in (
        (multi(FLAT, (2, 6), (3, 3)), "ARRAY[0..1, 0..2] OF LREAL"), (multi(FLAT), "ARRAY[0..5] OF LREAL"),
        (multi(FLAT, (6, 6)), "ARRAY[0..5] OF LREAL"), (multi(FLAT, (3, 6), (3, 3)), ""),
    ):  # fmt: skip
        seen = Seen("std_msgs/Float64MultiArray", published=True)
        seen.message = message
        (offer,) = browsed({"/m": seen}, Wanted(), "").offers
        assert (offer.type, bool(offer.refused)) == (kind, not kind), message


def test_a_write_does_not_contradict_the_layout_of_the_last_message() -> None:
    address = "/m std_msgs/Float64MultiArray data"
    robot = Robot({"m": {"type": "ARRAY[0..1, 0..2] OF LREAL", "address": address, "writable": True}})
    register = robot.topics.layout.registers[0]
    writes = encode(register, TABLE, robot.topics.layout.byte_order)
    for message, right in (
        (multi([0.0] * 6, (2, 6), (3, 3)), True), (multi([0.0] * 6, (3, 6), (2, 2)), False),
        (multi([0.0] * 8, (2, 8), (3, 4)), False), (multi([]), True),
    ):  # fmt: skip
        robot.publish("/m", message)
        publications, _ = plan(robot.topics, writes)
        found = publications[0].message
        assert found["data"] == FLAT
        assert found["layout"] == (message["layout"] if right else multi([])["layout"])


def test_bytes_of_unknown_types_are_base64() -> None:
    tags = {
        "all": ("ARRAY[0..3] OF BYTE", "/u any_msgs/Image data"), "one": ("USINT", "/u any_msgs/Image data[3]"),
        "text": ("STRING[9]", "/u any_msgs/Image data"),
    }  # fmt: skip
    robot = Robot(tags)
    robot.publish("/u", {"data": base64.b64encode(bytes([0, 1, 254, 255])).decode()})
    assert (robot.value("all"), robot.value("one"), robot.value("text")) == ([0, 1, 254, 255], 255, "AAH+/w==")
    for wrong, code in (("AAH+", BAD_INDEX_RANGE_NO_DATA), ("é", BAD_TYPE_MISMATCH), (7, BAD_TYPE_MISMATCH)):
        robot.publish("/u", {"data": wrong})
        assert (robot.status("all").code, robot.status("one").code) == (code, code), wrong


def test_a_stamp_that_is_no_time_is_uncertain(caplog: pytest.LogCaptureFixture) -> None:
    field = "/s geometry_msgs/TwistStamped twist.linear."
    robot = Robot({name: ("LREAL", f"{field}{name}") for name in "xyz"})
    twist = {"linear": {"x": 1.0, "y": 2.0, "z": 3.0}}
    for stamp, code, source_ns in (
        ({"sec": 7, "nanosec": 1}, GOOD, 7_000_000_001), ({"secs": 7, "nsecs": 1}, GOOD, 7_000_000_001),
        ({"sec": 0, "nanosec": 0}, GOOD, 5), ({"sec": -1, "nanosec": 0}, UNREADABLE_TIME, 5),
        ({"sec": 1, "nanosec": 10**9}, UNREADABLE_TIME, 5), ({"sec": "7"}, UNREADABLE_TIME, 5),
    ):  # fmt: skip
        robot.publish("/s", {"header": {"stamp": stamp}, "twist": twist})
        assert [robot.status(name) for name in "xyz"] == [(code, source_ns)] * 3, stamp
        assert robot.value("z") == 3.0
    assert len(caplog.records) == 1


def test_a_value_that_does_not_fit_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    robot = Robot({"n": ("SINT", "/n std_msgs/Int32 data"), "x": ("LREAL", "/x any_msgs/Thing x")})
    with caplog.at_level(logging.WARNING):
        robot.publish("/n", {"data": 300})
        robot.publish("/x", {"x": 1 << 2000})
        assert (robot.status("n").code, robot.status("x").code) == (BAD_OUT_OF_RANGE, BAD_OUT_OF_RANGE)
    assert [record.getMessage().split(":")[0] for record in caplog.records] == ["n", "x"]
