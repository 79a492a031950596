"""Compiles declared injections: finds the registers that they name, and encodes their values."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple, Protocol

import numpy as np

from shmio.config import Declaration
from shmio.errors import ConfigError, PathError, ValueRangeError
from shmio.injection._numbers import Number
from shmio.injection.activation import Window
from shmio.injection.condition import Expression, parse
from shmio.injection.draw import SeededRandom
from shmio.injection.operations import (
    ADD,
    MAX_DELAY_BYTES,
    MAX_DELAY_CYCLES,
    MULTIPLY,
    Arithmetic,
    Bytes,
    Delay,
    Drop,
    Fixed,
    Flip,
    Freeze,
    Noise,
    Operation,
    RandomChoice,
    RandomRange,
    ValueGroup,
    Values,
    places,
)
from shmio.layout.model import INTEGERS, ElementType, Layout, Register
from shmio.layout.topic import Direction, look_up, parse_topic
from shmio.layout.values.codec import Buffer, Value, codec, scalar_codec
from shmio.layout.values.literal import parse_literal
from shmio.layout.values.text import from_text, wire_type
from shmio.layout.values.write import bits_of, chosen
from shmio.model.statuses import status_area, trusted_codec
from shmio.wording import unknown

_NS: Final = 1_000_000_000
MAX_REGISTERS: Final = 4096
"""Maximum number of registers and elements in one target."""
_MAX_REFERENCES: Final = 64

_Operate = Callable[[SeededRandom], Operation]
"""A function that creates an operation; its argument generates the operation's random numbers."""


class Target(NamedTuple):
    """The registers that an injection changes.

    The registers belong to one source and one direction, and do not overlap. ``cover`` is an image of
    the block in which exactly their bits are set.
    """

    source: str
    direction: Direction
    registers: tuple[Register, ...]
    cover: bytes


class Decoder(Protocol):
    """Decodes a register that a condition reads."""

    def decode(self, data: Buffer, /) -> Value:
        """Return the register's value in an image; None if it is unknown."""


@dataclass(frozen=True)
class Condition:
    """A parsed condition, with the source and the decoder of each register that it reads."""

    expression: Expression
    reads: tuple[tuple[str, Decoder], ...]
    layouts: Mapping[str, Layout | None]
    """The layout of each source that the condition names, for which it was compiled; None: no such source."""

    def fits(self, layouts: Mapping[str, Layout]) -> bool:
        """Return whether the sources still have the layouts for which the condition was compiled."""
        return all(layouts.get(source) is layout for source, layout in self.layouts.items())


NEVER: Final = Condition(parse("false"), (), {})


@dataclass(frozen=True)
class Program:
    """A declared injection, compiled to run in its source's process."""

    declaration: Declaration
    source: str
    direction: Direction
    cover: Bytes
    window: Window
    condition: Condition | None
    operate: _Operate

    @cached_property
    def foreign(self) -> frozenset[str]:
        """The names of the sources that the condition names, without the source of the injection."""
        return frozenset(self.condition.layouts if self.condition else ()) - {self.source}


def compile_program(declaration: Declaration, layouts: Mapping[str, Layout], periods_ns: Mapping[str, int]) -> Program:
    """Compile a declared injection.

    Args:
        declaration: The declared injection.
        layouts: The layout of each source, by source name.
        periods_ns: The period of each source in ns, by source name.

    Raises:
        ConfigError: The declaration is invalid. The message begins with the wrong key.

    """
    texts = [declaration.target] if isinstance(declaration.target, str) else declaration.target
    try:
        target = resolve(texts, layouts)
    except PathError as error:
        raise ConfigError(f"target: {error}") from None
    layout = layouts[target.source]
    return Program(
        declaration,
        target.source,
        target.direction,
        np.frombuffer(target.cover, np.uint8),
        _window(declaration),
        None if declaration.when is None else compile_condition(declaration.when, layouts),
        _OPERATIONS[declaration.operation](declaration, target, layout, periods_ns[target.source]),
    )


def compile_condition(text: str, layouts: Mapping[str, Layout]) -> Condition:
    """Parse a condition, and find the registers that it reads.

    Raises:
        ConfigError: The condition is invalid. The message begins with the key ``when``.

    """
    try:
        expression = parse(text)
        if len(expression.references) > _MAX_REFERENCES:
            raise ConfigError(f"a condition may read at most {_MAX_REFERENCES} registers")
        reads = tuple(_read(path, layouts) for path in expression.references)
        return Condition(expression, reads, {source: layouts[source] for source, _ in reads})
    except (ConfigError, PathError) as error:
        raise ConfigError(f"when: {error}") from None


def _read(path: str, layouts: Mapping[str, Layout]) -> tuple[str, Decoder]:
    source, register = number_register(path, layouts)
    layout = layouts[source]
    if status_area(layout) is not None:
        return source, trusted_codec(register, layout)
    code = "?" if register.type == "BOOL" else scalar_codec(register.element).plain
    return source, Number((">" if layout.byte_order == "big" else "<") + code, register.offset, register.bit or 0)


def number_register(path: str, layouts: Mapping[str, Layout]) -> tuple[str, Register]:
    """Return the source and the register that a path in a condition names.

    The value of the register must be a number or a BOOL.

    Raises:
        PathError: There is no such register, or the path names an input.
        ConfigError: The register is an array, or its value is neither a number nor a BOOL.

    """
    try:
        source, register = single(path, layouts)
    except PathError as error:
        raise PathError(f"{error}{_division(path, layouts)}") from None
    if register.dims:
        raise ConfigError(f"{path} is an array, but a condition reads single values; name one of its elements")
    if register.type != "BOOL" and not scalar_codec(register.element).plain:
        raise ConfigError(f"{path}: {register.type} is neither a number nor a BOOL")
    return source, register


def _division(path: str, layouts: Mapping[str, Layout]) -> str:
    """Return a remedy if a path begins with the path of a number, as in ``cell/speed/4``; else an empty text."""
    head = path
    while "/" in head:
        head, _, _ = head.rpartition("/")
        with suppress(PathError, ConfigError):
            register = single(head, layouts)[1]
            if not register.dims and scalar_codec(register.element).plain:
                return (
                    f"; {head} is a number: put blanks around the '/' of a division: {head} / {path[len(head) + 1 :]}"
                )
    return ""


def _window(declaration: Declaration) -> Window:
    once = declaration.when is None and declaration.for_s is not None
    return Window(
        round((declaration.start_s or 0) * _NS),
        None if declaration.end_s is None else round(declaration.end_s * _NS),
        None if declaration.for_s is None else round(declaration.for_s * _NS),
        1 if once else declaration.times,
    )


# -- targets -------------------------------------------------------------------------------------------------


def resolve(texts: Iterable[str], layouts: Mapping[str, Layout]) -> Target:
    """Return the target of an injection: the registers that texts name.

    A text is the path of a register or of a part of it, a pattern, a structure or a whole source.

    Raises:
        PathError: A text names no register; or the registers belong to several sources or
            directions, overlap, or are too many.
    """
    found: list[tuple[str, Direction, Register]] = []
    for text in texts:
        found += _registers(text, layouts)
        if len(found) > MAX_REGISTERS:
            raise PathError(
                f"{text} names more than {MAX_REGISTERS} registers and elements; declare an injection for each part"
            )
    places = {(source, direction) for source, direction, _ in found}
    if len(places) != 1:
        named = ", ".join(sorted(f"{source} /{direction}" for source, direction in places))
        raise PathError(f"an injection covers one direction of one source, but this one covers {named}")
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
            raise PathError(f"the target names {source}/{register.path}, or a part of it, twice")
        cover[span] = bytes(there | own for there, own in zip(cover[span], bits, strict=True))
        registers.append(register)
    return Target(source, direction, tuple(registers), bytes(cover))


def single(text: str, layouts: Mapping[str, Layout]) -> tuple[str, Register]:
    """Return the source and the single register, element or part that a text names.

    Raises:
        PathError: There is no such register, or the text names an input.

    """
    topic = parse_topic(text, layouts, _default(layouts))
    if topic.direction == "in":
        raise PathError(f"{text}: a condition can only read outputs of a source; leave out /in")
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
        raise PathError(f"{text}: no register has this path")


def _default(layouts: Collection[str]) -> str | None:
    return next(iter(layouts)) if len(layouts) == 1 else None


def _layout(source: str, text: str, layouts: Mapping[str, Layout]) -> Layout:
    if source not in layouts:
        raise PathError(f"{text}: {unknown('source', source, layouts)}")
    return layouts[source]


# -- operations --------------------------------------------------------------------------------------------------------


def _set(declaration: Declaration, target: Target, layout: Layout, _period_ns: int) -> _Operate:
    image = bytearray(layout.size)
    for register in target.registers:
        _encode(declaration.value, "value", register, layout, image)
    values = np.frombuffer(bytes(image), np.uint8)
    return lambda _draw: Fixed(values)


def _encode(value: Any, key: str, register: Register, layout: Layout, image: bytearray) -> None:
    """Encode a value of the configuration into an image.

    Raises:
        ConfigError: The value does not fit into the register. The message begins with ``key``.

    """
    try:
        if isinstance(value, str) and (register.dims or wire_type(register) != "string"):
            try:
                value = from_text(value, register)
            except ValueRangeError:
                value = parse_literal(value, register, layout.byte_order)
        codec(register, layout.byte_order).encode_into(value, image)
    except ValueRangeError as error:
        raise ConfigError(f"{key}: {register.path}: {str(error).removeprefix(f'{register.path}: ')}") from None


def _offset(declaration: Declaration, target: Target, layout: Layout, _period_ns: int) -> _Operate:
    groups, by = _numbers(declaration, target, layout), _number(declaration.value, "value")
    return lambda _draw: Arithmetic(groups, lambda _places, values: values + by, (ADD, by))


def _scale(declaration: Declaration, target: Target, layout: Layout, _period_ns: int) -> _Operate:
    groups, by = _numbers(declaration, target, layout), _number(declaration.value, "value")
    return lambda _draw: Arithmetic(groups, lambda _places, values: values * by, (MULTIPLY, by))


def _clamp(declaration: Declaration, target: Target, layout: Layout, _period_ns: int) -> _Operate:
    groups = _numbers(declaration, target, layout)
    least = -math.inf if declaration.min is None else declaration.min
    most = math.inf if declaration.max is None else declaration.max

    def clamp(_places: ValueGroup, values: Values) -> Values:
        clamped: Values = np.minimum(np.maximum(values, values.dtype.type(least)), values.dtype.type(most))
        return clamped

    return lambda _draw: Arithmetic(groups, clamp)


def _noise(declaration: Declaration, target: Target, layout: Layout, _period_ns: int) -> _Operate:
    groups, amplitude = _numbers(declaration, target, layout), declaration.amplitude or 0.0
    gaussian = declaration.distribution == "gaussian"
    return lambda draw: Noise(groups, draw, amplitude, gaussian=gaussian)


def _random(declaration: Declaration, target: Target, layout: Layout, _period_ns: int) -> _Operate:
    if declaration.values is not None:
        tables = [(group, _table(declaration.values, group.element, layout)) for group in _places(target, layout)]
        return lambda draw: RandomChoice(tables, draw)
    groups = _numbers(declaration, target, layout)
    least, most = declaration.min or 0.0, declaration.max or 0.0
    if not math.isfinite(most - least):
        raise ConfigError(f"max: {most:g} is too far from min, {least:g}")
    whole = any(group.element.base not in ("REAL", "LREAL") for group in groups)
    if whole and math.ceil(least) > math.floor(most):
        raise ConfigError(f"min: there is no whole number from {least:g} to {most:g}")
    return lambda draw: RandomRange(groups, draw, least, most)


def _table(values: list[Any], element: ElementType, layout: Layout) -> Bytes:
    """Encode the values for an element type. Return an array of shape (k, size)."""
    bit = 0 if element.base == "BOOL" else None
    register = Register(element.name, element.name, (), 0, bit, element.size, 1, encoding=element.encoding)
    rows = []
    for index, value in enumerate(values):
        image = bytearray(element.size)
        _encode(value, f"values[{index}]", register, layout, image)
        rows.append(bytes(image))
    return np.frombuffer(b"".join(rows), np.uint8).reshape(len(rows), element.size)


def _freeze(_declaration: Declaration, _target: Target, _layout: Layout, _period_ns: int) -> _Operate:
    return lambda _draw: Freeze()


def _drop(_declaration: Declaration, _target: Target, _layout: Layout, _period_ns: int) -> _Operate:
    return lambda _draw: Drop()


def _delay(declaration: Declaration, _target: Target, layout: Layout, period_ns: int) -> _Operate:
    key = "delay_ms" if declaration.delay_cycles is None else "delay_cycles"
    delay_ns, cycles = round((declaration.delay_ms or 0) * 1e6), declaration.delay_cycles or 0
    held = cycles or -(-delay_ns // period_ns)
    most = min(MAX_DELAY_CYCLES, MAX_DELAY_BYTES // max(1, layout.size))
    if held > most:
        raise ConfigError(
            f"{key}: the delay is {held} cycles, but for images of {layout.size} bytes at most {most} are allowed"
        )
    return lambda _draw: Delay(layout.size, delay_ns, cycles)


def _flip(declaration: Declaration, target: Target, layout: Layout, _period_ns: int) -> _Operate:
    cover = np.frombuffer(target.cover, np.uint8)
    mask = None
    if declaration.bits is not None:
        image = bytearray(layout.size)
        for group in _places(target, layout):
            width = 1 if group.element.base == "BOOL" else 8 * group.element.size
            for bit in declaration.bits:
                if bit >= width:
                    raise ConfigError(f"bits: {group.element.name} has bits 0 to {width - 1}, not {bit}")
                for place, shift in zip(group.index.tolist(), group.shifts.tolist(), strict=True):
                    if width == 1:
                        image[place] ^= 1 << shift
                        continue
                    byte = len(place) - 1 - bit // 8 if layout.byte_order == "big" else bit // 8
                    image[place[byte]] ^= 1 << bit % 8
        mask = np.frombuffer(bytes(image), np.uint8)
    return lambda draw: Flip(mask, cover, draw)


_OPERATIONS: Final[Mapping[str, Callable[[Declaration, Target, Layout, int], _Operate]]] = {
    "set": _set,
    "offset": _offset,
    "scale": _scale,
    "clamp": _clamp,
    "noise": _noise,
    "random": _random,
    "freeze": _freeze,
    "delay": _delay,
    "drop": _drop,
    "flip": _flip,
}


def _places(target: Target, layout: Layout) -> list[ValueGroup]:
    try:
        return places(target.registers, layout.byte_order)
    except ValueError as error:
        raise ConfigError(f"target: {error}") from None


def _numbers(declaration: Declaration, target: Target, layout: Layout) -> list[ValueGroup]:
    """Return the values of a target. Raise ConfigError if any value is not a number."""
    for register in target.registers:
        if register.type == "BOOL" or not scalar_codec(register.element).plain:
            kinds = "numbers: REAL, LREAL, " + ", ".join(sorted(INTEGERS)) + ", TIME, LTIME"
            name = f"{target.source}/{register.path}"
            raise ConfigError(f"target: {name} is {register.type}, but {declaration.operation} is for {kinds}")
    return _places(target, layout)


def _number(value: Any, key: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ConfigError(f"{key}: expected a number, found {str(value)[:60]!r}")
    return value
