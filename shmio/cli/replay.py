"""``shmio replay``: controls sources that replay recordings."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import Final

import msgspec

from shmio.cli.common import dumps
from shmio.model.cell import Cell
from shmio.model.replay import ReplayChanges, ReplayStatus
from shmio.times import local_text
from shmio.wording import printable

_VERBS: Final = {
    "status": "show how the recordings play (default)",
    "pause": "pause the recordings",
    "play": "continue; at the end, start from the beginning",
    "seek": "TIME: go to this time",
    "until": "TIME: play until this time, and pause",
    "speed": "X: speed relative to the instance's clock, 0.01 to 1000",
    "loop": "on or off: begin again at the end",
    "to-change": "PATH: play to the next change of a register, and pause",
    "to-event": "KIND: play to the next event of a kind, such as accepted, quality, injected, or any, and pause",
}
_ALONE: Final = ("status", "pause", "play")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``replay``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    lines = "\n".join(f"  {verb:<10} {text}" for verb, text in _VERBS.items())
    parser.description = (
        f"{parser.description}\n\nACTION is one of\n{lines}\n\nTIME: seconds from the start, or a date and time."
    )
    parser.add_argument("action", choices=_VERBS, nargs="?", default="status", metavar="ACTION")
    parser.add_argument("value", nargs="?", metavar="VALUE")
    parser.add_argument(
        "--speed", type=float, metavar="X", help="with play: the speed relative to the instance's clock"
    )
    parser.add_argument(
        "--jump", action="store_true", help="with to-change and to-event: go there at once, without playing"
    )
    parser.add_argument(
        "--source", action="append", default=[], metavar="NAME", help="only the recording that has this source"
    )
    parser.set_defaults(refuse=parser.error)


def execute(cell: Cell, options: argparse.Namespace) -> int:
    """Carry out the action and print the new states.

    Raises:
        CommandError: A source refused the action.
        PathError: A source or register does not exist.
        ValueRangeError: A number or time is out of range.
    """
    found = cell.replay(**_changes(options))
    if options.json:
        print(dumps([msgspec.to_builtins(one) for one in found]))
    else:
        print("\n".join(map(printable, _lines(found))))
    return 0


def _changes(options: argparse.Namespace) -> ReplayChanges:
    """Return the changes that the action makes to the state of a replay."""
    action, value = options.action, options.value
    if (value is None) != (action in _ALONE):
        options.refuse(f"{action} takes no VALUE" if value is not None else f"{action} needs a VALUE: {_VERBS[action]}")
    if options.speed is not None and action != "play":
        options.refuse("--speed is only for the action play")
    if options.jump and action not in ("to-change", "to-event"):
        options.refuse("--jump is only for the actions to-change and to-event")
    by_action: dict[str, ReplayChanges] = {
        "status": {},
        "pause": {"paused": True},
        "play": {"paused": False} if options.speed is None else {"paused": False, "speed": options.speed},
        "seek": {"seek": value},
        "until": {"paused": False, "until": value},
        "speed": {"speed": _number(options)} if action == "speed" else {},
        "loop": {"loop": value == "on"},
        "to-change": {"change": value, "jump": options.jump},
        "to-event": {"event": value, "jump": options.jump},
    }
    if action == "loop" and value not in ("on", "off"):
        options.refuse(f"loop is on or off, not {value!r}")
    return {**by_action[action], "sources": options.source}


def _number(options: argparse.Namespace) -> float:
    try:
        return float(options.value)
    except ValueError:
        options.refuse(f"{options.value!r} is not a number")
        raise


def _lines(found: Iterable[ReplayStatus]) -> Iterable[str]:
    for one in found:
        state = "over" if one.over else "paused" if one.paused else "playing"
        at = local_text(one.time_s)
        until = f", until {one.until_s:.3f} s" if one.until_s is not None else ""
        loop = ", in a loop" if one.loop else ""
        yield (
            f"{one.source}: {state} at {one.position_s:.3f} s of {one.length_s:.3f} s ({at}), "
            f"speed {one.speed:g}{until}{loop}"
        )
