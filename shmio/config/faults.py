"""What is wrong with a configuration, all of it in one go, each with its line: collected here, and bounded."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from shmio.config.lines import Lines
from shmio.config.wording import named
from shmio.errors import ConfigError, LayoutError

MAX_SHOWN: Final = 1_000
MAX_CHARACTERS: Final = 500
"""Of one fault: what it quotes may be as long as the file."""
_KEY: Final = re.compile(r"[A-Za-z0-9_-]+(?:\[[0-9]+\]|\.[A-Za-z0-9_-]+)*(?=[:\s])")
_PLACE: Final = re.compile(r"\b(source|emulator|injection)\[([0-9]+)\]")


class Faults:
    """Collects what is wrong with one file. Messages begin with the key that they are about."""

    def __init__(self, file: Path, tables: Mapping[str, Any], text: str = "") -> None:
        self._file = file
        self._tables = tables
        self._text = text
        self._found: dict[str, None] = {}
        self._layout: LayoutError | None = None
        self.count = 0
        self.places: Mapping[str, Sequence[int]] = {}
        """Where in the file the sections are that are left, when those with faults are left out."""

    @cached_property
    def _lines(self) -> Lines:
        return Lines(self._text)

    def __bool__(self) -> bool:
        return self.count > 0

    @property
    def full(self) -> bool:
        """Whether no more are shown: what is costly to say need not be found."""
        return self.count >= MAX_SHOWN

    def add(self, message: str) -> None:
        """Note a fault: ``key: what is wrong``."""
        if self.full:
            self.count += 1
            return
        text = shortened(named(_PLACE.sub(self._place, message), self._tables))
        key = _KEY.match(text)
        line = self._lines.of(key[0]) if key else 0
        self._note(f"{self._file}{f':{line}' if line else ''}: {text}")

    def _note(self, line: str) -> None:
        if line not in self._found:
            self._found[line] = None
            self.count += 1

    def _place(self, match: re.Match[str]) -> str:
        places, index = self.places.get(match[1], ()), int(match[2])
        return f"{match[1]}[{places[index] if index < len(places) else index}]"

    @contextmanager
    def catching(self) -> Iterator[None]:
        """Note what is raised inside, and go on behind."""
        try:
            yield
        except ConfigError as error:
            self.add(str(error))
        except LayoutError as error:
            self._layout = error
            for line in str(error).splitlines():
                self._note(line)

    def raise_any(self) -> None:
        """ConfigError with a line for each fault, LayoutError if all are of one layout; neither: there is none."""
        if not self.count:
            return
        if self._layout is not None and [*self._found] == str(self._layout).splitlines():
            raise self._layout
        more = self.count - MAX_SHOWN
        raise ConfigError("\n".join([*self._found, *([f"{self._file}: {more} more faults"] if more > 0 else [])]))


def shortened(message: str) -> str:
    """A message without the middle of what it quotes at length."""
    if len(message) <= MAX_CHARACTERS:
        return message
    return f"{message[: MAX_CHARACTERS // 2]} … {message[-MAX_CHARACTERS // 2 :]}"
