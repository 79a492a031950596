"""The instance's time moved for clients of all services: stepping and playing."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Mapping
from contextlib import asynccontextmanager, closing, suppress
from functools import partial
from typing import Any, Final, TypeVar

from shmio.endpoints.grpc.commands.publish import Publisher
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.outboxes import Outboxes
from shmio.endpoints.grpc.streams.wakeups import WakeUp, WakeUps
from shmio.endpoints.grpc.time.open_streams import OpenStreams
from shmio.endpoints.grpc.time.timeline import Timeline
from shmio.endpoints.grpc.time.virtual_time import TimeStatus, VirtualTime
from shmio.errors import ShmioError, TimeError
from shmio.local.step_answers import StepWait
from shmio.local.time_control import Coordinator, Step, check_step
from shmio.segment import ProcessSlot, Segment
from shmio.segment.clock import ClockPage

BRIEF_NS: Final = 500_000
"""So long the event loop stands still for sources that answer at once: to be told by a thread takes about as long."""


class StepDriver:
    """What :meth:`Coordinator.step` is to a thread; for the event loop's thread, one step at a time."""

    def __init__(self, coordinator: Coordinator, clock: ClockPage, wake_ups: WakeUps) -> None:
        self._coordinator = coordinator
        self._clock = clock
        self._wake_ups = wake_ups
        self._delivered: WakeUp | None = None  # nobody else delivers steps, as a rule

    async def step(self, dt_ns: int | None) -> Step:
        """Errors as of :meth:`Coordinator.step`; one that is cancelled is broken off."""
        still_ns = time.monotonic_ns() + BRIEF_NS
        with closing(self._coordinator.stepping(dt_ns)) as stepping:
            while True:
                try:
                    wait = next(stepping)
                except StopIteration as over:
                    step: Step = over.value
                    return step
                if not _brief(wait, still_ns - time.monotonic_ns()):
                    await self._stay(wait)

    def stop(self) -> None:
        """Wait for nobody any more."""
        if self._delivered is not None:
            self._delivered.stop()
            self._delivered.join()

    async def _stay(self, wait: StepWait) -> None:
        """Until its bell rings, which it does now and then in any case."""
        rung = asyncio.get_running_loop().create_future()

        def ring() -> None:
            if not rung.done():
                rung.set_result(None)

        leave = self._listen(wait, ring)
        try:
            if wait.seen == (wait.block.ring.doorbell() if wait.block else self._clock.delivered_bell.value()):
                await rung
        finally:
            leave()

    def _listen(self, wait: StepWait, ring: Callable[[], None]) -> Callable[[], object]:
        block = wait.block
        if block is not None:
            self._wake_ups.join(block, ring)
            return lambda: self._wake_ups.leave(block, ring)
        bell = self._delivered = self._delivered or WakeUp(self._clock.delivered_bell, "delivered")
        bell.listeners[ring] = None
        return lambda: bell.listeners.pop(ring)


def _brief(wait: StepWait, rest_ns: int) -> bool:
    """Wait in the event loop's own thread, at most so long; whether the block's bell has rung."""
    if wait.block is None or rest_ns <= 0:
        return False
    return wait.block.ring.wait(wait.seen, min(rest_ns, wait.rest_ns)) != wait.seen


LATE_S: Final = 0.5
"""What is late is caught up with, up to this."""

log = logging.getLogger("shmio.grpc")


class Player:
    """For the event loop's thread."""

    def __init__(self, make: Callable[[int | None], Awaitable[object]], step_size_ns: Callable[[], int]) -> None:
        """``make``: makes a step of so many ns, or of the step size; a ShmioError is logged, and it goes on."""
        self.dt_ns: int | None = None
        """Of each step; None: the step size."""
        self.rate = 1.0
        """How many times as fast as real time."""
        self._make = make
        self._step_size_ns = step_size_ns
        self._loop = asyncio.get_running_loop()
        self._task: asyncio.Task[None] | None = None
        self._woken = asyncio.Event()

    @property
    def on(self) -> bool:
        """Whether it plays."""
        return self._task is not None

    @property
    def alive(self) -> bool:
        """Whether it plays if it should."""
        return self._task is None or not self._task.done()

    def begin(self) -> None:
        """Play, unless it does."""
        if self._task is None:
            self._task = self._loop.create_task(self._play())

    async def end(self) -> None:
        """Play no more; return when the last step is over."""
        task, self._task = self._task, None
        self._woken.set()
        if task is not None:
            await task

    async def break_off(self) -> None:
        """End in the middle of a step; it still counts as on."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)

    async def _play(self) -> None:
        due_s = self._loop.time()
        reason = ""
        self._woken.clear()
        while self._task is asyncio.current_task():
            try:
                await self._make(self.dt_ns)
                reason = ""
            except ShmioError as error:
                last, reason = reason, str(error)
                if reason != last:
                    log.warning("playing: %s", reason)
            dt_s = (self.dt_ns or self._step_size_ns()) / 1e9
            due_s = max(due_s + dt_s / self.rate, self._loop.time() - LATE_S)
            with suppress(TimeoutError):  # others have their turn even if it is late
                await asyncio.wait_for(self._woken.wait(), max(0.0, due_s - self._loop.time()))


REST_S: Final = 1.0
"""Time is given up when nobody has moved it for so long, so that others can."""

_Result = TypeVar("_Result")


class Stepper:
    """Moves time for clients, one at a time. For the event loop's thread."""

    def __init__(
        self,
        segment: Segment,
        slot: ProcessSlot,
        virtual_time: VirtualTime,
        wake_ups: WakeUps,
        feeds: Mapping[str, Feed],
        outboxes: Outboxes,
        publisher: Publisher,
        open_streams: OpenStreams,
    ) -> None:
        """Arguments as of :class:`Timeline`."""
        self._segment = segment
        self._publisher = publisher
        self._loop = asyncio.get_running_loop()
        self._coordinator = Coordinator(segment)
        self._driver = StepDriver(self._coordinator, segment.clock, wake_ups)
        self._turn = asyncio.Lock()  # one moves time
        self._owns = False
        self._changing = asyncio.Lock()  # one begins to play, or ends
        self._moving: asyncio.Task[Any] | None = None
        self._rest: asyncio.TimerHandle | None = None
        self._rest_s = 0.0  # when time is given up if nobody has moved it by then
        self._player = Player(self._make, lambda: segment.clock.read().step_size_ns)
        self._tasks: set[asyncio.Task[Any]] = set()
        self.timeline = Timeline(segment, slot, virtual_time, feeds, outboxes, open_streams, lambda: self._player.dt_ns)
        """How time stands, whoever moves it."""

    async def start(self, predecessor: int = 0) -> None:
        """Begin to follow time; go on playing if the process before this one, by its pid, did when it died."""
        self.timeline.start()
        state = self._segment.clock.told()
        if state.playing and state.owner == predecessor:  # what another program that died has played stands
            try:
                await self.play(state.dt_ns or None, state.rate)
            except TimeError as error:
                log.info("time is played by another program: %s", str(error))

    @property
    def alive(self) -> bool:
        """Whether time is being followed, and played if it should be."""
        return self.timeline.alive and self._player.alive

    async def set_step_size(self, dt_ns: int) -> None:
        """How far a step goes that does not say it itself; takes time over. ValueRangeError, TimeError."""
        _check(dt_ns)
        await self._do(self._change(partial(self._coordinator.set_step_size, dt_ns)))

    async def step(self, dt_ns: int | None = None, peer: str = "") -> Step:
        """Move time on, by the step size unless it is told; return when all streams have taken the step's marker.

        Before it, what was received on this peer's Publish streams is with its sources. One that was begun is done even
        if its client is gone, one that waits is not. TimeError: it failed, is not ours, or time plays; ValueRangeError.
        """
        done: asyncio.Future[Step] = self._loop.create_future()
        task = self._spawn(_tell(self._step(dt_ns, peer), done))
        try:
            return await done
        finally:
            if task is not self._moving:  # it is over, or others would wait for a step that nobody waits for
                task.cancel()

    async def play(self, dt_ns: int | None = None, rate: float = 1.0) -> TimeStatus:
        """Step from now on ``rate`` times as fast as real time; how time stands then. TimeError, ValueRangeError."""
        return await self._do(self._begin_play(dt_ns, rate))

    async def pause(self, *, end: bool = False) -> TimeStatus:
        """Step no more by itself; TimeError. ``end``: tell that it is not alive, until somebody moves time."""
        return await self._do(self._end_play(end))

    async def release(self) -> TimeStatus:
        """Have time be real again; TimeError: it is not ours to release, or was never real."""
        return await self._do(self._end_virtual())

    async def stop(self) -> None:
        """Move nothing more. A successor goes on with what is played."""
        if self._rest is not None:
            self._rest.cancel()
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(self._player.break_off(), *tasks, return_exceptions=True)
        if not self._player.on:
            self._coordinator.close()
        self._driver.stop()
        await self.timeline.stop()

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
        if self._player.on:
            raise TimeError("time is played at present: pause it before it can be stepped")
        return await self._make(dt_ns)

    async def _make(self, dt_ns: int | None) -> Step:
        """Make a step, and deliver it."""
        async with self._moved():
            step = await self._driver.step(dt_ns)
            await self.timeline.deliver(step)
            return step

    async def _change(self, call: Callable[[], None], *, end: bool = False) -> None:
        """Have the coordinator change how time is moved."""
        async with self._moved():
            call()
            self.timeline.ended = end

    @asynccontextmanager
    async def _moved(self) -> AsyncIterator[None]:
        """Time is ours, and nobody else's turn."""
        async with self._turn:
            self._moving, self.timeline.steered = asyncio.current_task(), True
            try:
                if self._segment.outdated:
                    await asyncio.to_thread(self._segment.refresh)
                if not self._owns:
                    self._coordinator.take_over()
                    self._own(True)
                    self.timeline.look()
                yield
            finally:
                self._moving, self.timeline.steered = None, False
                self.timeline.look()
                self._set_rest()

    def _own(self, owns: bool) -> None:
        self._owns = owns
        self.timeline.own(owns)

    def _set_rest(self) -> None:
        self._rest_s = self._loop.time() + REST_S
        if self._rest is None:
            self._rest = self._loop.call_at(self._rest_s, self._give_up)

    def _give_up(self) -> None:
        self._rest = None
        if self._loop.time() < self._rest_s:  # time was moved meanwhile
            self._rest = self._loop.call_at(self._rest_s, self._give_up)
        elif self._owns and not self._player.on and not self._turn.locked():
            self._spawn(self._release())

    async def _release(self) -> None:
        async with self._turn:
            if not self._player.on:
                self._own(False)
                self._coordinator.close()

    # ---- playing ---------------------------------------------------------------------------------------------------

    async def _begin_play(self, dt_ns: int | None, rate: float) -> TimeStatus:
        _check(dt_ns)
        async with self._changing:
            self._player.dt_ns, self._player.rate = dt_ns, rate
            await self._change(partial(self._coordinator.set_playing, True, rate))
            self._player.begin()
        return self.timeline.status

    async def _end_virtual(self) -> TimeStatus:
        self._coordinator.check_release()
        async with self._changing:
            await self._player.end()
            async with self._turn:
                self._coordinator.release()
                self._own(False)
                self.timeline.ended = False
            return self.timeline.status

    async def _end_play(self, end: bool) -> TimeStatus:
        async with self._changing:
            await self._player.end()
            await self._change(partial(self._coordinator.set_playing, False), end=end)
        return self.timeline.status


async def _tell(work: Coroutine[Any, Any, _Result], done: asyncio.Future[_Result]) -> None:
    """Do it, whoever waits for what comes of it; who is cancelled meanwhile is not told."""
    try:
        result = await work
    except Exception as error:  # noqa: BLE001  who waits is told, whatever it is
        if not done.done():
            done.set_exception(error)
    except asyncio.CancelledError:
        done.cancel()
        raise
    else:
        if not done.done():
            done.set_result(result)


def _check(dt_ns: int | None) -> None:
    """ValueRangeError: no step goes so far, and nothing has been taken over for it."""
    if dt_ns is not None:
        check_step(dt_ns)
