"""Control an instance's time: take over time, step it, play it (step it continuously), and release it."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Final, NamedTuple

import msgspec

from shmio.errors import SegmentError, ShmioError, TimeError, ValueRangeError
from shmio.model.clock import MAX_RATE, Clock, ClockMode, check_step
from shmio.model.values import Quality
from shmio.segment.block import Block
from shmio.segment.clock import time_lock
from shmio.segment.doorbell import Doorbell
from shmio.segment.processes import ProcessSlot
from shmio.segment.segment import Segment

_TURN_NS: Final = 100_000_000
"""Interval in ns at which a program that waits for the owner of time checks whether the owner has died."""
_DISPATCHERS: Final = frozenset({"alerts", "emulator", "grpc", "mqtt", "recorder"})
"""Kinds of processes that deliver finished steps. Each step may wait until they have delivered it."""
_PATIENCE_S: Final = 2.0
"""Longest time in s to wait for the owner of time to give up its ownership.

The gRPC endpoint gives up its ownership while its clients are idle.
"""
_LATE_NS: Final = 500_000_000
"""If a step is late by more than this time in ns while time is played, playing does not catch up."""

_NOBODY: Final = (
    "no source uses the instance clock, so stepping has no effect; sources with a device continue in real time"
)
_REAL: Final = "; shmio step --release returns to real time"
_PAUSED: Final = f"it is paused until the next step{_REAL}"

log = logging.getLogger("shmio.time")
log.addHandler(logging.NullHandler())  # without it, Python would print warnings of a program that has set up no log


class Step(msgspec.Struct, frozen=True):
    """A finished step.

    Attributes:
        number: Number of the step.
        time_ns: The instance's clock after the step, in ns.
        dt_ns: Length of the step, in ns.
    """

    number: int
    time_ns: int
    dt_ns: int


class StepWait(NamedTuple):
    """What a step waits for: until a doorbell's value differs from ``seen``, for at most ``rest_ns`` ns.

    The doorbell is that of ``block``, whose source has not done the step yet. If ``block`` is None,
    it is the doorbell that processes ring when they have delivered a step.
    """

    block: Block | None
    seen: int
    rest_ns: int


class Coordinator:
    """Moves the time of one instance, which one program at a time owns. Several threads may use it.

    A step begins when the coordinator writes the step's number to the clock page. Each source that
    uses the instance clock then publishes a frame for the step. When all have done so, the step is
    ``done``. Finally, this process and others deliver the frames of the step to remote programs and
    recordings.
    """

    def __init__(
        self,
        segment: Segment,
        *,
        soft_s: float = 1.0,
        hard_s: float = 10.0,
        deliver: Callable[[Step], None] = lambda _: None,
        own: ProcessSlot | None = None,
    ) -> None:
        """Prepare to move time, without taking it over yet.

        Args:
            segment: The instance's segment, writable. A process that delivers steps must pass the
                segment object with which it has locked its slot.
            soft_s: Soft time-out of a step: after this time, the log and the clock page name the
                processes that the step waits for.
            hard_s: Hard time-out of a step: after this time, the step has failed.
            deliver: Called within :meth:`step` when all sources have done the step.
            own: The slot of this process, if it has one, which saves a system call in each step.
        """
        self._segment = segment
        self._soft_ns = round(soft_s * 1e9)
        self._hard_ns = round(hard_s * 1e9)
        self._deliver = deliver
        self._own = own
        self._lock = threading.RLock()
        self._lock_byte = time_lock(segment.header)
        self._owns = False
        self._roles: _Roles | None = None

    @property
    def owns(self) -> bool:
        """True if this program owns time."""
        return self._owns

    def read(self) -> Clock:
        """Return the state of the clock, from the clock page."""
        return self._segment.clock.read()

    def take_over(self, patience_s: float = 0.0, *, steps: bool = False) -> None:
        """Take over time: from now on, only steps move it. Do nothing if this program owns time.

        Args:
            patience_s: Longest time to wait, in s, for an owner that is not playing to give up time.
            steps: Whether a step follows at once. Otherwise, a note of the clock says that time has
                stopped.

        Raises:
            TimeError: Another living process owns time, and is playing or does not give it up.
        """
        with self._lock:
            if self._owns:
                return
            self._check_writable()
            self._take_lock(time.monotonic_ns() + round(patience_s * 1e9))
            self._owns = True
            state = self.read()
            note = (
                f"step {state.step} was not finished: the program that requested it has ended"
                if state.stepping
                else state.note
            )
            state = state._replace(owner=os.getpid(), playing=False, stepping=False, note=note)
            if not state.virtual:
                # A free-running source reads the page before each cycle, so none starts a cycle after this
                # write. The present cycle, determined again afterwards, is therefore the last one.
                self._write(self._frozen(state))
                state = self._frozen(
                    state._replace(note="" if steps else _take_over_note(self._segment, self._participants()))
                )
            self._write(state)
            self._ring_all()

    def release(self, patience_s: float = 0.0) -> None:
        """Return to real time. The clock continues from the present virtual time, without an owner.

        Args:
            patience_s: Longest time to wait, in s, for an owner that is not playing to give up time.

        Raises:
            TimeError: Another living process owns time, or time was virtual from the start.
        """
        with self._lock:
            self.check_release()
            if not self._owns:
                self._take_lock(time.monotonic_ns() + round(patience_s * 1e9))
            state = self._segment.clock.last_written()
            if state.virtual:
                # Each source reads the page before it publishes, so no frame is later than this.
                offset_ns = state.time_ns - (time.monotonic_ns() - self._segment.header.started_ns)
                self._write(
                    state._replace(
                        mode=ClockMode.WALL, dt_ns=0, playing=False, stepping=False, owner=0, note="",
                        resumed_ns=state.time_ns, offset_ns=offset_ns,
                    )
                )  # fmt: skip
            self._unlock()
            self._ring_all()

    def check_release(self) -> None:
        """Raise TimeError if this instance always runs in virtual time."""
        self._check_writable()
        if self._segment.clock.stepped:
            raise TimeError(
                f"instance {self._segment.instance!r} always runs in virtual time, because its configuration says "
                'clock = "stepped"; for real time, change this to clock = "wall" and restart the instance'
            )

    def set_step_size(self, dt_ns: int) -> None:
        """Take over time, and set the default length of a step.

        Raises:
            ValueRangeError: The length is not between 1 us and 1 h.
            TimeError: Another process owns time.
        """
        check_step(dt_ns)
        with self._lock:
            self.take_over()
            self._write(self.read()._replace(step_size_ns=dt_ns))

    def set_playing(self, playing: bool, rate: float = 1.0) -> None:
        """Take over time, and write to the clock page whether this process plays time, and at which rate.

        Raises:
            ValueRangeError: The rate is not above 0 and at most 1000.
            TimeError: Another process owns time.
        """
        if not 0 < rate <= MAX_RATE:
            raise ValueRangeError(f"the rate must be above 0 and at most {MAX_RATE:g}, not {rate:g}")
        with self._lock:
            self.take_over()
            self._write(self.read()._replace(playing=playing, rate=rate))

    def step(self, dt_ns: int | None = None) -> Step:
        """Take over time, move it by one step, and wait until the step is done and delivered.

        Even if the step fails, its number is used, and time has moved.

        Args:
            dt_ns: Length of the step in ns; None: the step size.

        Raises:
            TimeError: Another process owns time, a source failed, or a source or a delivering
                process did not answer within the hard time-out.
            ValueRangeError: The length is not between 1 us and 1 h.
        """
        with self._lock:
            stepping = self.stepping(dt_ns)
            try:
                while True:
                    block, seen, rest_ns = next(stepping)
                    if block is None:
                        self._segment.clock.delivered_bell.wait(seen, rest_ns)
                    else:
                        block.ring.wait(seen, rest_ns)
            except StopIteration as over:
                step: Step = over.value
                return step
            finally:
                stepping.close()

    def steps(self, dt_ns: int | None, count: int) -> Step:
        """Do ``count`` steps, each as :meth:`step` does; return the last one."""
        step = self.step(dt_ns)
        for _ in range(count - 1):
            self._segment.require_running()
            step = self.step(dt_ns)
        return step

    def stepping(self, dt_ns: int | None = None) -> Generator[StepWait, None, Step]:
        """Do a step as :meth:`step` does, but yield what to wait for instead of waiting.

        If you do not run the generator to its end, close it. Until then, call no other method of
        this coordinator.
        """
        if not self._owns:
            self.take_over(steps=True)
        page = self._segment.clock
        before = page.last_written()
        dt_ns = before.step_size_ns if dt_ns is None else dt_ns
        check_step(dt_ns)
        number, time_ns = before.step + 1, before.time_ns + dt_ns
        roles = self._current_roles()
        unmoved = "" if roles.always_move else _unmoved_note(self._segment, roles.participants)
        problem = "it was cancelled"
        try:
            waiting = [(block, block.ring.head()) for block in roles.participants]
            page.begin_step(before, number, time_ns, dt_ns, before.done)
            for bell in roles.bells:
                bell.ring()
            problem = yield from self._await_frames(number, waiting)
        finally:
            note = f"step {number} failed: {problem}" if problem else unmoved
            page.end_step(before, number, time_ns, dt_ns, before.done if problem else number, note)
        step = Step(number, time_ns, dt_ns)
        if not problem:
            self._deliver(step)
            if roles.dispatchers:
                problem = yield from self._await_delivery(number, roles.dispatchers)
        if problem:
            raise TimeError(f"step {number}: {problem}")
        return step

    def jump(self, state: Clock) -> None:
        """Set the step, the time and the step size to those of a snapshot. This program must own time."""
        with self._lock:
            self._segment.clock.write(
                self.read()._replace(
                    step=state.step, done=state.done, time_ns=state.time_ns, dt_ns=0, step_size_ns=state.step_size_ns,
                    stepping=False, playing=False, note="",
                ),
                ring=False,
            )  # fmt: skip

    def announce(self) -> None:
        """Announce that time has jumped, and wait until all processes that deliver steps have noticed it.

        Raises:
            TimeError: A process did not notice it within the hard time-out.
        """
        with self._lock:
            number = self.read().done
            self._segment.clock.bell.ring()
            waiting = self._await_delivery(number, self._current_roles().dispatchers, jumped=True)
            while True:
                try:
                    _, seen, rest_ns = next(waiting)
                except StopIteration as over:
                    if over.value:
                        raise TimeError(str(over.value)) from None
                    return
                self._segment.clock.delivered_bell.wait(seen, rest_ns)

    def close(self) -> None:
        """Give up the ownership of time. Time stays stopped until another program takes it over."""
        with self._lock:
            if not self._owns or self._segment.closed:
                return
            self._write(self.read()._replace(owner=0, playing=False))
            self._unlock()

    def _check_writable(self) -> None:
        if not self._segment.shared.writable:
            raise TimeError("this attachment only reads; attach with writable=True")

    def _unlock(self) -> None:
        self._segment.shared.unlock(self._lock_byte)
        self._owns = False
        self._segment.clock.bell.ring()  # again, for a process that waits for the lock

    def _write(self, state: Clock) -> None:
        self._segment.clock.write(state)

    def _take_lock(self, until_ns: int) -> None:
        bell = self._segment.clock.bell
        while True:
            seen = bell.value()
            if self._segment.shared.try_lock(self._lock_byte):
                return
            rest_ns = until_ns - time.monotonic_ns()
            state = self.read()
            if rest_ns <= 0 or state.playing:
                name = self._segment.instance
                how = (
                    ", which is playing it; stop that program first"
                    if state.playing
                    else "; wait until that program ends"
                )
                raise TimeError(f"the time of instance {name!r} is moved by {self._owner(state.owner)}{how}")
            bell.wait(seen, min(rest_ns, _TURN_NS))

    def _frozen(self, state: Clock) -> Clock:
        """Return the state of virtual time that begins at the present moment of wall time."""
        now_ns = self._segment.clock_ns(time.monotonic_ns()) + state.offset_ns
        step = max([state.step, *(self._cycle(block, state, now_ns) for block in self._participants())])
        return state._replace(mode=ClockMode.VIRTUAL, step=step, done=step, time_ns=now_ns, resumed_ns=0, offset_ns=0)

    def _participants(self) -> list[Block]:
        return self._current_roles().participants

    def _current_roles(self) -> _Roles:
        self._segment.refresh()
        if self._roles is None or self._roles.blocks is not self._segment.blocks:
            self._roles = _Roles.of(self._segment, self._own)
        return self._roles

    @staticmethod
    def _cycle(block: Block, state: Clock, now_ns: int) -> int:
        """Return the present cycle of a block in wall time, but at least its newest frame's cycle.

        For a block that replays a recording, return 0: the recording's cycles are not steps.
        """
        if block.playhead is not None:
            return 0
        frame = block.latest()
        return max(now_ns // block.period_ns + state.lead(block.period_ns), 0 if frame is None else frame.cycle)

    def _ring_all(self) -> None:
        for slot in self._segment.processes:
            self._segment.clock.slot_bell(slot.index).ring()

    def _await_frames(self, number: int, waiting: list[tuple[Block, int]]) -> Generator[StepWait, None, str]:
        """Wait until each source has done a step.

        ``waiting`` has the block of each source and the number of its newest frame before the step.
        Return a text about the sources that failed; empty: none failed.
        """
        begun_ns = time.monotonic_ns()
        problems: list[str] = []
        warned = False
        while waiting:
            block, head = waiting[0]
            seen = block.ring.doorbell()  # before reading
            found = _step_answer(block, number, head)
            if found is not None:
                del waiting[0]
                problems += [f"{block.source}: {found}"] if found else []
                continue
            passed_ns = time.monotonic_ns() - begun_ns
            if passed_ns >= self._hard_ns:
                silent = [block for block, head in waiting if _step_answer(block, number, head) is None]
                problems += [_describe_silence(self._segment, block, self._hard_ns) for block in silent]
                return "; ".join(problems)
            if passed_ns >= self._soft_ns and not warned:
                warned = True
                names = [block.source for block, head in waiting if _step_answer(block, number, head) is None]
                note = f"step {number} waits for {', '.join(names)}"
                log.warning(note)
                self._write(self.read()._replace(note=note))
            yield StepWait(block, seen, (self._hard_ns if warned else min(self._soft_ns, self._hard_ns)) - passed_ns)
        return "; ".join(problems)

    def _await_delivery(
        self, number: int, dispatchers: Sequence[ProcessSlot], *, jumped: bool = False
    ) -> Generator[StepWait, None, str]:
        """Wait until these processes have delivered a step.

        With ``jumped``, time may have gone back, so that a later step may have been delivered.
        Return a text about the processes that have not delivered it; empty: all have.
        """
        clock, begun_ns = self._segment.clock, time.monotonic_ns()
        rung = warned = False
        while True:
            seen = clock.delivered_bell.value()
            waiting = [slot for slot in dispatchers if self._owes(slot, number, jumped=jumped)]
            if not rung:
                rung = True
                for slot in waiting:
                    clock.slot_bell(slot.index).ring()
            passed_ns = time.monotonic_ns() - begun_ns
            if not waiting:
                return ""
            names = ", ".join(f"{slot.name} (pid {slot.report.pid})" for slot in waiting)
            if passed_ns >= self._hard_ns:
                return f"{names} did not deliver the step within {self._hard_ns / 1e9:g} s"
            if passed_ns >= self._soft_ns and not warned:
                warned = True
                log.warning("step %d waits for its delivery by %s", number, names)
            # With a time limit, because a process that dies rings no doorbell.
            yield StepWait(None, seen, min(self._soft_ns, self._hard_ns - passed_ns))

    def _owes(self, slot: ProcessSlot, number: int, *, jumped: bool) -> bool:
        """Return whether a living process still has to deliver this step."""
        last = self._segment.clock.delivered(slot.index)
        owes = last is not None and (last != number if jumped else last < number)
        return owes and slot.alive()

    def _owner(self, pid: int) -> str:
        """Return name and pid of the owner of time, for a message."""
        names = [slot.name for slot in self._segment.processes if pid and slot.report.pid == pid and slot.alive()]
        return f"{names[0]} (pid {pid})" if names else f"another program (pid {pid})"


class _Roles(NamedTuple):
    """The blocks and processes that take part in each step, until a reload changes them.

    Attributes:
        blocks: The segment's blocks when the roles were determined.
        participants: The blocks that do each step; those with remote models first, because their
            answers come through a process that may itself wait.
        bells: The doorbells of their sources.
        dispatchers: The other processes that deliver steps.
        always_move: True if each step has an effect on all participants, and there are some.
    """

    blocks: Mapping[str, Block]
    participants: list[Block]
    bells: list[Doorbell]
    dispatchers: list[ProcessSlot]
    always_move: bool

    @classmethod
    def of(cls, segment: Segment, own: ProcessSlot | None) -> _Roles:
        """Determine the roles; ``own`` is the slot of this process, if it has one."""
        stepped = [block for block in segment.blocks.values() if block.attributes.stepped]
        sources = {block.source for block in stepped}
        slots = [slot for slot in segment.processes if own is None or slot.index != own.index]
        return cls(
            segment.blocks,
            sorted(stepped, key=lambda block: block.model_channel is None),
            [segment.clock.slot_bell(slot.index) for slot in slots if slot.name in sources],
            [slot for slot in slots if slot.kind in _DISPATCHERS],
            bool(stepped) and all(block.playhead is None for block in stepped),
        )


class Timekeeper:
    """Steps or plays an instance's time.

    The timekeeper owns time from the first step until :meth:`close`. Use it from one thread; it
    plays in a thread of its own.
    """

    def __init__(self, segment: Segment, coordinator: Coordinator | None = None) -> None:
        """Create the timekeeper.

        Args:
            segment: The instance's segment, writable.
            coordinator: Moves the time; None: create a coordinator for this segment.
        """
        self._segment = segment
        self._coordinator = coordinator or Coordinator(segment)
        self._paused = threading.Event()
        self._player: threading.Thread | None = None
        self._failure: ShmioError | None = None

    def step(self, dt_ns: int | None = None, count: int = 1) -> Step:
        """Move time by ``count`` steps, each as :meth:`Coordinator.step` does; return the last one.

        Raises:
            TimeError: As for :meth:`Coordinator.step`; or time is being played.
            ValueRangeError: The length is not between 1 us and 1 h.
        """
        if self._player is not None:
            raise TimeError("time is playing; pause it before you step it")
        self._segment.require_running()
        if not self._coordinator.owns:
            self._coordinator.take_over(_PATIENCE_S)
        return self._coordinator.steps(dt_ns, count)

    @contextmanager
    def still(self) -> Iterator[Coordinator]:
        """Own time, and do not move it, during a ``with`` block; yield the coordinator.

        Raises:
            TimeError: Another program owns time, time is being played, or time is real.
        """
        self._segment.require_running()
        if self._player is not None:
            raise TimeError("time is playing; pause it first")
        check_virtual(self._segment.clock.read())
        owned = self._coordinator.owns
        self._take_over()
        try:
            yield self._coordinator
        finally:
            if not owned:
                self._coordinator.close()

    def play(self, rate: float = 1.0, dt_ns: int | None = None) -> None:
        """Start to step in a thread, ``rate`` times as fast as real time.

        ``dt_ns`` is the length of each step in ns; None: the step size.

        Raises:
            TimeError: Another program owns time.
            ValueRangeError: The rate or the length is out of range.
        """
        if dt_ns is not None:
            check_step(dt_ns)
        self.pause()
        self._coordinator.set_playing(True, rate)
        self._paused.clear()
        self._player = threading.Thread(target=self._play, args=(rate, dt_ns), name="player", daemon=True)
        self._player.start()

    def pause(self) -> None:
        """Stop playing, and take over time if this program does not own it.

        Raises:
            TimeError: Another program owns time, or a step failed while time was played.
        """
        self._take_over()
        player, self._player = self._player, None
        if player is not None:
            self._paused.set()
            player.join()
        self._coordinator.set_playing(False)
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def release(self) -> None:
        """Return to real time. The clock continues from the present virtual time.

        Raises:
            TimeError: Another program owns time, time was virtual from the instance's start, or a
                step has failed while time was played.
        """
        self._segment.require_running()
        self._coordinator.check_release()
        if self._player is not None:
            self.pause()
        self._coordinator.release(_PATIENCE_S)

    def close(self) -> None:
        """Stop playing, and give up the ownership of time."""
        try:
            if self._player is not None:
                self.pause()
        finally:
            self._coordinator.close()

    def _take_over(self) -> None:
        self._segment.require_running()
        self._coordinator.take_over(_PATIENCE_S)

    def _play(self, rate: float, dt_ns: int | None) -> None:
        due_ns = time.monotonic_ns()
        while not self._paused.is_set():
            try:
                step = self._coordinator.step(dt_ns)
            except ShmioError as error:
                self._failure = error
                self._coordinator.set_playing(False)
                return
            now_ns = time.monotonic_ns()
            due_ns = max(due_ns + round(step.dt_ns / rate), now_ns - _LATE_NS)
            self._paused.wait(max(0, due_ns - now_ns) / 1e9)


def check_virtual(clock: Clock) -> None:
    """Raise TimeError if time is real, so that no snapshot can be saved or restored."""
    if not clock.virtual:
        raise TimeError("time is real, but snapshots need virtual time; stop time with shmio step --pause")


def _step_answer(block: Block, number: int, head: int) -> str | None:
    """Return a source's answer to a step: "" if it is done, the reason if it failed, None if none came yet.

    ``head`` is the number of its newest frame before the step.
    """
    if block.retired:
        return ""  # a reload has retired the block
    try:
        if block.playhead is not None:
            play = block.playhead.read()
            return None if play is None or play.step < number else ""
        if block.ring.head() == head:
            return None
        frame = block.latest()
    except SegmentError as error:
        return str(error)
    if frame is None or frame.cycle < number:
        return None
    return frame.reason or "it gave no reason" if frame.quality is Quality.BAD else ""


def _describe_silence(segment: Segment, block: Block, hard_ns: int) -> str:
    """Describe a source that has not answered a step within the hard time-out."""
    what = f"{block.source}: no answer within {hard_ns / 1e9:g} s"
    for slot in segment.processes:
        if slot.name == block.source:
            if slot.alive():
                return f"{what} from pid {slot.report.pid}"
            seen = slot.supervised
            return f"{what}: its process does not run ({seen.phase}{seen.note and f': {seen.note}'})"
    return what


def _moves(segment: Segment, participants: Sequence[Block]) -> bool:
    """Return whether a step has any effect: on a source, or on the program of an emulated controller."""
    return bool(participants) or any(
        slot.kind == "emulator" and segment.clock.delivered(slot.index) is not None for slot in segment.processes
    )


def _take_over_note(segment: Segment, participants: Sequence[Block]) -> str:
    """Return the note that the clock has between the take-over and the first step."""
    return _PAUSED if _moves(segment, participants) else f"{_NOBODY}{_REAL}"


def _unmoved_note(segment: Segment, participants: Sequence[Block]) -> str:
    """Return a note about sources on which a step has no effect, with the remedy; empty: there are none."""
    if not _moves(segment, participants):
        return _NOBODY if segment.clock.stepped else f"{_NOBODY}{_REAL}"
    found: dict[str, list[str]] = {"paused": [], "over": []}
    for block in participants:
        try:
            play = block.playhead.read() if block.playhead is not None else None
        except SegmentError:  # the step itself reports it
            continue
        if play is not None and play.paused:
            found["over" if play.over else "paused"].append(block.source)
    return "; ".join(
        f"the replay of {names[0]}{f' and {len(names) - 1} more' if names[1:] else ''} was {how} and did not move; "
        "start it with shmio replay play"
        for how, names in found.items()
        if names
    )
