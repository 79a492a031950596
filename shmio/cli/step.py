"""``shmio step``: advances, plays or releases the clock of an instance."""

from __future__ import annotations

import argparse
import math
import sys

import msgspec

from shmio.cli.common import at_least, dumps, step_ms, stop_on_signals
from shmio.errors import CommandError
from shmio.model.cell import Cell
from shmio.model.clock import MAX_RATE, ClockMode, ClockStatus, clock_status

LOOK_S = 0.2


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``step``."""
    parser.add_argument("--dt-ms", type=step_ms, metavar="N", help="length of a step (default: the step size, 50)")
    how = parser.add_mutually_exclusive_group()
    how.add_argument("--count", type=at_least(1), default=1, metavar="N", help="number of steps (default: 1)")
    how.add_argument(
        "--play",
        type=_rate,
        nargs="?",
        const=1.0,
        metavar="RATE",
        help="step at RATE times real time (default: 1) until Ctrl-C; then time is paused",
    )
    how.add_argument("--pause", action="store_true", help="pause time, without a step")
    how.add_argument("--release", action="store_true", help="make the instance follow real time again, without a step")
    parser.add_argument(
        "--yes",
        action="store_true",
        help="do not ask for confirmation if the instance follows real time and has devices",
    )


def execute(cell: Cell, options: argparse.Namespace) -> int:
    """Step, play, pause or release the clock, and print its new state.

    Raises:
        CommandError: The options contradict each other, or the user did not confirm.
        TimeError: The clock cannot be moved, or a step failed.
        ValueRangeError: A step or rate is out of range.

    """
    dt_s = None if options.dt_ms is None else options.dt_ms / 1000
    if dt_s is not None and (options.pause or options.release):
        raise CommandError(f"{'--pause' if options.pause else '--release'} does no step; leave out --dt-ms")
    if not options.yes and not options.release:
        _ask(cell)
    if options.play is not None:
        _play(cell, options.play, dt_s)
    elif options.pause:
        cell.pause()
    elif options.release:
        cell.release()
    else:
        cell.step(dt_s, options.count)
    clock = clock_status(cell.clock())
    print(dumps(msgspec.to_builtins(clock)) if options.json else clock_line(clock, options.dt_ms))
    return 0


def clock_line(clock: ClockStatus, dt_ms: float | None = None) -> str:
    """Return the state of the clock as text.

    Args:
        clock: The state.
        dt_ms: Length of the steps that were just made, in ms; None for the clock's step size.
    """
    if clock.mode == str(ClockMode.WALL):
        return f"real time {clock.time_s:.3f} s"
    size = f"{clock.step_size_ms:g} ms"
    step = f"{clock.step}, steps of {size}" if dt_ms is None else f"{clock.step} of {dt_ms:g} ms, step size {size}"
    how = f", playing at {clock.rate:g} times real time" if clock.playing else ""
    note = f"; {clock.note}" if clock.note else ""
    return f"virtual time {clock.time_s:.3f} s, step {step}{how}{note}"


def _ask(cell: Cell) -> None:
    """Ask the user to confirm a step that pauses the clock while devices continue in real time.

    Raises:
        CommandError: The user does not confirm.
    """
    if cell.clock().virtual or not (real := cell.real_sources()):
        return
    who = f"source {real[0]} continues" if len(real) == 1 else f"{real[0]} and {len(real) - 1} more sources continue"
    what = (
        f"the instance follows real time; a step pauses its time until shmio step --release, while {who} in real time"
    )
    if sys.stdin is None or not sys.stdin.isatty():
        raise CommandError(f"{what}; to step anyway, add --yes")
    sys.stderr.write(f"{what}. Continue? [y/N] ")
    sys.stderr.flush()
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise CommandError("the clock was not changed")


def _play(cell: Cell, rate: float, dt_s: float | None) -> None:
    with stop_on_signals() as over:
        cell.play(rate, dt_s)
        while not over.wait(LOOK_S) and cell.clock().playing:
            pass  # until a signal comes, or a step fails
        cell.pause()


def _rate(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value <= MAX_RATE:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0 and up to {MAX_RATE:g}")
    return value
