from __future__ import annotations

from shmio.connectors.register_image import RegisterImage
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
