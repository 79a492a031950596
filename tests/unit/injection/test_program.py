"""Operations on images, compared with plain arithmetic, and errors of declarations."""

from __future__ import annotations

import math
import struct
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.config import Declaration
from shmio.errors import ConfigError
from shmio.injection import Program, compile_program
from shmio.injection.draw import SeededRandom
from shmio.injection.operations import Operation, OperationContext
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout
from shmio.layout.values.codec import Value, codec

TABLE = b"""
[registers]
int = "INT"
uint = "UINT"
lint = "LINT"
ulint = "ULINT"
real = "REAL"
lreal = "LREAL"
time = "TIME"
run = "BOOL"
lamps = "ARRAY[0..9] OF BOOL"
grid = "ARRAY[0..3] OF INT"
name = "STRING[6]"
day = "DATE"
"""
LAYOUT = compile_sources([Source("t.toml", TABLE)]).layouts[0]
DRAW = SeededRandom(1, "x")


def program(target: str | list[str], operation: str, **keys: Any) -> Program:
    declaration = msgspec.convert({"name": "x", "target": target, "operation": operation, **keys}, Declaration)
    return compile_program(declaration, {"t": LAYOUT}, {"t": 10_000_000})


def image_of(values: dict[str, Value], layout: Layout = LAYOUT) -> np.ndarray[Any, np.dtype[np.uint8]]:
    image = bytearray(layout.size)
    for path, value in values.items():
        codec(layout.registers[layout.by_path[path]], layout.byte_order).encode_into(value, image)
    return np.frombuffer(bytes(image), np.uint8).copy()


def value_of(path: str, image: np.ndarray[Any, np.dtype[np.uint8]]) -> Value:
    return codec(LAYOUT.registers[LAYOUT.by_path[path]], LAYOUT.byte_order).decode(image.tobytes())


def becomes(path: str, value: Value, operation: str, place: int = 0, /, **keys: Any) -> Value:
    """Return a register's value after an operation on the bits that ``path`` covers."""
    found = program(path, operation, **keys)
    image = image_of({path: value})
    before = image.copy()
    found.operate(DRAW).apply(image, OperationContext(1, place, place, 0))
    image = before ^ (before ^ image) & found.cover
    return value_of(path, image)


LIMITS = {"int": (-(2**15), 2**15 - 1), "uint": (0, 2**16 - 1), "lint": (-(2**63), 2**63 - 1), "ulint": (0, 2**64 - 1)}


@given(st.sampled_from(sorted(LIMITS)), st.data())
def test_whole_numbers_are_exact_and_limited_to_their_type(path: str, data: st.DataObject) -> None:
    least, most = LIMITS[path]
    value = data.draw(st.integers(least, most))
    by = data.draw(st.integers(-(2**60), 2**60))
    assert becomes(path, value, "offset", value=by) == min(max(value + by, least), most)
    low, high = sorted((data.draw(st.integers(-(2**50), 2**50)), data.draw(st.integers(-(2**50), 2**50))))
    clamped = min(max(value, low), high)
    assert becomes(path, value, "clamp", min=low, max=high) == min(max(clamped, least), most)


floats = st.floats(allow_nan=False, allow_infinity=False)


@given(floats, floats)
def test_reals_follow_ieee_754_and_are_limited_to_their_range(value: float, by: float) -> None:
    most = struct.unpack(">d", b"\x7f\xef" + b"\xff" * 6)[0]
    assert becomes("lreal", value, "offset", value=by) == min(max(value + by, -most), most)
    assert becomes("lreal", value, "scale", value=by) == min(max(value * by, -most), most)


def test_nan_stays_nan() -> None:
    for operation, keys in (("offset", {"value": 1}), ("scale", {"value": 2}), ("clamp", {"min": 0})):
        found = becomes("real", math.nan, operation, **keys)
        assert isinstance(found, float)
        assert math.isnan(found)
    set_nan = becomes("real", 1.0, "set", value="NaN")
    assert isinstance(set_nan, float)
    assert math.isnan(set_nan)


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        ("int", "16#FF", 255), ("real", 1.5, 1.5), ("run", True, True), ("run", "true", True), ("name", "abc", "abc"),
        ("time", "T#1s", 1000), ("day", "2024-02-29", "2024-02-29"), ("grid", [1, 2, 3, 4], [1, 2, 3, 4]),
        ("grid", "[1, 3(7)]", [1, 7, 7, 7]), ("ulint", 2**64 - 1, 2**64 - 1),
    ],
)  # fmt: skip
def test_set_takes_json_text_and_s7_literals(path: str, value: Any, expected: Value) -> None:
    empty: dict[str, Value] = {"name": "", "day": "1990-01-01", "grid": [0] * 4, "run": False}
    assert becomes(path, empty.get(path, 0), "set", value=value) == expected


def test_texts_are_set_and_drawn_in_the_encoding_of_their_register() -> None:
    layout = LAYOUT.with_encoding("gbk")
    offset = layout.registers[layout.by_path["name"]].offset
    for keys in ({"operation": "set", "value": "温"}, {"operation": "random", "values": ["温"]}):
        declaration = msgspec.convert({"name": "x", "target": "t/name", **keys}, Declaration)
        image = image_of({}, layout)
        found = compile_program(declaration, {"t": layout}, {"t": 10_000_000})
        found.operate(DRAW).apply(image, OperationContext(1, 0, 0, 0))
        assert image[offset : offset + 4].tobytes() == bytes.fromhex("06 02 ce c2"), keys


@given(st.integers(0, 1000), st.floats(0.001, 1000))
def test_noise_is_within_its_amplitude(place: int, amplitude: float) -> None:
    found = becomes("lreal", 10.0, "noise", place, amplitude=amplitude)
    assert isinstance(found, float)
    assert abs(found - 10) <= amplitude * (1 + 1e-9)
    assert found == becomes("lreal", 10.0, "noise", place, amplitude=amplitude)


@given(st.integers(0, 1000), st.integers(-100, 100), st.integers(0, 50))
def test_random_is_from_its_range_or_set(place: int, least: int, width: int) -> None:
    whole = becomes("int", 0, "random", place, min=least, max=least + width)
    assert isinstance(whole, int)
    assert least <= whole <= least + width
    real = becomes("lreal", 0, "random", place, min=least, max=least + width)
    assert isinstance(real, float)
    assert least <= real <= least + width
    assert becomes("name", "", "random", place, values=["a", "bc"]) in ("a", "bc")
    assert becomes("run", False, "random", place, values=[True]) is True


def test_every_value_of_a_range_occurs_and_registers_draw_independently() -> None:
    assert {becomes("int", 0, "random", place, min=1, max=3) for place in range(100)} == {1, 2, 3}
    assert {becomes("run", False, "random", place, values=[True, False]) for place in range(50)} == {True, False}
    grids = [becomes("grid", [0] * 4, "random", place, min=0, max=1000) for place in range(5)]
    assert all(isinstance(grid, list) and len({str(item) for item in grid}) > 2 for grid in grids)
    lamps = [becomes("lamps", [False] * 10, "random", place, values=[True, False]) for place in range(20)]
    assert len({str(lamp) for lamp in lamps}) == 20


@given(st.integers(0, 2**15 - 1), st.sets(st.integers(0, 15), min_size=1), st.integers(0, 100))
def test_flip_inverts_the_given_bits_or_one_random_bit(value: int, bits: set[int], place: int) -> None:
    assert becomes("uint", value, "flip", bits=sorted(bits)) == value ^ sum(1 << bit for bit in bits)
    one = becomes("uint", value, "flip", place)
    assert isinstance(one, int)
    assert (one ^ value).bit_count() == 1
    assert becomes("run", True, "flip") is False


def test_random_flip_reaches_every_covered_bit() -> None:
    assert {becomes("uint", 0, "flip", place) for place in range(300)} == {1 << bit for bit in range(16)}


moments = st.lists(st.integers(0, 3), min_size=1, max_size=40)


def walk(operation: Operation, steps: list[int]) -> list[tuple[int, int]]:
    """Return (device's value, shown value) of each image. ``steps`` has the number of cycles between images."""
    seen = []
    cycle = 0
    for number, step in enumerate(steps):
        cycle += step
        image = image_of({"uint": cycle})
        operation.apply(image, OperationContext(1, cycle, cycle, cycle * 10))
        shown = value_of("uint", image)
        assert isinstance(shown, int)
        seen.append((cycle, shown))
        again = image_of({"uint": cycle})
        operation.apply(again, OperationContext(1, cycle, cycle, cycle * 10))
        assert value_of("uint", again) == shown, f"image {number}: the same cycle again gives the same value"
    return seen


@given(moments, st.integers(1, 6))
def test_delay_shows_the_newest_value_that_is_old_enough(steps: list[int], cycles: int) -> None:
    for keys in ({"delay_cycles": cycles}, {"delay_ms": cycles * 1e-5}):
        operation = program("t/uint", "delay", **keys).operate(DRAW)
        seen = walk(operation, steps)
        first = seen[0][0]
        for place, (cycle, shown) in enumerate(seen):
            due = [other for other, _ in seen[: place + 1] if cycle - other >= cycles]
            assert shown == (due[-1] if due else first)


@given(moments)
def test_freeze_and_drop_keep_the_first_value(steps: list[int]) -> None:
    for name in ("freeze", "drop"):
        operation = program("t/uint", name).operate(DRAW)
        first = steps[0]
        assert {shown for _, shown in walk(operation, steps)} == {first}
        operation.begin()
        assert walk(operation, [50])[0] == (50, 50), "a new activation keeps a new value"


@pytest.mark.parametrize(
    ("target", "operation", "keys", "message"),
    [
        ("t/none", "freeze", {}, "target: t/none: "),
        ("t/name", "offset", {"value": 1}, "target: t/name is STRING[6], but offset is for numbers"),
        ("t/run", "noise", {"amplitude": 1}, "target: t/run is BOOL, but noise is for numbers"),
        ("t/int", "set", {"value": 40000}, "value: int: "),
        ("t/int", "set", {"value": "warm"}, "value: int: "),
        ("t/grid", "set", {"value": [1, 2]}, "value: grid: expected a list of 4 elements"),
        ("t/int", "offset", {"value": "1"}, "value: expected a number"),
        ("t/int", "offset", {"value": True}, "value: expected a number"),
        ("t/int", "random", {"values": [1, "x"]}, "values[1]: INT: "),
        ("t/int", "random", {"min": 0.2, "max": 0.8}, "min: there is no whole number from 0.2 to 0.8"),
        ("t/int", "flip", {"bits": [16]}, "bits: INT has bits 0 to 15, not 16"),
        ("t/run", "flip", {"bits": [1]}, "bits: BOOL has bits 0 to 0, not 1"),
        ("t/int", "delay", {"delay_ms": 200_000}, "delay_ms: the delay is 20000 cycles"),
        ("t/int", "delay", {"delay_cycles": 10_001}, "delay_cycles: the delay is 10001 cycles"),
        ("t/int", "freeze", {"when": "t/int >"}, "when: at character 8: expected a register or a number"),
        ("t/int", "freeze", {"when": "t/nothing"}, "when: t/nothing: "),
        ("t/int", "freeze", {"when": "t/name"}, "when: t/name: STRING[6] is neither a number nor a BOOL"),
        (
            "t/int",
            "freeze",
            {"when": "t/grid"},
            "when: t/grid is an array, but a condition reads single values; name one of its elements",
        ),
        ("t/int", "freeze", {"when": "t/int/in"}, "leave out /in"),
    ],
)
def test_faulty_declaration_is_refused_by_key(target: str, operation: str, keys: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        program(target, operation, **keys)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_large_target_is_refused_for_operations_on_single_values() -> None:
    large = compile_sources([Source("l.toml", b'[registers]\nall = "ARRAY[0..5000] OF INT"\n')]).layouts[0]
    declared = msgspec.convert({"name": "x", "target": "l", "operation": "offset", "value": 1}, Declaration)
    with pytest.raises(ConfigError, match="more than 4096 single values"):
        compile_program(declared, {"l": large}, {"l": 1})
    compile_program(
        msgspec.convert({"name": "x", "target": "l", "operation": "freeze"}, Declaration), {"l": large}, {"l": 1}
    )


numbers = st.one_of(st.integers(-(2**63), 2**64 - 1), floats, st.sampled_from([0, 1, -1, 1e308, -1e308, 5e-324]))
OPERANDS: dict[str, st.SearchStrategy[dict[str, Any]]] = {
    "set": st.fixed_dictionaries({"value": numbers}),
    "offset": st.fixed_dictionaries({"value": numbers}),
    "scale": st.fixed_dictionaries({"value": numbers}),
    "clamp": st.tuples(numbers, numbers).map(lambda pair: {"min": min(pair), "max": max(pair)}),
    "noise": st.fixed_dictionaries(
        {"amplitude": st.floats(5e-324, 1e300), "distribution": st.sampled_from(["uniform", "gaussian"])}
    ),
    "random": st.tuples(numbers, numbers).map(lambda pair: {"min": min(pair), "max": max(pair)}),
    "freeze": st.just({}),
    "delay": st.one_of(
        st.fixed_dictionaries({"delay_ms": st.floats(0.001, 1000)}),
        st.fixed_dictionaries({"delay_cycles": st.integers(1, 20)}),
    ),
    "drop": st.just({}),
    "flip": st.one_of(st.just({}), st.fixed_dictionaries({"bits": st.lists(st.integers(0, 15), min_size=1)})),
}
places = st.lists(st.tuples(st.integers(0, 3), st.binary(min_size=LAYOUT.size, max_size=LAYOUT.size)), max_size=6)


@given(
    st.sampled_from(sorted(OPERANDS)).flatmap(lambda name: st.tuples(st.just(name), OPERANDS[name])),
    st.lists(
        st.sampled_from([register.path for register in LAYOUT.registers] + ["*", "grid/1..2", "int.%X3"]), min_size=1
    ),
    places,
)
def test_accepted_operation_runs_on_any_bytes(
    operation: tuple[str, dict[str, Any]], targets: list[str], images: list[tuple[int, bytes]]
) -> None:
    """An exception in an operation would end the source's process. In tests, warnings are errors."""
    name, keys = operation
    try:
        found = program([f"t/{target}" for target in targets], name, **keys)
    except ConfigError:
        return
    running = found.operate(DRAW)
    running.begin()
    cycle = 0
    for step, data in images:
        cycle += step
        image = np.frombuffer(data, np.uint8).copy()
        if step % 2:
            running.passed(image, OperationContext(1, cycle, cycle, cycle * 10_000_000))
        running.apply(image, OperationContext(1, cycle, cycle, cycle * 10_000_000))
        assert image.shape == (LAYOUT.size,)
        assert image.dtype == np.uint8
