"""The overview tab: the instance, its processes and its sources, once a second."""

from __future__ import annotations

import asyncio
from typing import ClassVar, Final

from shmio.endpoints.web.page import Nothing, Page, Tab, call

INTERVAL_S: Final = 1.0
"""Interval at which the overview is sent, in s."""


class Overview(Tab):
    """Sends the overview of the instance. All tabs show its head line, so each page follows it."""

    name: ClassVar[str] = "overview"

    def __init__(self, page: Page) -> None:
        super().__init__(page)
        self._following: asyncio.Task[None] | None = None

    @call("read", Nothing)
    async def follow(self, _: Nothing) -> None:
        """Send the overview now, and then each second."""
        if self._following is None:
            self._following = self.page.start(self._follow())

    async def _follow(self) -> None:
        while True:
            self.page.push("overview", self.page.served.overview())
            await asyncio.sleep(INTERVAL_S)
