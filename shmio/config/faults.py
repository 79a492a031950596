"""Collect all faults of a configuration, each with its line, within a bound."""

from __future__ import annotations

import math
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
"""Limit for one fault, which may quote text as long as the file."""
_KEY: Final = re.compile(r"[A-Za-z0-9_-]+(?:\[[0-9]+\]|\.[A-Za-z0-9_-]+)*(?=[:\s])")
_PLACE: Final = re.compile(r"\b(source|emulator|injection)\[([0-9]+)\]")


class Faults:
    """Collects the faults of one file; each message begins with its key."""

    def __init__(self, file: Path, tables: Mapping[str, Any], text: str = "") -> None:
        self._file = file
        self._tables = tables
        self._text = text
        self._found: dict[str, float] = {}
        self._elsewhere: dict[str, str] = {}
        self._warnings: list[str] = []
        self._layout: LayoutError | None = None
        self.count = 0
        self.places: Mapping[str, Sequence[int]] = {}
        """For each kind of section, the indices in the file of those that are kept."""

    @cached_property
    def _lines(self) -> Lines:
        return Lines(self._text)

    def __bool__(self) -> bool:
        return self.count > 0

    @property
    def full(self) -> bool:
        """Whether further faults are only counted, so callers can skip costly checks."""
        return self.count >= MAX_SHOWN

    def add(self, message: str) -> None:
        """Add a fault, ``key: what is wrong``."""
        if self.full:
            self.count += 1
            return
        text = shortened(named(_PLACE.sub(self._place, message), self._tables))
        key = _KEY.match(text)
        line = self._lines.of(key[0]) if key else 0
        own = text.partition(":")[0]
        if own in self._elsewhere:
            table, _, _ = own.partition(".")
            self._note(f"{self._elsewhere[own]}: {text.removeprefix(f'{table}.')}", line)
        else:
            self._note(f"{self._file}{f':{line}' if line else ''}: {text}", line)

    def lies_in(self, file: str, table: str, lines: Mapping[str, int]) -> None:
        """Note that these keys of a table are in another file, named relative to this one."""
        for name, line in lines.items():
            self._elsewhere[f"{table}.{name}"] = f"{self._file.parent / file}:{line}"

    def _note(self, message: str, line: float) -> None:
        """Note a fault for this line of the file."""
        if message not in self._found:
            self._found[message] = line
            self.count += 1

    def warn(self, message: str) -> None:
        """Add a warning, ``key: what is odd``, which is shown after the faults."""
        self._warnings.append(f"{self._file}: warning: {shortened(_PLACE.sub(self._place, message))}")

    def _place(self, match: re.Match[str]) -> str:
        places, index = self.places.get(match[1], ()), int(match[2])
        return f"{match[1]}[{places[index] if index < len(places) else index}]"

    @contextmanager
    def catching(self) -> Iterator[None]:
        """Add the ConfigError or LayoutError raised in the ``with`` block instead of raising it."""
        try:
            yield
        except ConfigError as error:
            self.add(str(error))
        except LayoutError as error:
            self._layout = error
            for line in str(error).splitlines():
                self._note(line, math.inf)  # of another file: after those of this one

    def raise_any(self) -> None:
        """Raise ConfigError with a line for each fault, then the warnings; LayoutError if all are of one layout."""
        if not self.count:
            return
        if self._layout is not None and not self._warnings and [*self._found] == str(self._layout).splitlines():
            raise self._layout
        more = self.count - MAX_SHOWN
        ordered = sorted(self._found, key=self._found.__getitem__)
        rest = [f"{self._file}: {more} more faults"] if more > 0 else []
        raise ConfigError("\n".join([*ordered, *rest, *self._warnings]))


def shortened(message: str) -> str:
    """Return a message, with its middle cut out if it is too long."""
    if len(message) <= MAX_CHARACTERS:
        return message
    return f"{message[: MAX_CHARACTERS // 2]} … {message[-MAX_CHARACTERS // 2 :]}"
