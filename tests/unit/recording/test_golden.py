"""The golden recordings in tests/golden/dump: later versions must read them in the same way."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader

import shmio
from shmio.recording.check import check
from shmio.recording.format import _frames
from shmio.recording.format.encoding import (
    EVENT,
    FRAME,
    FRAME_V2,
    GAP,
    PROCESS,
    STEP,
    Gap,
    decode_event,
    decode_frame,
    decode_gap,
    decode_process,
    decode_step,
    encode_event,
    encode_frame,
    encode_json,
    restore,
)
from shmio.recording.reading.reader import Reader

GOLDEN = Path(__file__).parents[2] / "golden/dump"
FILES = ["closed.mem", "killed.mem"]
DIFFERENCES = "differences.mem"
"""Name of a file with the content of ``closed.mem``, but frames in the second version of the encoding."""
CODECS: dict[str, tuple[Callable[[bytes], Any], Callable[[Any], bytes]]] = {
    FRAME: (decode_frame, encode_frame),
    EVENT: (decode_event, encode_event),
    GAP: (decode_gap, encode_json),
    STEP: (decode_step, encode_json),
    PROCESS: (decode_process, encode_json),
}


def described(file: Path) -> dict[str, Any]:
    """Return a file's whole content as JSON, with bytes in hexadecimal."""

    def plain(value: Any) -> Any:
        return value.hex() if isinstance(value, bytes) else str(value)

    with Reader(file) as reader:
        messages = list(reader.messages())
        layouts = {
            channel.source: reader.layout(channel).to_json().decode()
            for channel in reader.channels.values()
            if channel.encoding == FRAME
        }
        items = [
            {
                "topic": message.channel.topic,
                "time": message.log_ns,
                "item": json.loads(
                    json.dumps(
                        message.item._asdict()
                        if hasattr(message.item, "_asdict")
                        else msgspec.structs.asdict(message.item),
                        default=plain,
                    )
                ),
            }
            for message in messages
        ]
        for message in items:
            if message["item"].get("by") == "":  # the files are from before events had a sender
                del message["item"]["by"]
        return {"about": reader.about, "closed": reader.records.closed, "layouts": layouts, "messages": items}


@pytest.mark.parametrize("name", FILES)
def test_the_whole_content_is_read_as_written(name: str) -> None:
    assert described(GOLDEN / name) == json.loads((GOLDEN / name).with_suffix(".json").read_text())


@pytest.mark.parametrize("name", FILES)
def test_every_message_is_encoded_to_the_same_bytes(name: str) -> None:
    kinds = set()
    with Reader(GOLDEN / name) as reader:
        for record in reader.records.walk():
            if record.opcode == Opcode.CHUNK:
                for channel, _, data in reader.raw(record):
                    decode, encode = CODECS[channel.encoding]
                    assert encode(decode(bytes(data))) == data
                    kinds.add(channel.encoding)
        assert check(reader).whole
    assert kinds == CODECS.keys() - ({STEP} if name == "killed.mem" else set()), "only the last chunk has steps"


@pytest.mark.parametrize("name", FILES)
def test_open_dump_reads_the_same_content(name: str) -> None:
    expected = json.loads((GOLDEN / name).with_suffix(".json").read_text())["messages"]
    with shmio.open_dump(GOLDEN / name) as dump:
        entries = list(dump.items())
        assert [entry.time_ns for entry in entries] == [message["time"] for message in expected]
        counts = [message["item"]["number"] for message in expected if message["topic"] == "cell/frames"]
        assert dump.columns("cell/count").number.tolist() == counts
        assert [entry.item.count for entry in entries if isinstance(entry.item, Gap)] == [3]


def test_frames_of_the_second_version_are_equal() -> None:
    """The files are compared as messages, as frames, and as batches."""
    expected = json.loads((GOLDEN / "closed.json").read_text())
    found = described(GOLDEN / DIFFERENCES)
    for part in ("closed", "layouts", "messages"):
        assert found[part] == expected[part]
    with shmio.open_dump(GOLDEN / DIFFERENCES) as dump, shmio.open_dump(GOLDEN / "closed.mem") as first:
        for source in first.sources:
            assert [entry.item for entry in dump.frames(source)] == [entry.item for entry in first.frames(source)]
            some, others = (b"".join(b.records.tobytes() for _, b in d.batches(source)) for d in (dump, first))
            assert some == others
        with Reader(GOLDEN / DIFFERENCES) as reader:
            assert check(reader).whole


def test_frames_of_the_second_version_are_encoded_to_the_same_bytes() -> None:
    """The mcap library reads both files, and frames of the first version are converted."""
    messages: list[list[tuple[Any, ...]]] = []
    for name in ("closed.mem", DIFFERENCES):
        with (GOLDEN / name).open("rb") as stream:
            found = NonSeekingReader(stream, validate_crcs=True).iter_messages(log_time_order=False)
            messages.append([(channel.message_encoding, message) for _, channel, message in found])
    frames = 0
    for (encoding, one), (second, other) in zip(*messages, strict=True):
        times = one.sequence, one.log_time, one.publish_time
        assert times == (other.sequence, other.log_time, other.publish_time)
        if encoding == FRAME:
            frames += 1
            parts: list[bytes] = []
            _frames.add(parts, [], 1, [(one.log_time, decode_frame(one.data))], 0, 0, 0)
            header = struct.pack("<BQHIQQ", 5, 22 + len(other.data), 1, *times)
            assert (second, b"".join(parts)) == (FRAME_V2, header + other.data)
            assert restore(other.data, *times) == one.data
        else:
            assert (second, other.data) == (encoding, one.data)
    assert frames > 10


def test_the_mcap_library_reads_them() -> None:
    counts = []
    for name in FILES:
        count = 0
        with (GOLDEN / name).open("rb") as stream:
            try:
                for _ in NonSeekingReader(stream, validate_crcs=True).iter_messages(log_time_order=False):
                    count += 1
            except EndOfFile:
                assert name == "killed.mem"
        counts.append(count)
        assert count == len(json.loads((GOLDEN / name).with_suffix(".json").read_text())["messages"])
    assert counts[0] > counts[1] > 0
