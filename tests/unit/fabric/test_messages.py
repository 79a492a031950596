"""Messages of the fabric: they keep every field, and malformed ones raise ValueError."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.fabric.messages import (
    CommandReply,
    CommandRequest,
    Header,
    WriteItem,
    decode_entries,
    decode_header,
    decode_reply,
    decode_request,
    encode,
    encode_command,
    with_age,
)
from shmio.recording.format.encoding import Gap, Reason
from shmio.segment import Event, Frame, Provenance, Quality

FRAME = Frame(
    7, 70, 1_000, 900, 1_700_000_000, 3, Quality.UNCERTAIN, Provenance.SIMULATED, 4, 55, "doubt",
    bytes(range(200)) * 11, bytes(2200),
)  # fmt: skip
EVENT = Event(
    4, 4, 7, 70, 1_000, 900, 1_700_000_000, 3, Quality.GOOD, 5, 99, 1, 2, 8, 0, 2, b"\1\2", "", 12, "web: x (::1)"
)  # fmt: skip
GAP = Gap("cell", 1, "frames", 3, 6, 4, Reason.OVERTAKEN)
HEADER = Header(3, 1 << 60, 12, b"abcdefgh", 1_700_000_000_000, 5, -1_600_000_000_000)


def test_a_message_keeps_all_entries_in_order() -> None:
    data = encode(HEADER, [EVENT, FRAME, GAP, FRAME])
    assert decode_header(bytes(data)) == HEADER
    assert list(decode_entries(bytes(data))) == [EVENT, FRAME, GAP, FRAME]


def test_the_age_of_a_message_can_change() -> None:
    data = with_age(encode(HEADER, [FRAME]), 30_000_000_000)
    assert decode_header(data) == HEADER._replace(age_ns=30_000_000_000)
    assert list(decode_entries(data)) == [FRAME]


def test_entries_of_a_newer_version_are_skipped() -> None:
    data = encode(HEADER, [FRAME]) + b"\x09\x03\0\0\0abc"
    assert list(decode_entries(bytes(data))) == [FRAME]


def test_a_message_of_another_version_is_refused() -> None:
    data = encode(HEADER, [])
    data[0] = 2
    with pytest.raises(ValueError, match="version 2"):
        decode_header(bytes(data))


@given(st.data())
def test_damaged_messages_raise_value_error_only(data: st.DataObject) -> None:
    whole = encode(HEADER, [EVENT, FRAME, GAP])
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    cut = bytes(whole[: data.draw(st.integers(0, len(whole)))])
    try:
        decode_header(cut)
        entries = list(decode_entries(cut))
    except ValueError:
        return
    assert all(isinstance(one, Frame | Event | Gap) for one in entries)


@given(st.binary(max_size=300))
def test_any_bytes_are_a_message_or_a_value_error(data: bytes) -> None:
    for decode in (
        decode_header,
        decode_request,
        lambda one: decode_reply(one, 1),
        lambda one: list(decode_entries(one)),
    ):
        try:
            decode(data)
        except ValueError:
            continue


def test_commands_and_replies_keep_their_fields() -> None:
    request = CommandRequest(5, 7, b"abcdefgh", [WriteItem(3, 0, b"\1\2"), WriteItem(4, 8, b"\x08")])
    assert decode_request(encode_command(request)) == request
    reply = CommandReply(["written", "unknown"], ["", "no answer"])
    assert decode_reply(encode_command(reply), 2) == reply
    with pytest.raises(ValueError, match="outcomes"):
        decode_reply(encode_command(reply), 3)
