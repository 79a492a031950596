"""A source as a Sparkplug device: turns its frames into births, data and deaths."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import Enum
from typing import NamedTuple

from shmio.endpoints.mqtt.commands import CommandClient
from shmio.endpoints.mqtt.feed import MAX_FRAMES_PER_TURN, follow
from shmio.endpoints.mqtt.sparkplug.node import Metric, Sample, parts_of
from shmio.layout.glob import Glob
from shmio.layout.model import Register
from shmio.layout.values.codec import codec
from shmio.local.reading import reading
from shmio.segment import Block, Frame, Quality, QualityChange
from shmio.segment.changed_registers import ChangeScan


class DeviceEvent(Enum):
    """What happens to a device."""

    BIRTH = "birth"
    DATA = "data"
    DEATH = "death"


class DeviceChange(NamedTuple):
    """A change of a device. ``at`` has the indices of the metrics that have new values."""

    kind: DeviceEvent
    at: Sequence[int] = ()


class Device:
    """Follows one block, and reports its changes as those of a Sparkplug device.

    Use it only in the bridge's thread. Creating a device takes seconds for a large layout.
    """

    def __init__(self, block: Block, command_client: CommandClient, globs: Sequence[Glob], *, elements: bool) -> None:
        """Create the device.

        Args:
            block: The block of the source.
            command_client: Sends commands to the source.
            globs: Patterns that select the metrics, by path with the source's name.
            elements: Whether to make each element of an array a metric.

        """
        self.block = block
        self.command_client = command_client
        registers = [
            one for one in block.layout.registers if any(g.matches(f"{block.source}/{one.path}") for g in globs)
        ]
        self.parts: tuple[Register, ...] = tuple(parts_of(block.layout, registers, single=elements))
        self._metrics: Sequence[Metric] = ()
        self._scan = ChangeScan(self.parts, block.statuses)
        self._decoders = [codec(part, block.layout.byte_order).decode for part in self.parts]
        self._follower = follow(block)

    def set_metrics(self, metrics: Sequence[Metric]) -> None:
        """Set the metrics: one for each of :attr:`parts`, in the same order."""
        self._metrics = metrics

    @property
    def alive(self) -> bool:
        """True if the source's quality is good or uncertain."""
        return self._follower.quality is not Quality.BAD

    def poll(self) -> Iterator[DeviceChange]:
        """Read a few new frames, and yield the changes that they make to the device."""
        for frame in self._follower.read(MAX_FRAMES_PER_TURN):
            if (change := self._take(frame)) is not None:
                yield change
        if not self.behind and self._follower.became_stale():
            yield DeviceChange(DeviceEvent.DEATH)

    @property
    def missed(self) -> int:
        """Number of frames that were skipped because the bridge was too slow."""
        return self._follower.missed

    @property
    def last(self) -> int:
        """Number of the last frame that the device has read."""
        return self._follower.last

    @property
    def behind(self) -> int:
        """Number of frames that the device has not read yet."""
        return self._follower.behind

    def samples(self, at: Sequence[int] | None = None) -> list[Sample]:
        """Return samples of the metrics with the indices ``at``; of all metrics if ``at`` is None."""
        follower = self._follower
        frame = follower.frame
        if frame is None:
            return []
        at = range(len(self.parts)) if at is None else at
        if self.block.statuses is not None:
            return [self._sample_with_status(one, frame) for one in at]
        at_ms = frame.source_ns // 1_000_000
        return [
            Sample(self._metrics[one], self._decoders[one](frame.image), at_ms, follower.quality, follower.reason)
            for one in at
        ]

    def _sample_with_status(self, one: int, frame: Frame) -> Sample:
        """Return the sample of a metric whose register has a status of its own."""
        found = reading(self.block, self.parts[one], frame, aged=False)
        at_ms = round((found.source_time or 0) * 1000)
        return Sample(self._metrics[one], self._decoders[one](frame.image), at_ms, found.quality, found.reason)

    def _take(self, frame: Frame) -> DeviceChange | None:
        old = self._follower.frame
        change = self._follower.take(frame)
        if change is QualityChange.BAD:
            return DeviceChange(DeviceEvent.DEATH)
        if not self.alive:
            return None
        if old is None or change is QualityChange.RECOVERED:
            return DeviceChange(DeviceEvent.BIRTH)
        if change is QualityChange.DETAIL:
            return DeviceChange(DeviceEvent.DATA, range(len(self.parts)))
        changed = self._scan.changed(old.image, frame.image)
        return DeviceChange(DeviceEvent.DATA, changed) if changed else None
