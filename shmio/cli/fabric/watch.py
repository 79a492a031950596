"""``shmio fabric watch``: prints registers of any cells whenever they change."""

from __future__ import annotations

import argparse
import asyncio
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from shmio.cli.common import dumps, room, say
from shmio.cli.fabric.access import with_client
from shmio.cli.read import clock, line_of, object_of
from shmio.errors import RemoteError
from shmio.fabric.connection import is_stored
from shmio.fabric.live import LiveReadings, Watched
from shmio.fabric.registry import Registry

if TYPE_CHECKING:
    from nats.aio.client import Client
    from nats.aio.msg import Msg

    from shmio.model.values import Reading

SILENCE_S = 0.5
"""Interval at which sources that send nothing are looked for, in s."""
MAX_WAITING = 10_000
"""Maximum number of messages that wait to be printed. Further messages are dropped."""


def execute(options: argparse.Namespace) -> int:
    """Print values until Ctrl-C, the end of the connection, or the given number of lines."""
    watched = [Watched.parse(text) for text in options.watched]
    with_client(options, lambda client: _watch(client, watched, options))
    return 0


async def _watch(client: Client, watched: Sequence[Watched], options: argparse.Namespace) -> None:
    live = LiveReadings(await Registry.open(client), watched)
    await live.prepare()
    messages: asyncio.Queue[tuple[str, bytes]] = asyncio.Queue(MAX_WAITING)

    async def take(message: Msg) -> None:
        if not is_stored(message):
            await messages.put((message.subject, message.data))

    for subject in sorted({one.subject for one in watched}):
        await client.subscribe(subject, cb=take)
    printer = _Printer(options)
    checked_s, faulty = time.monotonic(), set[str]()
    while not printer.done:
        with suppress(TimeoutError):
            async with asyncio.timeout(SILENCE_S):
                subject, data = await messages.get()
                try:
                    printer.show(await live.take(subject, data))
                except ValueError as error:
                    if subject not in faulty:
                        say(f"{subject}: {error}", sys.stderr)
                    faulty.add(subject)
        if client.is_closed:
            raise RemoteError("the connection to the fabric is lost")
        if time.monotonic() - checked_s >= SILENCE_S:
            checked_s = time.monotonic()
            printer.show(live.silent())


class _Printer:
    """Prints readings, until there are enough lines."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self._width = self._printed = 0

    @property
    def done(self) -> bool:
        """True if the number of lines has been printed."""
        return bool(self._printed == self._options.count)

    def show(self, readings: Sequence[Reading]) -> None:
        """Print a line for each reading."""
        self._width = max([self._width, *(len(one.path) for one in readings)])
        for one in readings:
            if self.done:
                return
            text = f"{clock(one)}  {line_of(one, self._width, room(self._options))}"
            print(dumps({"path": one.path, **object_of(one)}) if self._options.json else text, flush=True)
            self._printed += 1
