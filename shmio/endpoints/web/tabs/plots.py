"""The plots tab: live values of registers, and past values from the recordings of this run."""

from __future__ import annotations

import asyncio
import time
from functools import partial
from typing import Annotated, Any, ClassVar, Final

import msgspec
from msgspec import Meta

from shmio.endpoints.web.page import Page, Tab, call
from shmio.endpoints.web.recordings import Opened, Work
from shmio.endpoints.web.served import Served
from shmio.endpoints.web.signal_history import Part, Window, first_time, past, signals_of
from shmio.endpoints.web.signals import Feed, check_plottable
from shmio.errors import PathError
from shmio.layout.model import MAX_PATH

MAX_SIGNALS: Final = 200
"""Maximum number of registers that one page plots."""
MAX_COLUMNS: Final = 4000
RECORDED_S: Final = 2.0
"""Time in s within which a published frame reaches the recorder's file."""


class Plotted(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``follow``: the registers of one source that the page plots from now on."""

    source: Annotated[str, Meta(min_length=1, max_length=MAX_PATH)]
    paths: Annotated[list[Annotated[str, Meta(min_length=1, max_length=MAX_PATH)]], Meta(max_length=MAX_SIGNALS)]
    """Paths of registers or elements, which start with the source's name."""


class Wanted(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``past``: registers of one source, a window of time, and the width of the plot in pixels.

    Times are in s of UTC, as in batches.
    """

    source: Annotated[str, Meta(min_length=1, max_length=MAX_PATH)]
    paths: Annotated[list[Annotated[str, Meta(min_length=1, max_length=MAX_PATH)]], Meta(min_length=1, max_length=32)]
    from_s: Annotated[float, Meta(ge=0, le=9e9)]
    to_s: Annotated[float, Meta(ge=0, le=9e9)]
    columns: Annotated[int, Meta(ge=1, le=MAX_COLUMNS)]


class Numbered(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``more``: a number that ``past`` has returned."""

    number: int


class Plots(Tab):
    """Sends the values of registers over time. A page that stalls gets a gap, and then the newest data."""

    name: ClassVar[str] = "plots"
    takes_turns: ClassVar[bool] = False

    def __init__(self, page: Page) -> None:
        super().__init__(page)
        self.turn = page.turn
        self._feeds: dict[str, Feed] = {}
        self._changing = asyncio.Lock()
        self._past: dict[str, dict[int, Work[Part]]] = {}
        self._past_number = 0

    def close(self) -> None:
        """Leave all feeds, and stop reading the past."""
        for source in tuple(self._feeds):
            self._leave(source)
        for source in tuple(self._past):
            self._forget(source)

    @call("read", Wanted)
    async def past(self, given: Wanted) -> list[int]:
        """Start to read past values of registers. This replaces an earlier request for the same source.

        Returns:
            A number for each recording that has some of these values, in the order of time. Pass it
            to ``more`` to get the parts. The list is empty if no recording has any.

        """
        async with self._changing:
            self._forget(given.source)
            served = self.page.served
            epoch = f"{served.segment.header.epoch:016x}"
            utc_ns = served.feeds.utc_ns
            window = Window(round(given.from_s * 1e9), round(given.to_s * 1e9), given.columns)
            since_s = min((window.to_ns - utc_ns) / 1e9 + RECORDED_S, time.monotonic() - RECORDED_S)
            works: list[Work[Part]] = []
            async for opened in served.recordings.of_run(served.segment.instance, epoch, since_s):
                try:
                    work, first_ns = await served.recordings.in_thread(partial(_work, served, opened, given, window))
                except BaseException:
                    served.recordings.release(opened)
                    for other in works:
                        other.stop()
                    raise
                if work is None:
                    served.recordings.release(opened)
                    continue
                works.insert(0, work)
                if first_ns + utc_ns <= window.from_ns:
                    break
            numbers = range(self._past_number + 1, self._past_number + 1 + len(works))
            self._past_number += len(works)
            self._past[given.source] = dict(zip(numbers, works, strict=True))
            return list(numbers)

    @call("read", Numbered)
    async def more(self, given: Numbered) -> Part | None:
        """Return the next part of the past values.

        Return None if there are no more, or if a newer request has replaced this one.
        """
        work = next((works[given.number] for works in self._past.values() if given.number in works), None)
        return None if work is None else await work.next()

    def _forget(self, source: str) -> None:
        for work in self._past.pop(source, {}).values():
            work.stop()

    @call("read", Plotted)
    async def follow(self, given: Plotted) -> dict[str, Any] | None:
        """Send the values of these registers from now on, instead of those of this source that were sent so far.

        The answer comes before the first batch. It has the feed's number, and the registers in the
        order of the batches; it is None if there are no registers.
        """
        async with self._changing:
            paths = list(dict.fromkeys(given.paths))
            others = sum(len(feed.registers) for source, feed in self._feeds.items() if source != given.source)
            if others + len(paths) > MAX_SIGNALS:
                raise PathError(f"a page plots at most {MAX_SIGNALS} registers; remove some first")
            self._leave(given.source)
            if not paths:
                return None
            found = [self.page.served.cell.resolve(path) for path in paths]
            block = found[0][0]
            for path, (other, register) in zip(paths, found, strict=True):
                if other.source != given.source:
                    raise PathError(f"{path}: this register is not one of {given.source}")
                check_plottable(register)
            feed = await self.page.served.feeds.follow(block, [register for _, register in found], self)
            self._feeds[given.source] = feed
            return {
                "number": feed.number,
                "period_ms": block.period_ns / 1e6,
                "signals": [
                    {"path": path, "type": register.type, "unit": register.unit, "comment": register.comment}
                    for path, (_, register) in zip(paths, found, strict=True)
                ],
            }

    def take(self, batch: bytes) -> None:
        """Send a batch to the page."""
        self.page.push_batch(batch)

    def end(self, number: int) -> None:
        """Tell the page which feeds remain, so that it follows the registers of the ended feed again."""
        self._feeds = {source: feed for source, feed in self._feeds.items() if feed.number != number}
        self.page.push("plots", [feed.number for feed in self._feeds.values()])

    def _leave(self, source: str) -> None:
        feed = self._feeds.pop(source, None)
        if feed is not None:
            self.page.served.feeds.leave(feed, self)


def _work(served: Served, opened: Opened, given: Wanted, window: Window) -> tuple[Work[Part] | None, int]:
    """Return the work that reads the past from a recording, and the monotonic time of the first frame in ns.

    The work is None if the recording has nothing of this past.

    Raises:
        PathError: The file has no such register.

    """
    with opened.lock:
        first_ns = first_time(opened.dump, given.source) if given.source in opened.dump.sources else None
        if first_ns is None or first_ns + served.feeds.utc_ns > window.to_ns:
            return None, 0
        signals = signals_of(opened.dump, given.paths)
        dump, utc_ns = opened.dump, served.feeds.utc_ns
        return Work(served.recordings, lambda _: past(dump, signals, window, utc_ns), opened), first_ns
