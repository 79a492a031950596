"""``shmio inject --file``: run a campaign, print its events, and remove it at the end."""

from __future__ import annotations

import argparse
import queue
import secrets
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Final

import msgspec

from shmio.cli.interrupt import stop_on_signals
from shmio.cli.run import dumps
from shmio.config import Declaration
from shmio.config.campaign import read_campaign
from shmio.errors import CommandError, ShmioError
from shmio.logs import printable
from shmio.model.cell import Campaign, Cell
from shmio.model.injection import Happening

TURN_S: Final = 0.2
"""Interval between looks for events, signals and the end of the time."""
SEED_BITS: Final = 32


def run_campaign(cell: Cell, options: argparse.Namespace) -> int:
    """Run a campaign until all of it is over, the time is up, or Ctrl-C.

    With ``keep``, return as soon as it has started. ConfigError, CommandError: nothing was started.
    """
    seed = secrets.randbits(SEED_BITS) if options.seed is None else options.seed
    read = read_campaign(options.file)
    declarations = [_with_seed(declaration, seed) for declaration in read]
    now_s = cell.clock().present_ns / 1e9
    if options.from_now:
        declarations = [_shifted(declaration, now_s) for declaration in declarations]
    else:
        _refuse_past(declarations, now_s)
    with stop_on_signals() as over, cell.declare(declarations, keep=options.keep) as campaign:
        if any(declaration.seed is None for declaration in read):
            told = dumps({"seed": seed}) if options.json else f"seed {seed}: --seed {seed} does the same again"
            print(told, flush=True)
        clock = cell.clock()
        if clock.virtual and not clock.playing and any(one.start_s or one.end_s for one in declarations):
            stands = f"time is paused at {clock.present_ns / 1e9:.3f} s"
            print(f"{stands}: start_s and end_s wait until shmio step moves it", file=sys.stderr, flush=True)
        _follow(campaign, over, options)
    return 0


def _follow(campaign: Campaign, over: threading.Event, options: argparse.Namespace) -> None:
    """Print events until no injection remains, the time is up, or a signal comes."""
    deadline_s = None if options.for_s is None else time.monotonic() + options.for_s
    names = {(one.source, one.number): one.name for one in campaign.declared}
    unheard = set(names)
    while unheard:  # the record begins with the injections' start
        happening = next(campaign)
        unheard.discard((happening.source, happening.number))
        _print(happening, names, as_json=options.json)
    if options.keep:
        return
    told: queue.SimpleQueue[Happening | ShmioError | None] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(campaign, told), daemon=True).start()  # it ends with the campaign
    while True:
        ended = over.is_set() or (deadline_s is not None and time.monotonic() > deadline_s)
        while not told.empty():
            one = told.get()
            if one is None:
                return
            if isinstance(one, ShmioError):
                raise one
            _print(one, names, as_json=options.json)
        if ended:
            return
        over.wait(TURN_S)


def _read(campaign: Campaign, told: queue.SimpleQueue[Happening | ShmioError | None]) -> None:
    """Queue the events of a campaign, then None, or the error that ended it."""
    try:
        for happening in campaign:
            told.put(happening)
    except ShmioError as error:
        told.put(error)
    told.put(None)


def _refuse_past(declarations: Sequence[Declaration], now_s: float) -> None:
    """Raise CommandError if the time of an injection has passed, so that it would do nothing."""
    for one in declarations:
        if one.end_s is not None and one.end_s <= now_s:
            raise CommandError(
                f"the time of injection {one.name!r} has passed: its end_s is {one.end_s:g}, the instance's clock "
                f"is at {now_s:.3f} s; --from-now counts the file's times from now"
            )


def _with_seed(declaration: Declaration, seed: int) -> Declaration:
    """Return a declaration with the given seed, unless it has its own."""
    return msgspec.structs.replace(declaration, seed=seed) if declaration.seed is None else declaration


def _shifted(declaration: Declaration, now_s: float) -> Declaration:
    """Return a declaration with times that count from now."""
    end_s = None if declaration.end_s is None else declaration.end_s + now_s
    return msgspec.structs.replace(declaration, start_s=(declaration.start_s or 0) + now_s, end_s=end_s)


def _print(happening: Happening, names: Mapping[tuple[str, int], str], *, as_json: bool) -> None:
    """Print an event as a line: time, cycle, injection, what happened."""
    source, number, time_s = happening.source, happening.number, happening.clock_ns / 1e9
    text = happening.text or names[source, number]
    if as_json:
        what = {"cycle": happening.cycle, "source": source, "id": number, "what": happening.what, "text": text}
        print(dumps({"time_s": time_s, **what}), flush=True)
        return
    line = f"{time_s:11.3f} s  cycle {happening.cycle}  {number} {happening.what}: {text}"
    print(printable(line), flush=True)
