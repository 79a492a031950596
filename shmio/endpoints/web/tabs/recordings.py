"""The recordings tab: lists, describes, checks and plots recordings, and controls replays."""

from __future__ import annotations

import asyncio
import shlex
import threading
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import msgspec
from msgspec import Meta
from starlette.concurrency import run_in_threadpool

from shmio.endpoints.web.page import Nothing, Page, Tab, call
from shmio.endpoints.web.recordings import MAX_NAME, Opened, Recordings, Work
from shmio.endpoints.web.signal_history import Window, signal_history, signals_of
from shmio.errors import CommandError, RecordingError
from shmio.layout.model import MAX_PATH, Register
from shmio.local.replays import ReplayRequest
from shmio.model.event import EventKind
from shmio.recording.check import check_by_record
from shmio.recording.description import describe
from shmio.recording.reading.reader import Reader

MAX_SIGNALS: Final = 32
"""Maximum number of registers in one plot of a recording."""
MAX_COLUMNS: Final = 4000
MAX_WORKS: Final = 4
"""Maximum number of plots and checks that one page may have in progress."""
MAX_FOUND: Final = 50
"""Maximum number of registers that a search returns."""
MAX_SHOWN: Final = 100
"""Maximum number of blocks, and of gaps, that the description of a recording lists."""
MAX_INSTANCE: Final = 40
"""Maximum length of an instance's name."""
BESIDE: Final = "-replay"
"""Suffix of the name of a second instance, which replays a recording while this instance runs."""
CHECKED_BYTES: Final = 1 << 20
"""Number of checked bytes after which a check reports its progress."""

_Path = Annotated[str, Meta(min_length=1, max_length=MAX_PATH)]
_Name = Annotated[str, Meta(min_length=1, max_length=MAX_NAME)]
_Seconds = Annotated[float, Meta(ge=0, le=9e9)]
_Text = Annotated[str, Meta(max_length=MAX_PATH)]


class Named(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of a call about one recording: its name."""

    name: _Name


class Search(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``registers``: a recording, and a text that the paths of the registers must contain."""

    name: _Name
    filter: Annotated[str, Meta(max_length=200)] = ""


class Plotted(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``plot``: registers of a recording, a window of time, and the width of the plot in pixels.

    Times are in s of UTC; None stands for the start or the end of the recording.
    """

    name: _Name
    paths: Annotated[list[_Path], Meta(max_length=MAX_SIGNALS)]
    columns: Annotated[int, Meta(ge=1, le=MAX_COLUMNS)]
    from_s: _Seconds | None = None
    to_s: _Seconds | None = None


class Numbered(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of a call about work that the page has started: the number of the work."""

    number: int


class Request(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``replay``: a change, with the fields of :class:`shmio.local.replays.ReplayRequest`."""

    paused: bool | None = None
    speed: float | None = None
    seek: _Text = ""
    loop: bool | None = None
    change: _Text = ""
    event: _Text = ""
    jump: bool = False
    sources: Annotated[list[_Text], Meta(max_length=256)] = []


class RecordingsTab(Tab):
    """Shows recordings, and controls replays."""

    name: ClassVar[str] = "recordings"
    takes_turns: ClassVar[bool] = False

    def __init__(self, page: Page) -> None:
        super().__init__(page)
        self._recordings: Recordings = page.served.recordings
        self._works: dict[int, Work[Any]] = {}
        self._number = 0
        self._moving = asyncio.Lock()
        self._closed = threading.Event()

    def close(self) -> None:
        """Stop all work of this page."""
        self._closed.set()
        for work in self._works.values():
            work.stop()
        self._works.clear()

    @call("read", Nothing)
    async def files(self, _: Nothing) -> dict[str, Any]:
        """Return the recordings in the recorder's directory."""
        folder = self._recordings.folder
        return {"folder": None if folder is None else str(folder), "files": await self._recordings.listed()}

    @call("read", Named)
    async def describe(self, given: Named) -> dict[str, Any]:
        """Describe a recording as ``shmio-dump info`` does. Add the commands that replay it."""
        path = self._recordings.path(given.name)
        found = await self._once(lambda beat: describe(path, own=True, beat=beat))
        found["blocks"], found["gaps"] = found["blocks"][:MAX_SHOWN], found["gaps"][:MAX_SHOWN]
        del found["attachments"]
        return found | {"replay": self._commands(path)}

    @call("read", Search)
    async def registers(self, given: Search) -> list[dict[str, str]]:
        """Return the registers of a recording whose path contains a text."""
        opened = await self._recordings.open(given.name)
        try:
            return await self._recordings.in_thread(lambda: _found(opened, given.filter.lower()))
        finally:
            self._recordings.release(opened)

    @call("read", Plotted)
    async def plot(self, given: Plotted) -> dict[str, Any]:
        """Start to read the history of registers, reduced to the width of the plot. ``more`` returns its parts."""
        opened = await self._recordings.open(given.name)
        try:
            dump = opened.dump
            paths = list(dict.fromkeys(given.paths))
            signals = await self._recordings.in_thread(lambda: signals_of(dump, paths))
            from_ns = dump.begin_ns if given.from_s is None else round(given.from_s * 1e9)
            to_ns = dump.end_ns if given.to_s is None else round(given.to_s * 1e9)
            window = Window(from_ns, max(from_ns + 1, to_ns), given.columns)
            number = self._start(
                Work(self._recordings, lambda _: signal_history(dump, signals, window, opened.damage), opened)
            )
        except BaseException:
            self._recordings.release(opened)
            raise
        described = [(signal.path, signal.newest) for signal in signals]
        return {
            "number": number,
            "begin_s": dump.begin_ns / 1e9,
            "end_s": dump.end_ns / 1e9,
            "from_s": from_ns / 1e9,
            "to_s": to_ns / 1e9,
            "signals": [_described(path, register) for path, register in described],
        }

    @call("read", Named)
    async def verify(self, given: Named) -> int:
        """Start to check a recording, as ``shmio-dump verify`` does. ``more`` returns the progress and the result."""
        path = self._recordings.path(given.name)

        def work(beat: Callable[[], None]) -> Iterator[dict[str, Any]]:
            with Reader(path, own=True, beat=beat) as reader:
                size, reported_at, steps = reader.records.size, 0, check_by_record(reader)
                while True:
                    try:
                        at = next(steps)
                    except StopIteration as end:
                        found = end.value
                        break
                    if at - reported_at >= CHECKED_BYTES:
                        reported_at = at
                        yield {"share": at / size}
                result = {"chunks": found.chunks, "messages": found.messages, "damage": found.texts()[:MAX_SHOWN]}
                yield {"share": 1.0, "closed": reader.records.closed, "end": reader.records.damage, **result}

        return self._start(Work(self._recordings, work))

    @call("read", Numbered)
    async def more(self, given: Numbered) -> Any:
        """Return the next part of the result of work that the page has started; None at the end of the work."""
        work = self._works.get(given.number)
        if work is None:
            raise CommandError("this work was stopped")
        try:
            part = await work.next()
        except BaseException:
            await self.stop(given)
            raise
        if part is None:
            await self.stop(given)
        return part

    @call("read", Numbered)
    async def stop(self, given: Numbered) -> None:
        """Stop work that the page has started."""
        work = self._works.pop(given.number, None)
        if work is not None:
            work.stop()

    @call("read", Nothing)
    async def replays(self, _: Nothing) -> dict[str, Any]:
        """Return the status of each replay, and the kinds of events that a replay can search for."""
        try:
            found = await run_in_threadpool(self.page.served.cell.replay.status)
        except CommandError:  # the instance plays no recording
            found = []
        return {"replays": [msgspec.structs.asdict(one) for one in found], "kinds": ["any", *map(str, _KINDS)]}

    @call("control", Request)
    async def replay(self, given: Request) -> list[dict[str, Any]]:
        """Change replays, and return their status. The page's next change waits until this one is done."""
        wanted = ReplayRequest(**msgspec.structs.asdict(given) | {"sources": tuple(given.sources)})
        async with self._moving:
            replay = self.page.served.cell.replay
            found = await run_in_threadpool(replay.change, wanted, self._closed.is_set)
        return [msgspec.structs.asdict(one) for one in found]

    def _commands(self, path: Path) -> dict[str, str]:
        """Return the commands that replay a file beside this instance, and in place of this instance.

        The page does not run them itself, because a replay in place of this instance would stop the
        page. In the first command, PORT stands for the port of the replay's page.
        """
        served = self.page.served
        name = f"{served.segment.instance[: MAX_INSTANCE - len(BESIDE)]}{BESIDE}"
        replay = f"--mode replay --from {shlex.quote(str(path))}"
        config = f"-c {shlex.quote(served.config_file)}"
        return {
            "beside": f"mkdir -p {name} && cat > {name}/supervisor.toml <<'END'\n"
            f'[instance]\nname = "{name}"\n'
            f"[recorder]\ndirectory = {msgspec.json.encode(str(path.parent)).decode()}\n"
            '[web]\nlisten = "127.0.0.1:PORT"\n'
            f"END\nshmio-supervisor up -c {name}/supervisor.toml {replay}",
            "instead": f"shmio-supervisor down {config}\nshmio-supervisor up {config} {replay}",
        }

    def _start(self, work: Work[Any]) -> int:
        if len(self._works) >= MAX_WORKS:
            raise CommandError(f"a page may read at most {MAX_WORKS} recordings at a time; stop one first")
        self._number += 1
        self._works[self._number] = work
        return self._number

    async def _once(self, function: Callable[[Callable[[], None]], dict[str, Any]]) -> dict[str, Any]:
        """Run a function in a thread that reads recordings; stop it when the page is closed."""

        def work(beat: Callable[[], None]) -> Iterator[dict[str, Any]]:
            yield function(beat)

        number = self._start(Work(self._recordings, work))
        found = await self.more(Numbered(number))
        await self.stop(Numbered(number))
        if found is None:
            raise RecordingError("the work was stopped")
        return dict(found)


_KINDS: Final = [kind for kind in EventKind if kind not in (EventKind.REMOVED, EventKind.OTHER)]


def _found(opened: Opened, wanted: str) -> list[dict[str, str]]:
    """Return registers whose path contains a text."""
    paths = (
        (f"{block.source}/{register.path}", register)
        for block in opened.dump.blocks
        for register in block.layout.registers
    )
    fits = ((path, register) for path, register in paths if wanted in path.lower())
    return [_described(path, register) for path, register in dict(islice(fits, MAX_FOUND)).items()]


def _described(path: str, register: Register) -> dict[str, str]:
    return {"path": path, "type": register.type, "unit": register.unit, "comment": register.comment}
