"""Control replays from a local program. All sources that replay the same recording move together.

This module also parses the times and dates that users give.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from datetime import datetime
from typing import Any, Final, Unpack

import msgspec

from shmio.errors import CommandError, PathError, ValueRangeError
from shmio.layout.topic import look_up, parse_topic
from shmio.model.replay import ReplayChanges, ReplayStatus
from shmio.segment.block import Block
from shmio.segment.playhead import (
    MAX_SPEED,
    MIN_SPEED,
    FindRequest,
    MoveRequest,
    Playhead,
    PlayheadAnswer,
    PlayheadRequest,
    PlayState,
)
from shmio.segment.segment import Segment

ANSWER_S: Final = 5.0
"""Time-out in s for the answer of a source to a request that needs no search."""
_SEARCH_S: Final = 600.0
_TURN_NS: Final = 500_000_000
"""Interval in ns at which a wait for an answer checks whether the caller has given up."""


class ReplayRequest(msgspec.Struct, frozen=True, omit_defaults=True):
    """A request to change replays. A field that is None or empty requests no change.

    Attributes:
        paused: True: pause; False: resume.
        speed: Speed relative to the instance's clock, 0.01 to 1000.
        seek: Position to go to: seconds from the start, or a date and time, which is in local time
            unless it has a time zone.
        until: Position at which to pause once, in the same form as ``seek``.
        loop: Whether to start again when the end is reached.
        change: Path of a register: play until its next change, and pause there.
        event: Kind of event: play until the next event of this kind, and pause there.
        jump: With ``change`` or ``event``: whether to go there at once instead of playing.
        sources: Names of the sources to change. Other sources that replay the same recordings change
            with them. Empty: all replays.
    """

    paused: bool | None = None
    speed: float | None = None
    seek: str = ""
    until: str = ""
    loop: bool | None = None
    change: str = ""
    event: str = ""
    jump: bool = False
    sources: tuple[str, ...] = ()

    @property
    def nothing(self) -> bool:
        """True if the request changes nothing."""
        return self == ReplayRequest(sources=self.sources)


class Replays:
    """Controls the replays of an instance.

    Several threads may use an object. Only one program at a time can move the replays.
    """

    def __init__(self, segment: Segment) -> None:
        """Create the object. Every method but :meth:`status` needs a writable ``segment``."""
        self._segment = segment

    def __call__(self, **changes: Unpack[ReplayChanges]) -> list[ReplayStatus]:
        """Control the replays, and return their status: see ``replay`` of :class:`shmio.Cell`."""
        self._segment.require_running()
        keys: dict[str, Any] = {**changes, "sources": tuple(changes.get("sources", ()))}
        for key in {"seek", "until"} & keys.keys():
            keys[key] = str(keys[key])
        wanted = ReplayRequest(**keys)
        return self.status(wanted.sources) if wanted.nothing else self.change(wanted)

    def status(self, sources: Collection[str] = ()) -> list[ReplayStatus]:
        """Return the status of each replay.

        Args:
            sources: Names of sources. The result also has other sources that replay the same
                recordings. Empty: all replays.

        Raises:
            CommandError: The instance replays no recording.
            PathError: One of the sources replays no recording.
        """
        now_ns = self._segment.clock.present_ns()
        plays = self._chosen(ReplayRequest(sources=tuple(sources)))
        return [_replay_status(source, play, now_ns) for source, play in plays.items()]

    def pause(self) -> list[ReplayStatus]:
        """Pause all replays, and return their status."""
        return self.change(ReplayRequest(paused=True))

    def play(self, speed: float | None = None) -> list[ReplayStatus]:
        """Resume all replays, and return their status. A replay at its end starts again.

        Args:
            speed: Speed relative to the instance's clock, 0.01 to 1000; None: as before.

        Raises:
            ValueRangeError: The speed is out of range.
        """
        return self.change(ReplayRequest(paused=False, speed=speed))

    def speed(self, speed: float) -> list[ReplayStatus]:
        """Set the speed of all replays relative to the instance's clock, 0.01 to 1000; return their status.

        Raises:
            ValueRangeError: The speed is out of range.
        """
        return self.change(ReplayRequest(speed=speed))

    def seek(self, to: float | str) -> list[ReplayStatus]:
        """Move all replays to a position, and return their status.

        Args:
            to: Seconds from the start, or a date and time.

        Raises:
            ValueRangeError: The position is not in the recording.
        """
        return self.change(ReplayRequest(seek=str(to)))

    def loop(self, on: bool = True) -> list[ReplayStatus]:
        """Set whether all replays start again when they reach the end, and return their status."""
        return self.change(ReplayRequest(loop=on))

    def play_until(self, to: float | str) -> list[ReplayStatus]:
        """Play up to a position, given as for :meth:`seek`, and pause there.

        Return the status when playing has started.
        """
        return self.change(ReplayRequest(paused=False, until=str(to)))

    def to_change(self, path: str, *, jump: bool = False) -> list[ReplayStatus]:
        """Play until the next change of a register, and pause there.

        Return the status when playing has started.

        Args:
            path: Path of the register.
            jump: Whether to go there at once, instead of playing.

        Raises:
            PathError: There is no such register.
            CommandError: The register does not change any more.
        """
        return self.change(ReplayRequest(change=path, jump=jump))

    def to_event(self, kind: str, *, jump: bool = False) -> list[ReplayStatus]:
        """Play until the next event of a kind, of any source, and pause there.

        Return the status when playing has started.

        Args:
            kind: Kind of event, such as ``accepted`` or ``noted``, or ``any``.
            jump: Whether to go there at once, instead of playing.

        Raises:
            CommandError: No such event follows in the recording.
        """
        return self.change(ReplayRequest(event=kind, jump=jump))

    def change(self, wanted: ReplayRequest, given_up: Callable[[], bool] = lambda: False) -> list[ReplayStatus]:
        """Carry out a request, and return the status of the replays.

        Args:
            wanted: The request.
            given_up: Called at intervals during a search. If it returns True, the search ends.

        Raises:
            ValueRangeError: The speed or a position is out of range.
            PathError: A source or a register does not exist.
            CommandError: There is no replay, a replay refuses or does not answer, or the caller has
                given up the search.
        """
        if not self._segment.shared.writable:
            raise CommandError("this attachment only reads; attach with writable=True")
        if wanted.speed is not None and not (math.isfinite(wanted.speed) and MIN_SPEED <= wanted.speed <= MAX_SPEED):
            raise ValueRangeError(f"the speed must be from {MIN_SPEED:g} to {MAX_SPEED:g}, not {wanted.speed:g}")
        plays = self._chosen(wanted)
        with self._held(plays) as heads:
            if wanted.change or wanted.event:
                self._go_to(wanted, heads, given_up)
            else:
                self._move(heads, lambda play, clock_ns: _move_request(play, wanted, clock_ns))
        return self.status(wanted.sources)

    # ---- choice ----------------------------------------------------------------------------------------------------

    def _blocks(self) -> dict[str, Block]:
        self._segment.refresh()
        return {name: block for name, block in self._segment.blocks.items() if block.playhead is not None}

    def _plays(self) -> dict[str, PlayState]:
        found: dict[str, PlayState] = {}
        for source, block in self._blocks().items():
            play = block.playhead.read() if block.playhead else None
            if play is not None:
                found[source] = play
        if not found:
            raise CommandError(f"instance {self._segment.instance!r} plays no recording")
        return found

    def _chosen(self, wanted: ReplayRequest) -> dict[str, PlayState]:
        """Return the states of the requested sources, and of all others that replay their recordings."""
        plays = self._plays()
        for source in wanted.sources:
            if source not in plays:
                raise PathError(f"source {source!r} plays no recording; these do: {', '.join(plays)}")
        names = list(wanted.sources)
        if wanted.change:
            names = [self._register(wanted.change)[0]]
        meant = {_recording(plays[source]) for source in names or plays}
        if wanted.event and len(meant) > 1:  # positions in different recordings are unrelated
            raise CommandError(
                f"several recordings are playing; choose one by the name of one of its sources ({', '.join(plays)})"
            )
        return {source: play for source, play in plays.items() if _recording(play) in meant}

    def _register(self, path: str) -> tuple[str, str]:
        """Split the path of a replayed register into source and path.

        Raises:
            PathError: There is no such register.
        """
        blocks = self._blocks()
        topic = parse_topic(path, self._segment.blocks, next(iter(blocks)) if len(blocks) == 1 else None)
        if topic.source not in blocks:
            raise PathError(f"{path}: source {topic.source!r} plays no recording; these do: {', '.join(blocks)}")
        look_up(blocks[topic.source].layout, topic)
        return topic.source, topic.path

    @contextmanager
    def _held(self, sources: Collection[str]) -> Iterator[dict[str, Playhead]]:
        """Lock the playheads of sources within a ``with`` block, so that no other program moves them."""
        blocks = self._blocks()
        heads = {source: head for source in blocks if source in sources and (head := blocks[source].playhead)}
        with ExitStack() as stack:
            for head in heads.values():  # all programs lock in this order, so that none deadlock
                stack.enter_context(head.held())
            yield heads

    # ---- moves -----------------------------------------------------------------------------------------------------

    def _go_to(self, wanted: ReplayRequest, heads: Mapping[str, Playhead], given_up: Callable[[], bool]) -> None:
        """Pause, find the next change or event, and play up to its position or go there at once."""
        self._move(heads, lambda _, clock_ns: MoveRequest(clock_ns, paused=True))
        searched = dict(heads)
        path = ""
        if wanted.change:
            source, path = self._register(wanted.change)
            searched = {source: heads[source]}
        now_ns = self._segment.clock.read().time_ns
        after_ns = {source: play.at_ns(now_ns) for source, play in self._plays().items()}
        answers = self._ask(
            searched,
            {source: FindRequest(after_ns[source], path, wanted.event) for source in searched},
            _SEARCH_S,
            given_up,
        )
        positions_ns = [found.position_ns for found in answers.values() if found.position_ns is not None]
        if not positions_ns:
            raise CommandError(next(iter(answers.values())).error)
        at_ns = min(positions_ns)
        if wanted.jump:
            self._move(heads, lambda _, clock_ns: MoveRequest(clock_ns, paused=True, position_ns=at_ns))
        else:
            self._move(heads, lambda _, now: MoveRequest(now, paused=False, until_ns=at_ns, speed=wanted.speed))

    def _move(self, heads: Mapping[str, Playhead], move: Callable[[PlayState, int], MoveRequest]) -> None:
        """Send a request to each playhead, so that all take effect at the same time of the clock.

        ``move`` returns the request for a state, given that time in ns.
        """
        clock_ns = self._segment.clock.read().time_ns  # a step in progress counts: no source answers before its end
        asks: dict[str, PlayheadRequest] = {}
        for source, head in heads.items():
            play = head.read()
            if play is not None:
                asks[source] = move(play, clock_ns)
        for source, found in self._ask(heads, asks, ANSWER_S).items():
            if found.error:
                raise CommandError(f"{source}: {found.error}")

    def _ask(
        self,
        heads: Mapping[str, Playhead],
        asks: Mapping[str, PlayheadRequest],
        patience_s: float,
        given_up: Callable[[], bool] = lambda: False,
    ) -> dict[str, PlayheadAnswer]:
        """Send to each playhead its request from ``asks``, and return the answers by source."""
        numbers = {source: heads[source].ask(ask) for source, ask in asks.items()}
        for slot in self._segment.processes:
            if slot.name in asks:
                self._segment.clock.slot_bell(slot.index).ring()
        until_ns = time.monotonic_ns() + round(patience_s * 1e9)
        return {
            source: self._answer(source, heads[source], number, until_ns, given_up)
            for source, number in numbers.items()
        }

    def _answer(
        self, source: str, head: Playhead, number: int, until_ns: int, given_up: Callable[[], bool]
    ) -> PlayheadAnswer:
        ring = self._segment.blocks[source].ring
        while True:
            seen = ring.doorbell()
            found = head.found(number)
            if found is not None:
                return found
            rest_ns = until_ns - time.monotonic_ns()
            if rest_ns <= 0:
                raise CommandError(f"source {source} does not answer: {self._state(source)}")
            if given_up():
                raise CommandError(f"the search in source {source} was given up before it ended")
            ring.wait(seen, min(rest_ns, _TURN_NS))

    def _state(self, source: str) -> str:
        for slot in self._segment.processes:
            if slot.name == source and slot.alive():
                return f"pid {slot.report.pid} is busy, or a step of time is in progress"
        return "its process does not run"


def _recording(play: PlayState) -> tuple[int, int, int]:
    return play.begin_ns, play.end_ns, play.utc_ns


def _move_request(play: PlayState, wanted: ReplayRequest, clock_ns: int) -> MoveRequest:
    """Convert a program's request to the request for one playhead, whose state is ``play``.

    Raises:
        ValueRangeError: A position is not in the recording.
    """
    return MoveRequest(
        clock_ns,
        paused=wanted.paused,
        speed=wanted.speed,
        position_ns=_position(play, wanted.seek) if wanted.seek else None,
        loop=wanted.loop,
        until_ns=_position(play, wanted.until) if wanted.until else None,
    )


def _position(play: PlayState, text: str) -> int:
    try:
        position_ns = moment_ns(text, play.utc_ns + play.begin_ns) - play.utc_ns
    except ValueError:
        raise ValueRangeError(
            f"{text!r} is neither a time such as 2026-11-21T08:30:00 nor seconds from the start of the played range"
        ) from None
    if not play.begin_ns <= position_ns <= play.end_ns:
        length_s = (play.end_ns - play.begin_ns) / 1e9
        raise ValueRangeError(f"{text} is outside the played range, which is {length_s:.3f} s long")
    return position_ns


def _replay_status(source: str, play: PlayState, clock_ns: int) -> ReplayStatus:
    position_ns = play.at_ns(clock_ns)
    return ReplayStatus(
        source,
        (play.utc_ns + position_ns) / 1e9,
        (position_ns - play.begin_ns) / 1e9,
        (play.end_ns - play.begin_ns) / 1e9,
        play.speed,
        play.paused,
        play.loop,
        play.over,
        (play.until_ns - play.begin_ns) / 1e9 if play.until_ns < play.end_ns else None,
    )


def moment_ns(text: str, begin_ns: int) -> int:
    """Parse a time, given in seconds from ``begin_ns`` or as a date and time.

    Returns:
        UTC in ns.

    Raises:
        ValueError: The text is neither a number of seconds nor a date and time.
    """
    try:
        return begin_ns + round(float(text) * 1e9)
    except ValueError:
        return date_ns(text)
    except OverflowError:
        raise ValueError from None


def date_ns(text: str) -> int:
    """Parse a date and time in ISO 8601, which is local time unless it has a time zone.

    Returns:
        UTC in ns.

    Raises:
        ValueError: The text is not a date and time.
    """
    try:
        return round(datetime.fromisoformat(text).astimezone().timestamp() * 1e6) * 1000
    except OverflowError:
        raise ValueError from None
