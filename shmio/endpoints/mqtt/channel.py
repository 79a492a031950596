"""Channels: each makes the payload of one topic when the outbox sends it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple, Protocol

import msgspec

from shmio.config import MqttTopic
from shmio.layout.model import Register
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.text import json_value, texts
from shmio.local.reading import holds_none, reading
from shmio.segment import Frame, FrameFollower, Quality

ONLINE: Final = b"online"
NUMBERS: Final = (int, float)


class Message(NamedTuple):
    """One message for the broker.

    ``keep``: it is a change of a value, which the backlog keeps while the broker is away.
    ``source_ns``: when the source had the value, in ns since 1970; 0: unknown, or no value.
    """

    topic: str
    payload: bytes
    qos: int
    retain: bool
    keep: bool = False
    source_ns: int = 0


class Channel(Protocol):
    """A topic that the bridge publishes."""

    topic: str

    def message(self, *, late: bool = False) -> Message:
        """Make the message from the current state.

        ``late``: it will not be sent now, but when the broker is back.
        """


class RegisterChannel:
    """The topic of a register or an array's element, as text or JSON."""

    def __init__(self, follower: FrameFollower, register: Register, topic: str, rule: MqttTopic) -> None:
        self.register = register
        self.registers = (register,)
        self.topic = topic
        self.json = rule.payload != "text"
        self.limited = rule.deadband > 0 or rule.max_rate_hz is not None
        """Whether a deadband or a maximum rate limits what is published."""
        self._follower = follower
        self._qos, self._retain, self._deadband = rule.qos, rule.retain, rule.deadband
        self._pause_ns = round(1e9 / rule.max_rate_hz) if rule.max_rate_hz else 0
        self._decode = codec(register, follower.block.layout.byte_order).decode
        self._to_text = texts(register)
        self._sent: Value = None
        self.due_ns = 0
        """When the next message may be sent, in ns of the source's clock."""

    def moved(self, image: bytes) -> bool:
        """Return whether the value is outside the deadband around the last one sent."""
        if not self._deadband:
            return True
        pairs = zip(_flat(self._decode(image)), _flat(self._sent), strict=False)
        return self._sent is None or any(_apart(new, old, self._deadband) for new, old in pairs)

    def message(self, *, late: bool = False) -> Message:
        """Make the message; without a good value, text is empty, and JSON says why."""
        payload = self._json(late=late) if self.json else self._text()
        frame = self._follower.frame
        return Message(self.topic, payload, self._qos, self._retain and not late, True, frame.source_ns if frame else 0)

    def _text(self) -> bytes:
        frame = self._follower.frame
        if frame is None or self._follower.quality is Quality.BAD:
            self._note(None)
            return b""
        value = self._decode(frame.image)
        if self.limited:
            self._note(value)
        return self._to_text(value).encode()

    def _json(self, *, late: bool) -> bytes:
        follower = self._follower
        frame, quality, reason = follower.frame, follower.quality, follower.reason
        found = reading(follower.block, self.register, frame)
        if holds_none(found.value):
            quality, reason = Quality.BAD, reason or found.reason
        self._note(None if quality is Quality.BAD else found.value)
        value = json_value(found.value, self.register.element)
        return json_payload(value, quality, reason, found.provenance, frame, late=late)

    def _note(self, value: Value) -> None:
        if self.limited:
            self._sent = value
            self.due_ns = self._follower.block.now_ns() + self._pause_ns


class FramesChannel:
    """The topic of a block's frames: the bytes of the effective image."""

    json = False

    def __init__(self, follower: FrameFollower, topic: str, rule: MqttTopic) -> None:
        self.topic = topic
        self.limited = rule.max_rate_hz is not None
        self._follower = follower
        self._qos, self._retain = rule.qos, rule.retain
        self._pause_ns = round(1e9 / rule.max_rate_hz) if rule.max_rate_hz else 0
        self.due_ns = 0

    def moved(self, _image: bytes) -> bool:
        """Return True: every frame is published."""
        return True

    def message(self, *, late: bool = False) -> Message:
        """Make the message; empty while there is no good frame."""
        frame, quality = self._follower.frame, self._follower.quality
        self.due_ns = self._follower.block.now_ns() + self._pause_ns
        payload = b"" if frame is None or quality is Quality.BAD else frame.image
        return Message(self.topic, payload, self._qos, self._retain and not late, True, frame.source_ns if frame else 0)


class StatusChannel:
    """The topic of a source's status, as JSON."""

    def __init__(self, follower: FrameFollower, topic: str) -> None:
        self.topic = topic
        self._follower = follower

    def message(self, *, late: bool = False) -> Message:  # noqa: ARG002  it is published again when the broker is back
        """Make the message from the current state."""
        follower = self._follower
        return status(self.topic, follower.quality, follower.reason, follower.missed, follower.frame)


class BridgeStatusChannel:
    """The topic of the bridge's status: always online; the will says offline."""

    def __init__(self, topic: str) -> None:
        self.topic = topic

    def message(self, *, late: bool = False) -> Message:  # noqa: ARG002  see StatusChannel
        """Make the message ``online``."""
        return Message(self.topic, ONLINE, 1, retain=True)


class ClearedTopic:
    """A topic that is no longer published; an empty message deletes the broker's retained one."""

    def __init__(self, topic: str) -> None:
        self.topic = topic

    def message(self, *, late: bool = False) -> Message:  # noqa: ARG002  see StatusChannel
        """Make the empty message."""
        return Message(self.topic, b"", 1, retain=True)


def json_payload(
    value: object, quality: Quality, reason: str, provenance: str, frame: Frame | None, *, late: bool
) -> bytes:
    """Encode a value as JSON, with its quality, source time, provenance and sequence number."""
    fields = {
        "value": value,
        "quality": str(quality),
        "reason": reason,
        "source_time": frame.source_ns / 1e9 if frame and frame.source_ns else None,
        "provenance": provenance,
        "sequence": frame.number if frame else 0,
    }
    return msgspec.json.encode(fields | {"late": True} if late else fields)


def status(topic: str, quality: Quality, reason: str, missed: int, frame: Frame | None = None) -> Message:
    """Make the message of a source's status topic.

    ``missed``: number of frames that were skipped.
    """
    fields = {
        "quality": str(quality),
        "reason": reason,
        "source_time": frame.source_ns / 1e9 if frame and frame.source_ns else None,
        "provenance": str(frame.provenance) if frame else None,
        "cycle": frame.cycle if frame else None,
        "missed": missed,
    }
    return Message(topic, msgspec.json.encode(fields), 1, retain=True)


def _flat(value: Value) -> Iterator[Value]:
    if isinstance(value, list):
        for item in value:
            yield from _flat(item)
    else:
        yield value


def _apart(new: Value, old: Value, deadband: float) -> bool:
    numbers = isinstance(new, NUMBERS) and isinstance(old, NUMBERS) and not isinstance(new, bool)
    return new != old and not (numbers and abs(new - old) < deadband)  # type: ignore[operator]  # they are numbers
