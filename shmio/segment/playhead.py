"""The playhead of a block that replays a recording: its position, and requests to move it.

See docs/reference/segment-format.md for the section. The source's process writes the state. A program
that wants to move the playhead takes the section's lock, writes a request, and waits for the answer.
A position is a time of the recorded instance's clock, in ns since its start.
"""

from __future__ import annotations

import math
import os
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final, NamedTuple

import msgspec

from shmio.errors import CommandError
from shmio.segment import _atomics
from shmio.segment.clock import ClockPage, DoubleBuffer
from shmio.segment.header import cut, text
from shmio.segment.shm import SharedObject

OWN_WORDS: Final = "replay: "
"""Prefix of a replay's own reasons and event texts; those without it were recorded."""
MIN_SPEED: Final = 0.01
MAX_SPEED: Final = 1000.0

_COPIES_AT: Final = (64, 704)
_ASK_AT: Final = 1344
PLAYHEAD_SIZE: Final = 2560

_STATE: Final = struct.Struct("<IIqqqqqqqdQQ256sQQ240x")
_ASK: Final = struct.Struct("<QII1000s")
_TEXT: Final = 255
_MAX_ASK: Final = 999
_MAX_ERROR: Final = 200

_VALID, _PAUSED, _LOOP, _OWN_CLOCK, _OVER = 1, 2, 4, 8, 16
_LOCK_TURN_S: Final = 0.02
_LOCK_S: Final = 10.0


class PlayState(NamedTuple):
    """State of a replay. Positions and clocks are in ns.

    Attributes:
        begin_ns: Start of the played range.
        end_ns: End of the played range, exclusive.
        anchor_ns: The instance's clock at which the position was ``position_ns``.
        position_ns: Position at the anchor; from there it moves at ``speed`` times the clock.
        until_ns: Position at which the replay stops.
        base_ns: Publish time of position 0.
        utc_ns: UTC of position 0.
        speed: Speed relative to the instance's clock.
        paused: Whether it is paused.
        loop: Whether it starts again at the end.
        own_clock: Whether frames have the clock of the recording, or that of the instance.
        over: Whether the end was reached.
        step: The last step of virtual time that was answered.
        asked: Number of the last request that was answered.
        answer: The answer to that request.
        begun: The last step of virtual time that was begun.
        head: Number of the newest frame when that step was begun.
    """

    begin_ns: int
    end_ns: int
    anchor_ns: int
    position_ns: int
    until_ns: int
    base_ns: int
    utc_ns: int
    speed: float = 1.0
    paused: bool = False
    loop: bool = False
    own_clock: bool = False
    over: bool = False
    step: int = 0
    asked: int = 0
    answer: str = ""
    begun: int = 0
    head: int = 0

    def reach_ns(self, clock_ns: int) -> int:
        """Return the position at a time of the instance's clock, ignoring the end."""
        if self.paused or clock_ns <= self.anchor_ns:
            return self.position_ns
        passed_ns = clock_ns - self.anchor_ns
        return self.position_ns + (passed_ns if self.speed == 1 else math.floor(passed_ns * self.speed))

    @property
    def wraps(self) -> bool:
        """Whether the replay starts again when it reaches the end."""
        return self.loop and self.until_ns >= self.end_ns

    def at_ns(self, clock_ns: int) -> int:
        """Return the position at a time of the instance's clock."""
        reach_ns = self.reach_ns(clock_ns)
        if reach_ns >= self.end_ns and self.wraps and not self.paused:
            return self.begin_ns + (reach_ns - self.begin_ns) % (self.end_ns - self.begin_ns)
        return min(reach_ns, self.until_ns)

    def due_ns(self, position_ns: int) -> int:
        """Return the first time of the instance's clock at which a position ahead is reached."""
        ahead_ns = position_ns - self.position_ns
        clock_ns = self.anchor_ns + (ahead_ns if self.speed == 1 else math.ceil(ahead_ns / self.speed))
        while not self.paused and self.reach_ns(clock_ns) < position_ns:  # by a rounding
            clock_ns += 1
        return clock_ns

    def next_round(self) -> PlayState:
        """Return the state at the start of the next round, for a replay that wraps."""
        return self._replace(anchor_ns=self.due_ns(self.end_ns), position_ns=self.begin_ns)

    def settled(self, clock_ns: int) -> PlayState:
        """Return the state after all finished rounds, paused if it has reached its stop."""
        reach_ns = self.reach_ns(clock_ns)
        if self.paused or reach_ns < self.until_ns:
            return self
        if self.wraps:
            rounds = (reach_ns - self.begin_ns) // (self.end_ns - self.begin_ns)
            anchor_ns = self.due_ns(self.begin_ns + rounds * (self.end_ns - self.begin_ns))
            return self._replace(anchor_ns=anchor_ns, position_ns=self.begin_ns)
        return self.anchored(clock_ns)._replace(paused=True, until_ns=self.end_ns)

    def anchored(self, clock_ns: int) -> PlayState:
        """Return the same state with another anchor."""
        return self._replace(anchor_ns=clock_ns, position_ns=self.at_ns(clock_ns))

    def moved_as(self, other: PlayState) -> PlayState:
        """Return the state with the movement of another replay of the same recording."""
        return self._replace(
            anchor_ns=other.anchor_ns,
            position_ns=other.position_ns,
            until_ns=other.until_ns,
            speed=other.speed,
            paused=other.paused,
            loop=other.loop,
            over=other.over,
        )


class MoveRequest(msgspec.Struct, tag="move", forbid_unknown_fields=True, omit_defaults=True):
    """A request to change a replay from ``clock_ns`` of the instance's clock on. None: no change.

    ``until_ns``: position at which to pause once; with a ``position_ns``, None means the end.
    """

    clock_ns: int
    paused: bool | None = None
    speed: float | None = None
    position_ns: int | None = None
    loop: bool | None = None
    until_ns: int | None = None


class FindRequest(msgspec.Struct, tag="find", forbid_unknown_fields=True, omit_defaults=True):
    """A request for the first position after ``after_ns`` with a change of a register or an event of a kind."""

    after_ns: int
    path: str = ""
    event: str = ""


class PlayheadAnswer(msgspec.Struct, omit_defaults=True):
    """The answer to a request. ``error``: why it was not done; ``position_ns``: the position found, if any."""

    error: str = ""
    position_ns: int | None = None


PlayheadRequest = MoveRequest | FindRequest
_ASKS: Final = msgspec.json.Decoder(PlayheadRequest)
_FOUND: Final = msgspec.json.Decoder(PlayheadAnswer)


class Playhead:
    """The playhead of one block. Several threads may read it."""

    def __init__(
        self, shared: SharedObject, memory: memoryview, offset: int, size: int, lock_byte: int, clock: ClockPage
    ) -> None:
        """Open the section. ValueError: it is too short."""
        if size < PLAYHEAD_SIZE:
            raise ValueError("the playhead's section is too short")
        self._shared = shared
        self._memory = memory
        first, second = _COPIES_AT
        complaint = "a playhead is invalid: restart its source: shmio-supervisor restart NAME"
        self._state = DoubleBuffer(memory, (offset + first, offset + second), complaint)
        self._ask_at = offset + _ASK_AT
        self._lock_byte = lock_byte
        self._clock = clock
        self._turn = threading.Lock()

    # ---- for readers ---------------------------------------------------------------------------------------------

    def read(self) -> PlayState | None:
        """Return the state; None if the source has not started yet. SegmentError: it is corrupt."""
        data = self._state.read(_STATE.size)
        (flags, _, begin, end, anchor, position, until, base, utc, speed, step, asked, answer, begun, newest) = (
            _STATE.unpack(data)
        )
        if not flags & _VALID or not begin < end or not (math.isfinite(speed) and speed > 0):
            return None
        return PlayState(
            begin, end, anchor, position, until, base, utc, speed, bool(flags & _PAUSED), bool(flags & _LOOP),
            bool(flags & _OWN_CLOCK), bool(flags & _OVER), step, asked, text(answer), begun, newest,
        )  # fmt: skip

    def now_ns(self) -> int:
        """Return the present time by which the block's frames age: the position as a publish time."""
        play = self.read()
        return time.monotonic_ns() if play is None else play.base_ns + play.at_ns(self._clock.present_ns())

    def came_now(self, number: int) -> bool:
        """Whether a frame was published in the present step of virtual time."""
        play, state = self.read(), self._clock.last_written()
        return play is not None and state.stepping and play.begun == state.step and number > play.head

    def clock_ns(self, publish_ns: int) -> int:
        """Return the instance's clock for an entry that is published now with this publish time."""
        play = self.read()
        return self._clock.present_ns() if play is None or not play.own_clock else publish_ns - play.base_ns

    # ---- the source's part ---------------------------------------------------------------------------------------

    def write(self, play: PlayState) -> None:
        """Write the state. Only the source's process may."""
        flags = _VALID | (_PAUSED * play.paused) | (_LOOP * play.loop) | (_OWN_CLOCK * play.own_clock)
        data = _STATE.pack(
            flags | (_OVER * play.over), 0, play.begin_ns, play.end_ns, play.anchor_ns, play.position_ns,
            play.until_ns, play.base_ns, play.utc_ns, play.speed, play.step, play.asked, cut(play.answer, _TEXT),
            play.begun, play.head,
        )  # fmt: skip
        self._state.write(data)

    def asks(self, answered: int) -> tuple[int, PlayheadRequest | None] | None:
        """Return number and content of a request newer than ``answered``, if any. Invalid content is None."""
        asked = self._asked()
        if asked is None or asked[0] == answered:
            return None
        number, document = asked
        try:
            return number, _ASKS.decode(document.rstrip(b"\0"))
        except msgspec.MsgspecError:
            return number, None

    def asked(self) -> int:
        """Return the number of the last request; 0: there was none."""
        asked = self._asked()
        return asked[0] if asked else 0

    def _asked(self) -> tuple[int, bytes] | None:
        data = _atomics.cell_read(self._memory, self._ask_at, _ASK.size)
        if data is None:
            return None
        number, _, _, document = _ASK.unpack(data)
        return number, document

    # ---- for programs that move it -------------------------------------------------------------------------------

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold the lock for requests. CommandError: another program does not release it."""
        with self._turn:
            until_s = time.monotonic() + _LOCK_S
            while not self._shared.try_lock(self._lock_byte):
                if time.monotonic() > until_s:
                    raise CommandError("another program is moving this recording: try again when it is done")
                time.sleep(_LOCK_TURN_S)  # rare, and its release rings no doorbell
            try:
                yield
            finally:
                self._shared.unlock(self._lock_byte)

    def ask(self, ask: PlayheadRequest) -> int:
        """Write a request, with the lock held; returns its number. The caller rings the source's doorbell."""
        document = msgspec.json.encode(ask)
        if len(document) > _MAX_ASK:
            raise CommandError("the request is too long")
        play = self.read()
        number = max(self.asked(), play.asked if play else 0) + 1
        _atomics.cell_write(self._memory, self._ask_at, _ASK.pack(number, os.getpid(), 0, document))
        return number

    def found(self, number: int) -> PlayheadAnswer | None:
        """Return the answer to a request; None if there is none yet."""
        play = self.read()
        if play is None or play.asked != number:
            return None
        try:
            return _FOUND.decode(play.answer)
        except msgspec.MsgspecError:
            return PlayheadAnswer(play.answer)


def with_answer(play: PlayState, number: int, found: PlayheadAnswer) -> PlayState:
    """Return the state with the answer to a request."""
    found = PlayheadAnswer(cut(found.error, _MAX_ERROR).decode(), found.position_ns)
    return play._replace(asked=number, answer=msgspec.json.encode(found).decode())
