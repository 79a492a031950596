"""``shmio fabric status``: prints the state of one cell and of its sources."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

import msgspec

from shmio.cli.common import dumps
from shmio.cli.fabric.access import with_client
from shmio.cli.instance.status import columns, duration
from shmio.errors import NotRunningError
from shmio.fabric.fleet import Member, member
from shmio.fabric.names import CellName
from shmio.fabric.registry import Registry
from shmio.wording import printable, unknown

if TYPE_CHECKING:
    from nats.aio.client import Client

_HEADINGS = ("SOURCE", "PERIOD", "REGISTERS", "LAYOUT", "QUALITY")


def execute(options: argparse.Namespace) -> int:
    """Print the state; return 1 if the cell does not run."""
    name = CellName.parse(options.cell)

    async def work(client: Client) -> Member:
        registry = await Registry.open(client)
        seen = await registry.find(name)
        if seen is None:
            names = [other.entry.cell for other in await registry.cells()]
            raise NotRunningError(unknown("cell", str(name), names, "the fabric"))
        return member(seen)

    found: Member = with_client(options, work)
    if options.json:
        print(dumps(msgspec.to_builtins(found), indent=2))
    else:
        print("\n".join(map(printable, _lines(found))))
    return 0 if found.alive else 1


def _lines(found: Member) -> list[str]:
    where = f"instance {found.instance} on {found.host}, shmio {found.version}"
    lines = [f"{found.cell}: {found.state}, {where}, renewed {duration(found.age_s)} ago"]
    if found.web:
        lines.append(f"web page: {found.web}")
    lines += found.notes
    rows = [
        (one.name, f"{one.period_ns / 1e6:g} ms", str(one.registers), one.layout[:16],
         f"{one.quality}: {one.reason}" if one.reason else one.quality)
        for one in found.sources
    ]  # fmt: skip
    return lines + (columns([_HEADINGS, *rows]) if rows else [])
