"""What an injection is laid over, and what a condition reads: registers, and parts of them.

A target is a topic's path, and may also name

- a range of an array's elements: ``cell/Inputs/2..5``, within the last dimension;
- a part of an integer register as STEP 7's slice access does: ``cell/Outputs/13.%X0`` (a bit, 0 the lowest),
  ``.%B1`` (a byte), ``.%W0``, ``.%D0``, the least significant first.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Final, NamedTuple

from shmio.errors import PathError
from shmio.layout.model import Layout, Register
from shmio.layout.topic import Direction, find, look_up, parse_topic
from shmio.layout.types import INTEGERS
from shmio.layout.write import bits_of, chosen

MAX_REGISTERS: Final = 4096
"""Registers and elements in one target."""

_SLICE: Final = re.compile(r"(?P<head>.*)\.%(?P<kind>[XBWD])(?P<number>[0-9]{1,3})(?P<direction>/in|/out)?")
_RANGE: Final = re.compile(r"(?P<head>.*)/(?P<low>-?[0-9]{1,9})\.\.(?P<high>-?[0-9]{1,9})(?P<direction>/in|/out)?")
_PARTS: Final = {"B": ("BYTE", 1), "W": ("WORD", 2), "D": ("DWORD", 4)}


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
    slice_of = _SLICE.fullmatch(text)
    topic = parse_topic(slice_of["head"] if slice_of else text, layouts, _default(layouts))
    if topic.direction == "in" or (slice_of and slice_of["direction"] == "/in"):
        raise PathError(f"{text}: a condition reads what comes out of a source; leave out /in")
    layout = _layout(topic.source, text, layouts)
    register = look_up(layout, topic)
    return topic.source, _part(layout, register, slice_of) if slice_of else register


def _registers(text: str, layouts: Mapping[str, Layout]) -> Iterator[tuple[str, Direction, Register]]:
    slice_of, range_of = _SLICE.fullmatch(text), _RANGE.fullmatch(text)
    match = slice_of or range_of
    topic = parse_topic(f"{match['head']}{match['direction'] or ''}" if match else text, layouts, _default(layouts))
    layout = _layout(topic.source, text, layouts)
    direction: Direction = topic.direction or "out"
    if match is None:
        count = 0
        for register in chosen(layout, topic.path or "**"):
            yield topic.source, direction, register
            count += 1
            if count > MAX_REGISTERS:  # resolve() says so
                return
        if not count:
            look_up(layout, topic)  # its error tells what is near
            raise PathError(f"{text} names no register")
        return
    register = look_up(layout, topic) if slice_of else _array(layout, topic.path, text)
    if slice_of:
        yield topic.source, direction, _part(layout, register, slice_of)
        return
    low, high = int(match["low"]), int(match["high"])
    if high < low or high - low >= MAX_REGISTERS:
        raise PathError(f"{text}: write the lower index first, and at most {MAX_REGISTERS} elements")
    for place in range(low, high + 1):
        yield topic.source, direction, find(layout, f"{topic.path}/{place}")


def _array(layout: Layout, path: str, text: str) -> Register:
    """The array that a range is of; all but the last of its indices may be given."""
    head, given = path, 0
    while head not in layout.by_path and "/" in head:
        head, _, _ = head.rpartition("/")
        given += 1
    place = layout.by_path.get(head)
    if place is None or len(layout.registers[place].dims) != given + 1:
        raise PathError(f"{text}: a range stands in place of an array's last index")
    return layout.registers[place]


def _part(layout: Layout, register: Register, match: re.Match[str]) -> Register:
    kind, number = match["kind"], int(match["number"])
    path = f"{register.path}.%{kind}{number}"
    if register.dims or register.type not in INTEGERS:
        raise PathError(f"{path}: {register.type} has no such part: bits, bytes and words are of one integer")
    size = register.size
    if kind == "X":
        byte, bit = divmod(number, 8)
        if byte < size:
            at = size - 1 - byte if layout.byte_order == "big" else byte
            return Register(path, "BOOL", (), register.offset + at, bit, 1, 1)
        raise PathError(f"{path}: {register.type} has bits 0 to {8 * size - 1}")
    name, width = _PARTS[kind]
    if width < size and number < size // width:
        at = size - width * (number + 1) if layout.byte_order == "big" else width * number
        return Register(path, name, (), register.offset + at, None, width, 1)
    raise PathError(f"{path}: {register.type} has no such part")


def _default(layouts: Collection[str]) -> str | None:
    return next(iter(layouts)) if len(layouts) == 1 else None


def _layout(source: str, text: str, layouts: Mapping[str, Layout]) -> Layout:
    if source not in layouts:
        raise PathError(f"{text}: nothing is served under {source} in this version")
    return layouts[source]
