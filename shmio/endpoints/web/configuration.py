"""The configuration file, as all pages show it: its text, its faults, and what a reload would do.

The supervisor checks the file, as for ``shmio-supervisor reload --dry-run``. All pages share the
result, so that many pages cause no more work than one page.
"""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from starlette.concurrency import run_in_threadpool

from shmio.config.faults import Lines, locate
from shmio.config.masking import Masked, mask
from shmio.config.read import read_text
from shmio.control import Reload, Where
from shmio.endpoints.web.supervisor import Supervisor
from shmio.errors import ConfigError, ControlError

CHECK_S: Final = 90.0
"""Maximum time in s that the supervisor may take to answer a dry run."""
WHERE_S: Final = 5.0
FRESH_S: Final = 1.0
"""Time in s for which a result is reused."""
_KINDS: Final = ("stop", "start", "restart", "change", "injections", "reread", "keep")


class ConfigurationFile:
    """The configuration file of the instance. Use it in the event loop's thread only."""

    def __init__(self, file: str, supervisor: Supervisor) -> None:
        self._file = file
        self._supervisor = supervisor
        self._checking = asyncio.Lock()
        self._checked: dict[str, Any] = {}
        self._checked_s = -FRESH_S
        self._outdated_s = -FRESH_S
        self._asking = asyncio.Lock()
        self._state: tuple[str, int | None] = ("", None)
        self._state_s = -FRESH_S

    async def state(self) -> tuple[str, int | None]:
        """Return the version of the file, and when the instance read the file.

        Returns:
            The version (see :func:`version`), and the time in ns since 1970; None if the time is
            unknown.
        """
        asked_s = time.monotonic()
        async with self._asking:
            if self._state_s < asked_s - FRESH_S:
                try:
                    read_ns = (await self._supervisor.ask(Where(), WHERE_S))["read_ns"]
                except ControlError:
                    read_ns = None
                self._state = await run_in_threadpool(version, self._file), read_ns
                self._state_s = time.monotonic()
            return self._state

    async def checked(self) -> dict[str, Any]:
        """Return the file and the result of checking it.

        The check has started at most a second ago, and after the last reload.
        """
        asked_s = time.monotonic()
        async with self._checking:
            if self._checked_s < max(asked_s - FRESH_S, self._outdated_s) or self._checked["problem"]:
                begun_s = time.monotonic()
                self._checked = await self._check()
                self._checked_s = begun_s
            return self._checked

    def outdate(self) -> None:
        """Do not reuse the results of earlier checks, because a reload has changed the instance."""
        self._outdated_s = time.monotonic()

    async def _check(self) -> dict[str, Any]:
        read = await run_in_threadpool(version, self._file)
        found: dict[str, Any] = {"file": self._file, "version": read, "lines": [], "problem": "", "changes": None}
        answer: dict[str, Any] = {"faults": [], "warnings": []}
        text = ""
        try:
            text = await run_in_threadpool(read_text, Path(self._file))
            answer = await self._supervisor.ask(Reload(dry_run=True), CHECK_S)
        except (ConfigError, ControlError) as error:
            found["problem"] = str(error)
        messages = [("fault", line) for line in answer["faults"]]
        messages += [("warning", line) for line in answer["warnings"]]
        if "keep" in answer:
            found["changes"] = {kind: answer[kind] for kind in _KINDS}
        return found | await run_in_threadpool(_annotated, self._file, text, messages)


def version(file: str) -> str:
    """Return a text that changes whenever the file changes; empty if there is no file.

    It reveals nothing of the content.
    """
    try:
        found = Path(file).stat()
    except OSError:
        return ""
    return f"{found.st_ino}-{found.st_size}-{found.st_mtime_ns}"


def _annotated(file: str, text: str, messages: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """Return the lines of the file without secrets, and the messages about them."""
    masked, lines = mask(text), Lines(text)
    return {
        "lines": masked.text.removesuffix("\n").split("\n") if text else [],
        "messages": [_message(kind, line, file, lines, masked) for kind, line in messages],
    }


def _message(kind: str, message: str, file: str, lines: Lines, masked: Masked) -> dict[str, Any]:
    number, text = locate(message, file, lines)
    return {"kind": kind, "line": number, "text": masked.hide(re.sub("^warning: ", "", text))}
