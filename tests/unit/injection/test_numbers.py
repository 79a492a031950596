"""The C extension reads and changes numbers as Python's struct does, and survives any arguments."""

from __future__ import annotations

import math
import operator
import struct
from collections.abc import Callable, Sequence
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.injection._numbers import Number, change_all, evaluate, evaluate_all, uniform
from shmio.injection.condition import parse
from shmio.injection.draw import Purpose
from shmio.injection.operations import ADD, GAUSSIAN, MULTIPLY, UNIFORM

CODES = "bBhHiIqQfd"
formats = st.builds("{}{}".format, st.sampled_from("<>"), st.sampled_from(CODES))


@given(formats, st.binary(min_size=20, max_size=20), st.integers(0, 12))
def test_decodes_as_struct(format_: str, image: bytes, offset: int) -> None:
    (expected,) = struct.unpack_from(format_, image, offset)
    found = Number(format_, offset).decode(image)
    assert type(found) is type(expected)
    assert found == expected or (math.isnan(found) and math.isnan(expected))


@given(st.binary(min_size=3, max_size=3), st.integers(0, 2), st.integers(0, 7))
def test_decodes_bits(image: bytes, offset: int, bit: int) -> None:
    assert Number("<?", offset, bit).decode(image) is bool(image[offset] >> bit & 1)


@given(st.sampled_from("<>"), st.integers(-(2**31), 2**31 - 1), st.floats(-(2.0**34), 2.0**34))
def test_rounds_as_python_and_clamps(order: str, value: int, by: float) -> None:
    image = bytearray(struct.pack(f"{order}xi", value))
    change_all(image, ((Number(f"{order}i", 1), ADD, by, 0, 0, 0),), 0)
    assert struct.unpack(f"{order}xi", image) == (min(max(round(value + by), -(2**31)), 2**31 - 1),)


@given(st.sampled_from("<>"), st.floats(width=32), st.floats())
def test_a_real_is_clamped_but_stays_nan(order: str, value: float, by: float) -> None:
    image = bytearray(struct.pack(f"{order}f", value))
    change_all(image, ((Number(f"{order}f", 0), MULTIPLY, by, 0, 0, 0),), 0)
    (found,) = struct.unpack(f"{order}f", image)
    if math.isnan(value * by):
        assert math.isnan(found)
    else:
        assert found == struct.unpack("f", struct.pack("f", min(max(value * by, -REAL_MAX), REAL_MAX)))[0]


REAL_MAX = struct.unpack("<f", b"\xff\xff\x7f\x7f")[0]


def test_an_integer_cannot_become_nan() -> None:
    with pytest.raises(ValueError, match="NaN"):
        change_all(bytearray(2), ((Number("<h", 0), MULTIPLY, math.inf, 0, 0, 0),), 0)


@given(st.integers(0, 2**64 - 1), st.integers(1, 1000), st.integers(0, 1000), st.floats(-1e6, 1e6))
def test_changes_follow_one_another(key: int, run: int, cycle: int, amount: float) -> None:
    image, number = bytearray(8), Number("<d", 0)
    changes = [(ADD, 3.0), (MULTIPLY, amount), (UNIFORM, amount), (GAUSSIAN, amount)]
    change_all(image, tuple((number, kind, by, key, run, cycle) for kind, by in changes), cycle + 7)
    value, angle = uniform(key, run, 7, Purpose.VALUE), uniform(key, run, 7, Purpose.ANGLE)
    noise = math.sqrt(-2 * math.log(1 - value)) * math.cos(math.tau * angle)
    assert struct.unpack("<d", image) == (3.0 * amount + (2 * value - 1) * amount + noise * amount,)


@pytest.mark.parametrize(
    "wrong",
    [
        (), None, (None, 0, 1, 0, 0, 0), (Number("<d", 0), 0, 1, 0, 0), (Number("<d", 0), 0, "1", 0, 0, 0),
        (Number("<d", 0), 9, 1, 0, 0, 0), (Number("<d", 0), "0", 1, 0, 0, 0), (Number("<d", 0), 2, 1, 0, None, 0),
        (Number("<d", 1), 0, 1, 0, 0, 0), (Number("<q", 0), 0, 1, 0, 0, 0), (Number("<?", 0), 0, 1, 0, 0, 0),
        (cast("Any", Number).__new__(Number), 0, 1, 0, 0, 0), (Number("<d", 0), 0, 10**400, 0, 0, 0),
    ],
)  # fmt: skip
def test_refuses_what_is_no_change(wrong: Any) -> None:
    image = bytearray(8)
    with pytest.raises((TypeError, ValueError, OverflowError)):
        change_all(image, (wrong,), 0)
    assert not any(image)


@pytest.mark.parametrize(
    ("format_", "offset", "bit"), [("f", 0, 0), ("=f", 0, 0), ("<x", 0, 0), ("<", 0, 0), ("<f", -1, 0), ("<?", 0, 8)]
)
def test_refuses_what_is_no_number(format_: str, offset: int, bit: int) -> None:
    with pytest.raises(ValueError, match=r"format|offset|bit"):
        Number(format_, offset, bit)


def test_touches_no_byte_outside_the_image() -> None:
    for offset in (1, 2**62):
        number = Number("<i", offset)
        with pytest.raises(ValueError, match="outside"):
            number.decode(bytes(4))
        with pytest.raises(ValueError, match="outside"):
            change_all(bytearray(4), ((number, ADD, 1, 0, 0, 0),), 0)
    with pytest.raises(BufferError):
        change_all(bytes(4), (), 0)
    with pytest.raises(ValueError, match="outside"):
        cast("Any", Number).__new__(Number).decode(bytes(4))


def test_conditions_read_the_images_of_sources() -> None:
    small, flag = ("a", Number("<h", 0)), ("b", Number("<?", 0, 1))
    conditions: Any = (
        None,
        (*parse("x > 2")[:2], (small,), {}),
        (*parse("x")[:2], (flag,), {}),
        (*parse("not x")[:2], (("c", Number("<b", 0)),), {}),
    )
    assert evaluate_all(conditions, {"a": b"\3\0", "b": b"\2", "c": None}) == [True, True, True, False]
    assert evaluate_all(conditions, {"a": b"\2\0", "b": b"\5", "c": b"\0"}) == [True, False, False, True]
    with pytest.raises(KeyError):
        evaluate_all(conditions, {"a": bytes(3)})
    with pytest.raises(ValueError, match="outside"):
        evaluate_all(conditions, {"a": b"", "b": b"", "c": b""})


@pytest.mark.parametrize(
    ("codes", "operands", "error"),
    [(b"\1", (3,), IndexError), (b"\1", (0.5,), TypeError), (b"\0", (), ValueError), (b"", (), ValueError)],
)
def test_refuses_wrong_operands(codes: bytes, operands: tuple[Any, ...], error: type[Exception]) -> None:
    assert evaluate(codes, operands, [1, None], {}) is None
    with pytest.raises(error):
        evaluate(codes, operands, [1], {})


@pytest.mark.parametrize("wrong", [(), ("a",), "ab", 1, (b"\0", (1,), ("a",), {}), (b"\0", (1,), (), ())])
def test_refuses_what_is_no_condition(wrong: Any) -> None:
    with pytest.raises((IndexError, SystemError, TypeError)):
        evaluate_all((wrong,), {})


OPERATORS: list[Callable[..., object]] = [
    operator.not_, operator.neg, abs,
    lambda before, now: not before and bool(now), lambda before, now: bool(before) and not now, operator.ne,
    lambda left, right: bool(left) or bool(right), lambda left, right: bool(left) and bool(right),
    operator.lt, operator.le, operator.eq, operator.ne, operator.gt, operator.ge,
    operator.add, operator.sub, operator.mul, operator.truediv, operator.mod,
]  # fmt: skip
"""What the codes from 2 on mean: three with one value, three edges, then those with two values."""


def evaluate_slowly(codes: bytes, operands: Sequence[Any], values: Sequence[Any], seen: dict[Any, Any]) -> bool | None:
    """Do what :func:`evaluate` does, for the test to compare."""
    if not 1 <= len(codes) <= 256:
        raise ValueError
    stack: list[Any] = []
    try:
        for code, operand in zip(codes, operands, strict=True):
            if code > 20 or len(stack) < (code > 1) + (code > 7):
                raise ValueError
            if code < 2:
                stack.append(values[operand] if code else operand)
            elif code in (5, 6, 7):
                now = stack.pop()
                stack.append(operand in seen and OPERATORS[code - 2](seen[operand], now))
                seen[operand] = now
            else:
                right = [stack.pop() for _ in range(1 if code < 5 else 2)]
                stack.append(OPERATORS[code - 2](*reversed(right)))
    except ArithmeticError:
        seen.clear()
        return None
    return bool(stack[-1])


numbers = st.integers(-2, 2) | st.floats() | st.booleans()


@st.composite
def whole_programs(draw: st.DrawFn) -> bytes:
    """Codes of which each finds enough values on the stack."""
    codes, depth = bytearray(), 0
    for _ in range(draw(st.integers(1, 20))):
        codes.append(draw(st.sampled_from(range([2, 8, 21][min(depth, 2)]))))
        depth += 1 if codes[-1] < 2 else -(codes[-1] > 7)
    return bytes(codes)


@given(whole_programs() | st.lists(st.sampled_from(range(22)), max_size=300).map(bytes), st.data())
def test_any_steps_mean_the_same_as_in_python_or_are_refused(codes: bytes, data: st.DataObject) -> None:
    operands = tuple(data.draw(st.integers(0, 2) if code == 1 else numbers) for code in codes)
    seen: tuple[dict[Any, Any], dict[Any, Any]] = {}, {}
    for _ in range(3):  # the edges compare
        values = data.draw(st.lists(numbers, min_size=1, max_size=3))
        try:
            expected = evaluate_slowly(codes, operands, values, seen[0])
        except (ValueError, IndexError) as error:
            with pytest.raises(type(error)):
                evaluate(codes, operands, values, seen[1])
        else:
            assert evaluate(codes, operands, values, seen[1]) is expected
        assert repr(seen[0]) == repr(seen[1])
