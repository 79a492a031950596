"""Publishes the recorded frames and events of one source with their own times."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Final, cast

from shmio.connectors.output import Image, Output
from shmio.connectors.replay.recorded_source import Entry, RecordedSource
from shmio.segment import NO_WRITER, BlockWriter, Event, EventKind, Frame, Provenance, Quality, Record, Stamp
from shmio.segment.commands import MAX_WRITES
from shmio.segment.playhead import OWN_WORDS

OVER: Final = f"{OWN_WORDS}the recording is over"
STOPPED: Final = f"{OWN_WORDS}the source was stopped"
NOTHING: Final = f"{OWN_WORDS}nothing of this source was recorded up to here"
GOES_ON: Final = f"{OWN_WORDS}the recording goes on"

_OF_PROCESSES: Final = frozenset({EventKind.STARTED, EventKind.STOPPED})
_OF_INJECTIONS: Final = frozenset(
    {
        EventKind.DIVERTED,
        EventKind.TAKEN,
        EventKind.INJECTED,
        EventKind.LIFTED,
        EventKind.SHADOWED,
        EventKind.ACTIVATED,
        EventKind.DEACTIVATED,
    }
)

StampOf = Callable[[int, int], Stamp]
"""Returns the stamp of an entry from its position and its recorded clock, both in ns."""

log = logging.getLogger("shmio.source")


def is_replayed(event: Event, *, keep: bool) -> bool:
    """Return whether a recorded event is published.

    ``keep``: whether recorded injections are shown.
    """
    return event.kind not in _OF_PROCESSES and (keep or not (event.kind in _OF_INJECTIONS or event.injection))


class Player:
    """The present place in a recording, and what is published there. For one thread."""

    def __init__(self, recorded: RecordedSource, output: Output, *, keep: bool) -> None:
        """Create a player; ``keep`` says whether recorded injections are shown."""
        self._recorded = recorded
        self._output = output
        self._writer: BlockWriter = output.writer
        self._keep = keep
        self._entries: Iterator[Entry] = iter(())
        self._next: Entry | None = None
        self.note = ""
        """Why quality is not good; empty if it is."""
        self._bad = False  # as last published
        self._missing = False  # whether the last frame was made by this replay
        self.stopped = False
        """Whether the last frame is the one that reports the end of the previous process."""
        self.published = 0

    @property
    def next_ns(self) -> int | None:
        """The position of the next entry; None at the end."""
        return None if self._next is None else self._next.position_ns

    def go(self, position_ns: int | None) -> None:
        """Continue with the first entry at or behind a position; None: from the first entry on."""
        self._entries = self._recorded.entries(position_ns)
        self._next = next(self._entries, None)

    def begin(self, position_ns: int, stamp: StampOf) -> None:
        """Publish the frame before a position, then continue with the entries from the position on.

        Without such a frame it continues with the first entry.
        """
        entry = self._recorded.newest(position_ns - 1)
        if entry is not None:
            self._publish(entry, stamp)
        self.go(None if entry is None else position_ns)

    def again(self, position_ns: int, stale_ns: int, stamp: StampOf) -> None:
        """Continue at the begin of a loop. If no frame follows soon, publish a bad one."""
        if self._recorded.newest(position_ns + stale_ns) is None:
            self.end(NOTHING, stamp(position_ns, position_ns))
        self.go(position_ns)

    def resume(self, position_ns: int) -> None:
        """Continue behind the position up to which the previous process has published."""
        self.go(position_ns + 1)
        entry = self._recorded.newest(position_ns)
        if entry is not None and isinstance(entry.item, Frame):
            self._output.resume(self._image(entry.item, None))
            self._bad = entry.item.quality is Quality.BAD
        last = self._writer.block.latest()
        reason = "" if last is None else last.reason
        self.stopped, self._missing = reason == STOPPED, reason.startswith(OWN_WORDS)

    def show(self, position_ns: int, stamp: StampOf) -> None:
        """Publish the newest frame at a position, and continue behind it.

        Earlier entries are not read.
        """
        entry = self._recorded.newest(position_ns)
        if entry is None:
            self.fail(NOTHING, stamp(position_ns, position_ns))
        else:
            self._publish(entry, stamp)
        self.go(position_ns + 1)

    def play(self, until_ns: int, stamp: StampOf, most: int) -> bool:
        """Publish up to ``most`` entries until a position; return whether there are more."""
        for _ in range(most):
            if self._next is None or self._next.position_ns > until_ns:
                return False
            self._publish(self._next, stamp)
            self._next = next(self._entries, None)
        return self._next is not None and self._next.position_ns <= until_ns

    def end(self, reason: str, stamp: Stamp) -> None:
        """Publish a bad frame, unless the last one was bad."""
        if not self._bad:
            self.fail(reason, stamp)

    def fail(self, reason: str, stamp: Stamp) -> None:
        """Publish the last image with bad quality."""
        output = self._output
        image = Image(
            output.raw, max(0, output.cycle), output.source_ns, Quality.BAD, Provenance.REPLAYED, reason,
            shown=None if output.base is output.raw else output.base, at=stamp,
        )  # fmt: skip
        self._tell(Quality.BAD, reason, stamp)
        self._missing = True
        self._show(image)

    # ---- what there is -------------------------------------------------------------------------------------------

    def _publish(self, entry: Entry, stamp: StampOf) -> None:
        position_ns, item = entry
        if isinstance(item, Frame):
            at = stamp(position_ns, item.clock_ns)
            self._writer.cycle = item.cycle
            if self._missing:
                self._missing = False
                if item.quality is not Quality.BAD:
                    self._tell(item.quality, GOES_ON, at)
            self._show(self._image(item, at))
        elif isinstance(item, Event):
            self._happen(item, stamp(position_ns, item.clock_ns))
        else:
            self.fail(f"{OWN_WORDS}{item.reason}", stamp(position_ns, position_ns))

    def _image(self, frame: Frame, at: Stamp | None) -> Image:
        asked_ns = None if at is None else at.publish_ns - 1000 * frame.delay_us
        return Image(
            frame.raw, frame.cycle, frame.source_ns, frame.quality, Provenance.REPLAYED, frame.reason, asked_ns,
            frame.effective if self._keep else None, at,
        )  # fmt: skip

    def _show(self, image: Image) -> None:
        self._output.publish(image)
        self.note = image.reason
        self._bad = image.quality is Quality.BAD
        self.stopped = False
        self.published += 1

    def _happen(self, event: Event, at: Stamp) -> None:
        """Publish a recorded event without an owner, so that no client takes it for its own."""
        if not is_replayed(event, keep=self._keep):
            return
        record = Record(
            cast(EventKind, event.kind),  # or a number that this version does not know
            event.text, NO_WRITER, event.command, event.item, min(event.items, MAX_WRITES), event.offset, event.mask,
            event.size, event.data, event.injection,
        )  # fmt: skip
        self._writer.cycle = event.cycle
        self._writer.event(record, quality=event.quality, at=at._replace(utc_ns=event.utc_ns))

    def _tell(self, quality: Quality, reason: str, at: Stamp) -> None:
        self._writer.event(Record(EventKind.QUALITY, reason), quality=quality, at=at)
        log.info("quality %s: %s", quality, reason)
