"""Initial image of a block with all initial values, as after a download to the controller."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Final

from shmio.errors import ValueRangeError
from shmio.layout.model import ElementType, Layout, Register
from shmio.layout.topic import shorten
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.literal import default_text, parse_literal

MAX_LISTED: Final = 20
"""Maximum number of unreadable initial values that :func:`initial_value_warnings` lists."""


def initial_frame(layout: Layout) -> tuple[bytearray, tuple[str, ...]]:
    """Return the initial frame, and the paths of registers whose initial value cannot be read.

    Such a value may be the name of a constant that only the controller knows. In the frame, these
    registers have the default of their type.
    """
    frame = bytearray(layout.size)
    unread: list[str] = []
    types = {register.type: register for register in layout.own}
    zero = {name for name, register in types.items() if _default_is_zeros(register.element)}
    for register in layout.own:
        if register.initial is None and register.type in zero:
            continue
        value = _default(register) if register.initial is None else _given(register)
        if value is None:
            unread.append(register.path)
            value = _default(register)
        codec(register, layout.byte_order).encode_into(value, frame)
    return frame, tuple(unread)


def unread(layout: Layout) -> tuple[Register, ...]:
    """Return the registers whose initial value cannot be read."""
    return tuple(r for r in layout.registers if r.initial is not None and _given(r) is None)


def initial_value_warnings(layout: Layout) -> Iterator[str]:
    """Yield a line for each initial value that cannot be read.

    After ``MAX_LISTED`` lines, a last one gives the number of the remaining values.
    """
    registers = unread(layout)
    for register in registers[:MAX_LISTED]:
        value = " ".join((register.initial or "").split())
        yield (
            f"the initial value {shorten(value, 40)} of {register.path} cannot be read as {register.type}; "
            f"an emulated PLC starts it at {default_text(register.element)}"
        )
    if len(registers) > MAX_LISTED:
        yield f"{len(registers) - MAX_LISTED} more initial values cannot be read"


def _given(register: Register) -> Value | None:
    try:
        return parse_literal(register.initial or "", register)
    except ValueRangeError:
        return None


@lru_cache(maxsize=1024)
def _default_is_zeros(element: ElementType) -> bool:
    bit = 0 if element.base == "BOOL" else None
    register = Register("default", element.name, (), 0, bit, element.size, 1)
    image = bytearray(element.size)
    codec(register, "big").encode_into(_default(register), image)
    return not any(image)


def _default(register: Register) -> Value:
    text = default_text(register.element)
    return parse_literal(f"[{register.count}({text})]" if register.dims else text, register)
