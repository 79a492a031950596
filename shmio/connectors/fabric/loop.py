"""The loop of a mirror: publishes the frames and events of another cell's source, in their order."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from typing import Final, cast

from shmio.connectors.base import TAKEN, UnconfirmedError
from shmio.connectors.base import Lost as LostWrite
from shmio.connectors.commands import CommandProcessor
from shmio.connectors.fabric.injections import BEGIN_NS, MAX_TIME_NS, MirroredInjections
from shmio.connectors.fabric.link import MAX_WAITING, Link
from shmio.connectors.fabric.order import Announced, Lost, MessageOrder, Missing, Received
from shmio.connectors.fabric.source import Mirror
from shmio.connectors.injections import Blocks, OwnerOf
from shmio.connectors.models.stepped import StepClock
from shmio.connectors.output import LIFTED, Image, Output
from shmio.connectors.poll_loop import Counters, QualityLog
from shmio.fabric.messages import (
    ENTRIES_AT,
    LEFT_OUT_LIMIT,
    CommandReply,
    CommandRequest,
    Entry,
    Header,
    InjectionRequest,
    WriteItem,
    decode_entries,
    decode_entry,
    decode_header,
    decode_state,
)
from shmio.layout.values.write import Write
from shmio.model.values import NO_WRITER, OutcomeKind
from shmio.recording.format.encoding import Gap
from shmio.segment import BlockWriter, Event, EventKind, Frame, Provenance, Quality, Record
from shmio.segment.commands import MAX_WRITES
from shmio.wording import counted

ANSWER_S: Final = 2.0
"""Longest wait for the outcome of a write, in s."""
CATCH_UP_S: Final = 0.8
"""Shortest time in s in which the mirror publishes as many frames as the ring holds.

After an outage, many frames come at once. Readers such as the recorder must be able to follow.
"""
MAX_WAITING_BYTES: Final = 64 << 20
"""Maximum size of the messages that wait for the loop. It requests those that are dropped."""
MAX_READY: Final = 64
"""Number of messages that wait to be published, after which the loop takes no further ones."""
MAX_MISSING: Final = (1 << 63) - 1
"""Maximum number of missing frames that is counted; a faulty owner may name larger numbers."""
NEVER_NS: Final = -(1 << 63)
"""A time before all others."""
STATE_NS: Final = 2_000_000_000
"""Time in ns after which the mirror asks again for the owner's injections, if none came."""
BUSY_NS: Final = 100_000_000
"""Longest wait of the loop in ns while outcomes of commands about injections are awaited."""
RELOAD_NS: Final = 30_000_000_000
"""Time in ns after which the mirror asks again for a reload, if the layout is still another one."""
MALFORMED: Final = "%s sent a malformed message: %s"
_LEFT_OUT: Final = frozenset({EventKind.STARTED, EventKind.STOPPED, EventKind.QUALITY})
"""Events of the owner that the mirror replaces by its own."""

log = logging.getLogger("shmio.source")

Connect = Callable[[Callable[[bytes], None], Callable[[Missing | Announced], None]], Link]
"""Makes the link; its arguments are those of :class:`Link` of the same names."""


class MirrorLoop:
    """Publishes what the owner's uplink sends, and passes writes and injections on to the owner.

    Frames keep their cycle, source time, quality and provenance. A message that comes late has the
    age that it had when the owner sent it, so readers see its frames as stale. Missing messages are
    requested, and later messages wait for them; if the owner no longer has them, the loop reports
    a gap.
    """

    def __init__(
        self,
        mirror: Mirror,
        writer: BlockWriter,
        clock: StepClock,
        connect: Connect,
        writable: Iterable[str] = (),
        *,
        allow_nonfinite: Iterable[str] = (),
        armed: bool = False,
        owner_of: OwnerOf = lambda _: None,
        blocks: Blocks | None = None,
        names: Mapping[str, str] | None = None,
        own_layout: bool = False,
        changed: Callable[[], None] = lambda: None,
        ending: Callable[[], bool] = lambda: False,
    ) -> None:
        """Create the loop.

        Args:
            mirror: The source to reproduce.
            writer: Writes the block.
            clock: The loop's clock; the link wakes it.
            connect: Makes the link to the fabric.
            writable: Patterns of the registers that commands of this instance may write. The owner
                has such a list, too.
            allow_nonfinite: Patterns of the registers to which NaN and infinities may be written.
            armed: Whether injections of this instance may change what the owner's device gets. The owner
                has such a key, too.
            owner_of: Returns the process that uses a command queue.
            blocks: Returns the blocks of all sources.
            names: For each source of this instance that mirrors a source of the same cell, its name there;
                None: only this one.
            own_layout: True if files of this instance have the layout, so that a reload changes nothing.
            changed: Called when the owner's layout is another one, at most each ``RELOAD_NS``.
            ending: Returns whether the whole instance is stopping, and not only this source.

        """
        self._mirror = mirror
        self._writer = writer
        self._clock = clock
        self._changed, self._ending = changed, ending
        self._own_layout = own_layout
        self._reload_ns = -RELOAD_NS
        self._layout = writer.block.layout.hash[:8]
        self._output = Output(writer, clock.now_ns)

        def mirrored(writable: bytes, refuse_in: str) -> MirroredInjections:
            self._injections = MirroredInjections(
                mirror.cell, writer, writable, refuse_in, ask=self._ask,
                names=names or {writer.block.source: mirror.source}, owner_of=owner_of,
                blocks=blocks or (lambda: {writer.block.source: writer.block}), now_ns=clock.now_ns, wake=clock.nudge,
            )  # fmt: skip
            return self._injections

        self.commands = CommandProcessor(
            self._output, writable, clock.now_ns, allow_nonfinite=allow_nonfinite, armed=armed,
            accepted=clock.nudge, injections=mirrored,
        )  # fmt: skip
        self._quality_log = QualityLog(writer)
        self.counters = Counters()
        self._order = MessageOrder()
        self._transit = _Transit()
        self._inbox: deque[Received | Missing | Announced] = deque()
        self._received_bytes = 0  # changed only by the link's thread
        self._taken_bytes = 0  # changed only by the loop's thread
        self._ready: deque[Received | Lost] = deque()
        ring = writer.block.ring
        self._pace = _Pace(max(ring.slot_count / CATCH_UP_S, 6e9 / writer.block.period_ns), ring.slot_count / 8)
        self._link = connect(self._receive, self._told)
        self._reply: Future[CommandReply] | None = None
        self._last_ns = clock.now_ns()  # when the last frame was published
        self._open = False
        self._bad = True  # the last frame was bad
        self._state_of = 0  # number of the stream from which the owner's injections are known
        self._state_ns = -STATE_NS  # when the mirror asked for them last
        self._problem, self._problem_ns = "", clock.now_ns()  # of the link, and when it last had it
        self.missing = 0
        """Number of frames that the owner no longer had."""
        self._good = False  # the last frame was good
        self._number = 0  # of the owner's last frame
        self._zero_ns = 0  # when the owner's clock began
        self._stream = 0  # of the last message
        self._left_out = 0  # frames that the owner's rules have left out in the stream before that frame

    @property
    def note(self) -> str:
        """Why quality is not good; empty if it is."""
        return self._quality_log.note

    # ---- in the link's thread ------------------------------------------------------------------------------------

    def _receive(self, data: bytes) -> None:
        if len(self._inbox) >= MAX_WAITING or self._received_bytes - self._taken_bytes > MAX_WAITING_BYTES:
            return  # the loop will request it
        try:
            header = decode_header(data)
        except ValueError as error:
            log.warning(MALFORMED, self._mirror, error)
            return
        self._received_bytes += len(data)
        self._inbox.append(Received(header, data, self._clock.now_ns()))
        self._clock.nudge()

    def _told(self, one: Missing | Announced) -> None:
        if isinstance(one, Announced) and len(self._inbox) >= MAX_WAITING:
            return  # another one follows
        self._inbox.append(one)
        self._clock.nudge()

    # ---- in the loop's thread ------------------------------------------------------------------------------------

    def run(self) -> None:
        """Mirror until the clock tells the loop to stop, then publish a last, bad frame."""
        self._link.start()
        try:
            while not self._run_once():
                pass
        finally:
            self.commands.stop()
            self._confirm()
            if self._ending() and self._link.connected:
                self._injections.leave()
            self._link.close()
            self._fail("the source was stopped")
            self._writer.event(Record(EventKind.STOPPED))

    def _run_once(self) -> bool:
        """Publish what has come, pass on writes, then wait. Return whether the loop must stop."""
        while self._inbox and len(self._ready) < MAX_READY:
            one = self._inbox.popleft()
            if isinstance(one, Received):
                self._taken_bytes += len(one.data)
                self._ready += self._order.add(one)
            elif isinstance(one, Missing):
                self._ready += self._order.answered(one, self._clock.now_ns())
            else:
                self._order.announce(one)
        now_ns = self._clock.now_ns()
        if self._link.connected and not self._link.stalled:
            self._ready += self._order.expired(now_ns)
        else:
            self._order.suspend(now_ns)
        while self._ready and self._pace.wait_ns(self._clock.now_ns()) == 0:
            self._deliver(self._ready.popleft())
        if (missing := self._order.missing(now_ns)) is not None and self._link.connected:
            self._link.request(missing)
        self._ask_state(now_ns)
        self._injections.turn()
        self._confirm()
        if self.commands.waiting and not self.commands.unconfirmed:
            self._carry_out()
        return self._clock.wait_ns(self._watch(self._clock.now_ns()))

    def _watch(self, now_ns: int) -> int:
        """Publish a bad frame if the last one is too old. Return how long the loop may wait, in ns."""
        stale_ns, problem = self._writer.block.stale_ns, self._link.problem
        due_ns = self._last_ns + stale_ns
        if problem:
            self._problem, self._problem_ns = problem, now_ns
            if problem != self.note and (self._bad or now_ns >= due_ns):
                self._fail(problem)
        elif now_ns >= due_ns and not self._bad:
            self._fail(f"{self._mirror.cell} has sent nothing for {(now_ns - self._last_ns) / 1e6:.0f} ms")
        elif self._bad and self.note == self._problem and now_ns >= max(due_ns, self._problem_ns + stale_ns):
            self._fail(f"{self._mirror.cell} sends nothing; shmio fabric cells shows its state")
        wait_ns = 500_000_000 if self._bad else max(1_000_000, due_ns - now_ns)
        if self._inbox and len(self._ready) < MAX_READY:
            return 1  # the loop has not taken all messages
        if self._ready:
            wait_ns = min(wait_ns, max(1_000_000, self._pace.wait_ns(now_ns)))
        if self._injections.busy:
            wait_ns = min(wait_ns, BUSY_NS)
        patience_ns = self._order.patience_ns(now_ns)
        return wait_ns if patience_ns is None else min(wait_ns, patience_ns)

    # ---- frames and events ---------------------------------------------------------------------------------------

    def _deliver(self, one: Received | Lost) -> None:
        if isinstance(one, Lost):
            what = counted(one.last - one.first + 1, "message")
            log.warning("%s no longer has %s, which this host has not received", self._mirror, what)
            self._state_of = 0  # a change of the injections may be among them
            return
        if one.header.layout != self._layout:
            self._refuse_layout()
            return
        late_ns = one.header.age_ns + self._transit.excess_ns(one.header, one.at_ns) + self._clock.now_ns() - one.at_ns
        if one.header.zero_ns != self._zero_ns:
            # The owner was started again, and numbers its frames from 1.
            self._zero_ns, self._number = one.header.zero_ns, 0
        try:
            if (state := decode_state(one.data)) is not None:
                self._state_of = one.header.stream
                self._injections.show(state, late_ns)
                return
            entries = list(decode_entries(one.data, self._show_run(one, late_ns)))
            self._find_gap(one.header, entries)
            for entry in entries:
                self._publish(entry, late_ns + _waited_ns(one.header, entry))
        except ValueError as error:
            log.warning(MALFORMED, self._mirror, error)

    def _publish(self, entry: Entry, late_ns: int) -> None:
        if isinstance(entry, Frame):
            self._show(entry, late_ns)
        elif isinstance(entry, Event):
            self._happen(entry)
        else:
            self._tell_gap(entry.what, entry.first, entry.last, f"{self._mirror.cell}: {entry.reason}")

    def _find_gap(self, header: Header, entries: Sequence[Entry]) -> None:
        """Report the frames that are missing before those of a message, except those that the owner's rules leave out.

        Each message counts those of its whole stream, so it does not matter how many messages are missing.
        """
        if header.stream != self._stream:
            self._stream, self._left_out = header.stream, 0
        last, counted_here = 0, 0
        for entry in entries:
            if isinstance(entry, Frame):
                last, counted_here = entry.number, counted_here + 1
            elif isinstance(entry, Gap) and entry.what == "frames":
                last, counted_here = entry.last, counted_here + entry.count
        if not counted_here:
            return
        left_out = (header.left_out - self._left_out) % LEFT_OUT_LIMIT
        missing = last - self._number - counted_here - left_out
        if self._number and missing > 0:
            first = self._number + 1
            self._tell_gap("frames", first, first + missing - 1, "the owner no longer had them")
        self._number, self._left_out = last, header.left_out

    def _show(self, frame: Frame, late_ns: int) -> None:
        if len(frame.raw) != self._writer.block.layout.size:
            raise ValueError(f"a frame has {len(frame.raw)} bytes instead of {self._writer.block.layout.size}")
        now_ns = self._clock.now_ns()
        self._writer.cycle = frame.cycle
        self._bad = frame.quality is Quality.BAD
        self._good = frame.quality is Quality.GOOD and not frame.reason
        self._last_ns = now_ns
        self._quality_log.update(frame.quality, frame.reason, frame.cycle, f", mirrored from {self._mirror}")
        age_ns = late_ns + 1000 * frame.delay_us
        image = Image(
            frame.raw, frame.cycle, frame.source_ns, frame.quality, frame.provenance, frame.reason, now_ns - age_ns,
            frame.effective,
        )  # fmt: skip
        if not self._open and not self._bad and age_ns < self._writer.block.stale_ns:
            self._open = True
            self.counters.connects += 1
            self.commands.open()  # before consumers see that the source is good
        self._output.publish(image)
        self._pace.spend(now_ns)
        self.counters.polls += 1
        self.counters.round_trip_us = late_ns // 1000
        self.commands.release(frame.cycle)

    def _show_run(self, one: Received, late_ns: int) -> int:
        """Publish the frames at the beginning of a message that change nothing but values, all at once.

        Return the position after them.
        """
        header, end = one.header, ENTRIES_AT
        if not self._good or (header.stream, header.left_out) != (self._stream, self._left_out):
            return end
        if not self._open and late_ns < self._writer.block.stale_ns:
            return end  # the next frame may open the source for writes
        count, now_ns = 0, self._clock.now_ns()
        made_ns = header.made_ns - header.zero_ns if header.zero_ns else NEVER_NS

        def publish() -> Image | None:
            nonlocal count, end
            count, last, end = self._writer.publish_packed(
                one.data, ENTRIES_AT, number=self._number, made_ns=made_ns, late_ns=late_ns
            )
            if not count:
                return None
            frame, _ = decode_entry(one.data, last)
            assert isinstance(frame, Frame)  # noqa: S101  publish_packed has read it
            age_ns = late_ns + _waited_ns(header, frame) + 1000 * frame.delay_us
            return Image(
                frame.raw, frame.cycle, frame.source_ns, frame.quality, frame.provenance, "", now_ns - age_ns,
                frame.effective,
            )  # fmt: skip

        if self._output.publish_many(publish):
            self._number += count
            self._writer.cycle = self._output.cycle
            self._last_ns = now_ns
            self._pace.spend(now_ns, count)
            self.counters.polls += count
            self.counters.round_trip_us = late_ns // 1000
        return end

    def _happen(self, event: Event) -> None:
        """Publish an event of the owner.

        If it is about a command or an injection of this instance, it gets the writer of that command.
        Any other event gets none, so that no client takes it for an answer to itself.
        """
        if event.kind in _LEFT_OUT or (writer := self._injections.writer_of(event)) is None:
            return
        self._writer.cycle = event.cycle
        text, owner = event.text, f"cell {self._mirror.cell}{f' on host {self._link.host}' if self._link.host else ''}"
        if event.kind == EventKind.REJECTED and writer != NO_WRITER:
            text = f"{owner}: {text}"
        elif event.kind == EventKind.LIFTED and writer == NO_WRITER and text == LIFTED:
            text = f"lifted in {owner}"
        by = self._injections.sender_of(event) if writer != NO_WRITER else event.by and f"{owner}: {event.by}"
        record = Record(
            cast(EventKind, event.kind), text, writer, event.command, event.item,
            min(event.items, MAX_WRITES), event.offset, event.mask, event.size, event.data, event.injection, by,
        )  # fmt: skip
        self._writer.event(record, quality=event.quality)

    def _tell_gap(self, what: str, first: int, last: int, why: str) -> None:
        if what == "frames":
            self.missing = min(self.missing + last - first + 1, MAX_MISSING)
            self.counters.overruns = self.missing
        text = f"{what} {first} to {last} are missing, {why}"
        log.warning("%s", text)
        self._writer.event(Record(EventKind.NOTED, text))

    def _fail(self, reason: str) -> None:
        """Publish the last image with bad quality, and stop accepting writes."""
        self._open = self._good = False
        self.commands.close(reason)
        self._bad = True
        last = self._output.last
        # Not the cycle of the last event: the owner's frame with that cycle may still come.
        cycle = self._writer.cycle if last is None else last.cycle
        if self._quality_log.update(Quality.BAD, reason, cycle):
            provenance = Provenance.LIVE if last is None else last.provenance
            image = Image(
                self._output.raw, cycle, self._output.source_ns, Quality.BAD, provenance, reason,
                shown=None if last is None else last.shown,
            )  # fmt: skip
            self._output.publish(image)

    def _refuse_layout(self) -> None:
        if self._own_layout:
            what = "another layout than this source's key layout; use the owner's file, or remove the key"
        else:
            what = "another layout now"
        self._fail(f"{self._mirror} has {what}; run shmio-supervisor reload")
        now_ns = self._clock.now_ns()
        if not self._own_layout and now_ns - self._reload_ns >= RELOAD_NS:
            self._reload_ns = now_ns  # not only once: the owner may publish before the registry has its new layout
            self._changed()

    # ---- commands ------------------------------------------------------------------------------------------------

    def _ask_state(self, now_ns: int) -> None:
        """Ask for the owner's injections until they are known: there may be some that do not change.

        The answer also tells the clock of an uplink that was restarted and has nothing else to publish.
        """
        known = self._state_of == self._order.stream != 0
        if not known and self._link.connected and now_ns - self._state_ns >= STATE_NS:
            self._state_ns = now_ns
            self._link.request_state()

    def _ask(self, injection: InjectionRequest, begin_ns: int) -> Future[CommandReply] | None:
        """Send a command about an injection. Any thread may call this."""
        return self._command([], injection, begin_ns)

    def _command(
        self, writes: list[WriteItem], injection: InjectionRequest | None = None, begin_ns: int = BEGIN_NS
    ) -> Future[CommandReply] | None:
        """Send a command; return None if the owner's clock is not known yet."""
        usual = self._transit.usual
        if usual is None:
            return None
        stream, taken_ns = usual
        expires_ns = min(self._clock.now_ns() - taken_ns + begin_ns, MAX_TIME_NS)
        return self._link.command(CommandRequest(expires_ns, stream, self._layout, writes, injection), ANSWER_S)

    def _carry_out(self) -> None:
        try:
            self.commands.carry_out(self._send)
        except UnconfirmedError as error:
            log.warning("%s", error)

    def _send(self, writes: Sequence[Write]) -> Sequence[str] | None:
        self._reply = self._command([WriteItem(*write) for write in writes])
        if self._reply is None:
            return ["no new message of the owner has come yet"] * len(writes)
        self._reply.add_done_callback(lambda _: self._clock.nudge())
        return None

    def _confirm(self) -> None:
        if not self.commands.unconfirmed:
            return
        try:
            self.commands.confirm(self._outcomes)
        except UnconfirmedError as error:
            log.warning("%s", error)

    def _outcomes(self) -> Sequence[str] | None:
        reply = self._reply
        if reply is None or not reply.done():
            return None
        self._reply = None
        kinds = [OutcomeKind(kind) for kind in reply.result().outcomes]
        found = [_outcome(*pair) for pair in zip(kinds, reply.result().reasons, strict=True)]
        if any(isinstance(outcome, LostWrite) for outcome in found):
            reason = next(filter(None, reply.result().reasons), "no answer came")
            raise UnconfirmedError(reason, found)
        return cast(Sequence[str], found)


class _Transit:
    """Finds how much longer than usual a message was on its way, without equal clocks on both hosts.

    The usual time is the shortest of the last ``WINDOW_NS`` to twice that. After somebody sets the
    owner's clock back, messages seem to be late for that long. A message that is much faster than usual
    does not count, because it may be false. But if the next one is as fast, that one counts: somebody
    has set the owner's clock forward.
    """

    WINDOW_NS: Final = 30_000_000_000
    STEP_NS: Final = 500_000_000

    def __init__(self) -> None:
        self._stream = 0
        self._begun_ns = 0
        self._before: int | None = None  # shortest time in the window before
        self._least: int | None = None  # shortest time in this window
        self._doubtful: int | None = None  # the time of the last message, if it did not count
        self.usual: tuple[int, int] | None = None
        """The stream of the last message that counted, and the usual time, in ns.

        The owner's clock is this clock less that time. None: no new message has come yet.
        """

    def excess_ns(self, header: Header, at_ns: int) -> int:
        """Return the extra time in ns of a message of the owner that came at ``at_ns``."""
        taken_ns = at_ns - header.made_ns - header.age_ns
        if header.stream != self._stream:
            self._stream, self._begun_ns, self._before, self._least = header.stream, at_ns, None, None
            self._doubtful = None
        elif at_ns - self._begun_ns >= self.WINDOW_NS:
            self._begun_ns, self._before, self._least = at_ns, self._least, None
        if not header.age_ns:  # the age of a late message is not that exact
            self._measure(taken_ns)
        usual_ns = self._usual_ns
        return 0 if usual_ns is None else max(0, taken_ns - usual_ns)

    @property
    def _usual_ns(self) -> int | None:
        return min((least for least in (self._before, self._least) if least is not None), default=None)

    def _measure(self, taken_ns: int) -> None:
        usual_ns, doubtful, self._doubtful = self._usual_ns, self._doubtful, None
        fast = usual_ns is not None and taken_ns < usual_ns - self.STEP_NS
        if fast and (doubtful is None or abs(taken_ns - doubtful) > self.STEP_NS):
            self._doubtful = taken_ns
            return
        self._least = taken_ns if self._least is None else min(self._least, taken_ns)
        self.usual = self._stream, taken_ns if usual_ns is None else min(usual_ns, taken_ns)


class _Pace:
    """Limits the rate of frames: a token bucket."""

    def __init__(self, rate_hz: float, burst: float) -> None:
        self._rate, self._burst = rate_hz / 1e9, max(1.0, burst)
        self._tokens, self._at_ns = self._burst, 0

    def _refill(self, now_ns: int) -> None:
        self._tokens = min(self._burst, self._tokens + (now_ns - self._at_ns) * self._rate)
        self._at_ns = now_ns

    def wait_ns(self, now_ns: int) -> int:
        """Return the time in ns until the next frame may be published; 0 if it may be now."""
        self._refill(now_ns)
        return 0 if self._tokens > 0 else 1 + int(-self._tokens / self._rate)

    def spend(self, now_ns: int, count: int = 1) -> None:
        """Count published frames."""
        self._refill(now_ns)
        self._tokens -= count


def _waited_ns(header: Header, entry: Entry) -> int:
    """Return how long a frame waited at the owner until its message was made, such as for a maximum rate."""
    if not isinstance(entry, Frame) or not header.zero_ns:
        return 0
    return max(0, header.made_ns - header.zero_ns - entry.publish_ns)


def _outcome(kind: OutcomeKind, reason: str) -> str | LostWrite:
    """Convert an outcome at the owner to that of a connector's write."""
    if kind is OutcomeKind.WRITTEN:
        return ""
    if kind is OutcomeKind.EXPIRED:
        return LostWrite.UNSENT
    if kind is OutcomeKind.TAKEN:
        return TAKEN
    if kind in (OutcomeKind.REFUSED, OutcomeKind.REJECTED):
        return reason or str(kind)
    return LostWrite.UNKNOWN
