"""Compiles the layout files that a configuration names, and chooses a data block from each."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from shmio.config import Config, Emulator, Source
from shmio.errors import ConfigError, Diagnostic, LayoutError, ValueRangeError
from shmio.layout import compiler
from shmio.layout.encodings import ISO_8859_1, WINDOWS_1252, canonical, encoding_of_file
from shmio.layout.model import Layout, is_encoded
from shmio.layout.source.lexer import MAX_SOURCE_BYTES
from shmio.layout.values.literal import parse_literal
from shmio.wording import unknown

_QUOTED = re.compile(r"'[^']*'")


class LayoutFiles:
    """A cache that reads each set of files once, and compiles each of their data blocks once."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._programs: dict[tuple[tuple[Path, ...], str], compiler.Program] = {}
        self._compiled: dict[object, compiler.Compiled | LayoutError] = {}
        self.warnings: list[str] = []
        self.odd: list[str] = []
        """Warnings about keys that are probably mistakes; each begins with the key."""

    def get(self, key: str, section: Source | Emulator, number: int | None, *, optimized: bool = False) -> Layout:
        """Return the layout of a section's data block.

        If the files declare several blocks, the key ``block`` or ``number`` chooses one. Errors in
        the other blocks are then ignored.

        Args:
            key: The key of the section, for messages.
            section: The section that names the files.
            number: Number of the block; None if the section has no such key.
            optimized: True if the section reads the members by their names, so that it can use a block
                with optimized access, and no type needs a size.

        Raises:
            ConfigError: A file or block is missing, or the section does not say which block it means.
            LayoutError: The block cannot be compiled.

        """
        paths, program = self._program(key, section)
        if section.block is None and len(program.blocks) <= 1:
            return self._compile(key, section, paths, program, None, optimized=optimized)[0]
        try:
            block = _choose(key, section, program.blocks, number)
        except ConfigError:
            program.compile(())  # raises errors in damaged sources first
            raise
        return self._compile(key, section, paths, program, block.name, optimized=optimized)[0]

    def all(self, key: str, section: Source | Emulator) -> tuple[Layout, ...]:
        """Return all layouts of a section's files; ``key`` is the key of the section, for messages.

        Raises:
            ConfigError: A file is missing.
            LayoutError: A block cannot be compiled.

        """
        return self._compile(key, section, *self._program(key, section), None)

    def _program(self, key: str, section: Source | Emulator) -> tuple[tuple[Path, ...], compiler.Program]:
        if section.layout is None:
            raise ConfigError(
                f"{key}.layout: this key is needed; name the data block's source file (.db), and the files of its UDTs"
            )
        names = [section.layout] if isinstance(section.layout, str) else section.layout
        paths = tuple(self._config.path(name) for name in names)
        given = "" if section.encoding is None else encoding_of(key, section, table=False)
        if (paths, given) not in self._programs:
            self._programs[paths, given] = read_program(paths, f"{key}.layout: ", given)
        return paths, self._programs[paths, given]

    def _compile(
        self,
        key: str,
        section: Source | Emulator,
        paths: object,
        program: compiler.Program,
        block: str | None,
        *,
        optimized: bool = False,
    ) -> tuple[Layout, ...]:
        """Compile one block, or all blocks if ``block`` is None."""
        sizes = section.type_bytes
        encoding = encoding_of(key, section, table=program.is_table)
        which = paths, block and block.lower(), tuple(sorted(sizes.items())), optimized, encoding
        if which not in self._compiled:
            try:
                compiled = program.compile(None if block is None else (block,), sizes, by_name=optimized)
                layouts = tuple(layout.with_encoding(encoding) for layout in compiled.layouts)
                if program.is_table:
                    _check_texts(key, layouts)
                self._compiled[which] = replace(compiled, layouts=layouts)
            except LayoutError as error:
                self._compiled[which] = error
        found = self._compiled[which]
        if isinstance(found, LayoutError):
            raise found
        compiled = found
        warnings = [one for one in compiled.warnings if not (optimized and compiler.is_of_access(one))]
        self.warnings += [line for line in summarize(warnings) if line not in self.warnings]
        names = ", ".join(layout.name for layout in compiled.layouts)
        self.odd += [f"{key}.type_bytes: no member in {names} has the type {name!r}" for name in compiled.unused]
        return compiled.layouts


def encoding_of(key: str, section: Source | Emulator, *, table: bool) -> str:
    """Return the canonical name of the encoding of a section's texts: as configured, or as Siemens' tools have it.

    Args:
        key: The key of the section, for messages.
        section: The section.
        table: True if its registers come from a tag table or a model, False if from a data block.

    Raises:
        ConfigError: There is no such encoding.

    """
    if section.encoding is not None:
        try:
            return canonical(section.encoding)
        except ValueError as error:
            raise ConfigError(f"{key}.encoding: {error}") from None
    kind = section.connector if isinstance(section, Source) else section.kind
    return ISO_8859_1 if table and kind != "s7" else WINDOWS_1252


def _check_texts(key: str, layouts: Iterable[Layout]) -> None:
    """Raise ConfigError if the encoding cannot hold an initial value of a tag table."""
    for register in (one for layout in layouts for one in layout.registers):
        if register.initial is not None and is_encoded(register.type):
            try:
                parse_literal(register.initial, register)
            except ValueRangeError as error:
                raise ConfigError(f"{key}.encoding: {register.path}: initial: {error}") from None


def _choose(
    key: str, section: Source | Emulator, blocks: Sequence[compiler.BlockName], number: int | None
) -> compiler.BlockName:
    names = ", ".join(block.name for block in blocks)
    if section.block is not None:
        for block in blocks:
            if block.name.lower() == section.block.lower():
                return block
        raise ConfigError(f"{key}.block: {unknown('data block', section.block, (block.name for block in blocks))}")
    found = [block for block in blocks if block.number is not None and block.number == number]
    if len(found) != 1:
        if number is not None:
            raise ConfigError(
                f"{key}.dbNumber: no data block has the number {number} ({names}); choose one with the key block"
            )
        raise ConfigError(
            f"{key}.layout: the files contain several data blocks ({names}); choose one with the key block or dbNumber"
        )
    return found[0]


def read_program(paths: Iterable[Path], key: str = "", encoding: str = "") -> compiler.Program:
    """Read source files as one program, so that each file may use the types of the others.

    ``encoding`` is that of files whose text is not UTF-8; "" if it is unknown.

    Raises:
        ConfigError: A file cannot be read; the message begins with ``key``.
        LayoutError: A tag table is invalid.

    """
    return compiler.Program([_read(path, key, encoding) for path in paths])


def _read(path: Path, key: str, encoding: str) -> compiler.Source:
    """Read a file. Of a file that is too large, read just enough that the compiler refuses it."""
    try:
        with open(path, "rb", opener=_open_at_once) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise ConfigError(f"{key}{path}: not a regular file; name the file of a data block")
            data = file.read(MAX_SOURCE_BYTES + 4)
    except OSError as error:
        raise ConfigError(f"{key}{path}: {error.strerror}") from None
    return compiler.Source(str(path), data, encoding_of_file(data, encoding))


def _open_at_once(path: str, flags: int) -> int:
    """Open a file. If it is a FIFO, do not wait for a process that writes to it."""
    return os.open(path, flags | os.O_NONBLOCK)


def summarize(warnings: Iterable[Diagnostic]) -> list[str]:
    """Return a line for each warning.

    Warnings of a file that differ only in a quoted name share a line.
    """
    lines: list[str] = []
    alike: dict[tuple[str, str], int] = {}
    for warning in warnings:
        name = _QUOTED.search(warning.message)
        kind = warning.file, _QUOTED.sub("", warning.message, count=1)
        if name is None or kind not in alike:
            alike[kind] = len(lines)
            lines.append(str(warning))
        elif name[0] not in lines[at := alike[kind]]:
            lines[at] += f"{',' if '; likewise ' in lines[at] else '; likewise'} {name[0]}"
    return lines
