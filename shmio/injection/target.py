"""What an injection is laid over, and what a condition reads: registers, and parts of them.

A target is a topic's path, parts of registers included, a pattern, a structure or a whole source.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Final, NamedTuple

from shmio.errors import PathError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import Direction, look_up, parse_topic
from shmio.layout.values.write import bits_of, chosen

MAX_REGISTERS: Final = 4096
"""Registers and elements in one target."""


class Target(NamedTuple):
    """Registers of one source, in one direction, none of them twice; ``cover``: their bits in the block."""

    source: str
    direction: Direction
    registers: tuple[Register, ...]
    cover: bytes


def resolve(texts: Iterable[str], layouts: Mapping[str, Layout]) -> Target:
    """The target that these name together; patterns, structures and whole sources are allowed.

    PathError: no such register; more than one source or direction; the same bits twice; too much.
    """
    found: list[tuple[str, Direction, Register]] = []
    for text in texts:
        found += _registers(text, layouts)
        if len(found) > MAX_REGISTERS:
            raise PathError(f"{text}: more than {MAX_REGISTERS} registers and elements: lay several over parts of it")
    places = {(source, direction) for source, direction, _ in found}
    if len(places) != 1:
        named = ", ".join(sorted(f"{source} /{direction}" for source, direction in places))
        raise PathError(f"one injection is over one direction of one source, this is over {named}")
    source, direction = places.pop()
    cover = bytearray(layouts[source].size)
    registers = []
    for _, _, register in found:
        bits = bits_of(register)
        span = slice(register.offset, register.offset + register.size)
        taken = [there & own for there, own in zip(cover[span], bits, strict=True)]
        if taken == list(bits):
            continue
        if any(taken):
            raise PathError(f"{source}/{register.path}: part of it is named twice")
        cover[span] = bytes(there | own for there, own in zip(cover[span], bits, strict=True))
        registers.append(register)
    return Target(source, direction, tuple(registers), bytes(cover))


def single(text: str, layouts: Mapping[str, Layout]) -> tuple[str, Register]:
    """The source and the one register, element or part that a text names; PathError."""
    topic = parse_topic(text, layouts, _default(layouts))
    if topic.direction == "in":
        raise PathError(f"{text}: a condition reads what comes out of a source; leave out /in")
    return topic.source, look_up(_layout(topic.source, text, layouts), topic)


def _registers(text: str, layouts: Mapping[str, Layout]) -> Iterator[tuple[str, Direction, Register]]:
    topic = parse_topic(text, layouts, _default(layouts))
    layout = _layout(topic.source, text, layouts)
    direction: Direction = topic.direction or "out"
    count = 0
    for register in chosen(layout, topic.path or "**"):
        yield topic.source, direction, register
        count += 1
        if count > MAX_REGISTERS:  # resolve() says so
            return
    if not count:
        look_up(layout, topic)  # its error tells what is near
        raise PathError(f"{text} names no register")


def _default(layouts: Collection[str]) -> str | None:
    return next(iter(layouts)) if len(layouts) == 1 else None


def _layout(source: str, text: str, layouts: Mapping[str, Layout]) -> Layout:
    if source not in layouts:
        raise PathError(f"{text}: nothing is served under {source} in this version")
    return layouts[source]
