"""The topics that the bridge publishes: their names, the configuration's rules for them, and channels.

A channel makes the payload of one topic when the outbox sends the topic.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple, Protocol

import msgspec

from shmio.config import MqttTopic
from shmio.layout.glob import Glob
from shmio.layout.model import Layout, Register
from shmio.layout.topic import canonical_path, decode_segment, names_part
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.text import json_value, texts
from shmio.local.reading import holds_none, injected, reading, status_of
from shmio.model.statuses import worse
from shmio.segment import Frame, FrameFollower, Provenance, Quality

DEFAULT: Final = MqttTopic(match="**")
"""The rule for registers that no other rule matches."""
ONLINE: Final = b"online"
NUMBERS: Final = (int, float)

_ToJson = Callable[[bytes], Any]
"""Function that converts an image to a value for JSON."""


def output_topic(prefix: str, source: str, path: str = "") -> str:
    """Return the topic of a register or structure; of the whole source if ``path`` is empty."""
    return f"{prefix}/{source}/{path}/out" if path else f"{prefix}/{source}/out"


class TopicRules:
    """The configuration's rules for topics. For each path, the first rule that matches it applies."""

    def __init__(self, topics: Sequence[MqttTopic]) -> None:
        """Compile the rules.

        Raises:
            PathError: A pattern is not valid.

        """
        self._frames = {pattern: rule for rule in topics if rule.payload == "frames" for pattern in rule.patterns}
        rules = [(pattern, rule) for rule in topics if rule.payload != "frames" for pattern in rule.patterns]
        self._parts: dict[str, MqttTopic] = {}
        for pattern, rule in rules:
            if names_part(pattern):
                self._parts.setdefault(canonical_path(pattern, parts=True), rule)
        self._rules = [(Glob(pattern), rule) for pattern, rule in rules if not names_part(pattern)]

    def of(self, source: str, path: str) -> MqttTopic:
        """Return the rule for a register, bit or slice."""
        if not self._rules and not self._parts:
            return DEFAULT
        full = f"{source}/{path}"
        return self._parts.get(full) or self._first(full)[1]

    def parts(self, source: str) -> Iterator[str]:
        """Yield the paths of those bits, slices and other parts of a source that have rules of their own."""
        for full, rule in self._parts.items():
            first, _, path = full.partition("/")
            if first == source and rule.publish:
                yield path

    def structure(self, source: str, path: str) -> str | None:
        """Return the structure whose topic contains the value of a register.

        Returns:
            The path of the structure; empty if the topic of the whole source contains the value;
            None if the register has a topic of its own.

        """
        glob, rule = self._first(f"{source}/{path}")
        if glob is None or rule.payload != "structure":
            return None
        names = [source, *path.split("/")]
        depths = range(1, len(names))
        return next(("/".join(names[1:n]) for n in depths if glob.matches("/".join(names[:n]))), None)

    def _first(self, full: str) -> tuple[Glob | None, MqttTopic]:
        return next((found for found in self._rules if found[0].matches(full)), (None, DEFAULT))

    def frames(self, source: str) -> MqttTopic | None:
        """Return the rule for a source's whole frames; None if they are not published."""
        rule = self._frames.get(source)
        return rule if rule and rule.publish else None


class Message(NamedTuple):
    """One message for the broker.

    ``keep`` is True for a change of a value, which the backlog keeps while there is no broker.
    ``source_ns`` is the time of the value at the source, in ns since 1970; 0 if it is unknown, or
    there is no value.
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
        """Make the message from the present state.

        ``late`` is True if the message will be sent later, when there is a broker again.
        """


class _RuledChannel:
    """A topic to which a rule of the configuration applies."""

    json = False

    def __init__(self, follower: FrameFollower, topic: str, rule: MqttTopic) -> None:
        self.topic = topic
        self.limited = rule.deadband > 0 or rule.max_rate_hz is not None
        """True if a dead-band or a maximum rate applies."""
        self.due_ns = 0
        """Time at which the next message may be sent, in ns of the source's clock."""
        self._follower = follower
        self._qos, self._retain = rule.qos, rule.retain
        self._pause_ns = round(1e9 / rule.max_rate_hz) if rule.max_rate_hz else 0

    def moved(self, _image: bytes) -> bool:
        """Return whether the value has moved by more than the dead-band; always True without one."""
        return True

    def _pause(self) -> None:
        """Start the pause before the next message."""
        if self.limited:
            self.due_ns = self._follower.block.now_ns() + self._pause_ns

    def _message(self, payload: bytes, *, late: bool) -> Message:
        frame = self._follower.frame
        return Message(self.topic, payload, self._qos, self._retain and not late, True, frame.source_ns if frame else 0)


class RegisterChannel(_RuledChannel):
    """The topic of a register or an array element, with text or JSON as payload."""

    def __init__(self, follower: FrameFollower, register: Register, topic: str, rule: MqttTopic) -> None:
        super().__init__(follower, topic, rule)
        self.registers = (register,)
        self.json = rule.payload != "text"
        self._register, self._deadband = register, rule.deadband
        self._decode = codec(register, follower.block.layout.byte_order).decode
        self._to_text = texts(register)
        self._sent: Value = None
        self._sent_quality: Quality | None = None
        """The quality in the last message; None if the source gives registers no status."""

    def moved(self, image: bytes) -> bool:
        """Return whether the value differs from that of the last message by more than the dead-band.

        A change of quality also counts.
        """
        if not self._deadband or self._quality_in(image) is not self._sent_quality:
            return True
        pairs = zip(_flat(self._decode(image)), _flat(self._sent), strict=False)
        return self._sent is None or any(_apart(new, old, self._deadband) for new, old in pairs)

    def _quality_in(self, image: bytes) -> Quality | None:
        area = self._follower.block.statuses
        return None if area is None else area.quality(image, area.index(self._register))

    def message(self, *, late: bool = False) -> Message:
        """Make the message. While the value is bad, a text payload is empty, and a JSON payload has the reason."""
        return self._message(self._json(late=late) if self.json else self._text(), late=late)

    def _text(self) -> bytes:
        follower = self._follower
        frame = follower.frame
        status = frame and status_of(follower.block, self._register, frame)
        if frame is None or follower.quality is Quality.BAD or (status and status.quality is Quality.BAD):
            self._note(None)
            return b""
        value = self._decode(frame.image)
        self._note(value)
        return self._to_text(value).encode()

    def _json(self, *, late: bool) -> bytes:
        follower = self._follower
        frame, quality, reason = follower.frame, follower.quality, follower.reason
        found = reading(follower.block, self._register, frame)
        if frame is not None and (status := status_of(follower.block, self._register, frame)):
            quality, reason = worse(quality, reason, status)
        if holds_none(found.value):
            quality, reason = Quality.BAD, reason or found.reason
        self._note(None if quality is Quality.BAD else found.value)
        value = json_value(found.value, self._register.element)
        return _json_payload(value, quality, reason, found.provenance, found.source_time, frame, late=late)

    def _note(self, value: Value) -> None:
        if self._deadband:
            self._sent, frame = value, self._follower.frame
            self._sent_quality = frame and self._quality_in(frame.image)
        self._pause()


class StructureChannel(_RuledChannel):
    """The topic of a structure. Its payload has the registers of the structure as one JSON object."""

    json = True

    def __init__(
        self, follower: FrameFollower, path: str, registers: Sequence[Register], topic: str, rule: MqttTopic
    ) -> None:
        """Create the channel.

        Args:
            follower: Follows the block.
            path: Path of the structure; empty for the whole source.
            registers: The registers of the structure.
            topic: The topic.
            rule: The rule of the topic.

        """
        super().__init__(follower, topic, rule)
        self.registers = registers
        depth = path.count("/") + 1 if path else 0
        parts = [(register.path.split("/")[depth:], register) for register in registers]
        self._value = _members(parts, follower.block.layout)
        area = follower.block.statuses
        self._indices = [] if area is None else area.indices(registers)

    def message(self, *, late: bool = False) -> Message:
        """Make the message. While the quality is bad, it has the last known values.

        If the source gives each register a status, the message has the worst of the qualities.
        """
        follower = self._follower
        block, frame = follower.block, follower.frame
        self._pause()
        value, provenance = None, Provenance.LIVE
        quality, reason = follower.quality, follower.reason
        if frame is not None:
            provenance = Provenance.INJECTED if injected(block, self.registers, frame) else frame.provenance
            value = self._value(frame.image) if frame.source_ns else None
            if block.statuses is not None and frame.source_ns:
                worst, status = block.statuses.worst(frame.raw, self._indices)
                if status.quality < quality:
                    quality, reason = status.quality, f"{block.layout.registers[worst].path}: {status.reason}"
        source_time = frame.source_ns / 1e9 if frame and frame.source_ns else None
        payload = _json_payload(value, quality, reason, str(provenance), source_time, frame, late=late)
        return self._message(payload, late=late)


ValueChannel = RegisterChannel | StructureChannel


class FramesChannel(_RuledChannel):
    """The topic of a block's frames. Its payload is the image that consumers see."""

    def message(self, *, late: bool = False) -> Message:
        """Make the message. Its payload is empty while there is no good frame."""
        frame, quality = self._follower.frame, self._follower.quality
        self._pause()
        return self._message(b"" if frame is None or quality is Quality.BAD else frame.image, late=late)


class StatusChannel:
    """The topic of a source's status, as JSON."""

    def __init__(self, follower: FrameFollower, topic: str) -> None:
        self.topic = topic
        self._follower = follower

    def message(self, *, late: bool = False) -> Message:  # noqa: ARG002  sent again when the broker is back
        """Make the message from the present state."""
        follower = self._follower
        return status(self.topic, follower.quality, follower.reason, follower.missed, follower.frame)


class BridgeStatusChannel:
    """The topic of the bridge's status. Its message is ``online``; the connection's will is ``offline``."""

    def __init__(self, topic: str) -> None:
        self.topic = topic

    def message(self, *, late: bool = False) -> Message:  # noqa: ARG002  see StatusChannel
        """Make the message ``online``."""
        return Message(self.topic, ONLINE, 1, retain=True)


class ClearedTopic:
    """A topic that is no longer published.

    Its empty message deletes the retained message at the broker.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic

    def message(self, *, late: bool = False) -> Message:  # noqa: ARG002  see StatusChannel
        """Make the empty message."""
        return Message(self.topic, b"", 1, retain=True)


def _json_payload(
    value: object,
    quality: Quality,
    reason: str,
    provenance: str,
    source_time: float | None,
    frame: Frame | None,
    *,
    late: bool,
) -> bytes:
    """Encode a value as JSON, with its quality, source time, provenance and sequence number."""
    fields = {
        "value": value,
        "quality": str(quality),
        "reason": reason,
        "source_time": source_time,
        "provenance": provenance,
        "sequence": frame.number if frame else 0,
    }
    return msgspec.json.encode(fields | {"late": True} if late else fields)


def status(topic: str, quality: Quality, reason: str, missed: int, frame: Frame | None = None) -> Message:
    """Return the message for a source's status topic.

    Args:
        topic: The topic.
        quality: The source's quality.
        reason: Why the quality is not good; empty if it is good.
        missed: Number of frames that were skipped.
        frame: The newest frame; None if there is none.

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


def _members(parts: Sequence[tuple[list[str], Register]], layout: Layout) -> _ToJson:
    """Return a function that converts an image to a JSON object.

    Args:
        parts: Each register, after the names in its path below this object.
        layout: The layout of the block.

    """
    groups: dict[str, list[tuple[list[str], Register]]] = {}
    for (name, *rest), register in parts:
        groups.setdefault(decode_segment(name), []).append((rest, register))
    members = {
        name: _members(inner, layout) if inner[0][0] else _member(inner[0][1], layout) for name, inner in groups.items()
    }
    return lambda image: {name: value(image) for name, value in members.items()}


def _member(register: Register, layout: Layout) -> _ToJson:
    decode, element = codec(register, layout.byte_order).decode, register.element
    return lambda image: json_value(decode(image), element)
