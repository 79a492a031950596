from __future__ import annotations

import math
from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from shmio.connectors.register_image import RegisterImage
from shmio.layout.model import ByteOrder
from shmio.layout.tags import place_tags
from shmio.layout.values.codec import Value, codec
from shmio.model.statuses import (
    BAD_DEVICE_FAILURE,
    BAD_OUT_OF_RANGE,
    BAD_WAITING_FOR_INITIAL_DATA,
    GOOD,
    RegisterStatus,
    StatusArea,
)
from tests.unit.statuses import COUNT, LAYOUT, ROW, SOURCE_NS, SPEED

AREA = StatusArea(LAYOUT)


def value(image: RegisterImage, index: int) -> object:
    return codec(LAYOUT.registers[index], LAYOUT.byte_order).decode(bytes(image))


def test_registers_wait_for_their_first_values() -> None:
    image = RegisterImage(LAYOUT)
    assert len(bytes(image)) == LAYOUT.size
    codes = {AREA.get(bytes(image), index).code for index in range(len(LAYOUT.registers))}
    assert codes == {BAD_WAITING_FOR_INITIAL_DATA}


def test_a_value_comes_with_its_time_and_status() -> None:
    image = RegisterImage(LAYOUT)
    image.put(ROW, [1, -2, 3, -4], SOURCE_NS, 0x40900000)
    assert value(image, ROW) == [1, -2, 3, -4]
    assert AREA.get(bytes(image), ROW) == RegisterStatus(0x40900000, SOURCE_NS)
    assert AREA.get(bytes(image), COUNT).code == BAD_WAITING_FOR_INITIAL_DATA


def test_a_register_that_turns_bad_keeps_its_value() -> None:
    image = RegisterImage(LAYOUT)
    image.put(SPEED, 2.5, SOURCE_NS)
    assert AREA.get(bytes(image), SPEED) == RegisterStatus(GOOD, SOURCE_NS)
    image.fail(SPEED, BAD_DEVICE_FAILURE, SOURCE_NS + 1)
    assert value(image, SPEED) == 2.5
    assert AREA.get(bytes(image), SPEED) == RegisterStatus(BAD_DEVICE_FAILURE, SOURCE_NS + 1)


def test_a_value_that_does_not_fit_its_type_turns_the_register_bad() -> None:
    image = RegisterImage(LAYOUT)
    image.put(COUNT, 7)
    wrongs: tuple[Value, ...] = (40_000, "seven", None, [1])
    for wrong in wrongs:
        image.put(COUNT, wrong)
        assert value(image, COUNT) == 7
        assert AREA.get(bytes(image), COUNT).code == BAD_OUT_OF_RANGE
    image.put(COUNT, 8)
    assert AREA.get(bytes(image), COUNT).code == GOOD


BATCHED = ("b", "a", "c", "d", "f", "e")
NUMBERS = {"n": "INT", "a": "LREAL", "b": "LREAL", "c": "REAL", "d": "REAL", "w": "INT", "e": "REAL", "f": "LREAL"}
_FLOATS = st.floats() | st.sampled_from([1e300, math.nan, 5, True, "x"])


@given(st.sampled_from(["big", "little"]), st.lists(st.lists(_FLOATS, min_size=6, max_size=6), min_size=1, max_size=3))
def test_a_batch_stores_what_single_calls_store(order: ByteOrder, rounds: list[list[Any]]) -> None:
    layout = place_tags("t", NUMBERS, order).with_statuses()
    indices = [layout.by_path[name] for name in BATCHED]
    together, single = RegisterImage(layout), RegisterImage(layout)
    batch = together.batch(indices)
    assert batch is not None
    for time, values in enumerate(rounds, SOURCE_NS):
        if not together.put_batch(batch, values, time):
            assert any(type(value) is not float or abs(value) > 3e38 for value in values)
            for index, value in zip(indices, values, strict=True):
                together.put(index, value, time)
        for index, value in zip(indices, values, strict=True):
            single.put(index, value, time)
        assert bytes(together) == bytes(single)


def test_only_numbers_of_one_type_form_a_batch() -> None:
    layout = place_tags("t", {**NUMBERS, "lamp": "BOOL", "row": "ARRAY[0..1] OF INT", "s": "STRING"}).with_statuses()
    image = RegisterImage(layout)
    for names in (["a", "n"], ["n", "lamp"], ["n", "row"], ["s", "s"]):
        assert image.batch([layout.by_path[name] for name in names]) is None
    counts = image.batch([layout.by_path[name] for name in ("n", "w")])
    assert counts is not None
    assert image.put_batch(counts, (7, -2))
    assert not image.put_batch(counts, (7, 40_000))
    assert [codec(register, layout.byte_order).decode(bytes(image)) for register in layout.registers[:6:5]] == [7, -2]
