"""Result of an import: the tags for a tag table, and the items that were left out, with the reasons."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from shmio.errors import LayoutError, PathError, ShmioError
from shmio.layout.model import MAX_REGISTERS
from shmio.layout.tags import place_tags
from shmio.layout.topic import canonical_path, encode_segment, shorten
from shmio.wording import counted, printable

MAX_TEXT: Final = 1000
_NAMES_SHOWN: Final = 5


class ImportingError(ShmioError):
    """A file is not a tag list that can be imported; the message says why."""


@dataclass
class Found:
    """The tags of a file, in the order of the file.

    Attributes:
        kind: What the file contains, for messages, such as ``tags of KEPServerEX``.
        tags: Entries of the tag table, by path.
        remarks: Remarks about the file as a whole.

    """

    kind: str
    tags: dict[str, dict[str, object]] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    _skipped: dict[str, list[str]] = field(default_factory=dict)
    _heads: set[str] = field(default_factory=set)

    def add(self, names: tuple[str, ...], kind: str, **columns: object) -> None:
        """Add a tag, or skip it if a tag table cannot contain it.

        Args:
            names: The segments of the path, as the vendor spells them.
            kind: Type in the tag table.
            columns: Values of other columns of the tag table; None, "" and False are left out.

        """
        shown = "/".join(names)
        try:
            path = canonical_path("/".join(encode_segment(name) for name in names))
        except PathError as error:
            return self.skip(shown, f"the name cannot be a path: {error}")
        entry = {"type": kind, **{name: cell for name, cell in columns.items() if cell not in (None, "", False)}}
        if isinstance(comment := entry.get("comment"), str):
            entry["comment"] = " ".join(printable(comment).split())[:MAX_TEXT]
        if isinstance(unit := entry.get("unit"), str) and len(unit) > 64:
            del entry["unit"]
        heads = list(_heads(path))
        if path in self.tags:
            return self.skip(shown, "the list has this name twice")
        if path in self._heads or any(head in self.tags for head in heads):
            return self.skip(shown, "a tag and a group of tags have this name")
        if len(self.tags) >= MAX_REGISTERS:
            return self.skip(shown, f"a tag table has at most {MAX_REGISTERS} registers")
        try:
            place_tags("import", {path: entry})
        except LayoutError as error:
            found = error.diagnostics[0].message if error.diagnostics else str(error)
            return self.skip(shown, found.removeprefix(f"{shorten(printable(path))}: "))
        self.tags[path] = entry
        self._heads.update(heads)
        return None

    def skip(self, name: str, why: str) -> None:
        """Record that the item ``name`` of the file is left out, with the reason ``why``."""
        self._skipped.setdefault(why, []).append(name)

    @property
    def skipped(self) -> Mapping[str, list[str]]:
        """Names of the items that were left out, by reason."""
        return self._skipped

    def report(self) -> Iterator[str]:
        """Yield lines for the user: the number of tags, the skipped items with reasons, the remarks."""
        yield f"imported {counted(len(self.tags), 'tag')} from {self.kind}"
        for why, names in self._skipped.items():
            shown = ", ".join(shorten(name, 60) for name in names[:_NAMES_SHOWN])
            more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
            yield f"skipped {len(names)}: {why}: {shown}{more}"
        yield from self.remarks

    def to_toml(self, source: str, *, writable: bool) -> str:
        """Return the tag table as TOML.

        Args:
            source: Name of the imported file, for the first line.
            writable: Whether to make those tags writable that are writable in the vendor's tool.

        """
        lines = [f"# {printable(self.kind)}, imported from {printable(source)}", "[registers]"]
        for path, entry in self.tags.items():
            cells = {name: cell for name, cell in entry.items() if writable or name != "writable"}
            lines.append(f"{_toml(path)} = {_entry(cells)}")
        return "\n".join([*lines, ""])


def _heads(path: str) -> Iterator[str]:
    head = path.rpartition("/")[0]
    while head:
        yield head
        head = head.rpartition("/")[0]


def _entry(cells: Mapping[str, object]) -> str:
    if cells.keys() == {"type"}:
        return _toml(cells["type"])
    return "{ " + ", ".join(f"{name} = {_toml(cell)}" for name, cell in cells.items()) + " }"


def _toml(value: object) -> str:
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
