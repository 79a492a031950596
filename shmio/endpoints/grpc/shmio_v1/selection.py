"""Resolves the patterns of a call to views of blocks. Clients with equal patterns share their views."""

from __future__ import annotations

import asyncio
import itertools
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple
from weakref import WeakValueDictionary

from shmio.endpoints.grpc.commands.command_client import CommandClient
from shmio.endpoints.grpc.shmio_v1.tables import RawFrames, Selection, View
from shmio.endpoints.grpc.topics import Topics
from shmio.errors import EndpointError, PathError, ValueRangeError
from shmio.layout.glob import named
from shmio.layout.model import Register
from shmio.layout.topic import Topic, shorten
from shmio.segment import Block

MAX_PATTERNS: Final = 256
MAX_REGISTERS: Final = 16_384
MAX_ELEMENTS: Final = 262_144
"""Maximum number of elements that one call may use."""
MAX_MATCHES: Final = 1_000_000
"""Maximum number of comparisons between a pattern with stars and a register in one call.

This many comparisons take a few seconds.
"""
MAX_ALL_ELEMENTS: Final = 1 << 22
"""Maximum number of elements that all clients together may use. Elements of equal patterns count once."""
KEPT: Final = 16
"""Number of unused views that stay cached, for clients that read repeatedly."""


class SourceDirection(NamedTuple):
    """The values of a source or, if ``inward`` is True, the writes to it."""

    source: str
    inward: bool = False


TopicsBySource = Mapping[SourceDirection, Sequence[Topic]]

_Key = tuple[int, bool, tuple[str, ...]]


class Selections:
    """Creates and caches the views of all clients."""

    def __init__(self, topics: Topics) -> None:
        self._topics = topics
        self._numbers = itertools.count(1)
        self._known: WeakValueDictionary[_Key, View] = WeakValueDictionary()
        self._kept: OrderedDict[_Key, View] = OrderedDict()
        self._lock = asyncio.Lock()

    def resolve(self, patterns: Sequence[str], *, inward: bool = False) -> TopicsBySource:
        """Parse a call's patterns, and group them by source and direction.

        Args:
            patterns: Paths, structures, globs or source names.
            inward: Whether the patterns may end in ``/in``.

        Raises:
            PathError: There is no such source, or ``/in`` is not allowed.
            ValueRangeError: There is no pattern, or there are too many.

        """
        if not patterns:
            raise ValueRangeError(
                "no pattern is given; name a path, a structure, a glob, or a source for all of its registers"
            )
        if len(patterns) > MAX_PATTERNS:
            raise ValueRangeError(
                f"{len(patterns)} patterns are given, but at most {MAX_PATTERNS} are allowed; use stars or structures"
            )
        wanted: dict[SourceDirection, dict[Topic, None]] = {}
        for pattern in patterns:
            topic = self._topics.topic(pattern)
            if topic.direction == "in" and not inward:
                raise PathError(f"{shorten(pattern)}: an input of a source cannot be read here; leave out /in")
            wanted.setdefault(SourceDirection(topic.source, topic.direction == "in"), {})[topic] = None
        return {place: tuple(topics) for place, topics in wanted.items()}

    def commands(self, source: str) -> CommandClient:
        """Return the command client of a source.

        Raises:
            PathError: A reload has removed the source.

        """
        return self._topics.feed(source).commands

    async def select(self, wanted: TopicsBySource, *, frames: bool = False) -> list[View]:
        """Return a view for each source and direction, in order.

        Args:
            wanted: The topics, by source and direction.
            frames: Whether the views deliver raw frames instead of registers.

        Raises:
            PathError: There is no such register.
            ValueRangeError: This call uses too many registers or elements.
            EndpointError: All clients together use too many elements.

        """
        views = []
        budget = _Budget()
        for place, topics in wanted.items():
            views.append(view := await self._view(place, () if frames else topics, budget))
            budget.take(view)
        return views

    async def registers(self, wanted: TopicsBySource) -> Selection:
        """Return the table for ``wanted``, which must have one source. Without topics, the table has no registers."""
        ((place, topics),) = wanted.items()
        if not topics:
            block = self._topics.feed(place.source).block
            return Selection(next(self._numbers), block, (), inward=place.inward)
        view = await self._view(place, topics, _Budget())
        if not isinstance(view, Selection):  # a view of raw frames, which has no registers
            raise PathError(f"{place.source}: no register is named")
        return view

    async def _view(self, place: SourceDirection, topics: Sequence[Topic], budget: _Budget) -> View:
        """Return a cached or a new view.

        Args:
            place: The source and direction.
            topics: The topics; empty for raw frames.
            budget: How much the call may still request.

        """
        block = self._topics.feed(place.source).block
        key = block.section, place.inward, tuple(topic.path for topic in topics)
        if (view := self._known.get(key)) is None:
            async with self._lock:  # one at a time, because a large layout takes seconds in a thread
                view = self._known.get(key)
                if view is None:
                    view = self._known[key] = await self._make(block, topics, budget, inward=place.inward)
        self._kept[key] = view
        self._kept.move_to_end(key)
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return view

    async def _make(self, block: Block, topics: Sequence[Topic], budget: _Budget, *, inward: bool) -> View:
        number = next(self._numbers)
        if not topics:
            return RawFrames(number, block)
        view = await asyncio.to_thread(_select, number, block, topics, budget, inward=inward)
        if self._elements + view.elements > MAX_ALL_ELEMENTS:
            self._kept.clear()
        if self._elements + view.elements > MAX_ALL_ELEMENTS:
            raise EndpointError(
                f"all clients together have {self._elements} elements open, but at most {MAX_ALL_ELEMENTS} are "
                "allowed; select fewer registers, or subscribe to raw frames"
            )
        return view

    @property
    def _elements(self) -> int:
        return sum(view.elements for view in self._known.values())


class _Budget:
    """Numbers of registers, elements and path comparisons that a call may still use."""

    def __init__(self) -> None:
        self.registers, self.elements, self.matches = MAX_REGISTERS, MAX_ELEMENTS, MAX_MATCHES

    def take(self, view: View) -> None:
        if isinstance(view, Selection):
            self.check(len(view.registers), view.elements)
            self.registers -= len(view.registers)
            self.elements -= view.elements

    def check(self, registers: int, elements: int) -> None:
        """Raise ValueRangeError if there are too many registers or elements."""
        if registers > self.registers or elements > self.elements:
            raise ValueRangeError(
                f"the patterns name more than {MAX_REGISTERS} registers or {MAX_ELEMENTS} elements, which is the "
                "maximum of one call; select fewer registers, make several calls, or use raw frames"
            )

    def match(self, registers: int) -> None:
        """Count the comparisons of a star pattern.

        Raises:
            ValueRangeError: There are too many comparisons.

        """
        self.matches -= registers
        if self.matches < 0:
            raise ValueRangeError(
                f"the patterns with stars need more than {MAX_MATCHES} comparisons; use fewer stars, or name structures"
            )


def _select(number: int, block: Block, topics: Sequence[Topic], budget: _Budget, *, inward: bool) -> Selection:
    chosen: dict[str, Register] = {}
    elements = 0
    for topic in topics:
        if "*" in topic.path:
            budget.match(len(block.layout.registers))
        found = named(block.layout, topic)
        if not found:
            raise PathError(f"{shorten(str(topic))}: source {block.source!r} has no such register")
        for register in found:
            if register.path not in chosen:
                chosen[register.path] = register
                elements += register.count
        budget.check(len(chosen), elements)
    selection = Selection(number, block, list(chosen.values()), inward=inward)
    _ = selection.table
    return selection
