"""How a source begins to play: as its process before did, else as others of its recording do, else as configured."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from shmio.connectors.replay.source import Replay
from shmio.errors import SegmentError
from shmio.segment import NO_WRITER, Block, Stamp
from shmio.segment.playhead import Playhead, PlayState


class ReplayStart(NamedTuple):
    """How a source plays from now on; ``done_ns``: the position up to which the process before has published it.

    None: there was none that played the same recording.
    """

    play: PlayState
    done_ns: int | None

    @property
    def at(self) -> Stamp:
        """When the process's start is told: with what comes next, however long it took."""
        play, done_ns = self
        position_ns = play.begin_ns if done_ns is None else done_ns
        return stamp(play, position_ns, position_ns)


def begin(source: Replay, block: Block, started_ns: int, blocks: Iterable[Block]) -> ReplayStart:
    """Set the playhead of a block, unless it is. ``started_ns``: of the segment; ``blocks``: all there are.

    SegmentError: the block is none for a replay.
    """
    heads = [other.playhead for other in blocks if other.playhead is not None]
    if block.playhead is None or not heads:
        raise SegmentError(f"the block of source {block.source} has no playhead")
    own = block.playhead.read()
    if own is not None and _is_of(source, own):  # without the lock: who holds it may wait for this process
        return ReplayStart(own, _done_ns(block, own))
    with heads[0].held():  # sources that begin at the same time begin together
        others = as_others(source, heads)
        play = _as_configured(source, block, started_ns) if others is None else others
        play = play._replace(
            step=0, asked=block.playhead.asked(), answer=""
        )  # what was asked before was not asked of it
        block.playhead.write(play)
        return ReplayStart(play, None)


def _done_ns(block: Block, play: PlayState) -> int | None:
    """The position of the last frame, or of what was told behind it."""
    last = block.latest()
    if last is None:
        return None
    told = block.events.read(block.events.head())
    behind = told is not None and told.frame == last.number and told.writer == NO_WRITER
    return max(last.publish_ns, told.publish_ns if told is not None and behind else 0) - play.base_ns


def _is_of(source: Replay, play: PlayState) -> bool:
    return (play.begin_ns, play.end_ns, play.utc_ns) == (*source.span, source.recording.utc_ns)


def as_others(source: Replay, heads: Iterable[Playhead]) -> PlayState | None:
    """How what plays the same recording plays, as it was moved last; None: nothing does."""
    plays = [play for head in heads if (play := head.read()) is not None and _is_of(source, play)]
    return max(plays, key=lambda play: play.anchor_ns, default=None)


def _as_configured(source: Replay, block: Block, started_ns: int) -> PlayState:
    span, options = source.span, source.options
    recorded = options.own_clock
    now_ns = block.clock.read().present_ns
    return PlayState(
        span.begin_ns,
        span.end_ns,
        anchor_ns=span.begin_ns if recorded else now_ns,
        position_ns=span.begin_ns,
        until_ns=span.end_ns,
        base_ns=started_ns + (0 if recorded else now_ns - span.begin_ns),
        utc_ns=source.recording.utc_ns,
        speed=options.speed,
        paused=options.paused,
        loop=options.loop,
        own_clock=recorded,
    )


def stamp(play: PlayState, position_ns: int, clock_ns: int) -> Stamp:
    """When what is at a position is published; ``clock_ns``: of the recording."""
    if not play.own_clock:
        clock_ns = play.due_ns(max(position_ns, play.position_ns))
    return Stamp(play.base_ns + position_ns, clock_ns)
