"""The values that ``shmio-supervisor browse`` finds in a device, and the user's choice of them."""

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
        names: The names of all levels from the top down to this value, as the device spells them.
        type: The type in a tag table of a register with this value; empty for a group, and for a
            value that cannot be a register.
        columns: Other columns of the tag table: ``address``, ``unit``, ``comment``, ``writable``.
        refused: Why the value cannot be a register; empty for a group and for a value that can be
            one.

    """

    names: tuple[str, ...]
    type: str = ""
    columns: Mapping[str, object] = field(default_factory=dict)
    refused: str = ""


@dataclass
class Browsed:
    """Result of a search in a device.

    Attributes:
        offers: The values and groups. Each follows the group that contains it.
        incomplete: Why the device may offer more values, with the remedy; empty if these are all.

    """

    offers: list[Offer] = field(default_factory=list)
    incomplete: str = ""


class Wanted:
    """The part of a device that the user wants to list, and the limits of the search."""

    def __init__(self, patterns: Iterable[str] = (), *, depth: int = DEFAULT_DEPTH, nodes: int = DEFAULT_NODES) -> None:
        """Create the choice.

        Args:
            patterns: Paths and globs, written like those of registers. If there are none, the user
                wants everything.
            depth: Maximum number of levels.
            nodes: Maximum number of nodes to look at.

        Raises:
            PathError: A pattern is malformed.

        """
        self._globs = [Glob(pattern) for pattern in patterns]
        self.depth, self.nodes = depth, nodes

    @property
    def everything(self) -> bool:
        """True if the user has given no pattern and so wants everything."""
        return not self._globs

    def takes(self, names: Iterable[str]) -> bool:
        """Return whether the user wants to list the value or group with these names."""
        path = _path(names)
        return not self._globs or (path is not None and any(glob.matches(path) for glob in self._globs))

    def enters(self, names: Iterable[str]) -> bool:
        """Return whether the group with these names may contain something that the user wants to list."""
        path = _path(names)
        return not self._globs or (
            path is not None and any(glob.matches(path) or glob.reaches(path) for glob in self._globs)
        )


def _path(names: Iterable[str]) -> str | None:
    """Return the path that has these names as its segments; None if they cannot form a path."""
    try:
        return "/".join(encode_segment(name) for name in names)
    except PathError:
        return None
