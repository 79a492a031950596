"""Injections of a local program: shadows, to which the program gives values, and declared injections."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import msgspec

from shmio.config import Declaration
from shmio.config.declaration import check_declarations
from shmio.errors import CommandError, ConfigError, DeclarationError, PathError, ValueRangeError
from shmio.layout.model import Register
from shmio.layout.overlay import names_in
from shmio.layout.topic import Topic, parse_topic
from shmio.layout.values.codec import Value
from shmio.layout.values.write import cover, merge
from shmio.local.subscription import Following
from shmio.local.writer import PendingCommand, SourceWriter
from shmio.model.injection import Declared, InjectionEvent
from shmio.model.values import Outcome
from shmio.segment.block import Block, Cursor, Layouts
from shmio.segment.commands import CommandAssembler, CommandWrites, Direction, apply, decode_writes
from shmio.segment.events import Event, EventKind
from shmio.segment.segment import Segment

if TYPE_CHECKING:
    from shmio.injection import Program


_EVENTS: Final = frozenset({EventKind.INJECTED, EventKind.ACTIVATED, EventKind.DEACTIVATED, EventKind.LIFTED})

Next = Callable[[Cursor[Event], float | None], Event | None]
"""Function that waits for a cursor's next event, at most for the given time in s.

It returns None if no event came in time, or if no further event can come. It raises NotRunningError
if the instance has stopped.
"""


class ObservedWrite(msgspec.Struct, frozen=True):
    """The values that one command wrote to a source, or those of them that an injection took.

    Attributes:
        values: Values by path within the block. If only a part of an array or integer was written,
            the paths are those of the written elements or bits.
        writer: Number of the command queue, as in events.
        command: Number that the writer gave the command, as in events.
        clock_ns: Time of the instance's clock, in ns.
        utc_ns: UTC time, in ns.
        missed: Number of events lost since the previous command. Some of them may have been about
            writes, which are then missing here.
    """

    values: Mapping[str, Value]
    writer: int
    command: int
    clock_ns: int
    utc_ns: int
    missed: int


class Shadow:
    """An injection over registers of one source, to which this program gives values.

    Until the program gives values, a shadow over ``/out`` changes nothing for consumers. A shadow
    over ``/in`` takes all writes to its registers from the start, so the device gets none of them.
    Leaving the ``with`` block lifts the shadow, unless it was created with ``keep``.
    """

    def __init__(
        self,
        source_writer: SourceWriter,
        number: int,
        direction: Direction,
        events: Cursor[Event],
        next_event: Next,
        *,
        keep: bool,
        names: Sequence[Register] = (),
        running: Callable[[], bool] = lambda: True,
    ) -> None:
        """Wrap an existing injection.

        Args:
            source_writer: The writing side of its source.
            number: Number of the injection.
            direction: Direction that it covers.
            events: A cursor that was created before the injection.
            next_event: Waits for the cursor's next event.
            keep: Whether the injection stays when it is closed.
            names: The registers of tag tables over the block whose names the program gave.
            running: Returns whether the instance still runs.
        """
        self.source = source_writer.block.source
        self.number = number
        """Number of the injection.

        Any program may use it to lift the injection or to give values to it.
        """
        self.direction = direction
        self._source_writer = source_writer
        self._events = events
        self._gathered = CommandAssembler()
        self._image = bytearray(source_writer.block.layout.size)  # all writes diverted so far
        self._next_event = next_event
        self._keep = keep
        self._names = names
        self._running = running

    def set(self, values: Mapping[str, object], timeout_s: float | None = None) -> list[Outcome]:
        """Give values: to consumers if the shadow is over ``/out``, to the device if it is over ``/in``.

        Args:
            values: Values by path, with or without the source.
            timeout_s: Time in s that the values may wait for a cycle of the source; None: 2 s, or
                three cycles if that is longer.

        Returns:
            The outcome of each value, with the path that you gave. SHADOWED: consumers see the
            value. REJECTED: the shadow does not cover the path, or was lifted. For a shadow over
            ``/in``, the outcomes are those of a write to the device.

        Raises:
            PathError: A path names no register.
            ValueRangeError: A value does not fit its register, or a register is given twice.
            CommandError: The source's queue has no room.
                After any of these errors, nothing has been sent.
        """
        paths = by_path([parse_topic(path, (self.source,), self.source) for path in values], values)
        return as_given(values, self._source_writer.shadow(self.number, paths, timeout_s))

    def diverted(self, timeout_s: float | None = None) -> Iterator[ObservedWrite]:
        """Iterate over the commands whose values this shadow has taken since its creation.

        A shadow over ``/in`` takes the writes of other programs. A shadow over ``/out`` takes the
        values of inner shadows. (It also covers the values that the source delivers, but these are
        in the frames.) If there are two iterators, each command goes to only one of them. The
        iterator ends when the shadow is lifted.

        Args:
            timeout_s: The iterator also ends after this time in s without such a command; None: it
                waits forever.

        Raises:
            NotRunningError: The instance has stopped.
        """
        until_s = _deadline(timeout_s)
        while (event := self._next_event(self._events, _rest(until_s))) is not None:
            for diverted in self._gathered.follow(event):
                if diverted.injection == self.number:
                    yield self._observed(diverted)
                    until_s = _deadline(timeout_s)
            if event.kind == EventKind.LIFTED and event.injection == self.number:
                return

    def _observed(self, diverted: CommandWrites) -> ObservedWrite:
        apply(self._image, diverted.writes)
        event = diverted.event
        layout = self._source_writer.block.layout
        written = decode_writes(layout, bytes(self._image), diverted.writes, self._names)
        return ObservedWrite(
            written, event.writer, event.command, event.clock_ns, event.utc_ns, self._events.take_missed()
        )

    def lift(self) -> None:
        """Lift the shadow.

        Consumers, or the device, then get the values that they would get without the shadow.

        Raises:
            CommandError: The shadow was lifted already, or the source does not answer.
        """
        self._source_writer.lift(self.number)

    def close(self) -> None:
        """Lift the shadow, unless it was created with ``keep``, or has ended.

        Raises:
            CommandError: The source does not answer.
        """
        if not self._keep and self._running():
            lift_all([(self._source_writer, self.number)])

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def written(
    block: Block, patterns: Iterable[str], events: Cursor[Event], next_event: Next, timeout_s: float | None
) -> Iterator[ObservedWrite]:
    """Iterate over the accepted commands that write to registers, each when its outcome is known.

    Args:
        block: The source's block.
        patterns: Patterns of registers.
        events: A cursor of the block's events.
        next_event: Waits for the cursor's next event.
        timeout_s: The iterator ends after this time in s without a command; None: it waits forever.

    Raises:
        PathError: The patterns name no register.
        NotRunningError: The instance has stopped.
    """
    chosen = list(patterns)
    bits = cover(block.layout, chosen)
    if not any(bits):
        raise PathError(f"{block.source}: no register matches {', '.join(chosen)}")
    return _written(block, bits, names_in(block.layout, chosen), events, next_event, timeout_s)


def _written(
    block: Block,
    bits: bytes,
    names: Sequence[Register],
    events: Cursor[Event],
    next_event: Next,
    timeout_s: float | None,
) -> Iterator[ObservedWrite]:
    layout, gatherer = block.layout, CommandAssembler(EventKind.ACCEPTED)
    last = block.latest()
    image = bytearray(layout.size if last is None else last.image)
    until_s = _deadline(timeout_s)
    while (event := next_event(events, _rest(until_s))) is not None:
        for accepted in gatherer.follow(event):
            mask = bytearray(layout.size)
            apply(mask, (write._replace(data=b"\xff" * len(write.data)) for write in accepted.writes))
            apply(image, accepted.writes)
            mask = bytearray(a & b for a, b in zip(mask, bits, strict=True))
            if any(mask):
                found = decode_writes(layout, bytes(image), merge(image, mask, [(0, layout.size)]), names)
                event, missed = accepted.event, events.take_missed()
                yield ObservedWrite(found, event.writer, event.command, event.clock_ns, event.utc_ns, missed)
                until_s = _deadline(timeout_s)


class _Created(NamedTuple):
    """A declared injection that this program has created."""

    source_writer: SourceWriter
    number: int
    program: Program

    def lift(self) -> None:
        """Lift the injection.

        Raises:
            CommandError: The injection is over or was lifted already, or the source does not answer.
        """
        self.source_writer.lift(self.number)


def compile_declarations(
    declarations: Sequence[Declaration], blocks: Mapping[str, Block], wanted: Callable[[], bool] = lambda: True
) -> list[Program]:
    """Compile declarations for this instance.

    Args:
        declarations: The declarations.
        blocks: The instance's blocks, by source.
        wanted: Called before each declaration, because compiling many declarations over a large
            layout takes seconds. If it returns False, the compilation is cancelled.

    Raises:
        ConfigError: A declaration is wrong; the message starts as ``injection[0].target: …``.
        CommandError: ``wanted`` returned False.
    """
    from shmio.injection import compile_program  # noqa: PLC0415 - loads numpy, which nothing else here needs

    check_declarations(declarations)
    layouts = Layouts(blocks)
    periods_ns = {source: block.period_ns for source, block in blocks.items()}
    programs = []
    for index, declaration in enumerate(declarations):
        if not wanted():
            raise CommandError("the compilation was cancelled, because the program that requested it no longer waits")
        try:
            programs.append(compile_program(declaration, layouts, periods_ns))
        except ConfigError as error:
            raise ConfigError(f'injection[{index}].{error} (injection "{declaration.name}")') from None
    return programs


def _create(
    declarations: Sequence[Declaration],
    blocks: Mapping[str, Block],
    source_writer: Callable[[Block], SourceWriter],
    *,
    keep: bool,
) -> list[_Created]:
    """Create all declared injections, or none of them.

    Raises:
        ConfigError: A declaration is wrong.
        CommandError: A source refuses an injection, or does not answer.
    """
    created: list[_Created] = []
    try:
        for program in compile_declarations(declarations, blocks):
            sender = source_writer(blocks[program.source])
            try:
                number = sender.declare(program.declaration, keep=keep)
            except CommandError as error:
                raise CommandError(f'{error} (injection "{program.declaration.name}")') from None
            created.append(_Created(sender, number, program))
    except BaseException:
        for one in created:
            one.lift()
        raise
    return created


def _read(declarations: Iterable[Mapping[str, Any] | Declaration]) -> list[Declaration]:
    """Read declarations from tables, and give a random seed to each declaration that has none.

    Raises:
        DeclarationError: A declaration is wrong.
    """
    tables = [one if isinstance(one, Mapping) else msgspec.to_builtins(one) for one in declarations]
    try:
        from shmio.config.campaign import parse_campaign  # noqa: PLC0415  few programs need it

        read = parse_campaign({"injection": tables}) if tables else []
    except ConfigError as error:
        raise DeclarationError(str(error)) from None
    import secrets  # noqa: PLC0415  programs that only read need no random numbers, and it loads OpenSSL

    # 53 bits: every JSON reader represents such a number exactly.
    return [msgspec.structs.replace(one, seed=secrets.randbits(53)) if one.seed is None else one for one in read]


class Campaign(Following[InjectionEvent]):
    """Declared injections that this program has created.

    Iterate over the campaign to get the events of its injections. The iteration ends when all
    injections are lifted, and leaves out events that were overwritten before the program read them.
    Leaving the ``with`` block lifts the remaining injections, unless they were created with
    ``keep``.
    """

    def __init__(
        self,
        segment: Segment,
        declarations: Iterable[Mapping[str, Any] | Declaration],
        blocks: Mapping[str, Block],
        source_writer: Callable[[Block], SourceWriter],
        *,
        keep: bool,
    ) -> None:
        """Create all the injections, or none.

        Args:
            segment: The instance's segment.
            declarations: The injections to create.
            blocks: The instance's blocks, by source.
            source_writer: Returns the writer that sends commands to a block.
            keep: Whether the injections stay when this program ends.

        Raises:
            DeclarationError: A declaration is wrong.
            CommandError: A source refuses an injection, or does not answer.
        """
        super().__init__(segment)
        self._keep = keep
        events = {source: block.events.cursor() for source, block in blocks.items()}
        try:
            created = _create(_read(declarations), blocks, source_writer, keep=keep)
        except ConfigError as error:
            raise DeclarationError(str(error)) from None
        self.declared = tuple(
            Declared(one.program.source, one.number, one.program.declaration.name, one.program.declaration.seed or 0)
            for one in created
        )
        """The injections, in the order of the declarations."""
        self._left = {(one.program.source, one.number): one for one in created}
        sources = dict.fromkeys(one.program.source for one in created)
        self._cursors = {source: (blocks[source], events[source]) for source in sources}
        for source in sources:
            self._follow(blocks[source])

    def _take(self) -> InjectionEvent | None:
        for source, (block, cursor) in self._cursors.items():
            retired = block.retired  # before reading
            while (event := cursor.poll()) is not None:
                if event.kind in _EVENTS and event.offset == 0 and (source, event.injection) in self._left:
                    return self._injection_event(source, event)  # the first part, if the event has several
            if cursor.take_missed():  # a lost event may have said that an injection was lifted
                present = {one.number for one in block.injections.read() if not one.lifted}
                self._left = {key: one for key, one in self._left.items() if key[0] != source or key[1] in present}
            if retired:
                self._left = {key: one for key, one in self._left.items() if key[0] != source}
        if not self._left:
            raise StopIteration
        return None

    def _injection_event(self, source: str, event: Event) -> InjectionEvent:
        lifted = event.kind == EventKind.LIFTED
        if lifted:
            del self._left[source, event.injection]
        run = event.item if event.kind in (EventKind.ACTIVATED, EventKind.DEACTIVATED) else 0
        return InjectionEvent(
            source, event.injection, str(EventKind(event.kind)), event.clock_ns, event.utc_ns, event.frame,
            event.cycle, run, event.text if lifted else "",
        )  # fmt: skip

    def close(self) -> None:
        """Lift the remaining injections, unless they were created with ``keep``."""
        super().close()
        if not self._keep and self._segment.shared.current():
            with suppress(CommandError):  # the source does not answer
                lift_all((one.source_writer, one.number) for one in self._left.values())
        self._left.clear()


def lift_all(injections: Iterable[tuple[SourceWriter, int]]) -> None:
    """Lift injections, given by writer and number. Ignore those that were lifted before.

    Raises:
        CommandError: Some injections could not be lifted. The message gives the reasons.
    """
    asked: list[tuple[SourceWriter, PendingCommand]] = []
    chosen, reasons = _present(injections), dict[str, None]()
    for source_writer, number in chosen:
        try:
            asked.append((source_writer, source_writer.ask_to_lift(number)))
        except CommandError as error:
            reasons[str(error)] = None
    for source_writer, ticket in asked:
        try:
            source_writer.expect_lifted(ticket)
        except CommandError as error:
            reasons[str(error)] = None
    left = len(_present(chosen))
    if left:
        raise CommandError(f"{left} of {len(chosen)} injections were not lifted: {'; '.join(reasons)}")


def _present(injections: Iterable[tuple[SourceWriter, int]]) -> list[tuple[SourceWriter, int]]:
    """Return the injections that exist and are not lifted."""
    numbers: dict[int, set[int]] = {}  # by section of the block, whose list is read once
    found = []
    for source_writer, number in injections:
        block = source_writer.block
        if block.section not in numbers:
            entries = () if block.retired else block.injections.read()  # an injection ends with its block
            numbers[block.section] = {one.number for one in entries if not one.lifted}
        if number in numbers[block.section]:
            found.append((source_writer, number))
    return found


def by_path(topics: Iterable[Topic], values: Mapping[str, object]) -> dict[str, object]:
    """Return the same values by the canonical paths of their topics, instead of the caller's paths.

    Args:
        topics: The topic of each value, in the order of ``values``.
        values: Values by path, as the caller gave it.

    Raises:
        ValueRangeError: Two topics have the same path.
    """
    found: dict[str, object] = {}
    for topic, (path, value) in zip(topics, values.items(), strict=True):
        if topic.path in found:
            raise ValueRangeError(f"{path}: this path is given twice")
        found[topic.path] = value
    return found


def as_given(paths: Iterable[str], outcomes: Iterable[Outcome]) -> list[Outcome]:
    """Return the outcomes with the paths ``paths``, which the caller gave, instead of canonical paths."""
    return [msgspec.structs.replace(outcome, path=path) for path, outcome in zip(paths, outcomes, strict=True)]


def _deadline(timeout_s: float | None) -> float | None:
    return None if timeout_s is None else time.monotonic() + timeout_s


def _rest(until_s: float | None) -> float | None:
    return None if until_s is None else until_s - time.monotonic()
