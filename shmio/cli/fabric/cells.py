"""``shmio fabric cells``: lists all cells, and what happens to them."""

from __future__ import annotations

import argparse
import asyncio
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

import msgspec

from shmio.cli.common import dumps, say
from shmio.cli.fabric.access import with_client
from shmio.cli.instance.status import columns
from shmio.fabric.fleet import Member, changes, members
from shmio.fabric.registry import RENEW_S, Registry
from shmio.times import local_text, utc_text
from shmio.wording import printable

if TYPE_CHECKING:
    from nats.aio.client import Client

_HEADINGS = ("CELL", "STATE", "HOST", "INSTANCE", "VERSION", "SOURCES", "AGE", "")


def execute(options: argparse.Namespace) -> int:
    """Print a line for each cell; with ``--follow``, also a line for each change."""

    async def work(client: Client) -> None:
        registry = await Registry.open(client)
        found = await members(registry)
        if options.json and not options.follow:
            print(dumps(msgspec.to_builtins(found), indent=2))
        elif not options.json:
            print("\n".join(table(found)) if found else "the fabric has no cells yet", flush=True)
        if options.follow:
            await _follow(registry, found, as_json=options.json)

    with_client(options, work)
    return 0


def table(found: Sequence[Member]) -> list[str]:
    """Return a line for each cell, with headings."""
    rows = [
        (one.cell, one.state, one.host, one.instance, one.version, str(len(one.sources)), f"{one.age_s:.0f} s",
         "; ".join(one.notes))
        for one in found
    ]  # fmt: skip
    return [printable(line) for line in columns([_HEADINGS, *rows])]


async def _follow(registry: Registry, found: Sequence[Member], *, as_json: bool) -> None:
    before = {one.cell: one for one in found}
    for one in found if as_json else ():
        say(dumps({"cell": one.cell, "event": one.state, "at": utc_text(time.time(), "seconds")}))
    while True:
        await asyncio.sleep(RENEW_S)
        now = {one.cell: one for one in await members(registry)}
        for cell, text in changes(before, now):
            now_s = time.time()
            record = dumps({"cell": cell, "event": text, "at": utc_text(now_s, "seconds")})
            say(record if as_json else f"{local_text(now_s, 'seconds')}  {cell}  {text}")
        before = now
