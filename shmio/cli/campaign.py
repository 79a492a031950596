"""``shmio inject --file``: lay a campaign, tell what happens in it, and lift it at the end."""

from __future__ import annotations

import argparse
import secrets
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Final

import msgspec

from shmio.cli.interrupt import told_to_stop
from shmio.cli.run import dumps
from shmio.config import Declaration
from shmio.config.campaign import read_campaign
from shmio.errors import CommandError
from shmio.logs import printable
from shmio.segment import Cursor, Event, EventKind
from shmio.segment.attach import Attachment
from shmio.segment.campaign import Laid

TURN_S: Final = 0.2
"""How often it is told what has happened: the bells of several sources cannot be waited for at once."""
SEED_BITS: Final = 32

_TOLD: Final = frozenset({EventKind.INJECTED, EventKind.ACTIVATED, EventKind.DEACTIVATED, EventKind.LIFTED})


def run_campaign(cell: Attachment, options: argparse.Namespace) -> int:
    """Until all of it is over, the time is up, or Ctrl-C; with ``keep`` until it is laid.

    ConfigError, CommandError: nothing was laid.
    """
    seed = secrets.randbits(SEED_BITS) if options.seed is None else options.seed
    read = read_campaign(options.file)
    declarations = [_with_seed(declaration, seed) for declaration in read]
    if options.from_now and cell.sources:
        now_s = cell.block(cell.sources[0]).clock.read().present_ns / 1e9
        declarations = [_shifted(declaration, now_s) for declaration in declarations]
    cursors = {source: cell.block(source).events.cursor() for source in cell.sources}
    with told_to_stop() as over:
        laid = {one.number: one for one in cell.declare(declarations, keep=options.keep)}
        if any(declaration.seed is None for declaration in read):
            told = dumps({"seed": seed}) if options.json else f"seed {seed}: --seed {seed} does the same again"
            print(told, flush=True)
        try:
            _follow(cursors, laid, over, options)
        finally:
            for one in () if options.keep else laid.values():
                with suppress(CommandError):  # it was over, or somebody else has lifted it
                    one.lift()
    return 0


def _follow(
    cursors: Mapping[str, Cursor[Event]], laid: dict[int, Laid], over: threading.Event, options: argparse.Namespace
) -> None:
    """Tell what happens, until nothing is laid any more; what was lifted leaves ``laid``."""
    deadline_s = None if options.for_s is None else time.monotonic() + options.for_s
    while True:
        ended = over.is_set() or options.keep or (deadline_s is not None and time.monotonic() > deadline_s)
        for source, event in _news(cursors, laid):
            _print(source, event, as_json=options.json)
            if event.kind == EventKind.LIFTED:
                del laid[event.injection]
        if ended or not laid:
            return
        over.wait(TURN_S)


def _with_seed(declaration: Declaration, seed: int) -> Declaration:
    """One that has no seed of its own gets one that the user is told, or has told."""
    return msgspec.structs.replace(declaration, seed=seed) if declaration.seed is None else declaration


def _shifted(declaration: Declaration, now_s: float) -> Declaration:
    """With times that count from now."""
    end_s = None if declaration.end_s is None else declaration.end_s + now_s
    return msgspec.structs.replace(declaration, start_s=(declaration.start_s or 0) + now_s, end_s=end_s)


def _news(cursors: Mapping[str, Cursor[Event]], laid: Mapping[int, object]) -> Iterator[tuple[str, Event]]:
    for source, cursor in cursors.items():
        while (event := cursor.next(0)) is not None:
            if event.kind in _TOLD and event.injection in laid and event.offset == 0:  # of parts the first
                yield source, event


def _print(source: str, event: Event, *, as_json: bool) -> None:
    """A line: the instance's clock, the cycle, what happened to which."""
    kind = EventKind(event.kind)
    time_s = event.clock_ns / 1e9
    if as_json:
        told = {"time_s": time_s, "cycle": event.cycle, "source": source, "id": event.injection, "what": str(kind)}
        print(dumps({**told, "text": event.text}), flush=True)
        return
    print(printable(f"{time_s:11.3f} s  cycle {event.cycle}  {event.injection} {kind}: {event.text}"), flush=True)
