"""Lay declared injections: check them all, then send each to its source."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from shmio.config import Declaration
from shmio.config.declaration import check_declarations
from shmio.errors import CommandError, ConfigError
from shmio.injection import Program, compile_program
from shmio.local.writer import SourceWriter
from shmio.segment.block import Block


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
    check_declarations(declarations)
    layouts = {source: block.layout for source, block in blocks.items()}
    periods_ns = {source: block.period_ns for source, block in blocks.items()}
    programs = []
    for index, declaration in enumerate(declarations):
        if not wanted():
            raise CommandError("whoever declared it does not wait for it any more")
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
