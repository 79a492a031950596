"""Which entries of two recordings belong together: those with the same key, and events of one key by what they say."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from itertools import groupby, islice
from typing import Final, TypeVar

from shmio.recording.format.entries import Entry
from shmio.segment import Event, Frame

EVENT_FIELDS: Final = ("kind", "quality", "text", "offset", "size", "mask", "data")
"""What an event says, wherever and in whichever run it was told."""
MAX_AT_ONCE: Final = 4096
"""Events of one key that are held in memory; where time stands there may be any number of one cycle."""

T = TypeVar("T", Frame, Event)
Pair = tuple[Entry[T] | None, Entry[T] | None]
Groups = Iterator[tuple[int, list[Entry[T]]]]


def one_by_one(entries: Iterable[Entry[T]], key: Callable[[Entry[T]], int]) -> Groups[T]:
    """Each entry with its key."""
    return ((key(entry), [entry]) for entry in entries)


def at_once(entries: Iterable[Entry[T]], key: Callable[[Entry[T]], int]) -> Groups[T]:
    """The entries that follow each other with the same key."""
    for value, some in groupby(entries, key):
        while group := list(islice(some, MAX_AT_ONCE)):
            yield value, group


def joined(
    first: Groups[T],
    second: Groups[T],
    align: Callable[[Sequence[Entry[T]], Sequence[Entry[T]]], Iterable[Pair[T]]],
) -> Iterator[Pair[T]]:
    """Pairs of what belongs together, None in place of what one of them does not have. Keys ascend."""
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


def aligned(ones: Sequence[Entry[Event]], others: Sequence[Entry[Event]]) -> Iterator[Pair[Event]]:
    """Events that say the same, in whichever order; of the rest those of one kind about one place, or of one kind."""
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
