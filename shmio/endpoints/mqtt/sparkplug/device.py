"""A source as a Sparkplug device: turns its frames into births, data and deaths."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import Enum
from typing import NamedTuple

from shmio.endpoints.mqtt.command_client import CommandClient
from shmio.endpoints.mqtt.frame_reader import FrameReader
from shmio.endpoints.mqtt.sparkplug.metrics import Metric, parts_of
from shmio.endpoints.mqtt.sparkplug.node import Sample
from shmio.layout.glob import Glob
from shmio.layout.model import Register
from shmio.layout.values.codec import codec
from shmio.segment import Block, Frame, Quality
from shmio.segment.changed_registers import ChangeScan


class DeviceEvent(Enum):
    """Kinds of changes of a device."""

    BIRTH = "birth"
    DATA = "data"
    DEATH = "death"


class DeviceChange(NamedTuple):
    """A change of a device.

    ``at``: indices of the metrics that are new.
    """

    kind: DeviceEvent
    at: Sequence[int] = ()


class Device:
    """Follows one block for Sparkplug. Use it from the bridge's thread.

    For a large layout, creating one takes seconds.
    """

    def __init__(self, block: Block, command_client: CommandClient, globs: Sequence[Glob], *, elements: bool) -> None:
        """``command_client``: sends commands to the source.

        ``globs``: select the metrics, by path with the source. ``elements``: each element of an
        array is a metric.
        """
        self.block = block
        self.command_client = command_client
        registers = [
            one for one in block.layout.registers if any(g.matches(f"{block.source}/{one.path}") for g in globs)
        ]
        self.parts: tuple[Register, ...] = tuple(parts_of(block.layout, registers, single=elements))
        self.alive = False
        """Whether the source's quality is good or uncertain."""
        self._metrics: Sequence[Metric] = ()
        self._scan = ChangeScan(self.parts)
        self._decoders = [codec(part, block.layout.byte_order).decode for part in self.parts]
        self._frame: Frame | None = None
        self._quality, self._reason = Quality.BAD, ""
        self._reader = FrameReader(block)

    def set_metrics(self, metrics: Sequence[Metric]) -> None:
        """Set the metrics of the device's parts, in their order."""
        self._metrics = metrics

    def poll(self) -> Iterator[DeviceChange]:
        """Read a few new frames, and yield what changed."""
        for frame in self._reader.read():
            if (change := self._take(frame)) is not None:
                yield change
        last = self._frame
        if last is not None and not self.behind and (change := self._take(last)) is not None:  # with age
            yield change

    @property
    def missed(self) -> int:
        """Number of frames that were skipped because the bridge was too slow."""
        return self._reader.missed

    @property
    def behind(self) -> int:
        """Number of frames that have not been read."""
        return self._reader.behind

    def samples(self, at: Sequence[int] | None = None) -> list[Sample]:
        """Return samples of all metrics, or of those with the indices ``at``."""
        frame = self._frame
        if frame is None:
            return []
        at_ms = frame.source_ns // 1_000_000
        return [
            Sample(self._metrics[one], self._decoders[one](frame.image), at_ms, self._quality, self._reason)
            for one in (range(len(self.parts)) if at is None else at)
        ]

    def _take(self, frame: Frame) -> DeviceChange | None:
        old, before = self._frame, (self._quality, self._reason)
        self._frame = frame
        self._quality, self._reason = self.block.assess(frame)
        alive, self.alive = self.alive, self._quality is not Quality.BAD
        if not self.alive:
            return DeviceChange(DeviceEvent.DEATH) if alive else None
        if not alive or old is None:
            return DeviceChange(DeviceEvent.BIRTH)
        if before != (self._quality, self._reason):
            return DeviceChange(DeviceEvent.DATA, range(len(self.parts)))
        changed = self._scan.changed(old.image, frame.image)
        return DeviceChange(DeviceEvent.DATA, changed) if changed else None
