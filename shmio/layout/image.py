"""A block as the controller has it after a download: every register at its initial value."""

from __future__ import annotations

from shmio.errors import ValueRangeError
from shmio.layout.codec import codec
from shmio.layout.literal import default_text, parse_literal
from shmio.layout.model import Layout


def initial_frame(layout: Layout) -> tuple[bytearray, tuple[str, ...]]:
    """Return the frame, and the paths of registers whose initial value could not be read.

    Those have their type's default: a source may name constants that only the controller knows.
    """
    frame = bytearray(layout.size)
    unread: list[str] = []
    for register in layout.registers:
        default = default_text(register.element)
        if register.dims:
            default = f"[{register.count}({default})]"
        try:
            value = parse_literal(default if register.initial is None else register.initial, register)
            codec(register, layout.byte_order).encode_into(value, frame)
        except ValueRangeError:
            unread.append(register.path)
            codec(register, layout.byte_order).encode_into(parse_literal(default, register), frame)
    return frame, tuple(unread)
