"""The tree of all registers. A page shows only a few of its rows at a time."""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterable, Iterator
from itertools import islice
from typing import Final, NamedTuple

from shmio.layout.model import Layout, Register
from shmio.segment import Block

STEP_ROWS: Final = 32
"""Number of rows between which a search lets others proceed."""


class Row(NamedTuple):
    """A visible row: a source, a structure, a register, or an element of an array."""

    path: str
    name: str
    depth: int
    register: Register | None
    """The register; None for a source or a structure."""
    expandable: bool


class Node:
    """A source, a structure or a register, and the nodes below it in the order of the layout."""

    __slots__ = ("children", "name", "path", "register")

    def __init__(self, name: str, path: str, register: Register | None = None) -> None:
        self.name, self.path, self.register = name, path, register
        self.children: dict[str, Node] = {}


def tree(source: str, layout: Layout) -> Node:
    """Return the tree of a layout, whose root is the source."""
    root = Node(source, source)
    for register in layout.registers:
        node = root
        for name in register.path.split("/"):
            child = node.children.get(name)
            if child is None:
                child = node.children[name] = Node(name, f"{node.path}/{name}")
            node = child
        node.register = register
    return root


def rows(root: Node, layout: Layout, expanded: Collection[str]) -> Iterator[Row]:
    """Yield the visible rows of a source: its root, and all rows below nodes whose path is in ``expanded``."""
    pending = [(root, 0)]
    while pending:
        node, depth = pending.pop()
        array = node.register is not None and bool(node.register.dims)
        yield Row(node.path, node.name, depth, node.register, array or bool(node.children))
        if node.path not in expanded:
            continue
        if array and node.register is not None:
            yield from _elements(node, depth + 1, layout, node.register)
        pending += [(child, depth + 1) for child in reversed(node.children.values())]


class Trees:
    """The trees of all sources, shared by all pages, because a tree of 100,000 registers takes tens of MB."""

    def __init__(self) -> None:
        self._trees: dict[int, Node] = {}
        self._making = threading.Lock()

    def present(self, block: Block) -> Node | None:
        """Return the tree of a block if it has been made."""
        return self._trees.get(block.section)

    def of(self, block: Block, blocks: Iterable[Block]) -> Node:
        """Return the tree of a block. If a new tree is made, drop the trees of blocks that are not in ``blocks``."""
        with self._making:
            node = self._trees.get(block.section)
            if node is None:
                present = {one.section for one in blocks}
                self._trees = {section: one for section, one in self._trees.items() if section in present}
                node = self._trees[block.section] = tree(block.source, block.layout)
            return node


def matching(root: Node, layout: Layout, text: str) -> Iterator[Row]:
    """Yield a row for each register that has ``text`` in its path, its comment or its source's name.

    Case is ignored.
    """
    wanted = text.lower()
    for register in layout.registers:
        if wanted in register.path.lower() or wanted in register.comment.lower() or wanted in root.name.lower():
            yield Row(f"{root.path}/{register.path}", register.path, 0, register, expandable=False)


def _elements(node: Node, depth: int, layout: Layout, array: Register) -> Iterator[Row]:
    for index in _indices(array.dims):
        register = layout.element(array, index)
        yield Row(
            f"{root_of(node.path)}/{register.path}", ", ".join(map(str, index)), depth, register, expandable=False
        )


def root_of(path: str) -> str:
    """Return the name of the source, with which a path begins."""
    return path.partition("/")[0]


def _indices(dims: tuple[tuple[int, int], ...]) -> Iterator[tuple[int, ...]]:
    if not dims:
        yield ()
        return
    for index in range(dims[0][0], dims[0][1] + 1):
        for rest in _indices(dims[1:]):
            yield (index, *rest)


class Window(NamedTuple):
    """The rows that a page shows, the number of all rows, and the row that the user has marked."""

    rows: list[Row]
    total: int
    marked: Row | None


def window(visible: Iterator[Row], first: int, count: int, most: int, marked: str = "") -> Iterator[Window | None]:
    """Find ``count`` rows, beginning with number ``first``, and the row whose path is ``marked``, if it is visible.

    Rows are counted only up to ``most``. The iterator yields None after each ``STEP_ROWS`` rows, and then the result.
    """
    shown: list[Row] = []
    total, found = 0, None
    for row in islice(visible, max(most, first + count)):
        if first <= total < first + count:
            shown.append(row)
        if row.path == marked:
            found = row
        total += 1
        if not total % STEP_ROWS:
            yield None
    yield Window(shown, total, found)
