"""The registers tab: a tree of all registers with their values, which the user can write and override."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import chain
from typing import Annotated, Any, ClassVar, Final

import msgspec
from msgspec import Meta
from starlette.concurrency import run_in_threadpool

from shmio.endpoints.web.page import Page, Tab, call, release
from shmio.endpoints.web.register_tree import Node, Row, Window, matching, rows, window
from shmio.errors import CommandError, PathError
from shmio.layout.model import MAX_PATH, Register
from shmio.layout.values.text import to_text
from shmio.layout.values.typed import read_value
from shmio.layout.values.write import bits_of, cover
from shmio.local.attach import Attachment
from shmio.local.injection import Shadow
from shmio.local.reading import reading
from shmio.model.values import Reading
from shmio.segment import Block

INTERVAL_S: Final = 0.2
"""Interval in s at which changed values of visible rows are sent."""
MAX_ROWS: Final = 200
MAX_COUNTED: Final = 2_000_000
"""Maximum number of visible rows that are counted."""
MAX_EXPANDED: Final = 1000
MAX_OVERRIDES: Final = 64
"""Maximum number of registers that one page may override at the same time."""
MAX_TEXT: Final = 200
"""Maximum number of characters that are shown of a value."""
_TEXTS: Final = frozenset({"CHAR", "WCHAR", "STRING", "WSTRING"})

_Path = Annotated[str, Meta(min_length=1, max_length=MAX_PATH)]


class Shown(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``rows``: which rows the page shows."""

    first: Annotated[int, Meta(ge=0, le=MAX_COUNTED)]
    count: Annotated[int, Meta(ge=0, le=MAX_ROWS)]
    expanded: Annotated[list[_Path], Meta(max_length=MAX_EXPANDED)] | None = None
    """Paths of the expanded nodes; None if all sources, and nothing else, are expanded."""
    filter: Annotated[str, Meta(max_length=200)] = ""
    marked: Annotated[str, Meta(max_length=MAX_PATH)] = ""
    """Path of the row that the user has marked; empty if there is none."""


class Given(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``set`` and ``override``: a register's path, and the value that the user has typed."""

    path: _Path
    value: Annotated[str, Meta(max_length=32_768)]


class Named(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of a call about one register: its path."""

    path: _Path


class Followed(msgspec.Struct, forbid_unknown_fields=True):
    """The arguments of ``follow``: the registers whose values the page shows."""

    paths: Annotated[list[_Path], Meta(max_length=MAX_ROWS)]


class Registers(Tab):
    """Shows registers, writes them, and overrides them."""

    name: ClassVar[str] = "registers"

    def __init__(self, page: Page) -> None:
        super().__init__(page)
        self._cell: Attachment = page.served.cell
        self._looking, self._reading = asyncio.Lock(), asyncio.Lock()
        self._allowed: dict[int, bytes] = {}
        self._visible: list[tuple[str, Block, Register]] = []
        self._sent: dict[str, list[Any]] = {}
        self._sending: asyncio.Task[None] | None = None
        self._overrides: dict[str, Shadow] = {}

    def close(self) -> None:
        """Lift the overrides of this page."""
        overrides, self._overrides = self._overrides, {}
        if overrides:
            asyncio.get_running_loop().run_in_executor(None, release, overrides, self.page.user)

    @call("read", Shown)
    async def rows(self, given: Shown) -> dict[str, Any]:
        """Return the requested rows, and the marked row, even if it is scrolled out of view; null if it is gone.

        From now on, send the values of these rows whenever they change.
        """
        async with self._looking:  # one search at a time
            rows, total, marked = await self._rows(given)
        followed = rows if marked is None or marked in rows else [*rows, marked]
        await self._show([row.path for row in followed if row.register is not None])
        described = []
        for row in rows:
            described.append(self._describe(row))
            await self.page.turn.pause()
        return {
            "first": given.first,
            "total": total,
            "rows": described,
            "marked": None if marked is None else self._describe(marked),
        }

    @call("read", Followed)
    async def follow(self, given: Followed) -> None:
        """From now on, send the values of these registers, instead of those of the rows."""
        for path in given.paths:
            self._cell.resolve(path)
        await self._show(given.paths)

    @call("write", Given)
    async def set(self, given: Given) -> dict[str, str]:
        """Write a value, and return the outcome."""
        path, value = self._typed(given)
        outcome = (await run_in_threadpool(self._cell.set, {path: value}))[0]
        return {"path": path, "outcome": str(outcome.kind), "reason": outcome.text}

    @call("inject", Given)
    async def override(self, given: Given) -> dict[str, str]:
        """Override a register: show consumers this value until the page lifts the override or is closed."""
        path, value = self._typed(given)
        shadow = self._overrides.get(path)
        if shadow is None:
            if len(self._overrides) >= MAX_OVERRIDES:
                raise CommandError(f"a page may override at most {MAX_OVERRIDES} registers at a time; lift one first")
            name = f"page {self.page.user.name}".strip()
            shadow = await run_in_threadpool(lambda: self._cell.inject(path, name=name))
            self._overrides[path] = shadow
        outcome = (await run_in_threadpool(shadow.set, {path: value}))[0]
        return {"path": path, "outcome": str(outcome.kind), "reason": outcome.text}

    @call("inject", Named)
    async def lift(self, given: Named) -> None:
        """Lift an override of this page."""
        shadow = self._overrides.pop(given.path, None)
        if shadow is None:
            raise PathError(f"{given.path}: this page does not override it; the tab Injections lifts others")
        await run_in_threadpool(shadow.close)

    async def _show(self, paths: Iterable[str]) -> None:
        self._find(paths)
        if self._sending is None:
            self._sending = self.page.start(self._send())
        await self._send_values()

    def _find(self, paths: Iterable[str]) -> None:
        """Find the registers whose values are sent, in the present layouts."""
        self._visible, self._sent = [], {}
        for path in paths:
            with suppress(PathError):  # a reload has removed it
                self._visible.append((path, *self._cell.resolve(path)))

    def _typed(self, given: Given) -> tuple[str, Any]:
        block, register = self._cell.resolve(given.path)
        text = given.value
        if not register.dims and register.element.base in _TEXTS:
            text = msgspec.json.encode(text).decode()
        return f"{block.source}/{register.path}", read_value(text, register)

    async def _rows(self, given: Shown) -> Window:
        blocks = self.page.served.segment.blocks
        expanded = frozenset(blocks if given.expanded is None else given.expanded)
        trees = [(await self._tree(block), block.layout) for block in tuple(blocks.values())]
        visible: Iterator[Row] = chain.from_iterable(
            matching(tree, layout, given.filter) if given.filter else rows(tree, layout, expanded)
            for tree, layout in trees
        )
        search = window(visible, given.first, given.count, MAX_COUNTED, given.marked)
        while (found := next(search)) is None:
            await self.page.turn.pause()
        return found

    async def _tree(self, block: Block) -> Node:
        trees, blocks = self.page.served.trees, self.page.served.segment.blocks.values()
        present = trees.present(block)
        return present if present is not None else await self.page.turn.in_thread(trees.of, block, blocks)

    def _describe(self, row: Row) -> dict[str, Any]:
        described: dict[str, Any] = {
            "path": row.path,
            "name": row.name,
            "depth": row.depth,
            "expandable": row.expandable,
        }
        if row.register is not None:
            register = row.register
            bounds = "".join(f"[{low}..{high}]" for low, high in register.dims)
            described |= {
                "type": f"{register.type}{bounds}",
                "unit": register.unit,
                "comment": register.comment,
                "writable": self._writable(row.path, register),
                "overridden": row.path in self._overrides,
            }
        return described

    def _writable(self, path: str, register: Register) -> bool:
        """Return whether the configuration allows writing the whole register."""
        block = self.page.served.segment.blocks.get(path.partition("/")[0])
        if block is None:
            return False
        allowed = self._allowed.get(block.section)
        if allowed is None:
            allowed = self._allowed[block.section] = cover(block.layout, block.attributes.writable)
        share = allowed[register.offset : register.offset + register.size]
        return not any(bits & ~covered for bits, covered in zip(bits_of(register), share, strict=True))

    async def _send(self) -> None:
        while True:
            await asyncio.sleep(INTERVAL_S)
            await self._send_values()

    async def _send_values(self) -> None:
        """Send the values of all visible rows, if one has changed.

        Unchanged values are sent, too, because a newer message replaces one that is not sent yet.
        """
        async with self._reading:
            self.page.served.segment.refresh()
            blocks = self.page.served.segment.blocks
            visible = self._visible
            if any(blocks.get(block.source, block).section != block.section for _, block, _ in visible):
                self.page.push("layout", None)  # a reload has replaced a block, so registers may have moved
                self._find([path for path, _, _ in visible])
                return
            frames = {block.section: block.latest() for block in blocks.values()}
            values: dict[str, list[Any]] = {}
            ages: dict[str, float | None] = {}
            for path, block, register in visible:
                if block.section in frames:
                    found = reading(block, register, frames[block.section])
                    values[path], ages[path] = [*_value(found), found.source_time], found.age_s
                    await self.page.turn.pause()
            if visible is self._visible and values != self._sent:
                self._sent = values
                self.page.push("registers", {path: [*shown[:-1], ages[path]] for path, shown in values.items()})


def _value(found: Reading) -> list[Any]:
    """Return what a row shows besides the age: the value as text, quality, reason and provenance."""
    text = None if found.value is None else _text(found)
    return [text, str(found.quality), found.reason, found.provenance]


def _text(found: Reading) -> str:
    """Return a value as text, because JavaScript has no exact numbers above 2**53, and JSON no infinity."""
    text = to_text(found.value, found.register)
    return text if len(text) <= MAX_TEXT else f"{text[:MAX_TEXT]}…"
