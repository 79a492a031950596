"""What a request makes of how a recording plays."""

from __future__ import annotations

import math
from typing import Final

from shmio.connectors.replay.recording import MAX_NS
from shmio.errors import ValueRangeError
from shmio.segment.playhead import MAX_SPEED, MIN_SPEED, Move, Play

AHEAD_NS: Final = 60_000_000_000
"""A request may be of a moment that is so far ahead, and of any that has passed: its process may have been held up."""


def moved(play: Play, ask: Move, clock_ns: int) -> tuple[Play, int | None]:
    """How it plays from the request's moment on, and the position that is to be shown; None: it goes on where it is.

    ``clock_ns``: the instance's clock now. ValueRangeError: it cannot be.
    """
    if ask.speed is not None and not (math.isfinite(ask.speed) and MIN_SPEED <= ask.speed <= MAX_SPEED):
        raise ValueRangeError(f"a speed is from {MIN_SPEED:g} to {MAX_SPEED:g}, not {ask.speed:g}")
    if not -MAX_NS < ask.clock_ns <= clock_ns + AHEAD_NS:
        raise ValueRangeError("the request makes no sense")
    play = play.anchored(ask.clock_ns)
    position_ns, paused = ask.position_ns, play.paused if ask.paused is None else ask.paused
    if position_ns is None and not paused and play.position_ns >= play.end_ns:
        position_ns = play.begin_ns  # from the end it goes on at the beginning
    if position_ns is not None and not play.begin_ns <= position_ns <= play.end_ns:
        length_s = (play.end_ns - play.begin_ns) / 1e9
        raise ValueRangeError(f"that is not within what is played, which is {length_s:.3f} s long")
    at_ns = play.position_ns if position_ns is None else position_ns
    if ask.until_ns is not None and ask.until_ns < at_ns:
        at_s = (at_ns - play.begin_ns) / 1e9
        raise ValueRangeError(f"that is past: it is at {at_s:.3f} s; seek to before that first")
    until_ns = play.end_ns if ask.until_ns is None else min(ask.until_ns, play.end_ns)
    if ask.until_ns is None and position_ns is None and (ask.paused is None or play.until_ns > at_ns):
        until_ns = play.until_ns  # `pause` and `play` keep one that lies ahead
    play = play._replace(
        paused=paused,
        speed=play.speed if ask.speed is None else ask.speed,
        loop=play.loop if ask.loop is None else ask.loop,
        position_ns=at_ns,
        until_ns=until_ns,
        over=play.over and position_ns is None,
    )
    return play, position_ns
