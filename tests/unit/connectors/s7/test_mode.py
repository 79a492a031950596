"""The operating mode: its query, the doubt that follows from its answer, and controllers that do not answer."""

from __future__ import annotations

import contextlib
import logging
import re
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.connectors.s7.mode import INTERVAL_NS, ModeQuery
from shmio.errors import ConnectorError
from tests.unit.connectors.s7 import noise as frames


def answer(
    mode: int = 0x48,
    *,
    code: int = 0xFF,
    szl: int = 0x0424,
    records: int = 1,
    error: int = 0,
    identity: int = 0x4302,
) -> memoryview:
    record = struct.pack(">HBB16x", identity, 0xFF, mode) if records else b""
    data = struct.pack(">HHHH", szl, 0, 20, records) + record
    parameters = bytes.fromhex("000112 08 12 84 01 05 00 00") + struct.pack(">H", error)
    body = parameters + struct.pack(">BBH", code, 9, len(data)) + data
    head = struct.pack(">BxH3s BBHHHH", 3, 17 + len(body), b"\x02\xf0\x80", 0x32, 7, 0, 1, 12, len(body) - 12)
    return memoryview(head + body)


def test_the_request() -> None:
    question = ModeQuery()
    question.begin(0, 10)
    wanted = "03000021 02f080 32 07 0000 0102 0008 0008 00 01 12 04 11 44 01 00 ff 09 0004 0424 0000"
    assert question.take(1, 0x0102) == bytes.fromhex(wanted)


@pytest.mark.parametrize(
    ("mode", "doubt"),
    [
        (0x48, ""),
        (0x09, ""),  # RUN, as half of a redundant pair
        (0x0B, ""),
        (0x00, ""),
        (0x84, r"^the PLC is in STOP: .*switch it to RUN$"),
        (0x03, "in STOP"),
        (0x56, "starting up"),
        (0x8A, "on HOLD"),
        (0x0D, "DEFECTIVE"),
    ],
)
def test_doubt_of_each_mode(mode: int, doubt: str) -> None:
    question = ModeQuery()
    question.begin(0, 10)
    question.accept(0, answer(mode))
    assert question.complete
    assert re.search(doubt or "^$", question.doubt)


def test_the_record_of_a_real_cpu_in_run() -> None:
    question = ModeQuery()
    question.begin(0, 10)
    question.accept(0, answer(0x08, identity=0x5144))  # in a capture: 5144ff08
    assert question.doubt == ""


def test_mode_is_asked_once_an_interval() -> None:
    question = ModeQuery()
    assert question.due(5)
    question.begin(5, 100)
    assert not question.due(5 + INTERVAL_NS)  # while the query is under way
    assert [question.overdue(now) for now in (99, 100)] == [False, True]
    question.accept(0, answer())
    assert not question.overdue(100)
    assert [question.due(5 + INTERVAL_NS - 1), question.due(5 + INTERVAL_NS)] == [False, True]


@pytest.mark.parametrize(
    "unknown",
    [
        answer(code=0x0A),
        answer(error=0xD401),
        answer(records=0),
        memoryview(
            bytes.fromhex("03000021 02f080 32 07 0000 0001 000c 0004 000112 08 12 84 01 00 0000 8104 0a 00 0000")
        ),
        memoryview(bytes.fromhex("03000013 02f080 32 02 0000 0001 0000 0000 81 04")),
    ],
)
def test_controller_without_a_mode_is_asked_in_each_session(
    unknown: memoryview, caplog: pytest.LogCaptureFixture
) -> None:
    """The missing mode is logged once, at level DEBUG."""
    caplog.set_level(logging.DEBUG, "shmio.source")
    question = ModeQuery()
    told = [question.unknown]
    for _ in range(2):
        assert question.due(0)
        question.begin(0, 10)
        question.accept(0, unknown)
        told.append(question.unknown)
        assert question.doubt == ""
        assert not question.due(10 * INTERVAL_NS)
        question.lost()
        told.append(question.unknown)
    assert told == [False, True, False, True, False]
    assert [record.levelname for record in caplog.records] == ["DEBUG"]


def test_controller_that_closes_the_connection_is_not_asked_again() -> None:
    question = ModeQuery()
    for attempt in range(2):
        assert question.due(0), attempt
        question.begin(0, 10)
        question.lost()
    assert not question.due(10 * INTERVAL_NS)


def test_controller_that_has_answered_is_asked_again_after_lost_connections() -> None:
    question = ModeQuery()
    question.begin(0, 10)
    question.accept(0, answer(0x84))
    assert question.doubt
    for _ in range(5):
        question.lost()
        assert question.doubt == ""  # the mode is unknown now
        assert question.due(0)
        question.begin(0, 10)


def test_connections_lost_without_any_answer_say_nothing_of_the_question() -> None:
    question = ModeQuery()
    for _ in range(5):
        assert question.due(0)
        question.begin(0, 10)
        question.lost(alive=False)
    assert question.supported


GOOD = bytes(answer())


def changed(**at: int) -> memoryview:
    data = bytearray(GOOD)
    for place, value in at.items():
        data[int(place[1:])] = value
    return memoryview(data)


@pytest.mark.parametrize(
    "frame",
    [
        changed(_5=0x80),
        changed(_7=0x72),
        changed(_8=1),
        changed(_8=3, _17=0, _18=0),
        changed(_14=8),
        changed(_16=4),
        changed(_22=0x44),
        changed(_23=2),
        changed(_32=5),
        changed(_34=0x25),
        memoryview(GOOD[:16]),
    ],
)
def test_refuses_a_wrong_answer(frame: memoryview) -> None:
    question = ModeQuery()
    question.begin(0, 10)
    with pytest.raises(ConnectorError):
        question.accept(0, frame)
    assert question.mode is None


@given(frames.answers(7, GOOD[17:29], GOOD[29:]) | frames.answers(3, b"", GOOD[29:]) |
       st.binary(min_size=7, max_size=80) | st.builds(lambda cut, tail: (GOOD[:cut] + tail).ljust(7, b"\0"),
       st.integers(0, 61), st.binary(max_size=30)))  # fmt: skip
def test_noise_gives_a_mode_or_none_or_a_connector_error(noise: bytes) -> None:
    question = ModeQuery()
    question.begin(0, 10)
    with contextlib.suppress(ConnectorError):
        question.accept(0, memoryview(noise))
        assert question.mode is None or 0 <= question.mode <= 15
