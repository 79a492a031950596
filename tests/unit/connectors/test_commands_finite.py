"""NaN and infinities do not reach a device, however they are written."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.connectors.commands import FiniteCheck
from shmio.layout.model import ByteOrder, Layout, Register
from shmio.layout.values.write import Write, apply, encode

REGISTERS = (
    Register("speed", "REAL", (), 2, None, 4, 1),
    Register("count", "INT", (), 6, None, 2, 1),
    Register("axes/1/way", "LREAL", ((0, 1), (-1, 0)), 8, None, 32, 4),
    Register("free", "REAL", ((1, 2),), 40, None, 8, 2),
)
LITTLE_OR_BIG: st.SearchStrategy[ByteOrder] = st.sampled_from(["big", "little"])
FORMS = ((2, "f"), *((at, "d") for at in (8, 16, 24, 32)), (40, "f"))


def layout(order: ByteOrder = "big") -> Layout:
    return Layout("DB1", 1, 48, False, REGISTERS, order)


@pytest.mark.parametrize("value", [math.nan, -math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("order", ["big", "little"])
def test_nan_and_infinity_are_refused_by_path(value: float, order: ByteOrder) -> None:
    block = layout(order)
    finite = FiniteCheck(block, ["free/2"])
    speed, _, way, free = REGISTERS
    for register, new, path in (
        (speed, value, "speed"),
        (way, [[1.0, 2.0], [value, 3.0]], "axes/1/way/1/-1"),
        (block.element(way, (0, 0)), value, "axes/1/way/0/0"),
        (free, [value, 1.0], "free/1"),
    ):
        reason = finite.refusal(encode(register, new, order))
        assert reason.startswith(f"{path}: NaN and infinities are written only if")
        assert "`allow_nonfinite`" in reason
    assert not finite.refusal(encode(free, [1.0, value], order))
    assert not FiniteCheck(block, ["**"]).refusal(encode(way, [[value, value], [value, value]], order))


@given(LITTLE_OR_BIG, st.floats(allow_nan=False, allow_infinity=False, width=32))
def test_finite_numbers_are_accepted(order: ByteOrder, value: float) -> None:
    block = layout(order)
    finite = FiniteCheck(block, [])
    assert not finite.refusal(encode(REGISTERS[0], value, order))
    assert not finite.refusal(encode(REGISTERS[2], [[value, -value], [0.0, 1.0]], order))
    assert not finite.refusal([Write(6, 0, b"\xff\xff"), Write(0, 0, b"\xff\xff")]), (
        "no REAL or LREAL is at these offsets"
    )


BYTES = st.sampled_from(b"\0\x3f\x7f\x80\xbf\xc0\xf0\xfe\xff")
WRITES = st.one_of(
    st.builds(lambda at, data: Write(at, 0, bytes(data)), st.integers(0, 40), st.lists(BYTES, min_size=1, max_size=8)),
    st.builds(lambda at, bit, on: Write(at, 1 << bit, bytes([on << bit])), st.integers(0, 47), st.integers(0, 7),
              st.booleans()),
)  # fmt: skip


@given(LITTLE_OR_BIG, st.lists(WRITES, max_size=40))
def test_partial_writes_cannot_assemble_nan_or_infinity(order: ByteOrder, writes: list[Write]) -> None:
    finite = FiniteCheck(layout(order), ["free"])
    image = bytearray(48)
    for write in writes:
        if not finite.refusal([write]):
            apply(write, image)
    sign = ">" if order == "big" else "<"
    for at, form in FORMS[:-1]:
        assert math.isfinite(struct.unpack_from(sign + form, image, at)[0])
