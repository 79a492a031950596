from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout
from shmio.layout.topic import find
from shmio.model.statuses import (
    BAD_NODE_ID_UNKNOWN,
    BAD_OUT_OF_RANGE,
    GOOD,
    UNCERTAIN,
    UNCERTAIN_LAST_USABLE_VALUE,
    Finding,
    RegisterStatus,
    StatusArea,
    character_missing,
    describe,
    standard,
    status_area,
)
from shmio.model.values import Quality

TEXT = b"""DATA_BLOCK DB5 STRUCT a : Bool; b : Bool; row : Array[1..20] of Bool; n : Word; list : Array[0..2] of Int;
    s : Struct x : Byte; y : Real; END_STRUCT; END_STRUCT; BEGIN END_DATA_BLOCK"""
PLAIN = compile_sources([Source("x.db", TEXT)]).layouts[0]


@pytest.fixture
def layout() -> Layout:
    return PLAIN.with_statuses()


@pytest.mark.parametrize(
    ("path", "of"),
    [
        ("a", "a"), ("b", "b"), ("row", "row"), ("row/1", "row"), ("row/20", "row"), ("row/9..12", "row"), ("n", "n"),
        ("n.%X3", "n"), ("n.%X12", "n"), ("list/0", "list"), ("list/2", "list"), ("list/1..2", "list"),
        ("s/x", "s/x"), ("s/x.%X7", "s/x"), ("s/y", "s/y"),
    ],
)  # fmt: skip
def test_a_part_has_the_status_of_its_register(layout: Layout, path: str, of: str) -> None:
    assert StatusArea(layout).index(find(layout, path)) == layout.by_path[of]


def test_statuses_of_neighbours_do_not_touch_each_other_or_the_values(layout: Layout) -> None:
    area, image, last = StatusArea(layout), bytearray(layout.size), len(layout.registers) - 1
    area.put(image, 2, RegisterStatus(0xFFFFFFFF, -1))
    others = [area.get(image, index) for index in range(last + 1) if index != 2]
    assert others == [RegisterStatus(GOOD, 0)] * last
    assert area.get(image, 2) == RegisterStatus(0xFFFFFFFF, -1)
    assert not any(image[: layout.status_offset])
    area.put(image, last, RegisterStatus(1, (1 << 63) - 1))
    assert len(image) == layout.size
    assert area.get(image, last) == RegisterStatus(1, (1 << 63) - 1)


@given(st.integers(0, 0xFFFFFFFF))
def test_the_quality_is_the_severity_of_the_code(code: int) -> None:
    layout = PLAIN.with_statuses()
    area, image = StatusArea(layout), bytearray(layout.size)
    area.put(image, 3, RegisterStatus(code, 0))
    expected = {0: Quality.GOOD, 1: Quality.UNCERTAIN}.get(code >> 30, Quality.BAD)
    assert area.quality(image, 3) is area.get(image, 3).quality is expected
    assert bool(area.get(image, 3).reason) is (expected is not Quality.GOOD)


def test_codes_have_names() -> None:
    assert describe(BAD_NODE_ID_UNKNOWN | 0x400) == "BadNodeIdUnknown (0x80340400)"
    assert describe(0x9FFF0000) == "status 0x9FFF0000"
    reason = RegisterStatus(UNCERTAIN_LAST_USABLE_VALUE, 0).reason
    assert reason == "the device reports UncertainLastUsableValue (0x40900000)"


def test_a_layout_without_a_status_area_has_none(layout: Layout) -> None:
    assert status_area(PLAIN) is None
    assert status_area(layout) is status_area(layout) is not None


def test_findings_of_a_source_have_a_severity_a_reason_and_a_standard_code() -> None:
    remedy = "set the source's key encoding to one that can"
    for code, quality, reason, expected in (
        (character_missing(3, "✓"), Quality.BAD,
         f"the register's encoding cannot hold '✓', which is character 3 of the text; {remedy}", BAD_OUT_OF_RANGE),
        (character_missing(300, "\U0001f600"), Quality.BAD,
         f"the register's encoding cannot hold a character, which is character 255 of the text; {remedy}",
         BAD_OUT_OF_RANGE),
        (Finding.UNKNOWN_QUALITY.code(512), Quality.UNCERTAIN,
         "the device states the quality 512, which has no meaning", UNCERTAIN),
        (Finding.UNREADABLE_TIME.code(), Quality.UNCERTAIN,
         "the device states a time that cannot be read, so the value has the time of its receipt", UNCERTAIN),
    ):  # fmt: skip
        status = RegisterStatus(code, 0)
        assert (status.quality, status.reason, standard(code)) == (quality, reason, expected)
    for code in (0, BAD_OUT_OF_RANGE, 0x80340400, 0xC0000000):
        assert standard(code) == code


def test_a_status_that_the_source_may_have_found_is_not_said_to_be_the_devices() -> None:
    reason = RegisterStatus(BAD_OUT_OF_RANGE, 0).reason
    assert reason == ("BadOutOfRange (0x803C0000), from the device or from the source, whose log then has the reason")
    assert RegisterStatus(BAD_NODE_ID_UNKNOWN, 0).reason == "the device reports BadNodeIdUnknown (0x80340000)"
