"""Who moves time: takes it over, steps it, and waits until everybody has done the step."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Final

from shmio.errors import TimeError, ValueRangeError
from shmio.local.step_answers import StepWait, describe_silence, step_answer, take_over_note, unmoved_note
from shmio.segment.block import Block
from shmio.segment.clock import ClockMode, ClockState, time_lock
from shmio.segment.processes import ProcessSlot
from shmio.segment.segment import Segment

MIN_STEP_NS: Final = 1_000
MAX_STEP_NS: Final = 3_600_000_000_000
TURN_NS: Final = 100_000_000
"""Who waits for an owner of time looks by itself, too: the bell of one that dies is silent."""
MAX_RATE: Final = 1000.0
DISPATCHERS: Final = frozenset({"grpc", "mqtt", "recorder"})
"""Kinds of processes that a step may wait for until they have delivered it."""

log = logging.getLogger("shmio.time")
log.addHandler(logging.NullHandler())  # a program that asks for no log gets none


@dataclass(frozen=True, slots=True)
class Step:
    """A step that is done: its number, the instance's clock after it, and by how much it moved it."""

    number: int
    time_ns: int
    dt_ns: int


class Coordinator:
    """Moves the time of one instance. Several threads may use it; one program at a time owns time.

    A step: the page says which is asked for; each block that lives on the instance's clock publishes its frame for it;
    then it is ``done``, and is delivered, by this process and by the others that serve remote programs.
    """

    def __init__(
        self,
        segment: Segment,
        *,
        soft_s: float = 1.0,
        hard_s: float = 10.0,
        deliver: Callable[[Step], None] = lambda _: None,
    ) -> None:
        """``segment`` must be writable; of a process that delivers it is the one by which that holds its role.

        After ``soft_s`` the log and the page tell whom a step waits for, after ``hard_s`` it has failed.
        ``deliver``: called within :meth:`step` when all have done it.
        """
        self._segment = segment
        self._soft_ns = round(soft_s * 1e9)
        self._hard_ns = round(hard_s * 1e9)
        self._deliver = deliver
        self._turn = threading.RLock()
        self._lock_byte = time_lock(segment.header)
        self._owns = False

    def read(self) -> ClockState:
        """The clock page as it is now."""
        return self._segment.clock.read()

    def take_over(self, patience_s: float = 0.0, *, steps: bool = False) -> None:
        """From now on only steps move time. TimeError: another living process owns it, and plays, or goes on owning it.

        ``patience_s``: how long to wait for one that does not play. ``steps``: the first one follows at once, so that
        there is nothing to say of time that stands.
        """
        with self._turn:
            if self._owns:
                return
            if not self._segment.shared.writable:
                raise TimeError("this attachment only reads: attach with writable=True")
            self._take_lock(time.monotonic_ns() + round(patience_s * 1e9))
            self._owns = True
            state = self.read()
            note = f"step {state.step} was not finished: who asked for it has ended" if state.stepping else state.note
            state = state._replace(owner=os.getpid(), playing=False, stepping=False, note=note)
            if not state.virtual:
                # Who free-runs looks at the page before each cycle: none begins after this write, so that none of
                # theirs is later than the present one, as it is found once more after it.
                self._write(self._frozen(state))
                state = self._frozen(state._replace(note="" if steps else take_over_note(self._participants())))
            self._write(state)
            for slot in self._segment.processes:
                self._segment.clock.slot_bell(slot.index).ring()

    def release(self, patience_s: float = 0.0) -> None:
        """Have time be real again, from where it stands; it is nobody's then. Nothing, if it is real already.

        ``patience_s`` as of :meth:`take_over`. TimeError: another living process owns time, or it was never real.
        """
        with self._turn:
            self.check_release()
            if not self._owns:
                self._take_lock(time.monotonic_ns() + round(patience_s * 1e9))
            clock = self._segment.clock
            state = clock.told()
            if state.virtual:
                # Each source looks at the page before it publishes: none of theirs is later than this.
                offset_ns = state.time_ns - (time.monotonic_ns() - self._segment.header.started_ns)
                self._write(
                    state._replace(
                        mode=ClockMode.WALL, dt_ns=0, playing=False, stepping=False, owner=0, note="",
                        resumed_ns=state.time_ns, offset_ns=offset_ns,
                    )
                )  # fmt: skip
            self._segment.shared.unlock(self._lock_byte)
            self._owns = False
            clock.bell.ring()  # once more: who waits for the lock
            for slot in self._segment.processes:
                clock.slot_bell(slot.index).ring()

    def check_release(self) -> None:
        """TimeError: time cannot be released here, whoever owns it."""
        if not self._segment.shared.writable:
            raise TimeError("this attachment only reads: attach with writable=True")
        if self._segment.clock.stepped:
            raise TimeError(
                f'the time of instance {self._segment.instance!r} is virtual from its start (clock = "stepped" in its '
                'configuration): there is no real time to go back to; for that start it with clock = "wall"'
            )

    def set_step_size(self, dt_ns: int) -> None:
        """How far a step goes that does not say it itself; takes time over.

        ValueRangeError: not within 1 us and 1 h; TimeError.
        """
        check_step(dt_ns)
        with self._turn:
            self.take_over()
            self._write(self.read()._replace(step_size_ns=dt_ns))

    def set_playing(self, playing: bool, rate: float = 1.0) -> None:
        """Tell that steps come by themselves, at ``rate`` times real time, or no longer; takes time over.

        ValueRangeError: the rate is not above 0, at most 1000; TimeError.
        """
        if not 0 < rate <= MAX_RATE:
            raise ValueRangeError(f"a rate is above 0, at most {MAX_RATE:g}, not {rate:g}")
        with self._turn:
            self.take_over()
            self._write(self.read()._replace(playing=playing, rate=rate))

    def step(self, dt_ns: int | None = None) -> Step:
        """Move time by ``dt_ns`` (default: the step size), and wait until all have done so; takes time over.

        TimeError: another process owns time, or a participant or a dispatcher has not answered within the hard
        time-out, or a participant has failed; then the step's number and time are used up. ValueRangeError: not within
        1 us and 1 h.
        """
        with self._turn, closing(self.stepping(dt_ns)) as stepping:
            while True:
                try:
                    block, seen, rest_ns = next(stepping)
                except StopIteration as over:
                    step: Step = over.value
                    return step
                if block is None:
                    self._segment.clock.delivered_bell.wait(seen, rest_ns)
                else:
                    block.ring.wait(seen, rest_ns)

    def stepping(self, dt_ns: int | None = None) -> Generator[StepWait, None, Step]:
        """:meth:`step` for an event loop: it yields what to wait for, and looks again when it is asked to go on.

        Whoever does not go on to its end has to close it. Nothing else of this coordinator may be called meanwhile.
        """
        self.take_over(steps=True)
        before = self.read()
        dt_ns = before.step_size_ns if dt_ns is None else dt_ns
        check_step(dt_ns)
        step = Step(before.step + 1, before.time_ns + dt_ns, dt_ns)
        participants = self._participants()
        stands = unmoved_note(self._segment, participants)
        asked = before._replace(step=step.number, time_ns=step.time_ns, dt_ns=dt_ns, stepping=True, note="")
        problem = "it was broken off"
        try:
            self._segment.clock.write(asked, ring=False)  # those who deliver it have time until it is done
            self._ring([block.source for block in participants])
            problem = yield from self._await_frames(step.number, participants, asked)
        finally:
            note = f"step {step.number} failed: {problem}" if problem else stands
            done = before.done if problem else step.number
            self._write(asked._replace(done=done, stepping=False, note=note))
        if not problem:
            self._deliver(step)
            problem = yield from self._await_delivery(step.number)
        if problem:
            raise TimeError(f"step {step.number}: {problem}")
        return step

    def close(self) -> None:
        """Give time up to whoever takes it over next; until then it stands."""
        with self._turn:
            if not self._owns or self._segment.closed:
                return
            self._write(self.read()._replace(owner=0, playing=False))
            self._segment.shared.unlock(self._lock_byte)
            self._owns = False
            self._segment.clock.bell.ring()  # once more: who waits for the lock

    def _write(self, state: ClockState) -> None:
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
                how = ", which plays it; stop that first" if state.playing else "; it is free when that ends"
                raise TimeError(f"the time of instance {name!r} is moved by {self._owner(state.owner)}{how}")
            bell.wait(seen, min(rest_ns, TURN_NS))

    def _frozen(self, state: ClockState) -> ClockState:
        """Virtual time that goes on from now, and from this state of wall time."""
        now_ns = self._segment.clock_ns(time.monotonic_ns()) + state.offset_ns
        step = max([state.step, *(self._cycle(block, state, now_ns) for block in self._participants())])
        return state._replace(mode=ClockMode.VIRTUAL, step=step, done=step, time_ns=now_ns, resumed_ns=0, offset_ns=0)

    def _participants(self) -> list[Block]:
        self._segment.refresh()
        return [block for block in self._segment.blocks.values() if block.attributes.stepped]

    @staticmethod
    def _cycle(block: Block, state: ClockState, now_ns: int) -> int:
        """The present cycle of a block that has free-run, or a later one if it has published such.

        One that plays a recording has the recording's cycles, which are no steps.
        """
        if block.playhead is not None:
            return 0
        frame = block.latest()
        return max(now_ns // block.period_ns + state.lead(block.period_ns), 0 if frame is None else frame.cycle)

    def _ring(self, sources: Sequence[str]) -> None:
        for slot in self._segment.processes:
            if slot.name in sources:
                self._segment.clock.slot_bell(slot.index).ring()

    def _await_frames(
        self, number: int, participants: Sequence[Block], asked: ClockState
    ) -> Generator[StepWait, None, str]:
        """Wait for the frame of each for this step; who has failed or not answered, and why; empty: nobody."""
        begun_ns = time.monotonic_ns()
        waiting = list(participants)
        problems: list[str] = []
        told = False
        while waiting:
            block = waiting[0]
            seen = block.ring.doorbell()  # before looking
            found = step_answer(block, number)
            if found is not None:
                waiting.remove(block)
                problems += [f"{block.source}: {found}"] if found else []
                continue
            passed_ns = time.monotonic_ns() - begun_ns
            if passed_ns >= self._hard_ns:
                silent = [block for block in waiting if step_answer(block, number) is None]
                problems += [describe_silence(self._segment, block, self._hard_ns) for block in silent]
                return "; ".join(problems)
            if passed_ns >= self._soft_ns and not told:
                told = True
                names = [block.source for block in waiting if step_answer(block, number) is None]
                note = f"step {number} waits for {', '.join(names)}"
                log.warning(note)
                self._write(asked._replace(note=note))
            yield StepWait(block, seen, (self._hard_ns if told else min(self._soft_ns, self._hard_ns)) - passed_ns)
        return "; ".join(problems)

    def _await_delivery(self, number: int) -> Generator[StepWait, None, str]:
        """Wait until the other dispatchers have delivered a step; who has not, or empty."""
        clock, begun_ns, told = self._segment.clock, time.monotonic_ns(), False
        rung = False
        while True:
            seen = clock.delivered_bell.value()
            waiting = [slot for slot in self._segment.processes if self._owes(slot, number)]
            if not rung:
                rung = True
                self._ring([slot.name for slot in waiting])
            passed_ns = time.monotonic_ns() - begun_ns
            if not waiting:
                return ""
            names = ", ".join(f"{slot.name} (pid {slot.report.pid})" for slot in waiting)
            if passed_ns >= self._hard_ns:
                return f"not delivered within {self._hard_ns / 1e9:g} s by {names}"
            if passed_ns >= self._soft_ns and not told:
                told = True
                log.warning("step %d waits for its delivery by %s", number, names)
            # In turns: one that dies rings no bell.
            yield StepWait(None, seen, min(self._soft_ns, self._hard_ns - passed_ns))

    def _owes(self, slot: ProcessSlot, number: int) -> bool:
        """Whether another process delivers steps, lives, and has not delivered this one yet."""
        if slot.kind not in DISPATCHERS:
            return False
        last = self._segment.clock.delivered(slot.index)
        return last is not None and last < number and slot.alive()  # our own lock does not count as one held

    def _owner(self, pid: int) -> str:
        """Who owns time, as far as the page and the process table tell."""
        names = [slot.name for slot in self._segment.processes if pid and slot.report.pid == pid and slot.alive()]
        return f"{names[0]} (pid {pid})" if names else f"another program (pid {pid})"


def check_step(dt_ns: float) -> None:
    """ValueRangeError: it is no length of a step."""
    if not MIN_STEP_NS <= dt_ns <= MAX_STEP_NS:
        raise ValueRangeError(f"a step is from 0.001 ms to 3600000 ms (1 h), not {dt_ns / 1e6:g} ms")
