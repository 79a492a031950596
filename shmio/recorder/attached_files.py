"""The files attached to a recording: the instance's configuration and the sources of its layouts."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

from shmio.config import load
from shmio.errors import ConfigError
from shmio.recording.writer import TEXT, TOML

MAX_FILE_BYTES: Final = 16 << 20

log = logging.getLogger("shmio.recorder")


class AttachedFile(NamedTuple):
    """A file attached to a recording."""

    name: str
    media_type: str
    data: bytes
    changed_ns: int = 0


AttachedFiles = Callable[[str | None, int], list[AttachedFile]]
"""Returns the files to attach, given a source's name and its block's number; for None those of the instance."""


def no_attachments(_source: str | None, _block: int) -> list[AttachedFile]:
    """Attach no files."""
    return []


class ConfigFiles:
    """Reads the files that a configuration names. One that cannot be read is left out and logged."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._told: set[str] = set()

    def __call__(self, source: str | None, block: int) -> list[AttachedFile]:
        """Read the configuration (for None), or the files of a source's layout, as they are now."""
        if source is None:
            return self._read("config", [self._file], TOML)
        try:
            config = load(self._file)
        except ConfigError as error:
            self._tell(f"the layout's sources of {source} are not attached: {error}")
            return []
        layouts = [section.layout for section in config.source if section.name == source and section.layout]
        names = [name for layout in layouts for name in ([layout] if isinstance(layout, str) else layout)]
        return self._read(f"sources/{source}/{block}", [config.path(name) for name in names], TEXT)

    def _read(self, folder: str, files: list[Path], media_type: str) -> list[AttachedFile]:
        found = []
        for file in files:
            try:
                with file.open("rb") as stream:
                    data = stream.read(MAX_FILE_BYTES + 1)
                changed_ns = file.stat().st_mtime_ns
            except OSError as error:
                self._tell(f"{file} is not attached: {error.strerror}")
                continue
            if len(data) > MAX_FILE_BYTES:
                self._tell(f"{file} is not attached: larger than {MAX_FILE_BYTES} bytes")
                continue
            found.append(AttachedFile(f"{folder}/{file.name}", media_type, data, max(0, changed_ns)))
        return found

    def _tell(self, why: str) -> None:
        """Log a reason once, although the files are read again and again."""
        if why not in self._told:
            self._told.add(why)
            log.warning("%s", why)
