"""What a device offers, for ``shmio-supervisor browse``, and which part of it is wanted."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from shmio.errors import PathError
from shmio.layout.glob import Glob
from shmio.layout.topic import encode_segment

DEFAULT_DEPTH: Final = 32
DEFAULT_NODES: Final = 100_000


@dataclass(frozen=True)
class Offer:
    """A value that a device offers, or a group of values.

    Attributes:
        names: The names from the top, as the device spells them.
        type: Type of a register in a tag table; empty for a group, and for what cannot be a register.
        columns: Other columns of the tag table: ``address``, ``unit``, ``comment``, ``writable``.
        refused: Why a value cannot be a register; empty for a group.

    """

    names: tuple[str, ...]
    type: str = ""
    columns: Mapping[str, object] = field(default_factory=dict)
    refused: str = ""


@dataclass
class Browsed:
    """What was found.

    Attributes:
        offers: Each after the group that contains it.
        incomplete: Why there may be more, with the remedy; empty if this is all.

    """

    offers: list[Offer] = field(default_factory=list)
    incomplete: str = ""


class Wanted:
    """Which part of a device to list, and the limits of the search."""

    def __init__(self, patterns: Iterable[str] = (), *, depth: int = DEFAULT_DEPTH, nodes: int = DEFAULT_NODES) -> None:
        """Create the choice.

        Args:
            patterns: Paths and globs, as for registers; without any, everything is wanted.
            depth: Maximum number of levels.
            nodes: Maximum number of nodes to look at.

        Raises:
            PathError: A pattern is malformed.

        """
        self._globs = [Glob(pattern) for pattern in patterns]
        self.depth, self.nodes = depth, nodes

    @property
    def everything(self) -> bool:
        """True if there is no pattern."""
        return not self._globs

    def takes(self, names: Iterable[str]) -> bool:
        """Return whether to list a value or group."""
        path = _path(names)
        return not self._globs or (path is not None and any(glob.matches(path) for glob in self._globs))

    def enters(self, names: Iterable[str]) -> bool:
        """Return whether something in a group may be wanted."""
        path = _path(names)
        return not self._globs or (
            path is not None and any(glob.matches(path) or glob.reaches(path) for glob in self._globs)
        )


def _path(names: Iterable[str]) -> str | None:
    """Return the path of these names; None if there is none."""
    try:
        return "/".join(encode_segment(name) for name in names)
    except PathError:
        return None
