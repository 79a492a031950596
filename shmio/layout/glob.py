"""Glob patterns over register paths.

``*`` matches within one segment. ``**`` also matches across segments; if ``**`` is a whole segment, it
may match no segment at all. A pattern that matches an array or a structure also matches everything
inside. Segments may be percent-encoded like those of a path, so ``%2A`` is a literal star. Because
patterns come from clients, the time to match is linear in the path's length, whatever the pattern.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping

from shmio.errors import PathError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import Topic, canonical_path, decode_segment, encode_segment, look_up_each, parse_topic, shorten
from shmio.wording import unknown

MAX_PATTERN = 1024

_PIECES = re.compile(r"\*+|[^*]+")


class Glob:
    """A compiled pattern.

    The states of a non-deterministic automaton are the bits of one integer: bit i is set when the
    first i tokens of the pattern have been matched (Baeza-Yates and Gonnet, 1992).

    Raises:
        PathError: The pattern is empty or too long, or has an empty segment or a wrong
            percent-encoding.

    """

    def __init__(self, pattern: str) -> None:
        if len(pattern) > MAX_PATTERN:
            raise PathError(f"{shorten(pattern)}: a pattern is at most {MAX_PATTERN} characters long")
        self.pattern = pattern
        self._literals: dict[str, int] = {}
        self._stars = self._crossing = self._forks = 0
        self._final = 0
        segments = pattern.split("/")
        if "" in segments:
            raise PathError(f"{shorten(pattern)!r}: the pattern has an empty segment")
        for position, segment in enumerate(segments):
            if position:
                self._literal("/")
            if segment == "**" and position < len(segments) - 1:
                self._forks |= 1 << self._final  # a whole segment `**/` may match nothing
                self._final += 1
            for piece in _pieces(segment):
                if piece.startswith("*"):
                    self._star(crossing=len(piece) > 1)
                else:
                    for char in piece:
                        self._literal(char)
        self._start = self._close(1)

    def matches(self, path: str) -> bool:
        """Return whether the pattern matches the path or a structure or array that contains it."""
        final = 1 << self._final
        states = self._start
        for char in path:
            if char == "/" and states & final:
                return True
            states = self._step(states, char)
            if not states:
                return False
        return bool(states & final)

    def reaches(self, path: str) -> bool:
        """Return whether the pattern may match something inside ``path``, such as an element of an array."""
        states = self._start
        for char in f"{path}/":
            states = self._step(states, char)
        return states != 0

    def _step(self, states: int, char: str) -> int:
        """Return the states after one more character."""
        stay = self._crossing if char == "/" else self._stars
        return self._close(((states & self._literals.get(char, 0)) << 1) | (states & stay))

    def _literal(self, char: str) -> None:
        self._literals[char] = self._literals.get(char, 0) | 1 << self._final
        self._final += 1

    def _star(self, *, crossing: bool) -> None:
        self._stars |= 1 << self._final
        if crossing:
            self._crossing |= 1 << self._final
        self._final += 1

    def _close(self, states: int) -> int:
        """Add the states that are reachable without consuming a character."""
        while True:
            forks = states & self._forks
            more = states | (states & self._stars | forks) << 1 | forks << 3
            if more == states:
                return states
            states = more


def _pieces(segment: str) -> list[str]:
    """Split a segment into runs of stars and literal text, with the text in canonical encoding."""
    if "*" not in segment:
        return [encode_segment(decode_segment(segment))]
    pieces = _PIECES.findall(segment)
    # "in" and "out" are encoded only as whole names; the added letter prevents that.
    return [piece if piece[0] == "*" else encode_segment(f"_{decode_segment(piece)}")[1:] for piece in pieces]


def select(layout: Layout, patterns: Iterable[str]) -> tuple[int, ...]:
    """Return the ascending indices of the registers that any of the patterns matches.

    Raises:
        PathError: A pattern is malformed.

    """
    chosen: set[int] = set()
    for pattern in patterns:
        if "*" in pattern:
            glob = Glob(pattern)
            chosen.update(i for i, register in enumerate(layout.registers) if glob.matches(register.path))
            continue
        path = canonical_path(pattern)
        if path in layout.by_path:
            chosen.add(layout.by_path[path])
        chosen.update(layout.members(path))
    return tuple(sorted(chosen))


def named(layout: Layout, topic: Topic) -> list[Register]:
    """Return the registers that a topic's path names.

    The path names a register, an array element, a slice of an array (``Inputs/3..7``, returned as
    its elements), a bit or another part of an integer, a structure, or a glob. An empty path names
    all registers; a glob may match none.

    Raises:
        PathError: There is no such register, or the pattern is malformed.

    """
    if not topic.path:
        return list(layout.registers)
    if "*" in topic.path or layout.members(topic.path):
        return [layout.registers[index] for index in select(layout, [topic.path])]
    return look_up_each(layout, topic)


def choose(
    patterns: Iterable[str], layouts: Mapping[str, Layout], narrow: Callable[[Topic], Layout] | None = None
) -> list[tuple[str, Register]]:
    """Return the registers that patterns name, as (source, register), in the patterns' order without duplicates.

    Args:
        patterns: Paths, array elements, slices, structures, globs, or names of sources.
        layouts: Layouts by source; the patterns may omit the source if there is only one.
        narrow: Returns a layout with at least the register that a topic names, if it names one; None: use
            ``layouts``.

    Raises:
        PathError: A pattern names nothing, or ends in ``/in``.

    """
    chosen: list[tuple[str, Register]] = []
    sources: set[str] = set()
    repeated = False
    default = next(iter(layouts)) if len(layouts) == 1 else None
    for pattern in patterns:
        topic = parse_topic(pattern, layouts, default)
        if topic.direction == "in":
            raise PathError(f"{pattern}: an input of a source cannot be read; leave out /in")
        if topic.source not in layouts:
            raise PathError(f"{pattern}: {unknown('source', topic.source, layouts)}")
        if narrow is None or not topic.path or "*" in topic.path:
            registers = named(layouts[topic.source], topic)
        else:
            registers = named(narrow(topic), topic)
        if not registers:
            raise PathError(f"{pattern}: source {topic.source!r} has no such register")
        chosen += [(topic.source, register) for register in registers]
        repeated = repeated or topic.source in sources
        sources.add(topic.source)
    if not repeated:
        return chosen
    # By path, because hashing a path is faster than hashing a register.
    return list({(source, register.path): (source, register) for source, register in chosen}.values())
