"""Result of an import: the tags for a tag table, and the items that were left out, with the reasons."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

from shmio.errors import LayoutError, PathError, ShmioError
from shmio.layout.addresses import modbus
from shmio.layout.model import MAX_REGISTERS, Register
from shmio.layout.s7 import address as s7_address
from shmio.layout.tags import place_tags
from shmio.layout.topic import canonical_path, encode_segment, shorten
from shmio.wording import counted, printable

MAX_TEXT: Final = 1000
_MAX_UNIT: Final = 64
_NAMES_SHOWN: Final = 1000
_REMARKS_SHOWN: Final = 1000


class ImportingError(ShmioError):
    """A file is not a tag list that can be imported; the message says why."""


def of_s7(register: Register) -> bool:
    """Check the address of a register in an S7 controller; return whether it can be written to.

    Raises:
        ValueError: The connector cannot read this address.

    """
    return not s7_address.parse(register).area.read_only


def of_modbus(register: Register) -> bool:
    """Check the address of a register in a Modbus device, as :func:`of_s7` does."""
    return modbus.parse(register).table.writable


@dataclass
class Found:
    """The tags of a file, in the order of the file.

    Attributes:
        kind: What the file contains, for messages, such as ``tags of KEPServerEX``.
        tags: Entries of the tag table, by path.
        remarks: Remarks about the file as a whole.
        block: Name of the data block whose members the tags are; "" if they are not those of one block.

    """

    kind: str
    tags: dict[str, dict[str, object]] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)
    block: str = ""
    _skipped: dict[str, list[tuple[str, int]]] = field(default_factory=dict)
    _read_only: int = 0
    _heads: set[str] = field(default_factory=set)

    def add(
        self,
        names: tuple[str, ...],
        kind: str,
        columns: Mapping[str, object],
        line: int = 0,
        check: Callable[[Register], bool] | None = None,
    ) -> None:
        """Add a tag, or skip it if a tag table cannot contain it.

        Args:
            names: The segments of the path, as the vendor spells them.
            kind: Type in the tag table.
            columns: Values of other columns of the tag table; None, "" and False are left out.
            line: Line or row of the tag in the file, from 1; 0 if it has none.
            check: Checks the register's address, and returns whether it can be written to. None: there
                is no address, or nothing is known about it.

        """
        shown = "/".join(names)
        try:
            path = canonical_path("/".join(encode_segment(name) for name in names))
        except PathError as error:
            return self.skip(shown, f"the name cannot be a path: {error}", line)
        entry = {"type": kind, **{name: cell for name, cell in columns.items() if cell not in (None, "", False)}}
        if isinstance(comment := entry.get("comment"), str):
            entry["comment"] = " ".join(printable(comment).split())[:MAX_TEXT]
        if isinstance(unit := entry.get("unit"), str) and len(unit) > _MAX_UNIT:
            del entry["unit"]
            self.remarks.append(
                f"{shown} (line {line}): the unit is left out, because it has more than {_MAX_UNIT} characters"
            )
        heads = list(_heads(path))
        if path in self.tags:
            return self.skip(shown, "the list has this name twice", line)
        if path in self._heads or any(head in self.tags for head in heads):
            return self.skip(shown, "a tag and a group of tags have this name", line)
        if len(self.tags) >= MAX_REGISTERS:
            return self.skip(shown, f"a tag table has at most {MAX_REGISTERS} registers", line)
        try:
            registers = place_tags("import", {path: entry}).registers
            can_write = [check(register) for register in registers] if check else []
            if not all(can_write) and entry.pop("writable", False):
                self._read_only += 1
        except ValueError as error:
            return self.skip(shown, str(error).removeprefix("address: "), line)
        except LayoutError as error:
            found = error.diagnostics[0].message if error.diagnostics else str(error)
            return self.skip(shown, found.removeprefix(f"{shorten(printable(path))}: "), line)
        self.tags[path] = entry
        self._heads.update(heads)
        return None

    def skip(self, name: str, why: str, line: int = 0) -> None:
        """Record that the item ``name`` in a line of the file is left out, with the reason ``why``."""
        self._skipped.setdefault(shorten(why, MAX_TEXT), []).append((name, line))

    @property
    def skipped(self) -> Mapping[str, list[tuple[str, int]]]:
        """Name and line of each item that was left out, by reason."""
        return self._skipped

    def report(self, *, writable: bool = True) -> Iterator[str]:
        """Yield lines for the user: the number of tags, the skipped items with reasons, the remarks.

        ``writable`` is that of :meth:`to_toml`.
        """
        yield f"imported {counted(len(self.tags), 'tag')} from {self.kind}"
        for why, items in self._skipped.items():
            shown = ", ".join(_at(name, line) for name, line in items[:_NAMES_SHOWN])
            more = f" and {len(items) - _NAMES_SHOWN} more" if len(items) > _NAMES_SHOWN else ""
            yield f"skipped {len(items)}: {why}: {shown}{more}"
        if self._read_only and writable:
            yield f"not writable: {counted(self._read_only, 'tag')}, because there are inputs at their addresses"
        yield from self.remarks[:_REMARKS_SHOWN]
        if len(self.remarks) > _REMARKS_SHOWN:
            yield f"and {len(self.remarks) - _REMARKS_SHOWN} more remarks like these"

    def to_toml(self, source: str, *, writable: bool) -> str:
        """Return the tag table as TOML.

        Args:
            source: Name of the imported file, for the first line.
            writable: Whether to make those tags writable that are writable in the vendor's tool.

        """
        lines = [f"# {printable(self.kind)}, imported from {printable(source)}"]
        lines += [f"name = {_toml(self.block)}"] if self.block else []
        lines += ["[registers]"]
        for path, entry in self.tags.items():
            cells = {name: cell for name, cell in entry.items() if writable or name != "writable"}
            lines.append(f"{_toml(path)} = {_entry(cells)}")
        return "\n".join([*lines, ""])


def _at(name: str, line: int) -> str:
    return f"{shorten(name, 60)} (line {line})" if line else shorten(name, 60)


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
