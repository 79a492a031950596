"""Follows one block: finds the changes in each frame, and marks the topics to publish."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Final

from shmio.config import MqttTopic
from shmio.endpoints.mqtt.commands import CommandClient
from shmio.endpoints.mqtt.outbox import Outbox
from shmio.endpoints.mqtt.topics import (
    Channel,
    FramesChannel,
    RegisterChannel,
    StatusChannel,
    StructureChannel,
    TopicRules,
    ValueChannel,
    output_topic,
)
from shmio.errors import PathError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import find
from shmio.layout.values.write import elements
from shmio.segment import Block, Frame, FrameFollower, Quality, QualityChange
from shmio.segment.changed_registers import ChangeScan

log = logging.getLogger("shmio.mqtt")

MAX_FRAMES_PER_TURN: Final = 8
"""Maximum number of frames that are read in one go, before the bridge does other work."""
CATCH_UP_S: Final = 3.0
"""If the bridge is further behind than this time in s, or half of the ring, it skips to the newest frame."""


def follow(block: Block) -> FrameFollower:
    """Follow a block, beginning with its newest frame. If the follower falls far behind, it skips frames."""
    return FrameFollower(block, catch_up_s=CATCH_UP_S)


class Feed:
    """Follows one source, and marks its changed topics in the outbox.

    Use it only in the bridge's thread.
    """

    def __init__(self, block: Block, rules: TopicRules, prefix: str, outbox: Outbox, writer: int) -> None:
        """Create the feed. For a large layout this takes seconds.

        Args:
            block: The block to follow.
            rules: The configuration's rules for topics.
            prefix: Prefix of all topics.
            outbox: Queues the changed topics.
            writer: Number of this process's command queue.

        """
        self.block = block
        self.follower = follow(block)
        self.step_driven = False
        """True if values are published only by steps.

        That is the case while time is virtual, if the block follows the instance's clock.
        """
        self.command_client = CommandClient(block, writer)
        base = f"{prefix}/{block.source}"
        self.status = StatusChannel(self.follower, f"{base}/status")
        chosen = list(_chosen(block.layout, rules, block.source))
        self._channel_of = [*self._channels_of(chosen, rules, prefix)]
        """The channel of each published register, in the layout's order."""
        self.channels = list(dict.fromkeys(self._channel_of))
        frames = rules.frames(block.source)
        self.frames = FramesChannel(self.follower, f"{base}/frames", frames) if frames else None
        self._json = [channel for channel in self.channels if channel.json]
        self._injected: frozenset[ValueChannel] = frozenset()
        """The channels that are published as injected."""
        self._covered = self._injected
        self._injection_sequence = 0
        """Sequence number of the list of injections from which ``_covered`` was computed."""
        self._scan = ChangeScan([register for register, _ in chosen], block.statuses)
        self._outbox = outbox
        self._limited: dict[ValueChannel | FramesChannel, None] = {}

    def _channels_of(
        self, chosen: Sequence[tuple[Register, MqttTopic]], rules: TopicRules, prefix: str
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
                yield RegisterChannel(self.follower, register, output_topic(prefix, source, register.path), rule)
                continue
            if path not in structures:
                topic = output_topic(prefix, source, path)
                structures[path] = StructureChannel(self.follower, path, parts[path], topic, rule)
            yield structures[path]

    @property
    def missed(self) -> int:
        """Number of frames that were skipped because the bridge was too slow."""
        return self.follower.missed

    @property
    def ended(self) -> bool:
        """True if a reload has retired the block, and all its frames have been read."""
        return self.follower.ended

    def poll(self) -> bool:
        """Read a few new frames. Return whether more are waiting."""
        if self.step_driven:
            return False
        for frame in self.follower.read(MAX_FRAMES_PER_TURN):
            if self.follower.take_missed():
                log.warning(
                    "source %s: the bridge was too slow, and has missed %d frames", self.block.source, self.missed
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
        """Publish the changes of the present step, if the source is :attr:`step_driven`."""
        if self.step_driven and (frame := self.follower.newest()):
            self.take(frame)

    def take(self, frame: Frame) -> None:
        """Make a frame the present frame, and mark the topics that it changes."""
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
        """Mark the channels whose injections begin or end, even if their values do not change."""
        sequence, before = self.block.injections.sequence, self._injected
        if sequence != self._injection_sequence:
            self._injection_sequence = sequence
            over = [one for one in self.block.injections.read() if one.direction == "out"]
            self._covered = frozenset(
                channel for channel in self._json if any(one.covers(part) for part in channel.registers for one in over)
            )
        self._injected = frozenset() if frame.effective is None else self._covered
        self._outbox.mark_all(one for one in self._json if (one in before) != (one in self._injected))

    def _mark_everything(self) -> None:
        self._limited.clear()
        self._outbox.mark_all(self.all())

    def resend(self) -> None:
        """Publish the present state of all topics again, after the changes that were kept during an outage."""
        self._limited.clear()
        self._outbox.resend(self.all())

    def all(self) -> list[Channel]:
        """Return all channels of this source."""
        return [self.status, *self.channels, *([self.frames] if self.frames else [])]

    def _is_due(self, channel: ValueChannel | FramesChannel, frame: Frame) -> bool:
        """Return whether a change may be published now: no rate limit or dead-band holds it back."""
        if not channel.limited:
            return True
        if channel in self._limited or channel.due_ns > self.block.now_ns():
            self._limited[channel] = None
            return False
        return channel.moved(frame.image)

    def mark_due(self) -> int | None:
        """Mark the changed channels that a rate limit no longer delays.

        Returns:
            The time at which the next rate limit ends, in ns of the source's clock; None if no
            change waits for a rate limit.

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
        with suppress(PathError):  # a reload has changed the layout; `shmio-supervisor check` reports this
            yield find(layout, path), rules.of(source, path)
