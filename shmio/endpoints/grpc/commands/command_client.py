"""Sends commands to one block's source, and reports their outcomes.

Use it only in the event loop's thread.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Collection, Generator, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Final, Unpack

import msgspec

from shmio.audit.trail import MAX_NAMED, Actor, Attempt, acting, values_of
from shmio.config import Declaration
from shmio.endpoints.commands_in_flight import MAX_OPEN, CommandCost, Done, InFlightTable
from shmio.endpoints.grpc.commands.injections import InjectionFollower, InjectionFollowers
from shmio.endpoints.grpc.commands.write_subscriptions import WriteSubscriptions
from shmio.endpoints.grpc.wakeups import BatchReader, WakeUps
from shmio.errors import CommandError
from shmio.layout.model import Register
from shmio.layout.topic import find
from shmio.layout.values.write import Write, merge, paths_of, sizes
from shmio.local.writer import RETIRED, PendingCommand, SourceWriter
from shmio.segment import Block, Event, EventKind
from shmio.segment.commands import Direction, End, InjectionOptions

RETRY_S: Final = 0.25
"""Pause in s before asking a source again to lift an injection."""

BATCH_EVENTS: Final = 32
"""Maximum number of events that are processed before the event loop serves the streams again."""

log = logging.getLogger("shmio.grpc")


class CommandClient:
    """Sends commands to a block's source in order, and reports their outcomes.

    It waits while the commands in flight might cause more events than the event ring can buffer.
    Use it only in the event loop's thread.
    """

    def __init__(
        self,
        block: Block,
        writer: int,
        wake_ups: WakeUps,
        stamp: Callable[[Event], tuple[int, int]],
    ) -> None:
        """Create a client; :meth:`start` starts it.

        Args:
            block: The block whose source gets the commands.
            writer: Number of this process's command queue.
            wake_ups: Wakes this client when the block has new events.
            stamp: Returns an event's number and time; see :class:`WriteSubscriptions`.

        """
        self.block = block
        self.stamp = stamp
        self.write_subscriptions = WriteSubscriptions(block, stamp)
        self.followers = InjectionFollowers()
        self._loop = asyncio.get_running_loop()
        self._source_writer = SourceWriter(block, writer)
        self._prepared = False
        self._preparing = asyncio.Lock()
        self._in_flight = InFlightTable(writer)
        self._silent = False
        self._lock = asyncio.Lock()  # serves callers in order while they wait for room
        self._freed: asyncio.Future[None] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._events = block.events.cursor()
        self._reader = BatchReader(block, wake_ups, self._read, patient=True)

    @property
    def alive(self) -> bool:
        """True while the client follows the block's events, and also once a reload has retired the block."""
        return self._reader.alive or self.block.retired

    @property
    def over(self) -> bool:
        """True if the client has stopped, and has no commands in flight, no subscribers and no listeners."""
        return not (
            self._reader.alive
            or self._in_flight
            or self._lock.locked()
            or self.write_subscriptions.busy
            or self.followers.busy
        )

    @property
    def idle(self) -> bool:
        """True if nobody waits for an event: there are no commands in flight, subscribers or followers."""
        return not self._in_flight and not self.write_subscriptions.busy and self.followers.idle

    def start(self) -> None:
        """Start following the block's events."""
        self._reader.start()

    def stop(self) -> None:
        """Stop following the block's events."""
        self._reader.stop()
        if self._timer is not None:
            self._timer.cancel()

    def catch_up(self) -> None:
        """Process all events published so far, and deliver the writes among them to subscribers."""
        newest = self.block.events.head()
        while self._reader.alive and self._events.last < newest:
            self._reader.read()

    def ready(self, values: Mapping[str, object]) -> bool:
        """Return whether :meth:`send` or :meth:`give` would send these values without waiting."""
        return self._prepared and not self._lock.locked() and self._has_room(self._cost(values))

    async def writable(self, registers: Iterable[Register]) -> bool:
        """Return whether the configuration allows writing all of these registers."""
        await self._prepare()
        return all(map(self._source_writer.is_writable, registers))

    async def send(
        self,
        values: Mapping[str, object],
        done: Done,
        accepted: Callable[[], None] | None = None,
        *,
        timeout_s: float | None = None,
        until_accepted: bool = False,
    ) -> None:
        """Send values of registers as one command. Wait first until there is room for it.

        If this fails, nothing was sent, and neither ``done`` nor ``accepted`` is called.

        Args:
            values: Values by register path.
            done: Called once within a bounded time, with the outcome of each value.
            accepted: Called before ``done``, if the source accepts the command; None to call
                nothing.
            timeout_s: How long to wait for the outcomes, in s; None for the default.
            until_accepted: Whether the acceptance by the source is already the outcome.

        Raises:
            CommandError: A register is not writable, or the source does not answer.
            ValueRangeError: A value does not fit its register.

        """
        submit = partial(self._source_writer.submit, values, timeout_s)
        with Attempt("write", values_of(self.block.source, values)) as attempt:
            await self._send(submit, self._cost(values), done, accepted, attempt, until_accepted=until_accepted)

    async def give(
        self,
        injection: int,
        values: Mapping[str, object],
        done: Done,
        accepted: Callable[[], None] | None = None,
        *,
        raw: Sequence[Write] = (),
    ) -> None:
        """Give values to an injection of this process. Wait first until there is room for the command.

        If this fails, nothing was sent, and neither ``done`` nor ``accepted`` is called.

        Args:
            injection: Number of the injection.
            values: Values by register path.
            done: Called once, with the outcome of each write. A write may contain several values.
            accepted: Called before ``done``, if the injection is over ``/in`` and the source
                accepts the command; None to call nothing.
            raw: Writes of raw bytes to give in addition to the values.

        Raises:
            CommandError: The source does not answer.
            ValueRangeError: A value does not fit its register.

        """
        with Attempt("feed", values_of(self.block.source, values)) as attempt:
            writes = self._source_writer.joined(values, raw)
            cost = CommandCost.of([len(write.data) for write in writes])
            await self._send(partial(self._source_writer.give, injection, writes), cost, done, accepted, attempt)

    def inject(self, bits: bytes, follower: InjectionFollower, done: Done, **options: Unpack[InjectionOptions]) -> int:
        """Ask the source to create an injection, without waiting for the outcome.

        Args:
            bits: An image-sized mask in which the bits that the injection covers are set.
            follower: Receives the injection's events.
            done: Called once, with the outcome.
            options: Options of the injection, such as its name and priority.

        Returns:
            The injection's number.

        Raises:
            CommandError: The command was not sent.

        """
        writes = merge(bits, bits, [(0, len(bits))])
        cost = CommandCost.of([len(write.data) for write in writes], options.get("name", ""))
        with Attempt("inject", partial(_described, self.block, writes, options)) as attempt:
            return self._create(self._source_writer.ask_to_inject(writes, **options), cost, follower, done, attempt)

    def declare(self, declaration: Declaration, follower: InjectionFollower, done: Done, *, keep: bool) -> int:
        """Ask the source to create a declared injection, without waiting for the outcome.

        Args:
            declaration: The injection, which the source runs itself.
            follower: Receives the injection's events.
            done: Called once, with the outcome.
            keep: Whether the injection continues after this process has ended.

        Returns:
            The injection's number.

        Raises:
            CommandError: The command was not sent.

        """
        cost = CommandCost.of([len(msgspec.json.encode(declaration))], declaration.name)
        what = {"source": self.block.source, **msgspec.to_builtins(declaration), "keep": keep}
        with Attempt("declare", what) as attempt:
            ticket = self._source_writer.ask_to_declare(declaration, keep=keep)
            return self._create(ticket, cost, follower, done, attempt)

    def _create(
        self, ticket: PendingCommand, cost: CommandCost, follower: InjectionFollower, done: Done, attempt: Attempt
    ) -> int:
        self._in_flight.add(ticket, cost, done, attempt=attempt)
        self._start_timer()
        self.followers.add(ticket.number, follower)
        return ticket.number

    def lift(self, injection: int, done: Done) -> None:
        """Ask the source to lift an injection, without waiting for the outcome.

        Args:
            injection: Number of the injection.
            done: Called once, with the outcome.

        Raises:
            CommandError: The command was not sent.

        """
        with Attempt("lift", {"source": self.block.source, "injection": injection}) as attempt:
            self._in_flight.add(self._source_writer.ask_to_lift(injection), CommandCost.of(()), done, attempt=attempt)
        self._start_timer()

    async def _send(
        self,
        submit: Callable[[], PendingCommand],
        cost: CommandCost,
        done: Done,
        accepted: Callable[[], None] | None,
        attempt: Attempt,
        *,
        until_accepted: bool = False,
    ) -> None:
        async with self._lock:
            await self._prepare()
            while not self._has_room(cost):
                self._freed = self._loop.create_future()
                await self._freed
            if self.block.retired:
                raise CommandError(RETIRED)
            if self._silent and self._in_flight:  # one command at a time probes the source
                raise CommandError(
                    f"source {self.block.source} does not answer; shmio-supervisor status shows its state"
                )
            self._in_flight.add(submit(), cost, done, accepted, attempt=attempt, until_accepted=until_accepted)
            self._start_timer()

    async def _prepare(self) -> None:
        if not self._prepared:
            async with self._preparing:  # in a thread: a large layout takes seconds
                await asyncio.to_thread(self._source_writer.prepare)
                self._prepared = True

    def _cost(self, values: Collection[str]) -> CommandCost:
        """Return the cost of a command with these values.

        Raises:
            PathError: There is no such register.

        """
        return CommandCost.of([size for path in values for size in sizes(find(self.block.layout, path))])

    def _has_room(self, cost: CommandCost) -> bool:
        pending = self._in_flight
        fits = pending.untaken_bytes + cost.record_bytes <= self.block.commands.capacity
        return self._silent or not pending or (fits and pending.open_events + cost.events <= MAX_OPEN)

    # ---- events of the source --------------------------------------------------------------------------------

    def _read(self) -> bool:
        events = self._events
        for count in range(BATCH_EVENTS):
            event = events.poll()
            if missed := events.take_missed():
                self._missed(missed)
            if event is not None:
                self._on_event(event)
                continue
            if count:
                self._free()
            if events.ended:
                self._reader.stop()
                self._retired()
            return False
        self._free()
        return True

    def _on_event(self, event: Event) -> None:
        for channel, message in self.write_subscriptions.follow(event):
            for listener in channel.listeners:
                listener.deliver(message)
        self.followers.follow(event)
        if self._in_flight.on_event(event):
            self._silent = False
            if event.kind == EventKind.STARTED:
                self._set_timer()

    def _missed(self, count: int) -> None:
        """Handle missed events, which may have contained outcomes of commands."""
        reason = f"{count} events of source {self.block.source} were missed"
        self.write_subscriptions.skip()
        self.followers.skip()
        self.write_subscriptions.fail(reason)
        self.followers.fail(reason)
        self._in_flight.shorten_timeouts()
        self._set_timer()

    def _retired(self) -> None:
        self._in_flight.end(RETIRED)
        self.followers.end(RETIRED)
        self._free()

    def _free(self) -> None:
        if self._freed is not None and not self._freed.done():
            self._freed.set_result(None)

    # ---- time-outs -----------------------------------------------------------------------------------------

    def _start_timer(self) -> None:
        self._reader.end_pause()  # the outcome of a command cannot wait
        if self._timer is None:
            self._set_timer()

    def _set_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        due_ns = self._in_flight.due_ns
        if due_ns is not None:
            self._timer = self._loop.call_later(max(0.0, (due_ns - time.monotonic_ns()) / 1e9), self._expire)

    def _expire(self) -> None:
        self._timer = None
        self._silent |= self._in_flight.expire()
        self._free()
        self._set_timer()


def _described(block: Block, writes: Sequence[Write], options: InjectionOptions) -> Mapping[str, Any]:
    """Describe an injection for the audit log."""
    paths = [f"{block.source}/{path}" for path in paths_of(block.layout, writes, MAX_NAMED)]
    return {
        "source": block.source,
        "paths": paths,
        "direction": options.get("direction", Direction.OUT).name.lower(),
        **{key: options[key] for key in ("priority", "keep", "name") if key in options},
    }


# ---- commands awaited ----------------------------------------------------------------------------------------------


class Answer:
    """The outcomes of a command, as an awaitable."""

    def __init__(self) -> None:
        self._ends: asyncio.Future[Sequence[End]] = asyncio.get_running_loop().create_future()

    def done(self, ends: Sequence[End]) -> None:
        """Set the outcomes. Pass this method as ``done`` to a method of :class:`CommandClient`."""
        if not self._ends.done():
            self._ends.set_result(ends)

    def __await__(self) -> Generator[Any, None, Sequence[End]]:
        return self._ends.__await__()


async def write(
    commands: CommandClient,
    values: Mapping[str, object],
    timeout_s: float | None = None,
    *,
    until_accepted: bool = False,
) -> Sequence[End]:
    """Write values by path as one command, and wait for the outcome of each.

    If this fails, nothing was sent.

    Args:
        commands: The client of the source.
        values: Values by register path.
        timeout_s: How long to wait for the outcomes, in s; None for the default.
        until_accepted: Whether the acceptance by the source is already the outcome.

    Raises:
        PathError: There is no such register.
        ValueRangeError: A value does not fit its register.
        CommandError: A register is not writable, or the source does not answer.

    """
    answer = Answer()
    await commands.send(values, answer.done, timeout_s=timeout_s, until_accepted=until_accepted)
    return await answer


async def give(
    commands: CommandClient, injection: int, values: Mapping[str, object], raw: Sequence[Write] = ()
) -> Sequence[End]:
    """Give values and raw bytes to an injection, and wait for the outcomes.

    Adjacent values and bytes are written together, and share one outcome.
    """
    answer = Answer()
    await commands.give(injection, values, answer.done, raw=raw)
    return await answer


async def inject(
    commands: CommandClient, bits: bytes, follower: InjectionFollower, **options: Unpack[InjectionOptions]
) -> int:
    """Create an injection, wait until the source has done so, and return its number.

    Raises:
        CommandError: The source refused the injection, or does not answer.

    """
    return await _created(commands, lambda done: commands.inject(bits, follower, done, **options))


async def declare(commands: CommandClient, declaration: Declaration, follower: InjectionFollower, *, keep: bool) -> int:
    """Create a declared injection, which the source runs itself.

    Args:
        commands: The client of the source.
        declaration: The injection.
        follower: Receives the injection's events.
        keep: Whether the injection continues after this process has ended.

    Returns:
        The injection's number.

    Raises:
        CommandError: The source refused the injection, or does not answer.

    """
    return await _created(commands, lambda done: commands.declare(declaration, follower, done, keep=keep))


async def _created(commands: CommandClient, send: Callable[[Done], int]) -> int:
    _check(commands)
    answer = Answer()
    number = send(answer.done)
    try:
        ((kind, reason),) = await answer
    except asyncio.CancelledError:
        commands.followers.remove(number)
        raise
    if kind is EventKind.INJECTED:
        return number
    commands.followers.remove(number)
    if kind is EventKind.UNKNOWN:  # the source may have created it
        await lift(commands, number)
    raise CommandError(f"{commands.block.source}: {reason}")


async def lift(commands: CommandClient, injection: int) -> str:
    """Lift an injection. Return the reason if that failed; else an empty text."""
    try:
        _check(commands)
        answer = Answer()
        commands.lift(injection, answer.done)
        ((_, reason),) = await answer
    except CommandError as error:
        reason = str(error)
    return (reason or "the source has not lifted the injection yet") if stands(commands, injection) else ""


async def have_lifted(commands: CommandClient, injection: int, name: str) -> None:
    """Lift an injection of this process, and retry until that has succeeded.

    The retries are necessary because no other process lifts the injection while this process lives.
    The injection's follower gets no more events.

    Args:
        commands: The client of the source.
        injection: Number of the injection.
        name: Name of the injection in log lines.

    """
    commands.followers.remove(injection)
    with acting(Actor("process", "grpc", "the client has ended its stream or its connection"), "grpc"):
        while stands(commands, injection) and (reason := await lift(commands, injection)):
            log.warning("%s: an injection is not lifted yet: %s", name, reason)
            await asyncio.sleep(RETRY_S)


def stands(commands: CommandClient, injection: int) -> bool:
    """Return whether an injection still exists on the client's source."""
    present = commands.block.injections.read()
    return not commands.block.retired and any(one.number == injection and not one.lifted for one in present)


def _check(commands: CommandClient) -> None:
    if commands.block.retired:
        raise CommandError(RETIRED)
