"""The chain of injections: what consumers see, and which injection takes a write."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.connectors.injection_layers import MAX_INJECTIONS, Layer, LayerStack, Owner, covering, shadow
from shmio.layout.values.write import Write
from shmio.segment import Direction

SIZE = 8
OWNER = Owner(4, 100)


def layer(
    number: int, *bits: Write, direction: Direction = Direction.OUT, priority: int = 0, values: bytes = bytes(SIZE)
) -> Layer:
    cover = covering(SIZE, bits)
    return Layer(number, direction, priority, False, f"s{number}", OWNER, cover, np.frombuffer(values, np.uint8).copy())


def whole(offset: int, size: int) -> Write:
    return Write(offset, 0, b"\xff" * size)


def bit(offset: int, number: int) -> Write:
    return Write(offset, 1 << number, bytes([1 << number]))


def stacked(*layers: Layer) -> LayerStack:
    injections = LayerStack(SIZE)
    for one in layers:
        assert injections.add(one) == ""
    return injections


def test_image_without_injections_is_unchanged() -> None:
    assert stacked().effective(bytes(SIZE)) is None
    assert stacked(layer(1, whole(0, 2), direction=Direction.IN)).effective(bytes(SIZE)) is None


def test_injection_changes_only_covered_bits() -> None:
    injections = stacked(layer(1, whole(2, 2), bit(5, 3), values=b"\xaa" * SIZE))
    assert injections.effective(b"\x11" * SIZE) == b"\x11\x11\xaa\xaa\x11\x19\x11\x11"
    assert injections.effective(b"\xff" * SIZE) == b"\xff\xff\xaa\xaa\xff\xff\xff\xff"


def test_the_highest_priority_is_outermost_then_the_newest() -> None:
    injections = stacked(
        layer(1, whole(0, 4), priority=5, values=b"\x01" * SIZE),
        layer(2, whole(1, 4), values=b"\x02" * SIZE),
        layer(3, whole(2, 4), values=b"\x03" * SIZE),
        layer(4, whole(3, 1), priority=5, values=b"\x04" * SIZE),
    )
    assert [one.id for one in injections.layers] == [2, 3, 1, 4]
    assert injections.effective(bytes(SIZE)) == b"\x01\x01\x01\x04\x03\x03\x00\x00"
    assert [one.id for one in injections.lift(lambda one: one.id in (1, 4))] == [1, 4]
    assert injections.effective(bytes(SIZE)) == b"\x00\x02\x03\x03\x03\x03\x00\x00"


def test_shadow_accepts_only_values_that_it_covers() -> None:
    one = layer(1, whole(0, 2), bit(4, 0))
    assert shadow(one, [Write(0, 0, b"\x12\x34"), Write(4, 1, b"\xff")]) == ""
    assert stacked(one).effective(bytes(SIZE)) == b"\x12\x34\0\0\x01\0\0\0"
    for beyond in (Write(1, 0, b"\1\1"), Write(4, 2, b"\2"), Write(4, 0, b"\1"), Write(SIZE, 0, b"\1")):
        assert "not covered by the injection s1" in shadow(one, [Write(0, 0, b"\x99"), beyond])
    assert stacked(one).effective(bytes(SIZE)) == b"\x12\x34\0\0\x01\0\0\0", "a refused value has no effect"


def test_write_is_diverted_to_the_outermost_injection() -> None:
    inner = layer(1, whole(0, 4), direction=Direction.IN)
    outer = layer(2, whole(2, 1), bit(6, 1), direction=Direction.IN, priority=1)
    injections = stacked(inner, outer, layer(3, whole(0, 8)))
    taken, left, data, by = injections.divert(Write(1, 0, b"abcde"), None)
    assert taken == [(outer, [Write(2, 0, b"b")]), (inner, [Write(1, 0, b"a"), Write(3, 0, b"c")])]
    assert (left, data, by) == (b"\0\0\0\xff\xff", b"abcde", None)
    assert injections.divert(Write(2, 0, b"x"), outer)[:2] == ([(inner, [Write(2, 0, b"x")])], b"\0")
    assert injections.divert(Write(2, 0, b"x"), inner)[:2] == ([], b"\xff")
    assert injections.divert(Write(6, 2, b"\2"), None)[:2] == ([(outer, [Write(6, 2, b"\2")])], b"\0")
    assert injections.divert(Write(6, 4, b"\4"), None)[:2] == ([], b"\4")


def test_invalid_injections_are_refused() -> None:
    injections = stacked(layer(1, whole(0, 1)))
    assert "injection 1 exists already" in injections.add(layer(1, whole(0, 1)))
    with pytest.raises(ValueError, match="byte 8 lies outside"):
        covering(SIZE, [whole(6, 3)])
    for number in range(2, MAX_INJECTIONS + 1):
        assert injections.add(layer(number, whole(0, 1))) == ""
    assert "64 injections cover" in injections.add(layer(99, whole(0, 1)))


def has(parts: list[Write], at: int, mask: int, byte: int) -> bool:
    """Return whether the writes contain this bit with the value that it has in ``byte``."""
    return any(
        offset <= at < offset + len(part) and (bits or 0xFF) & mask and (part[at - offset] ^ byte) & mask == 0
        for offset, bits, part in parts
    )


images = st.binary(min_size=SIZE, max_size=SIZE)


@given(images, st.lists(st.tuples(images, images, st.integers(-2, 2), st.sampled_from(Direction)), max_size=5), images)
def test_each_bit_belongs_to_the_outermost_layer_that_covers_it(
    raw: bytes, layers: list[tuple[bytes, bytes, int, Direction]], data: bytes
) -> None:
    injections = stacked(
        *(
            layer(number, Write(0, 0, cover), values=values, priority=priority, direction=direction)
            for number, (cover, values, priority, direction) in enumerate(layers)
        )
    )
    effective = injections.effective(raw) or raw
    taken, left, _, _ = injections.divert(Write(0, 0, data), None)
    got = {one.id: parts for one, parts in taken}
    order = sorted(range(len(layers)), key=lambda number: (layers[number][2], number))
    for at in range(SIZE):
        for mask in (1 << shift for shift in range(8)):
            over = [n for n in order if layers[n][0][at] & mask]
            outs = [n for n in over if layers[n][3] is Direction.OUT]
            ins = [n for n in over if layers[n][3] is Direction.IN]
            assert effective[at] & mask == (layers[outs[-1]][1] if outs else raw)[at] & mask
            assert bool(left[at] & mask) is not bool(ins)
            holders = [number for number, parts in got.items() if has(parts, at, mask, data[at])]
            assert holders == ins[-1:]
