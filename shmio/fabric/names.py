"""Names of cells, and the subjects on which a cell publishes and listens."""

from __future__ import annotations

import re
from typing import Final, NamedTuple

from shmio.errors import ConfigError

ROOT: Final = "shmio"
"""First token of all subjects of the fabric."""
_SEPARATOR: Final = "~"
"""Separates the parts of a cell's name in the name of a stream. The parts cannot contain it."""
_PART: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}\Z")


class CellName(NamedTuple):
    """The name of a cell in the fabric, written ``plant.line.cell``."""

    plant: str
    line: str
    cell: str

    @classmethod
    def parse(cls, text: str) -> CellName:
        """Parse a name such as ``plant1.line3.a50``.

        Raises:
            ConfigError: The text is not the name of a cell.

        """
        parts = text.split(".")
        if len(parts) != 3 or not all(map(_PART.match, parts)):
            raise ConfigError(
                f"{text!r} is not the name of a cell; write plant.line.cell, such as plant1.line3.a50, each part with "
                "at most 40 letters, digits, _ and -"
            )
        return cls(*parts)

    def __str__(self) -> str:
        return ".".join(self)

    @property
    def subject(self) -> str:
        """The subject that all subjects of the cell begin with."""
        return f"{ROOT}.{self}"

    @property
    def status(self) -> str:
        """The subject on which the cell publishes its state."""
        return f"{self.subject}.status"

    @property
    def history(self) -> str:
        """The name of the JetStream stream that keeps what the cell has published."""
        return _SEPARATOR.join((ROOT, *self))

    @classmethod
    def of_history(cls, stream: str) -> CellName | None:
        """Return the cell whose history a stream keeps; None if it is another stream."""
        root, *parts = stream.split(_SEPARATOR)
        try:
            return cls.parse(".".join(parts)) if root == ROOT else None
        except ConfigError:
            return None

    def live(self, source: str) -> str:
        """Return the subject of a source's new frames and events."""
        return f"{self.subject}.{token(source)}.live"

    def late(self, source: str) -> str:
        """Return the subject of a source's frames and events that are published again after a lost connection."""
        return f"{self.subject}.{token(source)}.late"

    def missing(self, source: str) -> str:
        """Return the subject of requests for messages of a source that a mirror has not received."""
        return f"{self.subject}.{token(source)}.missing"

    @property
    def command_subjects(self) -> str:
        """The subjects of all commands to the cell, with wildcards."""
        return f"{self.subject}.*.command.*.*.*"

    def command(self, source: str, sender: CellName) -> str:
        """Return the subject of a cell's commands to a source.

        The sender's name is in the subject, so that the server can refuse a false name.
        """
        return f"{self.subject}.{token(source)}.command.{sender}"


def token(source: str) -> str:
    """Return a source's name as one token of a subject, in which a dot would begin another token."""
    return source.replace(".", "~")


def source_of(token: str) -> str:
    """Return the source's name from its token; the opposite of :func:`token`."""
    return token.replace("~", ".")
