"""The configuration tab: the file with its faults, what a reload would do, and the reload."""

from __future__ import annotations

import asyncio
import logging
from typing import Annotated, Any, ClassVar, Final

import msgspec
from msgspec import Meta

from shmio.control import Reload
from shmio.endpoints.web.configuration import version
from shmio.endpoints.web.page import FollowedTab, Nothing, Page, call
from shmio.errors import CommandError

INTERVAL_S: Final = 1.0
"""Interval in s at which to check whether the file has changed."""
RELOAD_S: Final = 90.0
"""Maximum time in s that a reload may take."""

_log = logging.getLogger("shmio.web")


class Seen(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``reload``: the version of the file that the user has seen."""

    version: Annotated[str, Meta(max_length=200)]


class Configuration(FollowedTab):
    """Shows the configuration file, and reloads it. It never changes the file."""

    name: ClassVar[str] = "configuration"
    takes_turns: ClassVar[bool] = False

    def __init__(self, page: Page) -> None:
        super().__init__(page)
        self._file = page.served.configuration

    @call("read", Nothing)
    async def check(self, _: Nothing) -> dict[str, Any]:
        """Check the file now. Return it with its faults and the changes that a reload would make."""
        return await self._described()

    @call("control", Seen)
    async def reload(self, given: Seen) -> dict[str, Any]:
        """Apply the changes of the file, if it is still the version that the user has seen."""
        if version(self.page.served.config_file) != given.version:
            raise CommandError("the file has changed since you saw what a reload would do; look at it again")
        _log.info(
            "%s asks the supervisor to reload the configuration",
            f"user {self.page.user.name!r}" if self.page.user.name else "a page",
        )
        try:
            answer = await self.page.served.supervisor.ask(Reload(), RELOAD_S)
        finally:
            self._file.outdate()
        return {key: answer[key] for key in ("done", "problems", "kept")}

    async def _follow(self) -> None:
        seen = None
        while True:
            present = await self._file.state()
            if present != seen:
                described = await self._described()
                self.page.push("configuration", described)
                seen = None if described["problem"] else present  # try again: the supervisor may have been busy
            await asyncio.sleep(INTERVAL_S)

    async def _described(self) -> dict[str, Any]:
        _, read_ns = await self._file.state()
        return await self._file.checked() | {"read_s": None if read_ns is None else read_ns / 1e9}
