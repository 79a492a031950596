"""What the registry says about all cells: which run, which are late or down, and which differ in version."""

from __future__ import annotations

from typing import Final

import msgspec

from shmio.fabric.registry import DEAD_S, Registry, Seen, SourceEntry
from shmio.version import __version__
from shmio.wording import counted

LATE_S: Final = 5.0
"""Age in s of a cell's entry from which on the cell is late: it has missed a renewal."""
STOPPED: Final = "stopped"
LATE: Final = "late"
DOWN: Final = "down"


class Member(msgspec.Struct, frozen=True):
    """A cell of the fabric.

    Attributes:
        cell: Name of the cell.
        state: The state of its instance, such as running; late or down if the cell has not renewed
            its entry in time; stopped after an orderly end.
        host: Name of its host.
        instance: Name of its instance.
        version: Its version of shmio.
        age_s: Time since it renewed its entry, by the server's clock, in s.
        started_utc_ns: Time of the start of its instance, UTC in ns since 1970.
        web: Address of its web page; empty if it has none.
        notes: What is remarkable about it.
        sources: Its sources. If the cell is late or down, their qualities are the last known ones.
        machine: A text that tells hosts of the same name apart; empty if it is unknown.

    """

    cell: str
    state: str
    host: str
    instance: str
    version: str
    age_s: float
    started_utc_ns: int
    web: str
    notes: tuple[str, ...]
    sources: tuple[SourceEntry, ...]
    machine: str = ""

    @property
    def alive(self) -> bool:
        """True if the cell runs, and has renewed its entry in time."""
        return self.state not in (STOPPED, LATE, DOWN)


def member(seen: Seen) -> Member:
    """Return what an entry says about its cell."""
    entry = seen.entry
    state = entry.state
    if state != STOPPED and seen.age_s >= LATE_S:
        state = DOWN if seen.age_s >= DEAD_S else LATE
    notes = []
    if entry.version != __version__:
        notes.append(f"version {entry.version}; this host has {__version__}")
    if entry.note and state not in (STOPPED, DOWN):
        notes.append(entry.note)
    if state not in (STOPPED, DOWN) and (bad := [one for one in entry.sources if one.quality != "good"]):
        first = bad[0]
        more = f", and {counted(len(bad) - 1, 'other source')}" if len(bad) > 1 else ""
        why = f" ({first.reason})" if first.reason else ""
        notes.append(f"{first.name} is {first.quality}{why}{more}")
    return Member(
        entry.cell, state, entry.host, entry.instance, entry.version, round(seen.age_s, 1), entry.started_utc_ns,
        entry.web, tuple(notes), entry.sources, entry.machine,
    )  # fmt: skip


async def members(registry: Registry, most: int | None = None) -> list[Member]:
    """Return all cells, in the order of their names; with ``most``, at most so many."""
    return [member(seen) for seen in await registry.cells(most)]


def changes(before: dict[str, Member], now: dict[str, Member]) -> list[tuple[str, str]]:
    """Return what happened to the cells between two looks, as (cell, text), in the order of their names."""
    found = []
    for name in sorted({*before, *now}):
        old, new = before.get(name), now.get(name)
        if new is None:
            found.append((name, "disappeared: the registry no longer has it"))
        elif old is None:
            found.append((name, f"appeared: {new.state} on {new.host}, version {new.version}"))
        else:
            found += [(name, text) for text in _changes(old, new)]
    return found


def _changes(old: Member, new: Member) -> list[str]:
    texts = []
    if old.state != new.state:
        age = f" for {new.age_s:.0f} s" if new.state in (LATE, DOWN) else ""
        texts.append(f"{new.state}{age}, was {old.state}")
    if (old.host, old.machine, old.instance) != (new.host, new.machine, new.instance):
        texts.append(f"moved from {old.instance} on {old.host} to {new.instance} on {new.host}")
    elif old.started_utc_ns != new.started_utc_ns:
        texts.append("started again")
    if old.version != new.version:
        texts.append(f"version {new.version}, was {old.version}")
    qualities = {one.name: one.quality for one in old.sources}
    texts += [
        f"{one.name} is {one.quality}{f': {one.reason}' if one.reason else ''}"
        for one in new.sources
        if qualities.get(one.name, one.quality) != one.quality
    ]
    return texts
