"""Compile tag tables that lie over a data block: names for its bits, parts, slices and views.

A source names such a table beside the block's source: ``layout = "db201.db"``, ``tags =
"names.toml"``. The table has the same formats as every tag table (``tags.py``), but its addresses
are paths in the block, and types may be left out. In TOML::

    block = "DB201"               # needed if the sources hold several blocks
    [registers]
    DoorClosed = "Inputs/8.%X0"
    "door/Speed" = { address = "Inputs/10", type = "REAL", unit = "mm/s" }
    Release = { address = "Outputs/13.%X0", writable = true, comment = "releases the robot" }
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Annotated, Any, Final, Literal

import msgspec

from shmio.config.faults import explain
from shmio.errors import Diagnostic, PathError
from shmio.layout import tag_sheets
from shmio.layout.model import MAX_ELEMENTS, MAX_REGISTERS, Layout, Register
from shmio.layout.overlay import overlay_register
from shmio.layout.report import Report, TooManyErrors
from shmio.layout.s7.address import is_address
from shmio.layout.spelling import block_path
from shmio.layout.tags import Lines, parse_type, read_sheet, read_toml, unknown_column
from shmio.layout.topic import MAX_TOPIC, canonical_path, shorten
from shmio.wording import printable, unknown

_NEEDED: Final = ("path", "address")


class _Entry(msgspec.Struct, forbid_unknown_fields=True):
    address: Annotated[str, msgspec.Meta(max_length=4096)] = ""
    type: str = ""
    comment: Annotated[str, msgspec.Meta(max_length=1000)] = ""
    unit: Annotated[str, msgspec.Meta(max_length=64)] = ""
    writable: bool = False
    initial: Any = None
    scale: Any = None
    deadband: Any = None


class _File(msgspec.Struct, forbid_unknown_fields=True):
    registers: Annotated[dict[str, object], msgspec.Meta(min_length=1, max_length=MAX_REGISTERS)]
    block: Annotated[str, msgspec.Meta(max_length=128)] = ""


class OverlayTable:
    """A table over a data block, as read from its file."""

    def __init__(self, file: str, data: bytes, encoding: str = "") -> None:
        """Read the file; raise LayoutError if it is not a tag table."""
        self.file = file
        report = Report([file])
        if file.lower().endswith(tag_sheets.SUFFIXES):
            sheet = read_sheet(file, data, report, _NEEDED, encoding)
            self.block = ""
            self._registers: Mapping[str, object] = sheet.registers
            self.line_of: Callable[[str], int] = lambda path: sheet.rows.get(path, 1)
        else:
            table = read_toml(file, data, report, _File)
            self.block = table.block
            self._registers, self.line_of = table.registers, Lines(data.decode()).line_of

    def apply(self, layout: Layout, report: Report) -> Layout:
        """Return the layout with the table's registers appended; report errors."""
        placer = _Placer(self, layout, report)
        with suppress(TooManyErrors):
            for key, given in self._registers.items():
                placer.place(key, given)
            placer.check_names()
        return placer.layout()


class _Placer:
    def __init__(self, table: OverlayTable, layout: Layout, report: Report) -> None:
        self._table, self._layout, self._report = table, layout, report
        self._found: dict[str, Register] = {}
        self._keys: dict[str, str] = {}
        self._elements = sum(register.count for register in layout.registers)

    def place(self, key: str, given: object) -> None:
        """Add a register, or report why it cannot be added."""
        try:
            register = self._register(key, _entry(given))
        except (PathError, ValueError) as error:
            self._complain(key, str(error))
            return
        self._found[register.path] = register
        self._keys[register.path] = key
        self._elements += register.count
        if self._elements > MAX_ELEMENTS or len(self._layout.registers) + len(self._found) > MAX_REGISTERS:
            self._complain(key, f"there are more than {MAX_REGISTERS} registers or {MAX_ELEMENTS} elements")
            raise TooManyErrors

    def check_names(self) -> None:
        """Report paths that lie below a register, or that differ from other paths only in case."""
        names = {register.path for register in self._layout.registers} | self._found.keys()
        in_lower_case = {register.path.lower(): register.path for register in self._layout.registers}
        for path, key in self._keys.items():
            first = in_lower_case.setdefault(path.lower(), path)
            if first != path:
                self._complain(key, f"this path differs from {shorten(first)} only in upper and lower case", "warning")
            head = path.rpartition("/")[0]
            while head:
                if head in names:
                    self._complain(key, f"{shorten(head)} is already a register; choose another path")
                head = head.rpartition("/")[0]

    def layout(self) -> Layout:
        """Return the layout with the placed registers appended."""
        return replace(self._layout, registers=(*self._layout.registers, *self._found.values()))

    def _register(self, key: str, entry: _Entry) -> Register:
        layout = self._layout
        if key.rpartition("/")[2] in ("in", "out"):
            raise PathError("leave out /in or /out at the end of the path, because each register has both")
        path = canonical_path(key)
        if len(path) > MAX_TOPIC:
            raise PathError(f"a path is at most {MAX_TOPIC} characters long")
        if path in self._found:
            raise PathError("this path is given twice; remove one of the entries")
        if path in layout.by_path:
            over = layout.registers[layout.by_path[path]].over
            what = "another table has this register" if over else f"{layout.name} has a register of this path"
            raise PathError(f"{what}; choose another path")
        if layout.members(path):
            raise PathError(f"{layout.name} has a structure of this path; choose another one")
        _refuse_conversions(entry, layout)
        if not entry.address:
            raise ValueError(
                f"address: this key is needed; name a register of {layout.name}, such as {_example(layout)}"
            )
        over = self._over(entry.address)
        register = overlay_register(layout.base, path, over, parse_type(entry.type) if entry.type else None)
        return msgspec.structs.replace(register, comment=entry.comment, unit=entry.unit, writable=entry.writable)

    def _over(self, address: str) -> str:
        """Return an address as a canonical path of the block; raise PathError if it is not a path."""
        base = self._layout.base
        text = block_path(address.strip(), base)
        if is_address(text) and text not in base.by_path:
            raise PathError(
                f"address: {shorten(text)} is an address in the controller; a table over {base.name} names its "
                f"registers, such as {_example(base)}; a table of addresses is a layout of its own, without {base.name}"
            )
        return canonical_path(text, parts=True)

    def _complain(self, key: str, problem: str, severity: Literal["error", "warning"] = "error") -> None:
        message = f"{shorten(printable(key))}: {problem}"
        self._report.add(Diagnostic(self._table.file, self._table.line_of(key), 1, message, severity))


def _entry(given: object) -> _Entry:
    """Read the entry of one register; raise ValueError if it is wrong."""
    if isinstance(given, str):
        return _Entry(given)
    known = _Entry.__struct_fields__
    if isinstance(given, dict) and (others := given.keys() - set(known)):
        other = min(others)
        raise ValueError(unknown_column(other, given, known, "; write a path with a dot in quotes"))
    try:
        return msgspec.convert(given, _Entry)
    except msgspec.ValidationError as error:
        raise ValueError(explain(error, "", _Entry, given)) from None


def _refuse_conversions(entry: _Entry, layout: Layout) -> None:
    """Raise ValueError if the entry has a column that is only for registers with bytes of their own."""
    if entry.initial is not None:
        raise ValueError(f"initial: leave out this key, because the initial values are those of {layout.name}")
    for name in ("scale", "deadband"):
        if getattr(entry, name):
            raise ValueError(
                f"{name}: leave out this key, because a name over a data block shows the bytes of {layout.name} as "
                "they are; say in unit or comment what the number means"
            )


def _example(layout: Layout) -> str:
    """Return a path of the block, as an example for messages."""
    for register in layout.own:
        if register.type == "BYTE":
            return f"{'/'.join((register.path, *(str(low) for low, _ in register.dims)))}.%X0"
    return layout.own[0].path if layout.own else "Inputs/8.%X0"


def lay_tables(
    tables: list[OverlayTable], layouts: list[Layout], blocks: list[str], report: Report, *, chosen: bool
) -> list[Layout]:
    """Return the layouts with the registers of the tables that lie over them; report errors.

    Args:
        tables: The tables.
        layouts: The layouts that were compiled.
        blocks: Names of all data blocks of the sources.
        report: The report to which errors are added.
        chosen: Whether the caller chose blocks by name. Then a table that names no block may lie
            over several.

    """
    for table in tables:
        if table.block and table.block.lower() not in {name.lower() for name in blocks}:
            report.add(Diagnostic(table.file, 1, 1, f"block: {unknown('data block', table.block, blocks)}"))
            continue
        if not table.block and len(layouts) > 1 and not chosen:
            names = ", ".join(blocks)
            what = f'the sources have several data blocks ({names}); choose one by block = "NAME" in this table'
            report.add(Diagnostic(table.file, 1, 1, what))
            continue
        if table.block and layouts and table.block.lower() not in {layout.name.lower() for layout in layouts}:
            what = f"the names of this table are left out: it is for {table.block}, but {layouts[0].name} is read"
            report.add(Diagnostic(table.file, 1, 1, what, "warning"))
        layouts = [
            table.apply(layout, report) if table.block.lower() in ("", layout.name.lower()) else layout
            for layout in layouts
        ]
    return layouts
