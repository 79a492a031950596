"""Follows one block: scans each frame for changes, and marks the topics to publish."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Any, Final

from shmio.config import MqttTopic
from shmio.endpoints.mqtt.channel import (
    Channel,
    FramesChannel,
    Message,
    RegisterChannel,
    StatusChannel,
    json_payload,
)
from shmio.endpoints.mqtt.command_client import CommandClient
from shmio.endpoints.mqtt.outbox import Outbox
from shmio.endpoints.mqtt.topic_rules import TopicRules
from shmio.errors import PathError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import decode_segment, find
from shmio.layout.values.codec import codec
from shmio.layout.values.text import json_value
from shmio.layout.values.write import elements
from shmio.local.reading import injected
from shmio.segment import Block, Frame, FrameFollower, Provenance, Quality, QualityChange
from shmio.segment.changed_registers import ChangeScan

Value = Callable[[bytes], Any]
"""Converts an image to a value for JSON."""


class StructureChannel:
    """The topic of a structure: its registers as one JSON object."""

    json = True

    def __init__(
        self, follower: FrameFollower, path: str, registers: Sequence[Register], topic: str, rule: MqttTopic
    ) -> None:
        """``path``: of the structure that contains the registers; empty: the whole source."""
        self.registers = registers
        self.topic = topic
        self.limited = rule.max_rate_hz is not None
        self._follower = follower
        self._qos, self._retain = rule.qos, rule.retain
        self._pause_ns = round(1e9 / rule.max_rate_hz) if rule.max_rate_hz else 0
        depth = path.count("/") + 1 if path else 0
        parts = [(register.path.split("/")[depth:], register) for register in registers]
        self._value = _members(parts, follower.block.layout)
        self.due_ns = 0

    def moved(self, _image: bytes) -> bool:
        """Return True: every change is published."""
        return True

    def message(self, *, late: bool = False) -> Message:
        """Make the message; while the quality is bad, with the last known values."""
        follower = self._follower
        block, frame = follower.block, follower.frame
        self.due_ns = block.now_ns() + self._pause_ns
        value, provenance = None, Provenance.LIVE
        if frame is not None:
            provenance = Provenance.INJECTED if injected(block, self.registers, frame) else frame.provenance
            value = self._value(frame.image) if frame.source_ns else None
        payload = json_payload(value, follower.quality, follower.reason, str(provenance), frame, late=late)
        return Message(self.topic, payload, self._qos, self._retain and not late, True, frame.source_ns if frame else 0)


def _members(parts: Sequence[tuple[list[str], Register]], layout: Layout) -> Value:
    """Make the decoder of a JSON object.

    ``parts``: each register with the names that lead to it from here.
    """
    groups: dict[str, list[tuple[list[str], Register]]] = {}
    for (name, *rest), register in parts:
        groups.setdefault(decode_segment(name), []).append((rest, register))
    members = {
        name: _members(inner, layout) if inner[0][0] else _member(inner[0][1], layout) for name, inner in groups.items()
    }
    return lambda image: {name: value(image) for name, value in members.items()}


def _member(register: Register, layout: Layout) -> Value:
    decode, element = codec(register, layout.byte_order).decode, register.element
    return lambda image: json_value(decode(image), element)


log = logging.getLogger("shmio.mqtt")

ValueChannel = RegisterChannel | StructureChannel

MAX_FRAMES_PER_TURN: Final = 8
"""Frames that are read before other work has its turn."""
CATCH_UP_S: Final = 3.0
"""A bridge that is further behind than this, or than half the ring, skips to the newest frame."""


def follow(block: Block) -> FrameFollower:
    """Follow a block from its newest frame on, and never fall far behind."""
    return FrameFollower(block, catch_up_s=CATCH_UP_S)


class Feed:
    """Follows one source, and marks its changed topics in the outbox.

    Use it from the bridge's thread.
    """

    def __init__(self, block: Block, rules: TopicRules, prefix: str, outbox: Outbox, writer: int) -> None:
        """``writer``: number of this process's command queue.

        For a large layout this takes seconds.
        """
        self.block = block
        self.follower = follow(block)
        self.step_driven = False
        """Whether only steps publish: the block is on the instance's clock, which is virtual."""
        self.command_client = CommandClient(block, writer)
        base = f"{prefix}/{block.source}"
        self.status = StatusChannel(self.follower, f"{base}/status")
        chosen = list(_chosen(block.layout, rules, block.source))
        self._channel_of = [*self._channels_of(chosen, rules, base)]
        """The channel of each published register, in the layout's order."""
        self.channels = list(dict.fromkeys(self._channel_of))
        frames = rules.frames(block.source)
        self.frames = FramesChannel(self.follower, f"{base}/frames", frames) if frames else None
        self.depths = _depths(block.layout)
        """The numbers of segments that this source's paths have."""
        self._json = [channel for channel in self.channels if channel.json]
        self._injected: frozenset[ValueChannel] = frozenset()
        """The channels that are published as injected."""
        self._covered = self._injected
        self._injection_sequence = 0
        """Sequence number of the standing injections from which ``_covered`` was made."""
        self._scan = ChangeScan([register for register, _ in chosen])
        self._outbox = outbox
        self._limited: dict[ValueChannel | FramesChannel, None] = {}

    def _channels_of(
        self, chosen: Sequence[tuple[Register, MqttTopic]], rules: TopicRules, base: str
    ) -> Iterator[ValueChannel]:
        source = self.block.source
        paths = [rules.structure(source, part.path) if rule.payload == "structure" else None for part, rule in chosen]
        parts: dict[str, list[Register]] = {}
        for (register, _), path in zip(chosen, paths, strict=True):
            if path is not None:
                parts.setdefault(path, []).append(register)
        structures: dict[str, StructureChannel] = {}
        for (register, rule), path in zip(chosen, paths, strict=True):
            if path is None:
                yield RegisterChannel(self.follower, register, f"{base}/{register.path}/out", rule)
                continue
            if path not in structures:
                topic = f"{base}/{path}/out" if path else f"{base}/out"
                structures[path] = StructureChannel(self.follower, path, parts[path], topic, rule)
            yield structures[path]

    @property
    def missed(self) -> int:
        """Number of frames that were skipped because the bridge was too slow."""
        return self.follower.missed

    @property
    def ended(self) -> bool:
        """Whether a reload has ended the block, and all its frames have been read."""
        return self.follower.ended

    def poll(self) -> bool:
        """Read a few new frames, and return whether more are waiting."""
        if self.step_driven:
            return False
        for frame in self.follower.read(MAX_FRAMES_PER_TURN):
            if self.follower.take_missed():
                log.warning(
                    "source %s: the bridge was too slow: it has missed %d frames", self.block.source, self.missed
                )
                self._outbox.mark(self.status)
            self.take(frame)
            if self._outbox.busy:
                self._outbox.flush()  # publishes the changes of each frame as long as the broker keeps up
        if self.follower.behind:
            return True
        if self.follower.became_stale():
            self._mark_everything()
        return False

    def step(self) -> None:
        """Publish what the step being delivered has changed, if steps drive this block."""
        if self.step_driven and (frame := self.follower.newest()):
            self.take(frame)

    def take(self, frame: Frame) -> None:
        """Make a frame the current one, and mark the topics that it changes."""
        old = self.follower.frame
        change = self.follower.take(frame)
        if old is None or change in (QualityChange.RECOVERED, QualityChange.BAD):
            self._mark_everything()
        else:
            if change is QualityChange.DETAIL:
                self._outbox.mark_all([self.status, *self._json])
            if self.follower.quality is Quality.BAD:
                return
            channels = dict.fromkeys(self._channel_of[index] for index in self._scan.changed(old.image, frame.image))
            self._outbox.mark_all([one for one in channels if not one.limited or self._is_due(one, frame)])
            if self._json and (frame.effective is not None or self._injected):
                self._mark_injected(frame)
            if self.frames and self._is_due(self.frames, frame):
                self._outbox.mark(self.frames)
        if self._limited:
            self.mark_due()

    def _mark_injected(self, frame: Frame) -> None:
        """Mark the channels that became injected or stopped being injected, even with equal values."""
        sequence, before = self.block.standing.sequence, self._injected
        if sequence != self._injection_sequence:
            self._injection_sequence = sequence
            over = [one for one in self.block.standing.read() if one.direction == "out"]
            self._covered = frozenset(
                channel for channel in self._json if any(one.covers(part) for part in channel.registers for one in over)
            )
        self._injected = frozenset() if frame.effective is None else self._covered
        self._outbox.mark_all(one for one in self._json if (one in before) != (one in self._injected))

    def _mark_everything(self) -> None:
        self._limited.clear()
        self._outbox.mark_all(self.all())

    def resend(self) -> None:
        """Publish all topics again, after what was kept during an outage."""
        self._limited.clear()
        self._outbox.resend(self.all())

    def all(self) -> list[Channel]:
        """Return all channels of this source."""
        return [self.status, *self.channels, *([self.frames] if self.frames else [])]

    def _is_due(self, channel: ValueChannel | FramesChannel, frame: Frame) -> bool:
        """Return whether to publish a change now; else it is rate-limited, or within the deadband."""
        if not channel.limited:
            return True
        if channel in self._limited or channel.due_ns > self.block.now_ns():
            self._limited[channel] = None
            return False
        return channel.moved(frame.image)

    def mark_due(self) -> int | None:
        """Mark the channels whose rate limit has elapsed.

        Returns:
            When the next one elapses, in ns of the source's clock; None: none is waiting.

        """
        now_ns, frame = self.block.now_ns(), self.follower.frame
        for channel in [channel for channel in self._limited if channel.due_ns <= now_ns]:
            del self._limited[channel]
            if frame and channel.moved(frame.image):
                self._outbox.mark(channel)
        return min((channel.due_ns for channel in self._limited), default=None)


def _chosen(layout: Layout, rules: TopicRules, source: str) -> Iterator[tuple[Register, MqttTopic]]:
    """Yield the registers, elements and parts to publish, each with its rule."""
    for register in layout.registers:
        rule = rules.of(source, register.path)
        if not rule.publish:
            continue
        for part in elements(layout, register) if rule.elements and register.dims else (register,):
            yield part, rule
    for path in rules.parts(source):
        with suppress(PathError):  # a reload has brought another layout; `check` tells
            yield find(layout, path), rules.of(source, path)


def _depths(layout: Layout) -> Sequence[int]:
    depths = set()
    for register in layout.registers:
        depth = register.path.count("/") + 1
        depths |= {depth, depth + len(register.dims)}
    return sorted(depths)
