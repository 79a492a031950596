"""A condition over topics that has a recording begin, and what was published in the seconds before it is true."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Mapping
from typing import Final

from shmio.dump.encoding import Gap, Place, Reason
from shmio.errors import ConfigError
from shmio.injection.expression import Memory, Number
from shmio.injection.program import NEVER, compile_condition
from shmio.layout.codec import RegisterCodec
from shmio.recording.follower import Aside, Entry
from shmio.segment import Block, Frame, Quality

ENTRY_BYTES: Final = 800
"""About as much an entry takes in memory beside its images."""

log = logging.getLogger("shmio.recorder")


class Trigger:
    """The condition, looked at with each frame of a source that it reads: of what consumers saw of good frames."""

    def __init__(self, when: str, blocks: Mapping[str, Block]) -> None:
        """ConfigError: it is no condition, or reads what is not there."""
        self.when = when
        self._blocks = blocks
        self._bind(blocks)

    def follow(self, blocks: Mapping[str, Block]) -> None:
        """Find the registers anew if a reload has changed the blocks; as long as one is not there it is not true."""
        if blocks is not self._blocks:
            try:
                self._bind(blocks)
            except ConfigError as error:
                log.warning("the trigger waits for what it reads: %s", error)
                self._blocks, self._condition = blocks, NEVER

    def _bind(self, blocks: Mapping[str, Block]) -> None:
        self._condition = compile_condition(self.when, {name: block.layout for name, block in blocks.items()})
        self._blocks = blocks
        self._sections = {block.section: name for name, block in blocks.items()}
        self.sources = {source for source, _ in self._condition.reads}
        """Which it reads."""
        self._images: dict[str, bytes | None] = {}
        self._memory = Memory()

    def sees(self, entry: Entry | Aside) -> bool:
        """Whether it is true with this entry."""
        if isinstance(entry, Aside) or not isinstance(entry.item, Frame):
            return False
        source = self._sections.get(entry.follower.block.section, "")
        if source not in self.sources:
            return False
        frame = entry.item
        known = frame.quality is not Quality.BAD and frame.source_ns != 0
        self._images[source] = frame.image if known else None
        return self._condition.expression.holds([self._value(*read) for read in self._condition.reads], self._memory)

    def _value(self, source: str, codec: RegisterCodec) -> Number | None:
        image = self._images.get(source)
        value = None if image is None else codec.decode(image)
        return value if isinstance(value, bool | int | float) else None


class Backlog:
    """What was published in the last seconds, as far as a bound of memory lasts; older entries are let go."""

    def __init__(self, before_s: float, limit_bytes: int, places: Mapping[int, Place]) -> None:
        """``places``: behind which it begins, by section."""
        self._before_ns = round(before_s * 1e9)
        self._limit = limit_bytes
        self._entries: deque[Entry | Aside] = deque()
        self._size = 0
        self._told = False
        self.places = dict(places)
        """Behind which it begins now, by section."""

    def add(self, entry: Entry | Aside) -> None:
        """The next one. What was lost before this recorder ran is not missed."""
        item = entry.item
        if isinstance(item, Gap) and item.reason is not Reason.OVERTAKEN:
            self._pass(entry)
            return
        self._entries.append(entry)
        self._size += _size(entry)
        self._trim(entry.log_ns)
        if self._size > self._limit and not self._told:
            self._told = True
            kept_s = (entry.log_ns - self._entries[0].log_ns) / 1e9
            log.warning(
                "only %.1f s before a trigger are kept: recorder.trigger.before_mb has no room for more", kept_s
            )
        while self._size > self._limit:
            self._drop()

    def before(self, log_ns: int) -> list[Entry | Aside]:
        """What was published in the seconds before this time, the oldest first; :attr:`places` is where it begins."""
        self._trim(log_ns)
        return list(self._entries)

    def _trim(self, now_ns: int) -> None:
        while self._entries and self._entries[0].log_ns < now_ns - self._before_ns:
            self._drop()

    def _drop(self) -> None:
        entry = self._entries.popleft()
        self._size -= _size(entry)
        self._pass(entry)

    def _pass(self, entry: Entry | Aside) -> None:
        if isinstance(entry, Aside):
            return
        section, item = entry.follower.block.section, entry.item
        frame, event, _ = self.places.get(section, entry.follower.begin)
        if isinstance(item, Gap):
            frame, event = (item.last, event) if item.what == "frames" else (frame, item.last)
        elif isinstance(item, Frame):
            frame = item.number
        else:
            event = item.number
        self.places[section] = Place(frame, event, entry.log_ns)


def _size(entry: Entry | Aside) -> int:
    item = entry.item
    return ENTRY_BYTES + (len(item.raw) + len(item.effective or b"") if isinstance(item, Frame) else 0)
