"""The replay source: its configuration keys, its recording, and the state in which it starts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, NamedTuple

import msgspec

from shmio.config.model import ReplayedInjections
from shmio.connectors.base import Replayed
from shmio.connectors.replay.recording import RecordedSource, Recording, Span
from shmio.errors import ConfigError, RecordingError, SegmentError
from shmio.layout.model import Layout
from shmio.model.values import NO_WRITER
from shmio.segment import Block, Stamp
from shmio.segment.playhead import MAX_SPEED, MIN_SPEED, Playhead, PlayState

File = Annotated[str, msgspec.Meta(min_length=1)]


class Replay(Replayed):
    """``connector = "replay"``: plays one source of a recording. It never writes to a device."""

    class Options(msgspec.Struct, forbid_unknown_fields=True):
        """Keys of the source.

        With ``own_clock``, each frame has its recorded instance time. Otherwise, it has the instance
        time at which it is played.
        """

        file: File | Annotated[list[File], msgspec.Meta(min_length=1)]
        source: str | None = None
        start: float | str | None = None
        end: float | str | None = None
        speed: Annotated[float, msgspec.Meta(ge=MIN_SPEED, le=MAX_SPEED)] = 1.0
        loop: bool = False
        paused: bool = False
        injections: ReplayedInjections = "keep"
        own_clock: bool = False

    def __init__(self, options: Options, name: str) -> None:
        """Open the recording.

        Raises:
            ConfigError: The recording cannot be played. The message begins with the configuration
                key that is wrong.

        """
        self.options = options
        try:
            self.recording = Recording(files(options))
        except RecordingError as error:
            raise ConfigError(f"file: {error}") from None
        try:
            self.span, self.recorded = chosen(self.recording, options, name)
        except ConfigError:
            self.recording.close()
            raise

    @property
    def layout(self) -> Layout:
        """The layout of the recorded frames."""
        return self.recorded.block.layout

    @property
    def keep(self) -> bool:
        """True if recorded injections are shown."""
        return self.options.injections == "keep"

    def close(self) -> None:
        """Close the files."""
        self.recording.close()


def files(options: Replay.Options) -> Sequence[str]:
    """Return the names of the recording's files as configured."""
    return [options.file] if isinstance(options.file, str) else options.file


def chosen(recording: Recording, options: Replay.Options, name: str) -> tuple[Span, RecordedSource]:
    """Return the part of the recording that the options select, and a reader of the source to play.

    Raises:
        ConfigError: There is nothing to play. The message begins with the configuration key that is
            wrong.

    """
    try:
        span = recording.span(options.start, options.end)
    except RecordingError as error:
        raise ConfigError(str(error)) from None
    try:
        return span, recording.recorded(options.source or name, span)
    except RecordingError as error:
        raise ConfigError(f"source: {error}") from None


class ReplayStart(NamedTuple):
    """The state in which the process of a replay source starts.

    ``done_ns`` is the position up to which the source's previous process has published the same
    recording; None if there was no such process.
    """

    play: PlayState
    done_ns: int | None

    @property
    def at(self) -> Stamp:
        """The time stamp for the start event, which belongs to the position where playing continues."""
        play, done_ns = self
        position_ns = play.begin_ns if done_ns is None else done_ns
        return stamp(play, position_ns, position_ns)


def begin(source: Replay, block: Block, started_ns: int, blocks: Iterable[Block]) -> ReplayStart:
    """Return the state from which to start, and write this state to the block's playhead.

    If the playhead already belongs to this recording, continue from it. Otherwise follow the other
    sources that replay the recording, if there are any, or start as configured.

    Args:
        source: The recording to play.
        block: The block of the source.
        started_ns: Time at which the segment was created, in ns of CLOCK_MONOTONIC.
        blocks: All blocks of the instance.

    Raises:
        SegmentError: The block has no playhead.

    """
    heads = [other.playhead for other in blocks if other.playhead is not None]
    if block.playhead is None or not heads:
        raise SegmentError(f"the block of source {block.source} has no playhead")
    own = block.playhead.read()
    if own is not None and _is_of(source, own):  # no lock: its holder may wait for this process
        return ReplayStart(own, _done_ns(block, own))
    with heads[0].held():  # sources that start concurrently must agree on one state
        others = as_others(source, heads)
        play = _as_configured(source, block, started_ns) if others is None else others
        play = play._replace(step=0, asked=block.playhead.asked(), answer="")  # skip earlier requests
        block.playhead.write(play)
        return ReplayStart(play, None)


def _done_ns(block: Block, play: PlayState) -> int | None:
    """Return the position of the newest frame or event that was replayed in the block.

    None if the block has no frame. Replayed events are those without an owner.
    """
    last = block.latest()
    if last is None:
        return None
    event = block.events.read(block.events.head())
    behind = event is not None and event.frame == last.number and event.writer == NO_WRITER
    return max(last.publish_ns, event.publish_ns if event is not None and behind else 0) - play.base_ns


def _is_of(source: Replay, play: PlayState) -> bool:
    return (play.begin_ns, play.end_ns, play.utc_ns) == (*source.span, source.recording.utc_ns)


def as_others(source: Replay, heads: Iterable[Playhead]) -> PlayState | None:
    """Return the newest play state of the sources that replay the same recording; None if there are none."""
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
    """Return the time stamp for a position in ns; ``clock_ns`` is the recorded instance time in ns."""
    if not play.own_clock:
        clock_ns = play.due_ns(max(position_ns, play.position_ns))
    return Stamp(play.base_ns + position_ns, clock_ns)
