"""The plots tab: the course of registers, live."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any, ClassVar, Final

import msgspec
from msgspec import Meta

from shmio.endpoints.web.page import Page, Tab, call
from shmio.endpoints.web.signals import Feed, check_plottable
from shmio.errors import PathError
from shmio.layout.model import MAX_PATH

MAX_SIGNALS: Final = 200
"""Maximum number of registers that one page plots."""


class Plotted(msgspec.Struct, forbid_unknown_fields=True):
    """The registers of one source that the page plots from now on."""

    source: Annotated[str, Meta(min_length=1, max_length=MAX_PATH)]
    paths: Annotated[list[Annotated[str, Meta(min_length=1, max_length=MAX_PATH)]], Meta(max_length=MAX_SIGNALS)]
    """Paths with the source, of registers or elements."""


class Plots(Tab):
    """Sends the course of registers. A page that stalls gets a gap, and then the newest data."""

    name: ClassVar[str] = "plots"

    def __init__(self, page: Page) -> None:
        super().__init__(page)
        self._feeds: dict[str, Feed] = {}
        self._changing = asyncio.Lock()

    def close(self) -> None:
        """Leave all feeds."""
        for source in tuple(self._feeds):
            self._leave(source)

    @call("read", Plotted)
    async def follow(self, given: Plotted) -> dict[str, Any] | None:
        """Send the course of these registers of a source, in place of those sent so far.

        The answer comes before the first batch. It names the feed's number, and the registers in
        the order of the batch.
        """
        async with self._changing:
            paths = list(dict.fromkeys(given.paths))
            others = sum(len(feed.registers) for source, feed in self._feeds.items() if source != given.source)
            if others + len(paths) > MAX_SIGNALS:
                raise PathError(f"a page plots at most {MAX_SIGNALS} registers: remove some first")
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
        """Tell the page which feeds are left. It follows the others again."""
        self._feeds = {source: feed for source, feed in self._feeds.items() if feed.number != number}
        self.page.push("plots", [feed.number for feed in self._feeds.values()])

    def _leave(self, source: str) -> None:
        feed = self._feeds.pop(source, None)
        if feed is not None:
            self.page.served.feeds.leave(feed, self)
