"""The loop that plays a recording, in wall time by the clock and in virtual time by steps.

``ReplayLoop`` decides which frames and events are due, and ``Player`` publishes them. ``moved`` and
``Search`` carry out the requests of clients to pause, seek and search.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Final, cast

import msgspec

from shmio.connectors.commands import CommandProcessor
from shmio.connectors.injections import Blocks, OwnerOf
from shmio.connectors.models.stepped import StepClock
from shmio.connectors.output import Image, Output
from shmio.connectors.poll_loop import Counters
from shmio.connectors.replay.recording import MAX_NS, Entry, RecordedSource
from shmio.connectors.replay.source import Replay, ReplayStart, as_others, stamp
from shmio.errors import PathError, SegmentError, ValueRangeError
from shmio.layout.topic import find
from shmio.layout.values.write import Write, bits_of
from shmio.model.values import NO_WRITER
from shmio.segment import BlockWriter, Event, EventKind, Frame, Provenance, Quality, Record, Stamp
from shmio.segment.commands import MAX_WRITES
from shmio.segment.playhead import (
    MAX_SPEED,
    MIN_SPEED,
    OWN_WORDS,
    FindRequest,
    MoveRequest,
    PlayheadAnswer,
    PlayheadRequest,
    PlayState,
    with_answer,
)
from shmio.wording import counted, unknown

OVER: Final = f"{OWN_WORDS}the recording is over"
STOPPED: Final = f"{OWN_WORDS}the source was stopped"
NOTHING: Final = f"{OWN_WORDS}nothing of this source was recorded up to here"
GOES_ON: Final = f"{OWN_WORDS}the recording continues"

PIECE: Final = 64
"""Maximum number of frames and events to play before the loop handles requests and commands again."""
LATE_NS: Final = 10_000_000_000
"""In wall time, frames that are more than this late (instance time, ns) are skipped."""
ASK_TURN_NS: Final = 1_000_000
"""Interval in ns for checking whether a step has ended, while a request waits for its end.

The end of a step does not wake the loop.
"""
BEHIND_NS: Final = 3_000_000_000
"""Age in ns below which a request waits until everything due before it has been played."""
AHEAD_NS: Final = 60_000_000_000
"""Maximum time in ns by which a request may lie in the future.

A request may lie in the past by any time, because the process may have been delayed.
"""
ANY = "any"
"""Event name in a search that matches every event that a replay publishes."""
SEARCH_PIECE = 256
"""Number of entries that a search reads before the loop continues to play."""

_OF_PROCESSES: Final = frozenset({EventKind.STARTED, EventKind.STOPPED})
_OF_INJECTIONS: Final = frozenset(
    {
        EventKind.DIVERTED,
        EventKind.TAKEN,
        EventKind.INJECTED,
        EventKind.LIFTED,
        EventKind.SHADOWED,
        EventKind.ACTIVATED,
        EventKind.DEACTIVATED,
    }
)

Asked = tuple[int, PlayheadRequest | None] | None
"""The number and the content of a waiting request; the content is None if it is invalid. None: no request waits."""
StampOf = Callable[[int, int], Stamp]
"""Function that returns the time stamp of an entry.

Its arguments are the entry's position and the recorded instance time, both in ns.
"""

log = logging.getLogger("shmio.source")


# -- publishing entries ------------------------------------------------------------------------------------------------


def is_replayed(event: Event, *, keep: bool) -> bool:
    """Return whether a replay publishes a recorded event.

    A replay publishes events about injections only with ``keep``, which shows recorded injections.
    """
    return event.kind not in _OF_PROCESSES and (keep or not (event.kind in _OF_INJECTIONS or event.injection))


class Player:
    """Publishes the frames and events of a recording in order. Use it in one thread only."""

    def __init__(self, recorded: RecordedSource, output: Output, *, keep: bool) -> None:
        """Create a player. Set ``keep`` to show recorded injections."""
        self._recorded = recorded
        self._output = output
        self._writer: BlockWriter = output.writer
        self._keep = keep
        self._entries: Iterator[Entry] = iter(())
        self._next: Entry | None = None
        self.note = ""
        """Why quality is not good; empty if it is good."""
        self._bad = False  # the last published frame was bad
        self._missing = False  # the last frame was a bad one of the replay itself, not a recorded one
        self.stopped = False
        """True if the last frame is the bad frame that the previous process published at its end."""
        self.published = 0

    @property
    def next_ns(self) -> int | None:
        """The position of the next entry in ns; None at the end."""
        return None if self._next is None else self._next.position_ns

    def go(self, position_ns: int | None) -> None:
        """Continue with the first entry at or after a position in ns; None: with the first entry of the recording."""
        self._entries = self._recorded.entries(position_ns)
        self._next = next(self._entries, None)

    def begin(self, position_ns: int, stamp: StampOf) -> None:
        """Publish the last frame before a position in ns, and continue with the entries from the position on.

        If there is no frame before the position, continue with the first entry of the recording.
        """
        entry = self._recorded.newest(position_ns - 1)
        if entry is not None:
            self._publish(entry, stamp)
        self.go(None if entry is None else position_ns)

    def again(self, position_ns: int, stale_ns: int, stamp: StampOf) -> None:
        """Start the next round of a looped replay at a position in ns.

        If no frame is due within ``stale_ns`` after the position, publish a bad frame.
        """
        if self._recorded.newest(position_ns + stale_ns) is None:
            self.end(NOTHING, stamp(position_ns, position_ns))
        self.go(position_ns)

    def resume(self, position_ns: int) -> None:
        """Continue after ``position_ns``, the position that the source's previous process has reached."""
        self.go(position_ns + 1)
        entry = self._recorded.newest(position_ns)
        if entry is not None and isinstance(entry.item, Frame):
            self._output.resume(self._image(entry.item, None))
            self._bad = entry.item.quality is Quality.BAD
        last = self._writer.block.latest()
        reason = "" if last is None else last.reason
        self.stopped, self._missing = reason == STOPPED, reason.startswith(OWN_WORDS)

    def show(self, position_ns: int, stamp: StampOf) -> None:
        """Publish the last frame at or before a position, and continue after the position.

        Entries in between are skipped.
        """
        entry = self._recorded.newest(position_ns)
        if entry is None:
            self.fail(NOTHING, stamp(position_ns, position_ns))
        else:
            self._publish(entry, stamp)
        self.go(position_ns + 1)

    def play(self, until_ns: int, stamp: StampOf, most: int) -> bool:
        """Publish the entries up to a position in ns, at most ``most`` entries. Return whether more are left."""
        for _ in range(most):
            if self._next is None or self._next.position_ns > until_ns:
                return False
            self._publish(self._next, stamp)
            self._next = next(self._entries, None)
        return self._next is not None and self._next.position_ns <= until_ns

    def end(self, reason: str, stamp: Stamp) -> None:
        """Publish a bad frame, unless the last published frame was bad."""
        if not self._bad:
            self.fail(reason, stamp)

    def fail(self, reason: str, stamp: Stamp) -> None:
        """Publish the last image with bad quality."""
        output = self._output
        image = Image(
            output.raw, max(0, output.cycle), output.source_ns, Quality.BAD, Provenance.REPLAYED, reason,
            shown=None if output.base is output.raw else output.base, at=stamp,
        )  # fmt: skip
        self._change_quality(Quality.BAD, reason, stamp)
        self._missing = True
        self._show(image)

    # ---- frames and events ---------------------------------------------------------------------------------------

    def _publish(self, entry: Entry, stamp: StampOf) -> None:
        position_ns, item = entry
        if isinstance(item, Frame):
            at = stamp(position_ns, item.clock_ns)
            self._writer.cycle = item.cycle
            if self._missing:
                self._missing = False
                if item.quality is not Quality.BAD:
                    self._change_quality(item.quality, GOES_ON, at)
            self._show(self._image(item, at))
        elif isinstance(item, Event):
            self._happen(item, stamp(position_ns, item.clock_ns))
        else:
            self.fail(f"{OWN_WORDS}{item.reason}", stamp(position_ns, position_ns))

    def _image(self, frame: Frame, at: Stamp | None) -> Image:
        asked_ns = None if at is None else at.publish_ns - 1000 * frame.delay_us
        return Image(
            frame.raw, frame.cycle, frame.source_ns, frame.quality, Provenance.REPLAYED, frame.reason, asked_ns,
            frame.effective if self._keep else None, at,
        )  # fmt: skip

    def _show(self, image: Image) -> None:
        self._output.publish(image)
        self.note = image.reason
        self._bad = image.quality is Quality.BAD
        self.stopped = False
        self.published += 1

    def _happen(self, event: Event, at: Stamp) -> None:
        """Publish a recorded event without its owner, so that no client takes it for an answer to itself."""
        if not is_replayed(event, keep=self._keep):
            return
        record = Record(
            cast(EventKind, event.kind),  # or a number that this version does not know
            event.text, NO_WRITER, event.command, event.item, min(event.items, MAX_WRITES), event.offset, event.mask,
            event.size, event.data, event.injection, event.by,
        )  # fmt: skip
        self._writer.cycle = event.cycle
        self._writer.event(record, quality=event.quality, at=msgspec.structs.replace(at, utc_ns=event.utc_ns))

    def _change_quality(self, quality: Quality, reason: str, at: Stamp) -> None:
        self._writer.event(Record(EventKind.QUALITY, reason), quality=quality, at=at)
        log.info("the quality is %s: %s", quality, reason)


# -- requests ----------------------------------------------------------------------------------------------------------


def moved(play: PlayState, ask: MoveRequest, clock_ns: int) -> tuple[PlayState, int | None]:
    """Apply a client's request to the state of a replay.

    Args:
        play: The present state.
        ask: The request.
        clock_ns: The present instance time, in ns.

    Returns:
        The new state, which applies from the request's time on, and the position to show in ns
        (None: the request does not seek).

    Raises:
        ValueRangeError: The request cannot be carried out.

    """
    if ask.speed is not None and not (math.isfinite(ask.speed) and MIN_SPEED <= ask.speed <= MAX_SPEED):
        raise ValueRangeError(f"the speed must be from {MIN_SPEED:g} to {MAX_SPEED:g}, not {ask.speed:g}")
    if not -MAX_NS < ask.clock_ns <= clock_ns + AHEAD_NS:
        raise ValueRangeError("invalid request")
    play = play.anchored(ask.clock_ns)
    position_ns, paused = ask.position_ns, play.paused if ask.paused is None else ask.paused
    if position_ns is None and not paused and play.position_ns >= play.end_ns:
        position_ns = play.begin_ns  # `play` at the end starts from the beginning
    if position_ns is not None and not play.begin_ns <= position_ns <= play.end_ns:
        length_s = (play.end_ns - play.begin_ns) / 1e9
        raise ValueRangeError(f"the requested time is outside the played part, which is {length_s:.3f} s long")
    at_ns = play.position_ns if position_ns is None else position_ns
    if ask.until_ns is not None and ask.until_ns < at_ns:
        at_s = (at_ns - play.begin_ns) / 1e9
        raise ValueRangeError(f"the requested time has passed: the replay is at {at_s:.3f} s; seek to an earlier time")
    until_ns = play.end_ns if ask.until_ns is None else min(ask.until_ns, play.end_ns)
    if ask.until_ns is None and position_ns is None and (ask.paused is None or play.until_ns > at_ns):
        until_ns = play.until_ns  # `pause` and `play` keep a stop position that lies ahead
    play = play._replace(
        paused=paused,
        speed=play.speed if ask.speed is None else ask.speed,
        loop=play.loop if ask.loop is None else ask.loop,
        position_ns=at_ns,
        until_ns=until_ns,
        over=play.over and position_ns is None,
    )
    return play, position_ns


class Search:
    """A search for an event or for the change of a register.

    It reads the recording in pieces while the replay runs.
    """

    def __init__(self, recorded: RecordedSource, find: FindRequest, end_ns: int, *, keep: bool) -> None:
        """Create a search.

        Args:
            recorded: The recording of the source.
            find: The event or register to find.
            end_ns: The position in ns before which the search ends.
            keep: True if recorded injections are shown.

        Raises:
            PathError: There is no such register or kind of event.

        """
        self._end_ns = end_ns
        self._matches = (
            _event_matcher(find.event, keep=keep) if find.event else _change_matcher(recorded, find, keep=keep)
        )
        self._entries: Iterator[Entry] = recorded.entries(find.after_ns + 1)
        self._what = f"event {find.event}" if find.event else f"change of {find.path}"

    def advance(self) -> PlayheadAnswer | None:
        """Read the next piece. Return the result, or None if the search is not finished."""
        for _ in range(SEARCH_PIECE):
            entry = next(self._entries, None)
            if entry is None or entry.position_ns >= self._end_ns:
                return PlayheadAnswer(f"there is no {self._what} between here and the end of the played part")
            if self._matches(entry):
                return PlayheadAnswer(position_ns=entry.position_ns)
        return None


def _event_matcher(name: str, *, keep: bool) -> Callable[[Entry], bool]:
    kinds = {str(kind): kind for kind in EventKind}
    if name == ANY:
        return lambda entry: isinstance(entry.item, Event) and is_replayed(entry.item, keep=keep)
    if name not in kinds:
        raise PathError(unknown("kind of event", name, [*kinds, ANY]))
    return lambda entry: isinstance(entry.item, Event) and entry.item.kind == kinds[name]


def _change_matcher(recorded: RecordedSource, wanted: FindRequest, *, keep: bool) -> Callable[[Entry], bool]:
    register = find(recorded.block.layout, wanted.path)
    span = slice(register.offset, register.offset + register.size)
    bits = bits_of(register)

    def value(frame: Frame) -> bytes:
        data = (frame.image if keep else frame.raw)[span]
        return bytes(byte & mask for byte, mask in zip(data, bits, strict=True))

    entry = recorded.newest(wanted.after_ns)
    last = value(entry.item) if entry is not None and isinstance(entry.item, Frame) else None

    def matches(entry: Entry) -> bool:
        nonlocal last
        if not isinstance(entry.item, Frame):
            return False
        before, last = last, value(entry.item)
        return before is not None and last != before

    return matches


# -- the loop ----------------------------------------------------------------------------------------------------------


class ReplayLoop:
    """Plays one source of a recording, and answers requests to pause, seek and search.

    In virtual time, each step plays the entries whose time falls into the step; there may be none.
    """

    def __init__(
        self,
        source: Replay,
        writer: BlockWriter,
        beginning: ReplayStart,
        clock: StepClock,
        writable: Iterable[str] = (),
        *,
        allow_nonfinite: Iterable[str] = (),
        owner_of: OwnerOf = lambda _: None,
        blocks: Blocks | None = None,
    ) -> None:
        """Create the loop.

        Args:
            source: The recording to play.
            writer: Writes the source's block.
            beginning: The state to start from, as :func:`~shmio.connectors.replay.source.begin`
                returned it for the same block.
            clock: The loop's clock.
            writable: Patterns of registers for which the configuration allows commands. Commands
                are refused nevertheless, because nothing can be written to a recording.
            allow_nonfinite: Patterns of the registers to which NaN and infinities may be written.
            owner_of: Returns the process that uses a command queue.
            blocks: Returns the blocks of all sources.

        """
        block = writer.block
        if block.playhead is None:
            raise SegmentError(f"the block of source {block.source} has no playhead")
        self._source = source
        self._writer = writer
        self._blocks = blocks or dict
        self._head = block.playhead
        self._page = block.clock
        self._clock = clock
        self._output = Output(writer, clock.now_ns)
        # Injections cannot reach a device here, so `armed` is not required.
        self.commands = CommandProcessor(
            self._output, writable, clock.now_ns, allow_nonfinite=allow_nonfinite, armed=True, owner_of=owner_of,
            blocks=blocks, accepted=clock.nudge,
        )  # fmt: skip
        self._player = Player(source.recorded, self._output, keep=source.keep)
        self._search: tuple[int, Search] | None = None
        self._play, self._done_ns = beginning
        self._round_before: PlayState | None = None
        self.counters = Counters()

    @property
    def note(self) -> str:
        """Why quality is not good; empty if it is good."""
        return self._player.note

    def run(self) -> None:
        """Play until the clock tells the loop to stop, then publish a last, bad frame."""
        try:
            self._begin()
            while not self._run_once():
                pass
        finally:
            self.commands.stop()
            self.commands.close(STOPPED)
            self._player.end(STOPPED, self._stamp_now())
            self._writer.event(Record(EventKind.STOPPED))

    def _begin(self) -> None:
        """Continue where the source's previous process stopped; without such a process, start to play."""
        play, clock_ns = self._play, self._page.read().time_ns
        if self._done_ns is not None:
            reach_ns = play.reach_ns(clock_ns) if play.wraps else play.at_ns(clock_ns)
            # A position ahead of the present one was published before a seek or in an earlier round.
            self._player.resume(self._done_ns if self._done_ns <= reach_ns else play.position_ns - 1)
        else:  # `play` may be that of other sources, which play already
            since_ns = clock_ns if clock_ns - play.anchor_ns > LATE_NS else play.anchor_ns
            self._player.begin(play.at_ns(since_ns), self._stamp)
            if play.over:
                self._end()
        self.commands.open()
        self.counters.connects += 1

    # ---- the loop ------------------------------------------------------------------------------------------------

    def _run_once(self) -> bool:
        """Play what is due, answer requests, then wait. Return whether the loop must stop."""
        asked = self._head.asks(self._play.asked)  # before the time is read, so that no request is in the future
        state = self._page.read()
        # In virtual time, all frames and events have the time of the end of the step.
        self._writer.at_ns = self._play.base_ns + self._play.at_ns(state.time_ns) if state.virtual else None
        stepped = state.stepping and state.step != self._play.step
        if stepped and state.step != self._play.begun:
            self._keep(self._play._replace(begun=state.step, head=self._writer.block.ring.head()))
        # First play up to the time of a waiting request: until then the present state applies.
        before_ns = None if state.stepping else self._before_ns(asked, state.time_ns)
        more = before_ns is not None or (not state.stepping and self._listen(asked, state.time_ns))
        clock_ns = state.time_ns if before_ns is None else before_ns
        more |= self.counters.watch(self._clock.now_ns, lambda: self._advance(clock_ns))
        if not more and stepped:
            self._keep(self._play._replace(step=state.step))
            self._writer.block.ring.wake()
        waits = state.stepping and self._head.asks(self._play.asked) is not None
        if self.commands.waiting:
            self.commands.settle()
            self.commands.carry_out(self._refuse)
        self.counters.polls = self._player.published
        return self._clock.wait_ns(0 if more else ASK_TURN_NS if waits else self._patience_ns(virtual=state.virtual))

    def _patience_ns(self, *, virtual: bool) -> int | None:
        """Return the time in ns until the next entry is due; None if the loop need only wait for a wake-up."""
        play, next_ns = self._play, self._player.next_ns
        if virtual or play.paused:
            return None
        goal_ns = min(play.until_ns, play.end_ns if next_ns is None else next_ns)
        return max(0, play.due_ns(goal_ns) - self._page.present_ns())

    def _advance(self, clock_ns: int) -> bool:
        """Play at most ``PIECE`` entries due at ``clock_ns``. Return whether more are due."""
        self._leave_out(clock_ns)
        play = self._play
        # An entry at the stop position is played; an entry at the end is not.
        target_ns = min(play.reach_ns(clock_ns), play.until_ns, play.end_ns - 1)
        before = self._player.published
        if self._player.play(target_ns, self._stamp, PIECE):
            return True
        if self._player.published != before:
            self.commands.release(self._writer.cycle)
        settled = play.settled(clock_ns)
        if settled is play:
            if self._player.stopped and not play.over and (play.paused or self._writer.at_ns is not None):
                self._show(play.at_ns(clock_ns))  # replace the bad frame: no other may follow
            return False
        if settled.paused:
            over = settled.position_ns >= settled.end_ns
            if over:
                self._end()
            self._keep(settled._replace(over=over))
            self._writer.block.ring.wake()  # for clients that wait for this position
            return False
        self._round_before = play
        self._keep(play.next_round())
        self._player.again(play.begin_ns, self._source.recorded.block.stale_ns, self._stamp)
        return True

    def _end(self) -> None:
        self._player.end(OVER, self._stamp(self._play.end_ns, self._play.end_ns))

    def _leave_out(self, clock_ns: int) -> None:
        """In wall time, skip to the present if the next entry is more than ``LATE_NS`` late.

        If the recording is played in a loop, also skip an entry that is a whole round late: clients
        could not distinguish it from the same entry in the present round.
        """
        play, next_ns = self._play, self._player.next_ns
        if next_ns is None or play.paused or self._writer.at_ns is not None:
            return
        late_ns = clock_ns - play.due_ns(next_ns)
        behind_ns = (play.reach_ns(clock_ns) if play.wraps else play.at_ns(clock_ns)) - next_ns
        too_late = late_ns > LATE_NS
        if not too_late and not (play.wraps and behind_ns >= play.end_ns - play.begin_ns):
            return
        left_out = behind_ns // self._source.recorded.block.period_ns
        self.counters.overruns += left_out
        if too_late:  # otherwise the speed is too high, and the message would repeat in each round
            skipped = counted(left_out, "frame")
            log.warning("the replay skipped %s, because this process was delayed by %.1f s", skipped, late_ns / 1e9)
        if play.wraps:
            self._keep(play.settled(clock_ns))
        self._player.show(min(self._play.at_ns(clock_ns), play.end_ns - 1), self._stamp)

    def _stamp(self, position_ns: int, clock_ns: int) -> Stamp:
        """Return the time stamp for a position; ``clock_ns`` is the recorded instance time."""
        return stamp(self._play, position_ns, clock_ns)

    def _stamp_now(self) -> Stamp:
        at_ns = self._writer.now_ns()
        return Stamp(at_ns, self._head.clock_ns(at_ns))

    def _keep(self, play: PlayState) -> None:
        self._play = play
        self._head.write(play)

    def _refuse(self, writes: Sequence[Write]) -> list[str]:
        return [f"source {self._writer.block.source} replays a recording, so it cannot be written"] * len(writes)

    # ---- requests ------------------------------------------------------------------------------------------------

    def _is_behind(self, clock_ns: int) -> bool:
        """Return whether an entry that was due at ``clock_ns`` has not been played yet."""
        play, next_ns = self._play, self._player.next_ns
        due_ns = min(play.reach_ns(clock_ns), play.until_ns, play.end_ns - 1)
        return (next_ns is not None and next_ns <= due_ns) or play.settled(clock_ns) is not play

    def _before_ns(self, asked: Asked, clock_ns: int) -> int | None:
        """Return the instance time in ns up to which to play before answering a request.

        None if the request can be answered now.
        """
        number, ask = asked or (0, None)
        if not isinstance(ask, MoveRequest) or number != self._play.asked + 1 or ask.position_ns is not None:
            return None
        moment_ns = min(ask.clock_ns, clock_ns)
        return moment_ns if self._is_behind(moment_ns) and clock_ns - moment_ns < BEHIND_NS else None

    def _listen(self, asked: Asked, clock_ns: int) -> bool:
        """Answer a request, or continue the search that it started.

        Return whether there was a request.
        """
        if asked is None:
            self._search = None
            return False
        number, ask = asked
        if missed := number != self._play.asked + 1:
            self._catch_up(clock_ns)
        if isinstance(ask, FindRequest):
            return self._find(number, ask)
        if not isinstance(ask, MoveRequest):
            found = PlayheadAnswer("invalid request")
        elif missed and ask.clock_ns <= self._play.anchor_ns:
            found = PlayheadAnswer()  # the state adopted from the other sources includes it
        else:
            found = self._move(ask, clock_ns)
        self._answer(number, found)
        return True

    def _answer(self, number: int, found: PlayheadAnswer) -> None:
        self._search = None
        self._keep(with_answer(self._play, number, found))
        self._writer.block.ring.wake()

    def _find(self, number: int, ask: FindRequest) -> bool:
        if self._search is None or self._search[0] != number:
            try:
                self._search = number, Search(self._source.recorded, ask, self._play.end_ns, keep=self._source.keep)
            except PathError as error:
                self._answer(number, PlayheadAnswer(str(error)))
                return True
        if (found := self._search[1].advance()) is not None:
            self._answer(number, found)
        return True

    def _move(self, ask: MoveRequest, clock_ns: int) -> PlayheadAnswer:
        """Carry out a request from its time on, and publish the frame at a new position."""
        play, behind = self._play, self._is_behind(min(ask.clock_ns, clock_ns + AHEAD_NS))
        before = self._round_before
        if before and before.anchor_ns <= ask.clock_ns < play.anchor_ns:
            play, behind = play.moved_as(before), True  # the request was made just before the round ended
        was_ns = play.at_ns(clock_ns)
        try:
            play, position_ns = moved(play, ask, clock_ns)
        except ValueRangeError as error:
            return PlayheadAnswer(str(error))
        self._keep(play)
        if position_ns is not None:
            self._show(position_ns)
        elif behind or was_ns - play.at_ns(clock_ns) > self._source.recorded.block.stale_ns:
            self._show(play.at_ns(clock_ns))  # frames were played that the request would have held back
        return PlayheadAnswer()

    def _catch_up(self, clock_ns: int) -> None:
        """After missed requests, adopt the playing state of the other sources that replay the recording."""
        other = as_others(self._source, [head for block in self._blocks().values() if (head := block.playhead)])
        if other is None or other.anchor_ns <= self._play.anchor_ns:
            return
        self._keep(self._play.moved_as(other))
        self._show(other.end_ns - 1 if other.over else other.at_ns(clock_ns))
        if other.over:
            self._end()

    def _show(self, position_ns: int) -> None:
        """Publish the last frame at or before a position, and continue after the position."""
        self._writer.at_ns = self._play.base_ns + position_ns
        self._player.show(position_ns, self._stamp)
