"""Match entries of two recordings: by key, and events with the same key by their content."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from itertools import chain, groupby, islice, zip_longest
from typing import Final, TypeVar

from shmio.recording.reading.entries import Entry
from shmio.segment import Event, Frame

EVENT_FIELDS: Final = ("kind", "quality", "text", "offset", "size", "mask", "data")
"""Content of an event, which does not depend on the run."""
MAX_EVENTS: Final = 4096
"""Limit on events of one key in memory: while time is paused, one cycle may have any number."""
MAX_SHIFT: Final = 64
"""Limit on the frames that one of two recordings lacks at the beginning of the first common key."""

T = TypeVar("T", Frame, Event)
Pair = tuple[Entry[T] | None, Entry[T] | None]
Groups = Iterator[tuple[int, Iterable[Entry[T]]]]


def grouped(entries: Iterable[Entry[T]], key: Callable[[Entry[T]], int], most: int) -> Groups[T]:
    """Yield groups of at most ``most`` consecutive entries with the same key."""
    for value, some in groupby(entries, key):
        while group := list(islice(some, most)):
            yield value, group


def joined(
    first: Groups[T],
    second: Groups[T],
    align: Callable[[Iterable[Entry[T]], Iterable[Entry[T]]], Iterable[Pair[T]]],
) -> Iterator[Pair[T]]:
    """Yield pairs of matching entries, with None for an entry that one recording lacks.

    The keys of both recordings must ascend. ``align`` matches the entries of two groups.
    """
    one, other = next(first, None), next(second, None)
    while one is not None or other is not None:
        if one is not None and (other is None or one[0] < other[0]):
            yield from ((entry, None) for entry in one[1])
            one = next(first, None)
        elif other is not None and (one is None or one[0] > other[0]):
            yield from ((None, entry) for entry in other[1])
            other = next(second, None)
        elif one is not None and other is not None:
            yield from align(one[1], other[1])
            one, other = next(first, None), next(second, None)


class InOrder:
    """Pairs frames of one key in their order.

    If ``shifted``, one of the recordings may lack the beginning of the first common key. Its frames
    are paired with those of the other that have the same content.
    """

    def __init__(self, *, shifted: bool) -> None:
        self._shifted = shifted

    def __call__(self, ones: Iterable[Entry[Frame]], others: Iterable[Entry[Frame]]) -> Iterator[Pair[Frame]]:
        """Yield pairs, with None for a frame that one group lacks."""
        if self._shifted:
            self._shifted = False
            first, second = iter(ones), iter(others)
            left, right = list(islice(first, MAX_SHIFT)), list(islice(second, MAX_SHIFT))
            shift = _shift(left, right)
            yield from ((entry, None) for entry in left[: max(0, shift)])
            yield from ((None, entry) for entry in right[: max(0, -shift)])
            ones, others = chain(left[max(0, shift) :], first), chain(right[max(0, -shift) :], second)
        yield from zip_longest(ones, others)


def _shift(ones: Sequence[Entry[Frame]], others: Sequence[Entry[Frame]]) -> int:
    """Return how many of ``ones`` are before the first of the others; negative: the other way round.

    Most pairs have the same content, or else there are most pairs, or else the last ones are paired.
    """

    def alike(shift: int) -> tuple[int, int, int]:
        pairs = list(zip(ones[max(0, shift) :], others[max(0, -shift) :], strict=False))
        return sum(_image(one.item) == _image(other.item) for one, other in pairs), len(pairs), abs(shift)

    return max(range(1 - len(others), len(ones)), key=alike)


def _image(frame: Frame) -> Hashable:
    return frame.quality, frame.raw, frame.effective


def aligned(ones: Iterable[Entry[Event]], others: Iterable[Entry[Event]]) -> Iterator[Pair[Event]]:
    """Pair events with the same content in any order, then by kind and place, then by kind."""
    left: list[Entry[Event]] = list(ones)
    right: list[Entry[Event]] = list(others)
    for alike in (_content, _place, _kind):
        waiting: defaultdict[Hashable, deque[Entry[Event]]] = defaultdict(deque)
        for entry in right:
            waiting[alike(entry.item)].append(entry)
        unmatched = []
        matched = set()
        for entry in left:
            if same := waiting[alike(entry.item)]:
                matched.add(id(same[0]))
                yield entry, same.popleft()
            else:
                unmatched.append(entry)
        left, right = unmatched, [entry for entry in right if id(entry) not in matched]
    yield from ((entry, None) for entry in left)
    yield from ((None, entry) for entry in right)


def _content(event: Event) -> Hashable:
    return tuple(getattr(event, name) for name in EVENT_FIELDS)


def _place(event: Event) -> Hashable:
    return event.kind, event.offset, event.mask


def _kind(event: Event) -> Hashable:
    return event.kind
