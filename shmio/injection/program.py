"""Compiles declarations: finds registers, encodes values and parses conditions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from shmio.config import Declaration
from shmio.errors import ConfigError, PathError, ValueRangeError
from shmio.injection.activation import Window
from shmio.injection.draw import SeededRandom
from shmio.injection.expression import Expression, parse
from shmio.injection.numbers import Bytes, ValueGroup, Values, places
from shmio.injection.operations import (
    MAX_DELAY_BYTES,
    MAX_DELAY_CYCLES,
    Arithmetic,
    Delay,
    Drop,
    Fixed,
    Flip,
    Freeze,
    Noise,
    Operation,
    RandomChoice,
    RandomRange,
)
from shmio.injection.target import Target, resolve, single
from shmio.layout.model import INTEGERS, ElementType, Layout, Register
from shmio.layout.topic import Direction
from shmio.layout.values.codec import RegisterCodec, codec, scalar_codec
from shmio.layout.values.literal import parse_literal
from shmio.layout.values.text import from_text, wire_type

NS: Final = 1_000_000_000
MAX_REFERENCES: Final = 64

Operate = Callable[[SeededRandom], Operation]
"""Creates the operation with its source of random numbers."""


@dataclass(frozen=True)
class Condition:
    """An expression, with the source and the codec of each of its references."""

    expression: Expression
    reads: tuple[tuple[str, RegisterCodec], ...]


NEVER: Final = Condition(parse("false"), ())


@dataclass(frozen=True)
class Program:
    """A declared injection, compiled to run in its source's process."""

    declaration: Declaration
    source: str
    direction: Direction
    cover: Bytes
    window: Window
    condition: Condition | None
    operate: Operate

    @property
    def foreign(self) -> frozenset[str]:
        """The other sources whose values the condition reads."""
        reads = self.condition.reads if self.condition else ()
        return frozenset(source for source, _ in reads if source != self.source)


def compile_program(declaration: Declaration, layouts: Mapping[str, Layout], periods_ns: Mapping[str, int]) -> Program:
    """Compile a declaration: find everything that it names.

    Args:
        declaration: The declared injection.
        layouts: The layout of each source.
        periods_ns: The period of each source, in ns.

    Raises:
        ConfigError: The declaration is wrong. The message begins with the key.

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
    """Parse a condition and find its registers.

    Raises:
        ConfigError: The condition is wrong. The message begins with the key ``when``.

    """
    try:
        expression = parse(text)
        if len(expression.references) > MAX_REFERENCES:
            raise ConfigError(f"a condition reads at most {MAX_REFERENCES} registers")
        return Condition(expression, tuple(_read(path, layouts) for path in expression.references))
    except (ConfigError, PathError) as error:
        raise ConfigError(f"when: {error}") from None


def _read(path: str, layouts: Mapping[str, Layout]) -> tuple[str, RegisterCodec]:
    source, register = single(path, layouts)
    if register.dims:
        raise ConfigError(f"{path}: an array; a condition reads one of its elements")
    if register.type != "BOOL" and not scalar_codec(register.element).plain:
        raise ConfigError(f"{path}: {register.type} is neither a number nor a BOOL")
    return source, codec(register, layouts[source].byte_order)


def _window(declaration: Declaration) -> Window:
    once = declaration.when is None and declaration.for_s is not None
    return Window(
        round((declaration.start_s or 0) * NS),
        None if declaration.end_s is None else round(declaration.end_s * NS),
        None if declaration.for_s is None else round(declaration.for_s * NS),
        1 if once else declaration.times,
    )


# -- operations --------------------------------------------------------------------------------------------------------


def _set(declaration: Declaration, target: Target, layout: Layout, _period_ns: int) -> Operate:
    image = bytearray(layout.size)
    for register in target.registers:
        _encode(declaration.value, "value", register, layout, image)
    values = np.frombuffer(bytes(image), np.uint8)
    return lambda _draw: Fixed(values)


def _encode(value: Any, key: str, register: Register, layout: Layout, image: bytearray) -> None:
    """Put a value of the configuration into an image.

    ConfigError if it does not fit the register.
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


def _offset(declaration: Declaration, target: Target, layout: Layout, _period_ns: int) -> Operate:
    groups, by = _numbers(declaration, target, layout), _number(declaration.value, "value")
    return lambda _draw: Arithmetic(groups, lambda _places, values: values + by)


def _scale(declaration: Declaration, target: Target, layout: Layout, _period_ns: int) -> Operate:
    groups, by = _numbers(declaration, target, layout), _number(declaration.value, "value")
    return lambda _draw: Arithmetic(groups, lambda _places, values: values * by)


def _clamp(declaration: Declaration, target: Target, layout: Layout, _period_ns: int) -> Operate:
    groups = _numbers(declaration, target, layout)
    least = -math.inf if declaration.min is None else declaration.min
    most = math.inf if declaration.max is None else declaration.max

    def clamp(_places: ValueGroup, values: Values) -> Values:
        clamped: Values = np.minimum(np.maximum(values, values.dtype.type(least)), values.dtype.type(most))
        return clamped

    return lambda _draw: Arithmetic(groups, clamp)


def _noise(declaration: Declaration, target: Target, layout: Layout, _period_ns: int) -> Operate:
    groups, amplitude = _numbers(declaration, target, layout), declaration.amplitude or 0.0
    gaussian = declaration.distribution == "gaussian"
    return lambda draw: Noise(groups, draw, amplitude, gaussian=gaussian)


def _random(declaration: Declaration, target: Target, layout: Layout, _period_ns: int) -> Operate:
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
    """Encode the values for one type, (k, size)."""
    register = Register(element.name, element.name, (), 0, 0 if element.base == "BOOL" else None, element.size, 1)
    rows = []
    for index, value in enumerate(values):
        image = bytearray(element.size)
        _encode(value, f"values[{index}]", register, layout, image)
        rows.append(bytes(image))
    return np.frombuffer(b"".join(rows), np.uint8).reshape(len(rows), element.size)


def _freeze(_declaration: Declaration, _target: Target, _layout: Layout, _period_ns: int) -> Operate:
    return lambda _draw: Freeze()


def _drop(_declaration: Declaration, _target: Target, _layout: Layout, _period_ns: int) -> Operate:
    return lambda _draw: Drop()


def _delay(declaration: Declaration, _target: Target, layout: Layout, period_ns: int) -> Operate:
    key = "delay_ms" if declaration.delay_cycles is None else "delay_cycles"
    delay_ns, cycles = round((declaration.delay_ms or 0) * 1e6), declaration.delay_cycles or 0
    held = cycles or -(-delay_ns // period_ns)
    most = min(MAX_DELAY_CYCLES, MAX_DELAY_BYTES // max(1, layout.size))
    if held > most:
        raise ConfigError(f"{key}: {held} cycles of {layout.size} bytes, but a delay holds at most {most}")
    return lambda _draw: Delay(layout.size, delay_ns, cycles)


def _flip(declaration: Declaration, target: Target, layout: Layout, _period_ns: int) -> Operate:
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


_OPERATIONS: Final[Mapping[str, Callable[[Declaration, Target, Layout, int], Operate]]] = {
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
    """Return the values of a target of numbers; ConfigError if it covers something else."""
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
