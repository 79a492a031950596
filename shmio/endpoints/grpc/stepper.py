"""The instance's time for all services: stepping and playing, and heeding those who do it elsewhere."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, Final, TypeVar

from shmio.endpoints.grpc.delivery import Delivery
from shmio.endpoints.grpc.errand import Errands
from shmio.endpoints.grpc.feed import Feed
from shmio.endpoints.grpc.hold import Hold, Moment, Status
from shmio.endpoints.grpc.marks import Marks
from shmio.endpoints.grpc.outbox import Outboxes
from shmio.endpoints.grpc.publish import Publisher
from shmio.errors import ShmioError, TimeError, ValueRangeError
from shmio.segment import ProcessSlot, Segment
from shmio.segment.clock import ClockState
from shmio.segment.coordinator import MAX_STEP_NS, MIN_STEP_NS, Coordinator, Step

REST_S: Final = 1.0
"""Time is given up when nobody has moved it for so long, so that others can."""
LATE_S: Final = 0.5
"""Who plays catches up with what it is late, up to this."""
TURN_NS: Final = 200_000_000

_Result = TypeVar("_Result")

log = logging.getLogger("shmio.grpc")


class Stepper:
    """Moves time for clients, one at a time, and has each step delivered, whichever process makes it.

    For the event loop's thread, but for two threads of its own: one that moves time, and one that hears of others.
    """

    def __init__(
        self,
        segment: Segment,
        slot: ProcessSlot,
        hold: Hold,
        feeds: Mapping[str, Feed],
        outboxes: Outboxes,
        publisher: Publisher,
    ) -> None:
        """``slot``: this process's in the table."""
        self.marks = Marks(hold, self._now, lambda: self._clock.read().step_size_ns / 1e9)
        """Tells steps and time."""
        self._clock = segment.clock
        self._slot = slot
        self.hold = hold
        """Whether time is virtual, and what was delivered."""
        self._delivery = Delivery(hold, feeds, outboxes)
        self._publisher = publisher
        self._loop = asyncio.get_running_loop()
        self._errands = Errands("time", self._loop)
        self._coordinator = Coordinator(segment)
        self._turn = asyncio.Lock()  # one moves time
        self._owns = False
        self._changing = asyncio.Lock()  # one begins to play, or ends
        self._moving: asyncio.Task[Any] | None = None
        self._alive = True
        self._watchers: list[Callable[[Status], None]] = []
        self._rest: asyncio.TimerHandle | None = None
        self._play_dt_ns: int | None = None
        self._rate = 1.0
        self._player: asyncio.Task[None] | None = None
        self._woken = asyncio.Event()  # the player is
        self._tasks: set[asyncio.Task[Any]] = set()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="clock", daemon=True)
        state = self._clock.read()
        if state.virtual:
            self._delivery.begin(Moment(state.done, state.present_ns))
        self._told = self.status[1:]
        self._coordinator.delivered(slot, state.done)

    async def start(self, before: int = 0) -> None:
        """Begin to follow time; go on playing if the process before this one, by its pid, did when it died."""
        self._thread.start()
        state = self._clock.read()
        if state.playing and state.owner == before:  # what another program that died has played stands
            try:
                await self.play(state.dt_ns or None, state.rate)
            except TimeError as error:
                log.info("time is played by another program: %s", str(error))

    @property
    def alive(self) -> bool:
        """Whether time is being followed, and played if it should be."""
        return self._thread.is_alive() and (self._player is None or not self._player.done())

    def also(self, deliver: Callable[[Step], Awaitable[None]]) -> None:
        """Have each step delivered to others, too, before it is over."""
        self._delivery.others.append(deliver)

    def watch(self, watcher: Callable[[Status], None]) -> None:
        """Have it told of each step and of each change."""
        self._watchers.append(watcher)

    @property
    def status(self) -> Status:
        """How time stands."""
        return self._status(self._clock.read())

    async def set_step_size(self, dt_ns: int) -> None:
        """How far a step goes that does not say it itself; takes time over. ValueRangeError, TimeError."""
        _check(dt_ns)
        await self._do(self._move(partial(self._coordinator.set_step_size, dt_ns)))

    async def step(self, dt_ns: int | None = None, peer: str = "") -> Step:
        """Move time on, by the step size unless it is told; return when all streams have taken the step's marker.

        Before it, what was received on this peer's Publish streams is with its sources. One that was begun is done even
        if its client is gone, one that waits is not. TimeError: it failed, is not ours, or time plays; ValueRangeError.
        """
        task = self._spawn(self._step(dt_ns, peer))
        try:
            return await asyncio.shield(task)
        finally:
            if task is not self._moving:  # it is over, or others would wait for a step that nobody waits for
                task.cancel()

    async def play(self, dt_ns: int | None = None, rate: float = 1.0) -> Status:
        """Step from now on ``rate`` times as fast as real time; how time stands then. TimeError, ValueRangeError."""
        return await self._do(self._begin_play(dt_ns, rate))

    async def pause(self, *, end: bool = False) -> Status:
        """Step no more by itself; TimeError. ``end``: tell that it is not alive, until somebody moves time."""
        return await self._do(self._end_play(end))

    async def stop(self) -> None:
        """Move nothing more, and end the threads. A successor goes on with what is played."""
        self._stopping.set()
        self.marks.stop()
        if self._rest is not None:
            self._rest.cancel()
        tasks = [*self._tasks, *([self._player] if self._player is not None else [])]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self._player is None and not self._errands.busy:
            await self._errands.call(self._coordinator.close)
        self._errands.stop()

    def join(self) -> None:
        """Wait until the threads have ended, but for one that a step holds up."""
        self._thread.join()
        if not self._errands.busy:
            self._errands.join()

    # ---- moving time ---------------------------------------------------------------------------------------------

    async def _do(self, work: Coroutine[Any, Any, _Result]) -> _Result:
        return await asyncio.shield(self._spawn(work))  # to its end, whoever waits for that

    def _spawn(self, work: Coroutine[Any, Any, _Result]) -> asyncio.Task[_Result]:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _step(self, dt_ns: int | None, peer: str) -> Step:
        _check(dt_ns)
        if peer:
            await self._publisher.settle(peer)
        if self._player is not None:
            raise TimeError("time is played at present: pause it before it can be stepped")
        return await self._move(partial(self._coordinator.step, dt_ns))

    async def _move(self, call: Callable[[], _Result], *, alive: bool = True) -> _Result:
        """Take time over, call the coordinator beside the event loop, and deliver the step if it was one."""
        async with self._turn:
            self._moving = asyncio.current_task()
            try:
                if not self._owns:
                    await self._errands.call(self._coordinator.take_over)
                    self._owns = True
                    self._look()
                done = await self._errands.call(call)
                self._alive = alive
                if isinstance(done, Step):
                    await self._deliver(done)
                return done
            finally:
                self._moving = None
                self._look()
                self._set_rest()

    def _set_rest(self) -> None:
        if self._rest is not None:
            self._rest.cancel()
        self._rest = self._loop.call_later(REST_S, self._give_up)

    def _give_up(self) -> None:
        if self._owns and self._player is None and not self._turn.locked():
            self._spawn(self._release())

    async def _release(self) -> None:
        async with self._turn:
            if self._player is None:
                self._owns = False
                await self._errands.call(self._coordinator.close)

    # ---- playing ---------------------------------------------------------------------------------------------------

    async def _begin_play(self, dt_ns: int | None, rate: float) -> Status:
        _check(dt_ns)
        async with self._changing:
            self._play_dt_ns, self._rate = dt_ns, rate
            await self._move(partial(self._coordinator.set_playing, True, rate))
            if self._player is None:
                self._player = self._loop.create_task(self._play())
        return self.status

    async def _end_play(self, end: bool) -> Status:
        async with self._changing:
            player, self._player = self._player, None
            self._woken.set()
            if player is not None:
                await player
            await self._move(partial(self._coordinator.set_playing, False), alive=not end)
        return self.status

    async def _play(self) -> None:
        due_s = self._loop.time()
        reason = ""
        self._woken.clear()
        while self._player is asyncio.current_task():
            try:
                await self._move(partial(self._coordinator.step, self._play_dt_ns))
                reason = ""
            except ShmioError as error:
                before, reason = reason, str(error)
                if reason != before:
                    log.warning("playing: %s", reason)
            dt_s = (self._play_dt_ns or self._clock.read().step_size_ns) / 1e9
            due_s = max(due_s + dt_s / self._rate, self._loop.time() - LATE_S)
            if (wait_s := due_s - self._loop.time()) > 0:
                with suppress(TimeoutError):
                    await asyncio.wait_for(self._woken.wait(), wait_s)

    # ---- delivering ------------------------------------------------------------------------------------------------

    async def _deliver(self, step: Step) -> None:
        def mark() -> None:
            self._alive = True
            self.marks.tell()
            self._tell(Status(step.time_ns, step.dt_ns, True, self._clock.read().playing))

        if await self._delivery.deliver(step, mark):
            self._coordinator.delivered(self._slot, step.number)

    def _look(self) -> None:
        """Heed what the page says by now."""
        state = self._clock.read()
        if state.virtual and not self.hold.on:
            self._delivery.begin(_before(state))
        if state.done > self.hold.moment.number and not self._moving:
            self._spawn(self._deliver(Step(state.done, state.present_ns, state.dt_ns)))
        elif self._status(state)[1:] != self._told:
            self._tell(self._status(state))

    def _status(self, state: ClockState) -> Status:
        dt_ns = (self._play_dt_ns if state.playing else None) or state.step_size_ns
        return Status(self._now().clock_ns, dt_ns, self._alive, state.playing)

    def _tell(self, status: Status) -> None:
        self._told = self.status[1:]
        for watcher in self._watchers:
            watcher(status)

    def _now(self) -> Moment:
        return self.hold.moment if self.hold.on else Moment(0, self._clock.read().time_ns)

    # ---- the thread ------------------------------------------------------------------------------------------------

    def _follow(self) -> None:
        """Hear of what other processes do with time."""
        heeded: tuple[object, ...] = ()
        while not self._stopping.is_set():
            seen = self._clock.bell.value()
            state = self._clock.read()
            news = state.mode, state.done, state.step_size_ns, state.playing
            if news != heeded and not self._moving:
                heeded = news
                self._loop.call_soon_threadsafe(self._look)
            self._clock.bell.wait(seen, TURN_NS)


def _before(state: ClockState) -> Moment:
    """What is delivered when time is found virtual: on a busy machine its first step may be over, and waits for us."""
    first = bool(state.dt_ns) and state.step == state.done
    return Moment(state.done - first, state.present_ns - first * state.dt_ns)


def _check(dt_ns: int | None) -> None:
    """ValueRangeError: no step goes so far, and nothing has been taken over for it."""
    if dt_ns is not None and not MIN_STEP_NS <= dt_ns <= MAX_STEP_NS:
        raise ValueRangeError(f"a step is from 1 us to 1 h, not {dt_ns / 1e6:g} ms")
