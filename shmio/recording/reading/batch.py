"""Reads the frames of a block as arrays, chunk by chunk, without a Python object for each frame."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode

from shmio.errors import RecordingError
from shmio.model.values import Provenance
from shmio.recording.format.encoding import Channel, decode_frame, encode_frame, restore
from shmio.segment.block import Frame

HEAD: Final = np.dtype(
    [
        ("number", "<u8"),
        ("cycle", "<u8"),
        ("publish_ns", "<i8"),
        ("clock_ns", "<i8"),
        ("source_ns", "<i8"),
        ("event", "<u8"),
        ("incarnation", "<u4"),
        ("quality", "u1"),
        ("provenance", "u1"),
        ("flags", "<u2"),
        ("reason_size", "<u2"),
        ("zero", "<u2"),
        ("image_size", "<u4"),
        ("delay_us", "<u4"),
    ]
)
"""The header of a frame as a numpy type (docs/reference/dump-format.md)."""

_RECORD: Final = struct.Struct("<BQH")  # opcode, size; then, in a message, the channel
_MESSAGE: Final = struct.Struct("<BQHIQQ")  # opcode, size, channel, sequence, log time, publish time
_MESSAGE_HEAD: Final = np.dtype(
    [
        ("opcode", "u1"),
        ("size", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_ns", "<i8"),
        ("publish_ns", "<i8"),
    ]
)
"""The record header and the message header as a numpy type."""
_HEAD_SIZE: Final = 9
_LOG_AT: Final = 15
_WORTH: Final = 4
"""Number of consecutive messages of a channel (a run) from which on it is faster to read them at once.

After ``_MAX_TRIES`` shorter runs, the rest of the chunk is read message by message.
"""
_MAX_TRIES: Final = 8

_Bytes = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Batch:
    """A batch of n frames of one block, in order.

    Attributes:
        time_ns: Log times in ns, int64, shape (n,).
        records: For each frame, its header (:data:`HEAD`) and image, uint8, shape (n, header + image
            size). The images are those that readers saw; with ``raw``, those that the source
            delivered.
        reasons: The reason of each frame; None if all reasons are empty.
    """

    time_ns: npt.NDArray[np.int64]
    records: _Bytes
    reasons: list[str] | None

    @property
    def head(self) -> npt.NDArray[Any]:
        """The headers of the frames, of type :data:`HEAD`, shape (n,)."""
        return self.records[:, : HEAD.itemsize].view(HEAD)[:, 0]

    @property
    def images(self) -> _Bytes:
        """The images of the frames, uint8, shape (n, image size)."""
        return self.records[:, HEAD.itemsize :]

    def __len__(self) -> int:
        return len(self.time_ns)

    def __getitem__(self, some: slice) -> Batch:
        """Return a slice of the frames."""
        return Batch(self.time_ns[some], self.records[some], self.reasons and self.reasons[some])


def batch(data: bytes, channel: Channel, size: int, from_ns: int, to_ns: int, *, raw: bool = False) -> Batch | None:
    """Return the frames of a channel in a chunk; None if there are no frames in the range of time.

    Args:
        data: The uncompressed chunk.
        channel: The channel.
        size: Size of an image in bytes.
        from_ns: First log time, in ns.
        to_ns: Last log time, in ns.
        raw: True for the images that the source delivered; False for the images that readers saw.

    Raises:
        RecordingError: The frames cannot be decoded.
    """
    array = np.frombuffer(data, np.uint8)
    found = []
    for run in _runs(array, data, channel.number):
        time_ns = np.ascontiguousarray(run[:, _LOG_AT : _LOG_AT + 8]).view("<i8")[:, 0]
        inside = (time_ns >= from_ns) & (time_ns <= to_ns)
        if not inside.all():
            time_ns, run = time_ns[inside], run[inside]  # noqa: PLW2901
        if len(run):
            frames = _restored(run) if channel.differences else run[:, _MESSAGE.size :]
            records = frames if _regular(frames, size) else None
            found.append((time_ns, *((records, None) if records is not None else _decoded(frames, size, raw=raw))))
    if len(found) <= 1:
        return Batch(*found[0]) if found else None
    reasons = None
    if any(some is not None for _, _, some in found):
        reasons = [reason for time_ns, _, some in found for reason in some or [""] * len(time_ns)]
    return Batch(np.concatenate([item[0] for item in found]), np.concatenate([item[1] for item in found]), reasons)


def frames(data: bytes, channel: Channel, size: int, from_ns: int, to_ns: int) -> list[tuple[int, Frame]]:
    """Return the frames of a channel in a chunk as objects, with their log times.

    Raises:
        RecordingError: The frames cannot be decoded.
    """
    found = []
    at, end, unpack = 0, len(data), _MESSAGE.unpack_from
    while at < end:
        if end - at < _HEAD_SIZE:
            raise RecordingError("it ends within a record")
        following = at + _HEAD_SIZE + int.from_bytes(data[at + 1 : at + _HEAD_SIZE], "little")
        if following > end:
            raise RecordingError("it ends within a record")
        if data[at] == Opcode.MESSAGE and following - at >= _MESSAGE.size:
            _, _, number, sequence, log_ns, publish_ns = unpack(data, at)
            if number == channel.number and from_ns <= log_ns <= to_ns:
                piece = data[at + _MESSAGE.size : following]
                if channel.differences:
                    piece = restore(piece, sequence, log_ns, publish_ns)
                found.append((log_ns, _frame(piece, size)))
        at = following
    return found


def record(frame: Frame) -> bytes:
    """Return the record of a frame in a batch: its header, and the image that readers saw."""
    return encode_frame(frame)[: HEAD.itemsize] + frame.image


def _frame(piece: bytes, size: int) -> Frame:
    try:
        frame = decode_frame(piece)
    except ValueError as error:
        raise RecordingError(str(error)) from None
    if len(frame.raw) != size:
        raise RecordingError("the size of a frame does not match its layout")
    return frame


def _runs(array: _Bytes, data: bytes, wanted: int) -> Iterator[_Bytes]:
    """Yield a channel's messages in runs: arrays of shape (n, bytes of a message).

    All messages of a run have the same size, and begin at the same distance from each other. If
    several blocks publish in turn, the same pattern of records repeats. This function finds the
    repetitions by comparing arrays, which is faster than reading each record.

    Raises:
        RecordingError: The records do not fit the chunk.
    """
    at, end, begin, tries = 0, len(data), -1, _MAX_TRIES
    pattern: list[int] = []
    unpack, smallest = _RECORD.unpack_from, _RECORD.size + 2
    while at < end:
        if end - at < smallest:
            raise RecordingError("it ends within a record")
        opcode, size, channel = unpack(data, at)
        if opcode == Opcode.MESSAGE and channel == wanted:
            if begin >= 0:
                count = _repeats(array, begin, at - begin, pattern) if tries else 1
                tries -= count < _WORTH and tries > 0
                yield _cut(array, begin, at - begin, count, pattern[1] - begin if len(pattern) > 1 else at - begin)
                at = begin + count * (at - begin)
                begin, pattern = -1, []
                continue
            begin = at
        if begin >= 0:
            pattern.append(at)
        at += _HEAD_SIZE + size
    if at > end:
        raise RecordingError("it ends within a record")
    if begin >= 0:
        yield _cut(array, begin, 0, 1, (pattern[1] if len(pattern) > 1 else at) - begin)


def _repeats(array: _Bytes, begin: int, period: int, pattern: list[int]) -> int:
    """Return how many times a pattern of records occurs in direct succession from ``begin`` on."""
    count = (len(array) - begin) // period
    rows = array[begin : begin + count * period].reshape(count, period)
    same = np.ones(count, np.bool_)
    for place in pattern:
        kind = slice(place - begin, place - begin + _RECORD.size)
        same &= (rows[:, kind] == rows[0, kind]).all(axis=1)
    return count if same.all() else int(same.argmin())


def _cut(array: _Bytes, begin: int, period: int, count: int, size: int) -> _Bytes:
    """Return messages of one size, ``period`` bytes apart, as uint8 of shape (count, size)."""
    if size < _MESSAGE.size:
        raise RecordingError("a message is shorter than its header")
    if count == 1:
        return array[begin : begin + size].reshape(1, size)
    return array[begin : begin + count * period].reshape(count, period)[:, :size]


def _restored(run: _Bytes) -> _Bytes:
    """Convert all messages from FRAME_V2 to FRAME, like ``restore`` in ``encoding.py``."""
    head_fields = run[:, : _MESSAGE.size].view(_MESSAGE_HEAD)[:, 0]
    frames = run[:, _MESSAGE.size :].copy()
    if frames.shape[1] >= HEAD.itemsize:
        head = frames[:, : HEAD.itemsize].view(HEAD)[:, 0]
        head["number"] += head_fields["sequence"]
        head["cycle"] += head["number"]
        head["clock_ns"] += head_fields["log_ns"]
        head["publish_ns"] += head["clock_ns"]
        head["source_ns"] += head_fields["publish_ns"]
    return frames


def _regular(frames: _Bytes, size: int) -> bool:
    """Return whether each frame consists of only a header and one image, without a reason."""
    if frames.shape[1] != HEAD.itemsize + size:
        return False
    head = frames[:, : HEAD.itemsize].view(HEAD)[:, 0]
    odd = head["reason_size"] | (head["flags"] & 1) | (head["image_size"] ^ size)
    return not odd.any() and not (head["provenance"] > Provenance.INJECTED).any()


def _decoded(frames: _Bytes, size: int, *, raw: bool) -> tuple[_Bytes, list[str]]:
    """Decode frames one by one. Return records as in :class:`Batch`, and the reasons."""
    records, reasons = [], []
    for piece in map(bytes, frames):
        frame = _frame(piece, size)
        records += [piece[: HEAD.itemsize], frame.raw if raw else frame.image]
        reasons.append(frame.reason)
    return np.frombuffer(b"".join(records), np.uint8).reshape(len(frames), HEAD.itemsize + size), reasons
