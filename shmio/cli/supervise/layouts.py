"""The data-block sources that a configuration names: compiled once, one block chosen from each."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterable, Sequence
from pathlib import Path

from shmio.config import Config, Emulator, Source
from shmio.errors import ConfigError
from shmio.layout import compiler
from shmio.layout.lexer import MAX_SOURCE_BYTES
from shmio.layout.model import Diagnostic, Layout

_QUOTED = re.compile(r"'[^']*'")


class LayoutFiles:
    """Compiles each set of files once."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._compiled: dict[tuple[Path, ...], tuple[Layout, ...]] = {}
        self.warnings: list[str] = []

    def get(self, key: str, section: Source | Emulator, number: int | None) -> Layout:
        """The data block of a section; if its files hold several, the one of its ``block`` or of this number.

        ConfigError: no such file or block, or none is chosen; LayoutError.
        """
        return _choose(key, section, self.all(key, section), number)

    def all(self, key: str, section: Source | Emulator) -> tuple[Layout, ...]:
        """Every data block of a section's files; ConfigError: no such file; LayoutError."""
        if section.layout is None:
            raise ConfigError(f"{key}.layout: this key is needed: the data block's source (.db), and its UDTs")
        names = [section.layout] if isinstance(section.layout, str) else section.layout
        paths = tuple(self._config.path(name) for name in names)
        if paths not in self._compiled:
            compiled = compile_files(paths, f"{key}.layout: ")
            self._compiled[paths] = compiled.layouts
            self.warnings += [line for line in summarize(compiled.warnings) if line not in self.warnings]
        return self._compiled[paths]


def _choose(key: str, section: Source | Emulator, layouts: Sequence[Layout], number: int | None) -> Layout:
    held = ", ".join(layout.name for layout in layouts)
    if section.block is not None:
        for layout in layouts:
            if layout.name.lower() == section.block.lower():
                return layout
        raise ConfigError(f"{key}.block: no data block {section.block!r}; there are: {held}")
    if len(layouts) > 1:
        layouts = [layout for layout in layouts if layout.number is not None and layout.number == number]
    if len(layouts) != 1:
        if number is not None:
            raise ConfigError(f"{key}.dbNumber: no data block has the number {number} ({held}); choose one by block")
        raise ConfigError(f"{key}.layout: it holds several data blocks ({held}); choose one by block or dbNumber")
    return layouts[0]


def compile_files(paths: Iterable[Path], key: str = "") -> compiler.Compiled:
    """Read and compile files that may use each other's types; ConfigError beginning with ``key``, LayoutError."""
    return compiler.compile_sources([_read(path, key) for path in paths])


def _read(path: Path, key: str) -> compiler.Source:
    """Read a source; a little more than allowed is enough for the compiler to refuse it."""
    try:
        with open(path, "rb", opener=_open_at_once) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise ConfigError(f"{key}{path}: no regular file; name the file of a data block")
            return compiler.Source(str(path), file.read(MAX_SOURCE_BYTES + 4))
    except OSError as error:
        raise ConfigError(f"{key}{path}: {error.strerror}") from None


def _open_at_once(path: str, flags: int) -> int:
    """Open without waiting for a writer, as a FIFO would have it."""
    return os.open(path, flags | os.O_NONBLOCK)


def summarize(warnings: Iterable[Diagnostic]) -> list[str]:
    """A line each; those of one file that differ in the quoted name only are one, with all the names."""
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
