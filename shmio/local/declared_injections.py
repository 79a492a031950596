"""Lay declared injections: check them all, send each to its source, and follow their events."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import msgspec

from shmio.config import Declaration
from shmio.config.campaign import parse_campaign
from shmio.config.declaration import check_declarations
from shmio.errors import CommandError, ConfigError, DeclarationError
from shmio.local.following import Following
from shmio.local.writer import SourceWriter
from shmio.model.injection import Declared, Happening
from shmio.segment.block import Block
from shmio.segment.events import Event, EventKind

if TYPE_CHECKING:
    from shmio.injection import Program

SEED_BITS: Final = 53
_EVENTS: Final = frozenset({EventKind.INJECTED, EventKind.ACTIVATED, EventKind.DEACTIVATED, EventKind.LIFTED})


class DeclaredInjection(NamedTuple):
    """A declared injection that this program has laid."""

    source_writer: SourceWriter
    number: int
    """Number of the injection; anybody may lift the injection by it."""
    program: Program

    def lift(self) -> None:
        """Lift the injection.

        Raises:
            CommandError: It is over, was lifted already, or the source does not answer.
        """
        self.source_writer.lift(self.number)


def check(
    declarations: Sequence[Declaration], blocks: Mapping[str, Block], wanted: Callable[[], bool] = lambda: True
) -> list[Program]:
    """Compile declarations for this instance.

    Args:
        declarations: What to compile.
        blocks: The instance's blocks, by source.
        wanted: Called before each declaration; compilation stops when it returns False. Many
            declarations over a large layout take seconds.

    Raises:
        ConfigError: The first fault, such as ``injection[0].target: …``.
        CommandError: ``wanted`` returned False.
    """
    from shmio.injection import compile_program  # noqa: PLC0415 - loads numpy, which nothing else here needs

    check_declarations(declarations)
    layouts = {source: block.layout for source, block in blocks.items()}
    periods_ns = {source: block.period_ns for source, block in blocks.items()}
    programs = []
    for index, declaration in enumerate(declarations):
        if not wanted():
            raise CommandError("its program no longer waits for it")
        try:
            programs.append(compile_program(declaration, layouts, periods_ns))
        except ConfigError as error:
            raise ConfigError(f'injection[{index}].{error} (injection "{declaration.name}")') from None
    return programs


def declare(
    declarations: Sequence[Declaration],
    blocks: Mapping[str, Block],
    source_writer: Callable[[Block], SourceWriter],
    *,
    keep: bool = False,
) -> list[DeclaredInjection]:
    """Lay all declared injections, or none of them.

    Args:
        declarations: What to lay.
        blocks: The instance's blocks, by source.
        source_writer: Gives the writer that sends commands to a block.
        keep: Whether the injections stay when this process ends.

    Returns:
        One object for each declaration, in the same order.

    Raises:
        ConfigError: A declaration is wrong.
        CommandError: A source refuses one, or does not answer.
    """
    laid: list[DeclaredInjection] = []
    try:
        for program in check(declarations, blocks):
            sender = source_writer(blocks[program.source])
            try:
                number = sender.declare(program.declaration, keep=keep)
            except CommandError as error:
                raise CommandError(f'{error} (injection "{program.declaration.name}")') from None
            laid.append(DeclaredInjection(sender, number, program))
    except BaseException:
        for one in laid:
            one.lift()
        raise
    return laid


def read_declarations(declarations: Iterable[Mapping[str, Any] | Declaration]) -> list[Declaration]:
    """Read declarations from tables, and draw a seed for each that has none. DeclarationError: one is wrong."""
    tables = [one if isinstance(one, Mapping) else msgspec.to_builtins(one) for one in declarations]
    try:
        read = parse_campaign({"injection": tables}) if tables else []
    except ConfigError as error:
        raise DeclarationError(str(error)) from None
    return [msgspec.structs.replace(one, seed=secrets.randbits(SEED_BITS)) if one.seed is None else one for one in read]


class Campaign(Following[Happening]):
    """Declared injections that this program has laid.

    Iterate over it for their events: the iteration ends when all of them are lifted. Events that were
    overwritten before they could be read are left out. Leaving the ``with`` block lifts the rest,
    unless they were laid with ``keep``.
    """

    def __init__(
        self,
        declarations: Iterable[Mapping[str, Any] | Declaration],
        blocks: Mapping[str, Block],
        source_writer: Callable[[Block], SourceWriter],
        check_running: Callable[[], None],
        *,
        keep: bool,
    ) -> None:
        """Lay all of them, or none.

        Args:
            declarations: What to lay.
            blocks: The instance's blocks, by source.
            source_writer: Gives the writer that sends commands to a block.
            check_running: Raises NotRunningError when the instance has stopped.
            keep: Whether the injections stay when this program ends.

        Raises:
            DeclarationError: A declaration is wrong.
            CommandError: A source refuses one, or does not answer.
        """
        super().__init__(check_running)
        self._keep = keep
        events = {source: block.events.cursor() for source, block in blocks.items()}
        try:
            laid = declare(read_declarations(declarations), blocks, source_writer, keep=keep)
        except ConfigError as error:
            raise DeclarationError(str(error)) from None
        self.declared = tuple(
            Declared(one.program.source, one.number, one.program.declaration.name, one.program.declaration.seed or 0)
            for one in laid
        )
        """The injections, in the order of the declarations."""
        self._left = {(one.program.source, one.number): one for one in laid}
        sources = dict.fromkeys(one.program.source for one in laid)
        self._cursors = {source: (blocks[source], events[source]) for source in sources}
        for source in sources:
            self._follow(blocks[source])

    def _take(self) -> Happening | None:
        for source, (block, cursor) in self._cursors.items():
            retired = block.retired  # before looking
            while (event := cursor.poll()) is not None:
                if event.kind in _EVENTS and event.offset == 0 and (source, event.injection) in self._left:
                    return self._happening(source, event)  # of an event in parts it is the first
            if cursor.take_missed():  # perhaps that some were lifted
                present = {one.number for one in block.standing.read() if not one.lifted}
                self._left = {key: one for key, one in self._left.items() if key[0] != source or key[1] in present}
            if retired:
                self._left = {key: one for key, one in self._left.items() if key[0] != source}
        if not self._left:
            raise StopIteration
        return None

    def _happening(self, source: str, event: Event) -> Happening:
        lifted = event.kind == EventKind.LIFTED
        if lifted:
            del self._left[source, event.injection]
        run = event.item if event.kind in (EventKind.ACTIVATED, EventKind.DEACTIVATED) else 0
        return Happening(
            source, event.injection, str(EventKind(event.kind)), event.clock_ns, event.utc_ns, event.frame,
            event.cycle, run, event.text if lifted else "",
        )  # fmt: skip

    def close(self) -> None:
        """Lift the injections that still stand, unless they are to be kept."""
        self.end()
        for one in () if self._keep else self._left.values():
            with suppress(CommandError):  # it was over, or somebody else has lifted it
                one.lift()
        self._left.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
