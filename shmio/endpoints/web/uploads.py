"""Compiles files that a user drops on a page: sources of data blocks, tag tables, and other tools' tag lists.

These files may be hostile. A separate process reads them from its standard input, with limits of
time and memory. No file is written.
"""

from __future__ import annotations

import asyncio
import os
import resource
import signal
import sys
from collections.abc import AsyncIterable, Iterator, Sequence
from contextlib import AsyncExitStack, suppress
from pathlib import PurePath
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta

from shmio.endpoints.turns import Turns
from shmio.errors import CommandError, EndpointError, LayoutError
from shmio.layout.compiler import SUFFIXES as SOURCES
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.importing.found import Found, ImportingError
from shmio.layout.importing.importer import import_tags
from shmio.layout.model import Layout, Register
from shmio.layout.tags import SUFFIXES, place_tags
from shmio.wording import printable

MAX_BYTES: Final = 8 << 20
"""Maximum size of all files together, in bytes."""
MAX_HEAD_BYTES: Final = 64 << 10
"""Maximum size in bytes of an upload's first line, which has the names of the files."""
MAX_RECEIVING: Final = 8
"""Maximum number of uploads that are received at the same time. If one more comes, the oldest is ended."""
MAX_COMPILING: Final = 2
"""Maximum number of uploads that are compiled at the same time. Others wait."""
WAIT_S: Final = 10
"""Maximum time in s for which an upload waits for others to be compiled."""
MAX_FILES: Final = 100
MAX_ROWS: Final = 100_000
"""Maximum number of registers that are shown."""
MAX_ANSWER_BYTES: Final = 16 << 20
"""Maximum size of the shown registers as JSON, in bytes."""
MAX_MESSAGES: Final = 200
MAX_TEXT: Final = 500
"""Maximum number of characters that are shown of a text."""
LIMIT_S: Final = 30
"""Maximum time in s that compiling files may take."""
MEMORY_BYTES: Final = 1 << 30
"""Maximum address space of the process that compiles, in bytes."""
NICENESS: Final = 10
"""How much the process that compiles yields to others, such as the sources: nice(2)."""

_Name = Annotated[str, Meta(min_length=1, max_length=255)]
_Bytes = Annotated[int, Meta(ge=0, le=MAX_BYTES)]


class _File(msgspec.Struct, forbid_unknown_fields=True):
    """The name and the size of a file, in the line before the contents."""

    name: _Name
    size: _Bytes


class Uploads:
    """Receives and compiles uploads. A slow client does not block others.

    Use it in the event loop's thread only.
    """

    def __init__(self) -> None:
        self._receiving: dict[int, bytearray] = {}
        """The uploads that are being received, the oldest first."""
        self._number = 0
        self._compiling = asyncio.Semaphore(MAX_COMPILING)
        self._turns = Turns(1)

    async def receive(self, parts: AsyncIterable[bytes]) -> bytes | None:
        """Receive an upload, and return it whole; None if it is too large.

        Raises:
            EndpointError: Too many newer uploads came meanwhile.

        """
        self._number += 1
        number, body = self._number, bytearray()
        self._receiving[number] = body
        if len(self._receiving) > MAX_RECEIVING:
            self._receiving.pop(next(iter(self._receiving))).clear()  # its client may take long to notice
        try:
            async for part in parts:
                if number not in self._receiving:
                    raise EndpointError("too many files are being received; try again")
                body += part
                if len(body) > MAX_BYTES + MAX_HEAD_BYTES:
                    return None
            return bytes(body)
        finally:
            self._receiving.pop(number, None)

    async def compile(self, body: bytes, client: str) -> bytes:
        """Compile an upload as :func:`compile_uploads` does. Wait first while too many others are being compiled.

        The uploads of one client are compiled one after the other, so that others find room.

        Raises:
            CommandError: Compiling took too much time or memory.
            EndpointError: Others took too long.

        """
        async with AsyncExitStack() as stack:
            try:
                async with asyncio.timeout(WAIT_S):
                    await stack.enter_async_context(self._turns.of(client))
                    await stack.enter_async_context(self._compiling)
            except TimeoutError:
                raise EndpointError("other files are being read; try again") from None
            return await compile_uploads(body)


async def compile_uploads(body: bytes) -> bytes:
    """Compile the files of an upload in a separate process. Return its answer, which is JSON.

    Args:
        body: The upload: a line with a JSON list of the files' names and sizes, and then their
            contents.

    Raises:
        CommandError: The process took too much time or memory.

    """
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-P", "-m", "shmio.endpoints.web.uploads"),
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
    )
    try:
        async with asyncio.timeout(LIMIT_S):
            answer, _ = await process.communicate(body)
    except TimeoutError:
        answer = b""
    finally:
        if process.returncode is None:
            with suppress(ProcessLookupError):
                process.kill()
            await process.wait()
    if process.returncode != 0 or not answer:
        raise CommandError(
            f"reading these files took more than {LIMIT_S} s or {MEMORY_BYTES >> 20} MB; use shmio-layout for them"
        )
    return answer


def describe(body: bytes) -> dict[str, Any]:
    """Return the layouts that the files of an upload define, and the messages about the files.

    Args:
        body: As for :func:`compile_uploads`.

    """
    try:
        files = list(_files(body))
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, ValueError) as error:
        return _answer((), [f"the request is malformed: {error}"])
    try:
        layouts, messages = _compile(files)
    except LayoutError as error:
        return _answer((), str(error).split("\n"))
    return _answer(layouts, messages)


def _files(body: bytes) -> Iterator[Source]:
    head, _, rest = body.partition(b"\n")
    described = msgspec.json.decode(head, type=Annotated[list[_File], Meta(min_length=1, max_length=MAX_FILES)])
    if sum(file.size for file in described) != len(rest):
        raise ValueError("the sizes are not those of the contents")
    for file in described:
        yield Source(printable(PurePath(file.name).name or file.name), rest[: file.size])
        rest = rest[file.size :]


def _compile(files: Sequence[Source]) -> tuple[Sequence[Layout], list[str]]:
    """Compile files as ``shmio-layout`` does; import a file that is a tag list of another tool.

    Raises:
        LayoutError: The files can neither be compiled nor imported.

    """
    suffix = files[0].file.lower()
    is_list = not suffix.endswith(SOURCES) and (len(files) == 1 or suffix.endswith(".xml"))
    if is_list and not suffix.endswith(SUFFIXES):
        try:
            return _import(files)
        except ImportingError as error:
            if suffix.endswith(".xml"):  # it is no source, so only the import says what is wrong with it
                raise LayoutError(f"{files[0].file}: {error}") from None
    try:
        compiled = compile_sources(files)
    except LayoutError:
        if is_list:
            with suppress(ImportingError):
                return _import(files)
        raise
    return compiled.layouts, [str(warning) for warning in compiled.warnings]


def _import(files: Sequence[Source]) -> tuple[Sequence[Layout], list[str]]:
    """Import a tag list of another tool, with the files of its types; raise ImportingError if it is not such a list."""
    file, *further = files
    found: Found = import_tags(file.text, file.file, further=further)
    layouts = [place_tags(PurePath(file.file).stem or "tags", found.tags)] if found.tags else []
    return layouts, list(found.report())


def _answer(layouts: Sequence[Layout], messages: Sequence[str]) -> dict[str, Any]:
    room_rows, room_bytes = MAX_ROWS, MAX_ANSWER_BYTES
    shown = []
    for layout in layouts:
        rows: list[list[Any]] = []
        for register in layout.registers:
            row = _row(register)
            room_rows, room_bytes = room_rows - 1, room_bytes - len(msgspec.json.encode(row))
            if room_rows < 0 or room_bytes < 0:
                break
            rows.append(row)
        shown.append(
            {
                "name": _short(layout.name),
                "number": layout.number,
                "size": layout.size,
                "count": len(layout.registers),
                "registers": rows,
            }
        )
    lines = [_short(printable(line)) for line in messages[:MAX_MESSAGES]]
    if len(messages) > MAX_MESSAGES:
        lines.append(f"{len(messages) - MAX_MESSAGES} more messages: shmio-layout prints them")
    return {"layouts": shown, "messages": lines}


def _row(register: Register) -> list[Any]:
    """Return path, type, place, size, initial value, unit and comment of a register."""
    bounds = "".join(f"[{low}..{high}]" for low, high in register.dims)
    place = register.address or (str(register.offset) if register.bit is None else f"{register.offset}.{register.bit}")
    texts = (register.path, f"{register.type}{bounds}", place)
    more = (" ".join((register.initial or "").split()), register.unit, register.comment)
    return [*map(_short, texts), register.size, *map(_short, more)]


def _short(text: str) -> str:
    return text if len(text) <= MAX_TEXT else f"{text[:MAX_TEXT]}…"


def main() -> None:
    """Read an upload from standard input, and write the answer to standard output."""
    os.nice(NICENESS)
    signal.alarm(2 * LIMIT_S)  # ends this process even if its parent has died
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_S, LIMIT_S))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    body = sys.stdin.buffer.read(MAX_BYTES + MAX_HEAD_BYTES)
    sys.stdout.buffer.write(msgspec.json.encode(describe(body)))


if __name__ == "__main__":
    main()
