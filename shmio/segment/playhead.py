"""The playhead of a block that replays a recording: its position, and requests to move it.

docs/reference/segment-format.md describes the playhead's section. The source's process writes the
state. To move the playhead, a program locks the section, writes a request, and waits for the answer.
A position is a time of the recorded instance's clock, in ns since that instance's start.
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
"""Prefix of the reasons and event texts that the replay itself creates; recorded texts do not have it."""
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
        anchor_ns: The anchor: a time of the instance's clock from which the position is computed.
        position_ns: Position at the anchor. From there, the playhead moves ``speed`` times as fast
            as the instance's clock.
        until_ns: Position at which the replay pauses or, if it is the end, starts again (``loop``).
        base_ns: Publish time, as in a frame, that corresponds to position 0.
        utc_ns: UTC of position 0.
        speed: Speed relative to the instance's clock.
        paused: True while the replay is paused.
        loop: True if the replay starts again at the end.
        own_clock: True if the published frames keep the recorded clock; False if they have the
            clock of the instance that replays.
        over: True if the replay has reached its end.
        step: Number of the last step of virtual time that the source has finished.
        asked: Number of the last request that was answered.
        answer: The answer to request ``asked``.
        begun: Number of the last step of virtual time that the source has begun.
        head: Number of the newest frame at the start of step ``begun``.
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
        """Return the position at a time of the instance's clock, as if the recording had no end.

        The result may therefore lie after the end of the recording.
        """
        if self.paused or clock_ns <= self.anchor_ns:
            return self.position_ns
        passed_ns = clock_ns - self.anchor_ns
        return self.position_ns + (passed_ns if self.speed == 1 else math.floor(passed_ns * self.speed))

    @property
    def wraps(self) -> bool:
        """True if the replay will reach the end of the played range, and then start again."""
        return self.loop and self.until_ns >= self.end_ns

    def at_ns(self, clock_ns: int) -> int:
        """Return the position, within the played range, at a time of the instance's clock."""
        reach_ns = self.reach_ns(clock_ns)
        if reach_ns >= self.end_ns and self.wraps and not self.paused:
            return self.begin_ns + (reach_ns - self.begin_ns) % (self.end_ns - self.begin_ns)
        return min(reach_ns, self.until_ns)

    def due_ns(self, position_ns: int) -> int:
        """Return the time of the instance's clock at which the playhead reaches a position after the anchor."""
        ahead_ns = position_ns - self.position_ns
        clock_ns = self.anchor_ns + (ahead_ns if self.speed == 1 else math.ceil(ahead_ns / self.speed))
        while not self.paused and self.reach_ns(clock_ns) < position_ns:  # rounding may make it too early
            clock_ns += 1
        return clock_ns

    def next_round(self) -> PlayState:
        """Return the state at the start of the next round of a replay that plays in a loop."""
        return self._replace(anchor_ns=self.due_ns(self.end_ns), position_ns=self.begin_ns)

    def settled(self, clock_ns: int) -> PlayState:
        """Return the state at a time of the instance's clock, with the anchor in the present round.

        The state is paused if ``until_ns`` has been reached.
        """
        reach_ns = self.reach_ns(clock_ns)
        if self.paused or reach_ns < self.until_ns:
            return self
        if self.wraps:
            rounds = (reach_ns - self.begin_ns) // (self.end_ns - self.begin_ns)
            anchor_ns = self.due_ns(self.begin_ns + rounds * (self.end_ns - self.begin_ns))
            return self._replace(anchor_ns=anchor_ns, position_ns=self.begin_ns)
        return self.anchored(clock_ns)._replace(paused=True, until_ns=self.end_ns)

    def anchored(self, clock_ns: int) -> PlayState:
        """Return the same state, described by an anchor at this time of the instance's clock."""
        return self._replace(anchor_ns=clock_ns, position_ns=self.at_ns(clock_ns))

    def moved_as(self, other: PlayState) -> PlayState:
        """Return this state with the position, the speed, and the flags for pause, loop and end of another replay."""
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
    """A request to change a replay at time ``clock_ns`` of the instance's clock.

    A field that is None changes nothing, with two exceptions. If ``position_ns`` is given and
    ``until_ns`` is None, the replay plays to the end. At the end of the played range, a request
    without ``position_ns`` that leaves the replay unpaused starts it from the beginning.

    When it reaches ``until_ns``, the replay pauses and forgets ``until_ns``. At the end of the
    played range, a replay in a loop starts again instead.
    """

    clock_ns: int
    paused: bool | None = None
    speed: float | None = None
    position_ns: int | None = None
    loop: bool | None = None
    until_ns: int | None = None


class FindRequest(msgspec.Struct, tag="find", forbid_unknown_fields=True, omit_defaults=True):
    """A request to find the next change of a register, or the next event of a kind.

    The search starts after the position ``after_ns``.
    """

    after_ns: int
    path: str = ""
    event: str = ""


class PlayheadAnswer(msgspec.Struct, omit_defaults=True):
    """The answer to a request.

    ``error`` is the reason why the request failed; empty: it succeeded. ``position_ns`` is the
    position that a search has found; None: the search has found nothing.
    """

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
        """Open the section; raise ValueError if it is too short."""
        if size < PLAYHEAD_SIZE:
            raise ValueError("the playhead's section is too short")
        self._shared = shared
        self._memory = memory
        first, second = _COPIES_AT
        complaint = "a playhead is invalid; restart its source with shmio-supervisor restart NAME"
        self._state = DoubleBuffer(memory, (offset + first, offset + second), complaint)
        self._ask_at = offset + _ASK_AT
        self._lock_byte = lock_byte
        self._clock = clock
        self._lock = threading.Lock()

    # ---- for readers ---------------------------------------------------------------------------------------------

    def read(self) -> PlayState | None:
        """Return the state; None if the source has not started yet. Raise SegmentError if it is corrupt."""
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
        """Return the present time in ns from which the age of frames is computed.

        It is the publish time that a frame at the present position has.
        """
        play = self.read()
        return time.monotonic_ns() if play is None else play.base_ns + play.at_ns(self._clock.present_ns())

    def came_now(self, number: int) -> bool:
        """Return whether the frame with this number was published in the present step of virtual time."""
        play, state = self.read(), self._clock.last_written()
        return play is not None and state.stepping and play.begun == state.step and number > play.head

    def clock_ns(self, publish_ns: int) -> int:
        """Return the ``clock_ns`` for a frame or event that is published now.

        ``publish_ns`` is the publish time of the frame or event.
        """
        play = self.read()
        return self._clock.present_ns() if play is None or not play.own_clock else publish_ns - play.base_ns

    # ---- for the source's process --------------------------------------------------------------------------------

    def write(self, play: PlayState) -> None:
        """Write the state. Only the source's process may call this."""
        flags = _VALID | (_PAUSED * play.paused) | (_LOOP * play.loop) | (_OWN_CLOCK * play.own_clock)
        data = _STATE.pack(
            flags | (_OVER * play.over), 0, play.begin_ns, play.end_ns, play.anchor_ns, play.position_ns,
            play.until_ns, play.base_ns, play.utc_ns, play.speed, play.step, play.asked, cut(play.answer, _TEXT),
            play.begun, play.head,
        )  # fmt: skip
        self._state.write(data)

    def asks(self, answered: int) -> tuple[int, PlayheadRequest | None] | None:
        """Return (number, content) of the last request; None if ``answered`` is its number.

        The content is None if the request is invalid.
        """
        asked = self._asked()
        if asked is None or asked[0] == answered:
            return None
        number, document, _ = asked
        try:
            return number, _ASKS.decode(document.rstrip(b"\0"))
        except msgspec.MsgspecError:
            return number, None

    def asked(self) -> int:
        """Return the number of the last request; 0: there was none."""
        asked = self._asked()
        return asked[0] if asked else 0

    def asker(self) -> int:
        """Return the pid of the program that made the last request."""
        asked = self._asked()
        return asked[2] if asked else 0

    def _asked(self) -> tuple[int, bytes, int] | None:
        data = _atomics.cell_read(self._memory, self._ask_at, _ASK.size)
        if data is None:
            return None
        number, pid, _, document = _ASK.unpack(data)
        return number, document, pid

    # ---- for programs that move it -------------------------------------------------------------------------------

    @contextmanager
    def held(self) -> Iterator[None]:
        """Lock the playhead during a ``with`` block, so that only this program makes requests.

        Raises:
            CommandError: Another program did not release the lock in time.
        """
        with self._lock:
            until_s = time.monotonic() + _LOCK_S
            while not self._shared.try_lock(self._lock_byte):
                if time.monotonic() > until_s:
                    raise CommandError("another program is moving this recording; try again when it is done")
                time.sleep(_LOCK_TURN_S)  # unlocking rings no doorbell
            try:
                yield
            finally:
                self._shared.unlock(self._lock_byte)

    def ask(self, ask: PlayheadRequest) -> int:
        """Write a request, and return its number.

        The caller must have locked the section (:meth:`held`), and must then ring the source's
        doorbell.

        Raises:
            CommandError: The request is too long.
        """
        document = msgspec.json.encode(ask)
        if len(document) > _MAX_ASK:
            raise CommandError(
                f"the request to the replay has {len(document)} bytes, but at most {_MAX_ASK} are allowed"
            )
        play = self.read()
        number = max(self.asked(), play.asked if play else 0) + 1
        _atomics.cell_write(self._memory, self._ask_at, _ASK.pack(number, os.getpid(), 0, document))
        return number

    def found(self, number: int) -> PlayheadAnswer | None:
        """Return the answer to the request with this number; None if the source has not answered it yet."""
        play = self.read()
        if play is None or play.asked != number:
            return None
        try:
            return _FOUND.decode(play.answer)
        except msgspec.MsgspecError:
            return PlayheadAnswer(play.answer)


def with_answer(play: PlayState, number: int, found: PlayheadAnswer) -> PlayState:
    """Return the state with ``found`` as the answer to request ``number``."""
    found = PlayheadAnswer(cut(found.error, _MAX_ERROR).decode(), found.position_ns)
    return play._replace(asked=number, answer=msgspec.json.encode(found).decode())
