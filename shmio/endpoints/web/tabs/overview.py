"""The overview tab: the instance, its processes and its sources, once a second."""

from __future__ import annotations

import asyncio
import logging
from typing import Annotated, ClassVar, Final

import msgspec
from msgspec import Meta

from shmio.control import Restart
from shmio.endpoints.web.page import Nothing, Page, Tab, call

INTERVAL_S: Final = 1.0
"""Interval in s at which the overview is sent."""


RESTART_S: Final = 40.0
"""Maximum time in s that the restart of a process may take."""

_log = logging.getLogger("shmio.web")


class Named(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``restart``: the name of a process."""

    name: Annotated[str, Meta(min_length=1, max_length=200)]


class Overview(Tab):
    """Sends the overview of the instance. Each page follows it, because all tabs show the overview's head line."""

    name: ClassVar[str] = "overview"

    def __init__(self, page: Page) -> None:
        super().__init__(page)
        self._following: asyncio.Task[None] | None = None

    @call("read", Nothing)
    async def follow(self, _: Nothing) -> None:
        """Send the overview now, and then once a second."""
        if self._following is None:
            self._following = self.page.start(self._follow())

    @call("control", Named)
    async def restart(self, given: Named) -> None:
        """Stop and start a process. Return once it runs again."""
        _log.info(
            "%s asks the supervisor to restart %s",
            f"user {self.page.user.name!r}" if self.page.user.name else "a page",
            given.name,
        )
        await self.page.served.supervisor.ask(Restart(given.name), RESTART_S)

    async def _follow(self) -> None:
        while True:
            self.page.push("overview", self.page.served.overview())
            await asyncio.sleep(INTERVAL_S)
