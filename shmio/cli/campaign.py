"""``shmio inject --file``: lay a campaign, tell what happens in it, and lift it at the end."""

from __future__ import annotations

import argparse
import secrets
import sys
import threading
import time
from collections.abc import Sequence
from typing import Final

import msgspec

from shmio.cli.cell import Campaign, CampaignEvent, Cell
from shmio.cli.interrupt import stop_on_signals
from shmio.cli.run import dumps
from shmio.config import Declaration
from shmio.config.campaign import read_campaign
from shmio.errors import CommandError
from shmio.logs import printable

TURN_S: Final = 0.2
"""How often it is told what has happened: the bells of several sources cannot be waited for at once."""
SEED_BITS: Final = 32


def run_campaign(cell: Cell, options: argparse.Namespace) -> int:
    """Until all of it is over, the time is up, or Ctrl-C; with ``keep`` until it is laid.

    ConfigError, CommandError: nothing was laid.
    """
    seed = secrets.randbits(SEED_BITS) if options.seed is None else options.seed
    read = read_campaign(options.file)
    declarations = [_with_seed(declaration, seed) for declaration in read]
    now_s = cell.clock.present_ns / 1e9
    if options.from_now:
        declarations = [_shifted(declaration, now_s) for declaration in declarations]
    else:
        _refuse_past(declarations, now_s)
    with stop_on_signals() as over, cell.declare(declarations, keep=options.keep) as campaign:
        if any(declaration.seed is None for declaration in read):
            told = dumps({"seed": seed}) if options.json else f"seed {seed}: --seed {seed} does the same again"
            print(told, flush=True)
        clock = cell.clock
        if clock.virtual and not clock.playing and any(one.start_s or one.end_s for one in declarations):
            stands = f"time stands at {clock.present_ns / 1e9:.3f} s"
            print(f"{stands}: start_s and end_s wait for shmio step to move it", file=sys.stderr, flush=True)
        _follow(campaign, over, options)
    return 0


def _follow(campaign: Campaign, over: threading.Event, options: argparse.Namespace) -> None:
    """Tell what happens, until nothing of it stands any more."""
    deadline_s = None if options.for_s is None else time.monotonic() + options.for_s
    while True:
        ended = over.is_set() or options.keep or (deadline_s is not None and time.monotonic() > deadline_s)
        for happened in campaign.news():
            _print(happened, as_json=options.json)
        if ended or not campaign.stands:
            return
        over.wait(TURN_S)


def _refuse_past(declarations: Sequence[Declaration], now_s: float) -> None:
    """CommandError: the time of one is over, so that it would do nothing."""
    for one in declarations:
        if one.end_s is not None and one.end_s <= now_s:
            raise CommandError(
                f"the time of injection {one.name!r} has passed: its end_s is {one.end_s:g}, the instance's clock "
                f"is at {now_s:.3f} s; --from-now counts the file's times from now"
            )


def _with_seed(declaration: Declaration, seed: int) -> Declaration:
    """One that has no seed of its own gets one that the user is told, or has told."""
    return msgspec.structs.replace(declaration, seed=seed) if declaration.seed is None else declaration


def _shifted(declaration: Declaration, now_s: float) -> Declaration:
    """With times that count from now."""
    end_s = None if declaration.end_s is None else declaration.end_s + now_s
    return msgspec.structs.replace(declaration, start_s=(declaration.start_s or 0) + now_s, end_s=end_s)


def _print(happened: CampaignEvent, *, as_json: bool) -> None:
    """A line: the instance's clock, the cycle, what happened to which."""
    time_s, cycle, source, number, what, text = happened
    if as_json:
        told = {"time_s": time_s, "cycle": cycle, "source": source, "id": number, "what": what, "text": text}
        print(dumps(told), flush=True)
        return
    print(printable(f"{time_s:11.3f} s  cycle {cycle}  {number} {what}: {text}"), flush=True)
