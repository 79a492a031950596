"""The log tab: the end of the log files of all processes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import msgspec
from msgspec import Meta

from shmio.endpoints.web.page import Tab, call
from shmio.local.log_files import last_lines, parse_line

MAX_LINES: Final = 500
"""Maximum number of lines that are sent to the page."""
SEARCHED_LINES: Final = 5_000
"""Number of newest lines in which a filter searches."""
MAX_TEXT: Final = 2_000
"""Maximum number of characters that are sent of a line."""


class Wanted(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``lines``: which lines the page wants."""

    filter: Annotated[str, Meta(max_length=200)] = ""
    """Text that each line must contain; empty: any line. Case is ignored."""
    process: Annotated[str, Meta(max_length=200)] = ""
    """Name of the process whose lines to return; empty: of all processes."""
    count: Annotated[int, Meta(ge=1, le=MAX_LINES)] = 200


class Log(Tab):
    """Shows the end of the log files."""

    name: ClassVar[str] = "log"

    @call("read", Wanted)
    async def lines(self, given: Wanted) -> list[dict[str, Any]]:
        """Return the newest matching lines, the oldest first."""
        served = self.page.served
        names = ["supervisor", *(slot.name for slot in served.segment.processes)]
        chosen = [name for name in names if given.process in ("", name)]
        files = [Path(served.folders["logs"]) / f"{name}.log" for name in chosen]
        return await self.page.turn.in_thread(_lines, files, given)


def _lines(files: list[Path], given: Wanted) -> list[dict[str, Any]]:
    wanted = given.filter.lower()
    most = SEARCHED_LINES if wanted else given.count
    found = (line.decode(errors="replace")[:MAX_TEXT] for line in last_lines(files, most))
    return [parse_line(line) for line in [line for line in found if wanted in line.lower()][-given.count :]]
