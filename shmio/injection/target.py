"""Finds the registers that an injection covers and that a condition reads.

A target is the path of a topic or a part of a register, a pattern, a structure or a whole source.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Final, NamedTuple

from shmio.errors import PathError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import Direction, look_up, parse_topic
from shmio.layout.values.write import bits_of, chosen

MAX_REGISTERS: Final = 4096
"""Most registers and elements in one target."""


class Target(NamedTuple):
    """Distinct registers of one source in one direction. ``cover`` has their bits in the block."""

    source: str
    direction: Direction
    registers: tuple[Register, ...]
    cover: bytes


def resolve(texts: Iterable[str], layouts: Mapping[str, Layout]) -> Target:
    """Return the target that several texts name together.

    Patterns, structures and whole sources are allowed.

    Raises:
        PathError: There is no such register, more than one source or direction, an overlap, or too
            many registers.

    """
    found: list[tuple[str, Direction, Register]] = []
    for text in texts:
        found += _registers(text, layouts)
        if len(found) > MAX_REGISTERS:
            raise PathError(
                f"{text}: more than {MAX_REGISTERS} registers and elements: lay several injections over parts of it"
            )
    places = {(source, direction) for source, direction, _ in found}
    if len(places) != 1:
        named = ", ".join(sorted(f"{source} /{direction}" for source, direction in places))
        raise PathError(f"an injection covers one direction of one source, but this covers {named}")
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
    """Return the source and the single register, element or part that a text names.

    PathError if there is none.
    """
    topic = parse_topic(text, layouts, _default(layouts))
    if topic.direction == "in":
        raise PathError(f"{text}: a condition reads outputs of a source; leave out /in")
    return topic.source, look_up(_layout(topic.source, text, layouts), topic)


def _registers(text: str, layouts: Mapping[str, Layout]) -> Iterator[tuple[str, Direction, Register]]:
    topic = parse_topic(text, layouts, _default(layouts))
    layout = _layout(topic.source, text, layouts)
    direction: Direction = topic.direction or "out"
    count = 0
    for register in chosen(layout, topic.path or "**"):
        yield topic.source, direction, register
        count += 1
        if count > MAX_REGISTERS:  # resolve() reports it
            return
    if not count:
        look_up(layout, topic)  # its error suggests similar names
        raise PathError(f"{text} names no register")


def _default(layouts: Collection[str]) -> str | None:
    return next(iter(layouts)) if len(layouts) == 1 else None


def _layout(source: str, text: str, layouts: Mapping[str, Layout]) -> Layout:
    if source not in layouts:
        raise PathError(f"{text}: unknown source {source}")
    return layouts[source]
