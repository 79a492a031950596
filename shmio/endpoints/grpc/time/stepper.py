"""Moves the instance's time for the clients of all services: makes steps, and plays in real time."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, Final, TypeVar

from shmio.audit.trail import Attempt
from shmio.endpoints.grpc.streams.feed import Feed, VirtualTime
from shmio.endpoints.grpc.streams.outbox import OpenStreams, Outboxes
from shmio.endpoints.grpc.time.timeline import Timeline, TimeStatus
from shmio.endpoints.grpc.wakeups import WakeUp, WakeUps
from shmio.errors import ShmioError, TimeError
from shmio.local.time_control import Coordinator, Step, StepWait, check_virtual
from shmio.model.clock import check_step
from shmio.segment import ProcessSlot, Segment
from shmio.segment.clock import ClockPage

BRIEF_NS: Final = 500_000
"""Time in ns for which a step blocks the event loop while it waits for the sources' answers.

A wake-up by another thread would take about as long.
"""


class StepDriver:
    """Makes steps as :meth:`Coordinator.step` does, but in an event loop. It makes one step at a time."""

    def __init__(self, coordinator: Coordinator, clock: ClockPage, wake_ups: WakeUps) -> None:
        self._coordinator = coordinator
        self._clock = clock
        self._wake_ups = wake_ups
        self._delivered: WakeUp | None = None  # made when needed: usually no other process delivers steps
        self._woken: asyncio.Future[None] | None = None
        self._stopped = False

    async def step(self, dt_ns: int | None) -> Step:
        """Make one step. If the task is cancelled meanwhile, raise CancelledError when the step has ended.

        ``dt_ns`` is the length of the step, in ns; None for the step size. This raises the errors
        of :meth:`Coordinator.step`.
        """
        until_ns = time.monotonic_ns() + BRIEF_NS
        cancelled = False
        stepping = self._coordinator.stepping(dt_ns)
        try:
            while not self._stopped:
                try:
                    wait = next(stepping)
                except StopIteration as over:
                    step: Step = over.value
                    if cancelled:
                        break
                    return step
                if not _brief(wait, until_ns - time.monotonic_ns()):
                    try:
                        await self._wait(wait)
                    except asyncio.CancelledError:
                        cancelled = True
        finally:
            stepping.close()
        raise asyncio.CancelledError

    def stop(self) -> None:
        """Abort the present step, and make no others. Stop waiting for other processes to deliver steps."""
        self._stopped = True
        self._ring()
        if self._delivered is not None:
            self._delivered.stop()
            self._delivered.join()

    async def _wait(self, wait: StepWait) -> None:
        """Wait until the step may continue, or until it is time to check again."""
        self._woken = asyncio.get_running_loop().create_future()
        leave = self._listen(wait, self._ring)
        try:
            if wait.seen == (wait.block.ring.doorbell() if wait.block else self._clock.delivered_bell.value()):
                await self._woken
        finally:
            leave()

    def _ring(self) -> None:
        if self._woken is not None and not self._woken.done():
            self._woken.set_result(None)

    def _listen(self, wait: StepWait, ring: Callable[[], None]) -> Callable[[], object]:
        block = wait.block
        if block is not None:
            self._wake_ups.join(block, ring)
            return lambda: self._wake_ups.leave(block, ring)
        bell = self._delivered = self._delivered or WakeUp(self._clock.delivered_bell, "delivered")
        bell.listeners[ring] = None
        return lambda: bell.listeners.pop(ring)


def _brief(wait: StepWait, rest_ns: int) -> bool:
    """Block the event loop until the source's block has a new frame or event, at most ``rest_ns``.

    Do not block it for a source with a remote model, because the model's answer needs the loop.

    Returns:
        True if the block had a new frame or event.

    """
    if wait.block is None or wait.block.model_channel is not None or rest_ns <= 0:
        return False
    return wait.block.ring.wait(wait.seen, min(rest_ns, wait.rest_ns)) != wait.seen


LATE_S: Final = 0.5
"""Maximum delay in s that playing makes up for. The rest of a longer delay is lost."""

log = logging.getLogger("shmio.grpc")


class Player:
    """Makes steps at a multiple of real time: it *plays*. Use it only in the event loop's thread."""

    def __init__(self, make: Callable[[int | None], Awaitable[object]], step_size_ns: Callable[[], int]) -> None:
        """Prepare to play. :meth:`begin` starts playing.

        Args:
            make: Makes one step of the given size in ns, or of the step size if that is None. A
                ShmioError is logged, and playing continues.
            step_size_ns: Returns the present step size, in ns.

        """
        self.dt_ns: int | None = None
        """Length of each step, in ns; None for the step size."""
        self.rate = 1.0
        """Speed, as a multiple of real time."""
        self._make = make
        self._step_size_ns = step_size_ns
        self._loop = asyncio.get_running_loop()
        self._task: asyncio.Task[None] | None = None
        self._woken = asyncio.Event()

    @property
    def on(self) -> bool:
        """True from :meth:`begin` until :meth:`end`."""
        return self._task is not None

    @property
    def alive(self) -> bool:
        """False if the task that plays has ended although the player should play; otherwise True."""
        return self._task is None or not self._task.done()

    def begin(self) -> None:
        """Start playing, unless the player plays already."""
        if self._task is None:
            self._task = self._loop.create_task(self._play())

    async def end(self) -> None:
        """Stop playing, and wait until the last step has ended."""
        task, self._task = self._task, None
        self._woken.set()
        if task is not None:
            await task

    async def break_off(self) -> None:
        """Abort the present step, and stop playing. :attr:`on` stays True."""
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
                    log.warning("a step failed while time is playing: %s", reason)
            dt_s = (self.dt_ns or self._step_size_ns()) / 1e9
            due_s = max(due_s + dt_s / self.rate, self._loop.time() - LATE_S)
            with suppress(TimeoutError):  # the wait lets other tasks run, even if playing is late
                await asyncio.wait_for(self._woken.wait(), max(0.0, due_s - self._loop.time()))


REST_S: Final = 1.0
"""Time in s without a step after which the endpoint gives up control of time, for other programs."""

_Result = TypeVar("_Result")


class Stepper:
    """Moves time for clients, one request at a time. Use it only in the event loop's thread."""

    def __init__(
        self,
        segment: Segment,
        slot: ProcessSlot,
        virtual_time: VirtualTime,
        wake_ups: WakeUps,
        feeds: Mapping[str, Feed],
        outboxes: Outboxes,
        settle: Callable[[str], Awaitable[None]],
        open_streams: OpenStreams,
    ) -> None:
        """Create the stepper; :meth:`start` starts it.

        Args:
            segment: The instance's shared memory.
            slot: This process's entry in the process table.
            virtual_time: The state of virtual time that the feeds use.
            wake_ups: The wake-ups that the feeds use.
            feeds: The feeds of all sources, by name.
            outboxes: The outboxes of all streams.
            settle: Waits for a client's earlier writes before its step.
            open_streams: Counts the open streams of all services together.

        """
        self._segment = segment
        self._settle = settle
        self._loop = asyncio.get_running_loop()
        self._coordinator = Coordinator(segment, own=slot)
        self._driver = StepDriver(self._coordinator, segment.clock, wake_ups)
        self._lock = asyncio.Lock()  # only one task moves time
        self._owns = False
        self._changing = asyncio.Lock()  # only one task starts or stops playing
        self._rest: asyncio.TimerHandle | None = None
        self._rest_s = 0.0  # when control of time is released
        self._player = Player(self._make, lambda: segment.clock.read().step_size_ns)
        self._tasks: set[asyncio.Task[Any]] = set()
        self.timeline = Timeline(segment, slot, virtual_time, feeds, outboxes, open_streams, lambda: self._player.dt_ns)
        """The state of time, whichever program moves time."""

    async def start(self, predecessor: int = 0) -> None:
        """Start following time.

        If the previous process of this endpoint was playing, resume playing.

        Args:
            predecessor: Process id of the previous process; 0 if there was none.

        """
        self.timeline.start()
        state = self._segment.clock.last_written()
        if state.playing and state.owner == predecessor:  # other programs' playing is not resumed
            try:
                await self.play(state.dt_ns or None, state.rate)
            except TimeError as error:
                log.info("another program plays time: %s", str(error))

    @property
    def alive(self) -> bool:
        """True if this process follows time, and playing has not failed; see :attr:`Player.alive`."""
        return self.timeline.alive and self._player.alive

    async def set_step_size(self, dt_ns: int) -> None:
        """Take control of time, and set the step size: the length of each step whose request gives no length.

        Raises:
            ValueRangeError: The step size is out of range.
            TimeError: Another program controls time.

        """
        with _attempt("step size", dt_ns) as attempt:
            _check(dt_ns)
            await self._do(self._change(partial(self._coordinator.set_step_size, dt_ns)))
            attempt.end("done")

    async def step(self, dt_ns: int | None = None, peer: str = "") -> Step:
        """Make a step. Return when all streams have taken the marker of the step.

        Values that came earlier on Publish streams of ``peer`` reach their sources before the step.
        If the client disconnects, a step that has started is completed, and a step that still waits
        is cancelled.

        Args:
            dt_ns: Length of the step, in ns; None for the step size.
            peer: The client, as gRPC names it; if empty, the step does not wait for published
                values.

        Raises:
            TimeError: The step failed, another program controls time, or this process is playing.
            ValueRangeError: ``dt_ns`` is out of range.

        """
        with _attempt("step", dt_ns) as attempt:
            _check(dt_ns)
            if peer:
                await self._settle(peer)
            if self._player.on:
                raise TimeError("time is playing; pause it before you step it")
            step = await self._make(dt_ns)
            attempt.what = {"step": step.number, "dt_s": step.dt_ns / 1e9, "time_s": step.time_ns / 1e9}
            attempt.end("done")
        return step

    async def play(self, dt_ns: int | None = None, rate: float = 1.0) -> TimeStatus:
        """Start playing. Return the state of time.

        Args:
            dt_ns: Length of each step, in ns; None for the step size.
            rate: Speed, as a multiple of real time.

        Raises:
            TimeError: Another program controls time.
            ValueRangeError: ``dt_ns`` is out of range.

        """
        with _attempt("play", dt_ns, rate=rate) as attempt:
            status = await self._do(self._begin_play(dt_ns, rate))
            attempt.end("done")
        return status

    async def pause(self, *, end: bool = False) -> TimeStatus:
        """Stop playing. Return the state of time.

        Args:
            end: Whether the status reports ``alive = False`` until the next step.

        Raises:
            TimeError: Another program controls time.

        """
        with _attempt("pause", None) as attempt:
            status = await self._do(self._end_play(end))
            attempt.end("done")
        return status

    async def release(self) -> TimeStatus:
        """Return to real time. Return the state of time.

        Raises:
            TimeError: Another program controls time, or the instance has no real time.

        """
        with _attempt("release", None) as attempt:
            status = await self._do(self._end_virtual())
            attempt.end("done")
        return status

    async def while_still(self, work: Callable[[Coordinator], _Result]) -> _Result:
        """Call ``work`` in a thread, while this process controls time and makes no step. Return its result.

        Raises:
            TimeError: Time is real or is playing, or another program controls it.

        """
        return await self._do(self._while_still(work))

    async def stop(self) -> None:
        """Stop moving time. If this process was playing, the next process of this endpoint resumes playing."""
        if self._rest is not None:
            self._rest.cancel()
        self._driver.stop()
        self.timeline.stop()
        tasks = list(self._tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(self._player.break_off(), *tasks, return_exceptions=True)
        async with self._lock:  # the steps in progress have ended
            if not self._player.on:
                self._coordinator.close()

    # ---- moving time ---------------------------------------------------------------------------------------------

    async def _do(self, work: Coroutine[Any, Any, _Result]) -> _Result:
        return await asyncio.shield(self._spawn(work))  # runs to its end, even if the caller is cancelled

    def _spawn(self, work: Coroutine[Any, Any, _Result]) -> asyncio.Task[_Result]:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _make(self, dt_ns: int | None) -> Step:
        """Make a step and deliver it."""

        async def make() -> Step:
            step = await self._driver.step(dt_ns)
            await self.timeline.deliver(step)
            return step

        return await self._steer(make)

    async def _change(self, call: Callable[[], None], *, end: bool = False) -> None:
        """Take control of time, and call a method of the coordinator that changes how time moves."""

        async def change() -> None:
            call()
            self.timeline.ended = end

        await self._steer(change)

    async def _steer(self, work: Callable[[], Awaitable[_Result]]) -> _Result:
        """Take control of time, and do ``work``. Until it ends, no other client of this endpoint can move time."""
        async with self._lock:
            try:
                if self._segment.outdated:
                    await asyncio.to_thread(self._segment.refresh)
                if not self._owns:
                    self.timeline.update()  # another program may just have returned to real time
                    self._coordinator.take_over()
                    self._own(True)
                    self.timeline.update()
                await self.timeline.delivered()
                self.timeline.steered = True
                return await work()
            finally:
                self.timeline.end_steering()
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
        if self._loop.time() < self._rest_s:  # time was moved in between
            self._rest = self._loop.call_at(self._rest_s, self._give_up)
        elif self._owns and not self._player.on and not self._lock.locked():
            self._spawn(self._release())

    async def _release(self) -> None:
        async with self._lock:
            await self.timeline.delivered()  # streams would send the values of the next step with this one
            if not self._player.on:
                self._own(False)
                self._coordinator.close()

    async def _while_still(self, work: Callable[[Coordinator], _Result]) -> _Result:
        if self._player.on:
            raise TimeError("time is playing; pause it first")
        check_virtual(self._segment.clock.read())
        return await self._steer(partial(asyncio.to_thread, work, self._coordinator))

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
            async with self._lock:
                self.timeline.update()
                await self.timeline.delivered()
                self._coordinator.release()
                self._own(False)
                self.timeline.ended = False
            return self.timeline.status

    async def _end_play(self, end: bool) -> TimeStatus:
        async with self._changing:
            await self._player.end()
            await self._change(partial(self._coordinator.set_playing, False), end=end)
        return self.timeline.status


def _attempt(action: str, dt_ns: int | None, **more: float) -> Attempt:
    return Attempt(action, ({} if dt_ns is None else {"dt_s": dt_ns / 1e9}) | more)


def _check(dt_ns: int | None) -> None:
    """Raise ValueRangeError if a step is out of range. Call this before taking control of time."""
    if dt_ns is not None:
        check_step(dt_ns)
