"""A name for a new instance that no other one has: neither one that runs, nor one that is configured nearby."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from itertools import chain, count, islice
from pathlib import Path
from typing import Final

from shmio.config.read import read_tables
from shmio.errors import ConfigError
from shmio.segment import instances

MAX_LENGTH: Final = 40
MAX_FILES: Final = 500
"""More configurations nearby are not looked at."""


def vacant(name: str, file: Path) -> str:
    """The name, or the first of ``name-2``, ``name-3``, … that is free, for a configuration at ``file``."""
    taken = {*instances(), *_configured(file)}
    numbered = (f"{name[: MAX_LENGTH - len(end)]}{end}" for end in (f"-{number}" for number in count(2)))
    return next(found for found in chain([name], numbered) if found not in taken)


def _configured(file: Path) -> Iterator[str]:
    """Names in the configurations of the same folder, of those beside it, and of the one above."""
    folder = file.resolve().parent
    found = chain(folder.glob("*.toml"), folder.parent.glob("*/supervisor.toml"), folder.parent.glob("*.toml"))
    for other in islice(found, MAX_FILES):
        with suppress(ConfigError, OSError, KeyError, TypeError):
            yield str(read_tables(other)["instance"]["name"])
