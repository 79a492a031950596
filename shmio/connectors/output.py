"""Publishes the images of a source with its injections applied, and the list and events of the injections.

The order of the injections is defined in :mod:`shmio.connectors.injection_layers`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Final

import msgspec
import numpy as np
from msgspec import Struct

from shmio.connectors.injection_layers import DeclaredLayer, Layer, LayerStack
from shmio.layout.model import Layout
from shmio.layout.values.write import Write, paths_outside
from shmio.model.values import NO_WRITER
from shmio.segment import BlockWriter, Command, Direction, EventKind, Provenance, Quality, Record, Stamp
from shmio.segment.events import EVENT_DATA_SIZE
from shmio.segment.injection_list import InjectionEntry, encode, ranges_of
from shmio.wording import MAX_PATHS, not_writable

EXTRA_FRAMES: Final = 4
"""Maximum number of frames in a period besides the frame of the cycle.

At this rate, a ring has room for the frames of 8 s.
"""
LIFTED: Final = "lifted"
"""Text of the event if a program has lifted an injection."""
GROWTH: Final = 64
"""Number of bytes reserved in the segment for each injection: its JSON grows with the numbers in it."""


def unwritable(source: str, layout: Layout, cover: np.ndarray[tuple[int], np.dtype[np.uint8]], writable: bytes) -> str:
    """Return why an injection over ``/in`` may not cover some bits; empty if it may.

    Args:
        source: Name of the source.
        layout: The layout of its block.
        cover: The bits that the injection covers, as an image of the block.
        writable: The bits that commands may write, as an image of the block.

    """
    if not (cover & ~np.frombuffer(writable, np.uint8)).any():
        return ""
    covered = [Write(offset, mask, bytes(size)) for offset, size, mask in ranges_of(cover.tobytes())]
    paths = paths_outside(layout, covered, writable, MAX_PATHS + 1)
    return f"the injection is over /in, but {not_writable([f'{source}/{path}' for path in paths])}"


class Image(Struct, frozen=True, gc=False):  # each cycle makes one: faster than a tuple
    """An image of the block, and its metadata.

    :meth:`BlockWriter.publish` explains the times.
    """

    raw: bytes
    cycle: int
    source_ns: int
    quality: Quality
    provenance: Provenance
    reason: str
    asked_ns: int | None = None
    shown: bytes | None = None
    """The image that consumers saw, if this is a recorded image that recorded injections had changed.

    None for any other image.
    """
    at: Stamp | None = None
    """The times with which to publish the image; None: the present time."""

    @property
    def base(self) -> bytes:
        """The image to which this instance's injections are applied."""
        return self.raw if self.shown is None else self.shown


class Output:
    """Publishes images, and publishes the last image again when injections change.

    Several threads may call the methods; ``lock`` serialises them. If injections change more often
    than ``EXTRA_FRAMES`` times in a period, several changes share a frame. Events about a change
    are published after the frame that shows the change.
    """

    def __init__(self, writer: BlockWriter, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.writer = writer
        self.injections = LayerStack(writer.block.layout.size)
        """The layers of this source.

        Hold ``lock`` while you change them, then call :meth:`show`.
        """
        self.lock = threading.Lock()
        self.advance: Callable[[Image], Iterable[Record]] | None = None
        """Called with each new image before the image is published.

        The events that it returns are published after the frame.
        """
        self._now_ns = now_ns
        self._gap_ns = writer.block.period_ns // EXTRA_FRAMES
        self._next_ns = 0
        self._changed = False
        self._pending: list[Record] = []
        self._last = self._predecessors()

    def _predecessors(self) -> Image | None:
        last = self.writer.block.latest()
        if last is None:
            return None
        asked_ns = last.publish_ns - 1000 * last.delay_us
        return Image(last.raw, last.cycle, last.source_ns, last.quality, last.provenance, last.reason, asked_ns)

    @property
    def raw(self) -> bytes:
        """The image published last, without this instance's injections.

        If this process has not published an image yet, this is the last image of the source's
        previous process; without one, all bytes are zero.
        """
        return bytes(self.writer.block.layout.size) if self._last is None else self._last.raw

    @property
    def base(self) -> bytes:
        """The image to which injections are applied, which is usually :attr:`raw`.

        In a replay that shows recorded injections, this is the recorded image with the recorded
        injections applied.
        """
        return self.raw if self._last is None else self._last.base

    @property
    def cycle(self) -> int:
        """The cycle of the image published last; -1 if there is none."""
        return -1 if self._last is None else self._last.cycle

    @property
    def source_ns(self) -> int:
        """Time when the device had the values of the image published last, UTC in ns since 1970.

        0 if the device has not delivered an image yet.
        """
        return 0 if self._last is None else self._last.source_ns

    @property
    def next_ns(self) -> int:
        """The earliest time for a frame between two cycles, in ns of the clock ``now_ns``."""
        return self._next_ns

    @property
    def patience_ns(self) -> int:
        """Time in ns until :meth:`flush` must publish waiting changes; negative if none wait."""
        return max(0, self._next_ns - self._now_ns()) if self._changed else -1

    def publish(self, image: Image) -> None:
        """Publish the next image, after applying the injections to it."""
        with self.lock:
            self._last = image
            if self.advance is not None:
                self._pending += self.advance(image)
            self._publish(image.at)

    def publish_many(self, publish: Callable[[], Image | None]) -> bool:
        """Publish several images at once, unless injections may change them.

        Args:
            publish: Publishes the images, and returns the last one; None: it has published none.

        Returns:
            Whether images were published.
        """
        with self.lock:
            if self.advance is not None or self.injections.layers or self._pending:
                return False
            if (last := publish()) is None:
                return False
            self._last, self._changed = last, False
            self._next_ns = self._now_ns() + self._gap_ns
            return True

    @property
    def last(self) -> Image | None:
        """The image published last, or by the source's previous process; None if there is none."""
        return self._last

    def replace(self, image: Image, records: Iterable[Record]) -> None:
        """Publish an image that replaces all pending changes, then ``records``. The caller holds ``lock``."""
        self._last = image
        self._pending = list(records)
        self._publish()

    def resume(self, image: Image) -> None:
        """Continue from an image that the source's previous process has published."""
        with self.lock:
            self._last = image

    def show(self, records: Iterable[Record]) -> None:
        """Publish the present state of the injections, then ``records``. The caller holds ``lock``.

        If the last frame was published too recently, the changes wait for :meth:`flush`.
        """
        self._pending += records
        self._changed = True
        if self._now_ns() >= self._next_ns:
            self._publish()

    def flush(self, *, now: bool = False) -> None:
        """Publish the waiting changes if their time has come, or if ``now`` is true."""
        with self.lock:
            if self._changed and (now or self._now_ns() >= self._next_ns):
                self._publish()

    def _publish(self, at: Stamp | None = None) -> None:
        if self._last is not None:
            last = self._last
            effective = self.injections.effective(last.base)
            self.writer.publish(
                last.raw,
                cycle=last.cycle,
                source_ns=last.source_ns,
                quality=last.quality,
                provenance=last.provenance,
                reason=last.reason,
                effective=last.shown if effective is None else effective,
                asked_ns=last.asked_ns,
                at=at,
            )
        self._changed = False
        if self._pending:
            pending, self._pending = self._pending, []
            for record in pending:
                self.writer.event(record)
        self._next_ns = self._now_ns() + self._gap_ns


# -- injections --------------------------------------------------------------------------------------------------------


class LayerPublisher:
    """Adds and removes layers, and publishes each change."""

    def __init__(self, output: Output, writable: bytes, refuse_in: str) -> None:
        """Create the publisher.

        Args:
            output: Publishes the source's images and events.
            writable: The bits that commands may write, as an image of the block.
            refuse_in: Why injections over ``/in`` are refused; empty if they are allowed.

        """
        self.output = output
        self._writable = writable
        self._refuse_in = refuse_in
        self._shown: dict[int, tuple[object, bytes]] = {}  # by number: the state, and its JSON
        self._ranges: dict[int, tuple[tuple[int, int, int], ...]] = {}
        self._computed: dict[int, list[Write]] = {}  # by number: the values published last

    @property
    def injections(self) -> LayerStack:
        """All layers of the source."""
        return self.output.injections

    def add(self, layer: Layer) -> str:
        """Add a layer; return "", or why it was refused.

        The caller holds the output's ``lock``.
        """
        if layer.direction is Direction.IN:
            if self._refuse_in:
                return self._refuse_in
            block = self.output.writer.block
            if reason := unwritable(block.source, block.layout, layer.cover, self._writable):
                return reason
        if reason := self.injections.add(layer):
            return reason
        self._ranges[layer.id] = ranges_of(layer.cover.tobytes())
        try:
            self.publish(growth=GROWTH * len(self.injections.layers))
        except ValueError as error:
            self.injections.lift(lambda other: other is layer)
            return str(error)
        return ""

    def restore(self, layer: Layer) -> None:
        """Add a layer that the source's previous process has already published."""
        self._ranges[layer.id] = ranges_of(layer.cover.tobytes())
        self.injections.add(layer)

    def lift(self, which: Callable[[Layer], bool], reason: str, command: Command | None = None) -> None:
        """Remove the layers that ``which`` selects, and publish events with the reason."""
        with self.output.lock:
            self.output.show(self.removed(which, reason, command))

    def replace(self, layers: Sequence[Layer], base: bytes) -> None:
        """Replace all layers. The caller holds the output's ``lock``, and then publishes the image ``base``.

        Raises:
            ValueError: The list of injections would be too long.

        """
        self._shown.clear()
        self._computed.clear()
        self._ranges = {layer.id: ranges_of(layer.cover.tobytes()) for layer in layers}
        self.injections.layers = list(layers)
        self.publish()
        for _ in self.computed(base):
            pass  # the clients of outer layers have got these values already

    def removed(self, which: Callable[[Layer], bool], reason: str, command: Command | None = None) -> list[Record]:
        """Remove the layers that ``which`` selects, and return the events about their removal.

        The caller holds the output's ``lock``.
        """
        gone = [layer for layer in self.injections.layers if which(layer)]
        above = {other.id for layer in gone for other in self.injections.outer(layer)}
        self.injections.lift(which)
        for layer in gone:
            self._shown.pop(layer.id, None)
            self._ranges.pop(layer.id, None)
            self._computed.pop(layer.id, None)
        self.publish()
        ends = [layer_event(EventKind.LIFTED, layer, reason, command) for layer in gone]
        lost_values = [record for layer in gone if isinstance(layer, DeclaredLayer) for record in lost(layer, reason)]
        left = [layer for layer in self.injections.layers if layer.id in above]
        for layer in left:
            self._computed.pop(layer.id, None)  # published below, without the removed layers
        return [*lost_values, *self.inner_values(left, ends[0]), *ends] if ends else []

    def inner_values(self, layers: Iterable[Layer], end: Record) -> Iterator[Record]:
        """Yield events with the values that inner layers now supply to the clients of ``layers``.

        The events precede ``end``, the last event of the command that caused the change.
        """
        for layer in layers:
            record = Record(EventKind.DIVERTED, layer.name, end.writer, end.command, injection=layer.id, by=end.by)
            yield from _parts(record, self.injections.inner_values(self.output.base, layer))

    def computed(self, base: bytes) -> Iterator[Record]:
        """Yield events about changed values that declared injections supply to the clients of outer layers.

        An event also follows when the last such injection becomes inactive. No command causes these
        events, so their command number is 0, and ``item`` and ``items`` number them.
        """
        for layer in self.injections.layers:
            if not layer.given:
                continue
            inner = self.injections.inner(layer)
            declared = any(isinstance(one, DeclaredLayer) and (one.cover & layer.cover).any() for one in inner)
            before = self._computed.pop(layer.id, None)
            if not declared and before is None:
                continue
            writes = self.injections.inner_values(base, layer)
            if declared:
                self._computed[layer.id] = writes
            if writes != before:
                parts = list(_parts(Record(EventKind.DIVERTED, layer.name, injection=layer.id), writes))
                yield from (part._replace(item=item, items=len(parts)) for item, part in enumerate(parts))

    def created(self, layer: Layer, end: Record) -> Iterator[Record]:
        """Yield events about a client's new layer, which state its direction, priority, ``keep`` and ranges."""
        how = {
            "direction": layer.direction.name.lower(),
            "priority": layer.priority,
            "keep": layer.keep,
            "ranges": self._ranges[layer.id],
        }
        return in_parts(end, msgspec.json.encode(how))

    def publish(self, growth: int = 0) -> None:
        """Write the list of injections into the segment, after each change. The caller holds the output's ``lock``.

        Raises:
            ValueError: The list, with ``growth`` more bytes, would be too long for the segment.

        """
        self.injections.settle()
        items = (self._item(layer) for layer in self.injections.layers)
        self.output.writer.block.injections.write(encode(items, growth))

    def _item(self, layer: Layer) -> bytes:
        running = layer.running if isinstance(layer, DeclaredLayer) else None
        shown = self._shown.get(layer.id)
        if shown is None or shown[0] != running:
            entry = InjectionEntry(
                layer.id, layer.direction.name.lower(), layer.priority, layer.keep, layer.name,
                layer.owner.writer, layer.owner.pid, self._ranges[layer.id], running,
            )  # fmt: skip
            shown = self._shown[layer.id] = running, msgspec.json.encode(entry)
        return shown[1]


def lost(layer: DeclaredLayer, reason: str) -> Iterator[Record]:
    """Discard the writes that a declared injection delays, and yield an EXPIRED event for each."""
    reason = f"an injection delayed the write, and discarded it: {reason}"
    while layer.held:
        offset, mask, data = layer.held.popleft().write
        yield Record(EventKind.EXPIRED, reason, NO_WRITER, layer.id, 0, 1, offset, mask, len(data), b"", layer.id)


def pieces(
    kind: EventKind, command: Command, place: int, writes: Iterable[Write], layer: Layer | None
) -> Iterator[Record]:
    """Yield events with the data of ``writes``, which are parts of an item. A long part needs several events."""
    name, number = (layer.name, layer.id) if layer else ("", 0)
    return _parts(Record(kind, name, command.writer, command.id, place, 1, injection=number, by=command.by), writes)


def _parts(record: Record, writes: Iterable[Write]) -> Iterator[Record]:
    for offset, mask, data in writes:
        for start in range(0, len(data), EVENT_DATA_SIZE):
            part = data[start : start + EVENT_DATA_SIZE]
            yield record._replace(offset=offset + start, mask=mask, size=len(part), data=part)


def in_parts(record: Record, document: bytes) -> Iterator[Record]:
    """Yield events like ``record`` that together carry a JSON document."""
    yield from _parts(record, [Write(0, 0, document)])


def layer_event(kind: EventKind, layer: Layer, text: str, command: Command | None = None) -> Record:
    """Return an event about an injection, caused by ``command``, or by the injection's owner if that is None."""
    writer, number, by = (
        (layer.owner.writer, layer.id, "") if command is None else (command.writer, command.id, command.by)
    )
    return Record(kind, text, writer, number, 0, 1, injection=layer.id, by=by)
