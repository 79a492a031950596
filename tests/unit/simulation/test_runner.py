from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from shmio.errors import ConfigError, LayoutError, ModelError, PathError, ShmioError, ValueRangeError
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.layout.values.write import Write, encode
from shmio.simulation import InOut, Input, Model, ModelRunner, Output, Parameter, layout_of
from tests.unit.simulation.plant import Belt

STEP_NS = 50_000_000


def value(runner: ModelRunner, path: str, image: bytes | None = None) -> Any:
    register = find(runner.layout, path)
    return codec(register, runner.layout.byte_order).decode(runner.image if image is None else image)


def set_to(runner: ModelRunner, path: str, new: object) -> str:
    (said,) = runner.write(encode(find(runner.layout, path), new, runner.layout.byte_order))
    return said


def step(runner: ModelRunner, number: int = 1) -> bytes:
    return runner.step(number * STEP_NS, STEP_NS)


def test_begins_with_the_declared_values() -> None:
    runner = ModelRunner(Belt)
    image = runner.begin()
    assert [value(runner, path, image) for path in ("speed", "label", "drives/main", "raw", "parts/box/width")] == [
        0.5, "empty", 7, [1, 2, 3, 4], 0.25,
    ]  # fmt: skip
    assert image == runner.image


def test_a_step_computes_the_whole_image() -> None:
    runner = ModelRunner(Belt)
    image = step(runner)
    assert value(runner, "position", image) == pytest.approx(0.025)
    assert value(runner, "barriers", image) == [True, False, False]
    assert value(runner, "label", image) == "0.05 s"
    assert value(runner, "drives/main", image) == 8
    assert value(runner, "raw", image) == [4, 3, 2, 1]
    assert value(runner, "parts/box/corners", image) == [0, 0]
    assert value(runner, "parts/box/width", image) == 0.25
    assert image == runner.image


def test_written_values_take_effect_at_the_next_step() -> None:
    runner = ModelRunner(Belt)
    step(runner)
    assert [set_to(runner, path, new) for path, new in {"speed": 1.5, "drives/main": -3, "raw/2": 9}.items()] == [
        ""
    ] * 3
    assert (value(runner, "speed"), value(runner, "drives/main"), value(runner, "raw")) == (0.5, 8, [4, 3, 2, 1])
    step(runner, 2)
    assert (value(runner, "speed"), value(runner, "drives/main"), value(runner, "raw")) == (1.5, -2, [4, 9, 2, 1])
    assert value(runner, "position") == pytest.approx(0.1)


def test_a_bit_is_written_alone() -> None:
    (layout,) = compile_sources(
        [Source("x.db", b"DATA_BLOCK DB1 STRUCT a : Bool; b : Bool; c : Bool; END_STRUCT; BEGIN END_DATA_BLOCK")]
    ).layouts

    class Bits(Model):
        a = Input("BOOL")
        b = Output("BOOL")

        def step(self, time_s: float, dt_s: float) -> None:
            self.b = not self.a

    runner = ModelRunner(Bits, layout)
    assert runner.write([Write(0, 1, b"\xff"), Write(0, 4, b"\xff")]) == ["", ""]
    assert (
        runner.write([Write(0, 2, b"\xff"), Write(0, 0, b"\xff")])
        == ["the model computes b: outputs cannot be written; shmio inject can show another value"] * 2
    )
    assert step(runner) == b"\x05\x00"
    assert runner.write([Write(0, 1, b"\0"), Write(0, 4, b"\0")]) == ["", ""]
    assert step(runner, 2) == b"\x02\x00"


def test_outputs_are_not_written() -> None:
    runner = ModelRunner(Belt)
    told = "the model computes position: outputs cannot be written; shmio inject can show another value"
    assert set_to(runner, "position", 1.0) == told
    assert set_to(runner, "parts/box/corners", [1, 2]).startswith("the model computes parts/box/corners")
    whole = runner.write([Write(0, 0, bytes(runner.layout.size)), Write(runner.layout.size - 1, 0, b"ab")])
    assert [said.partition(":")[0] for said in whole] == [
        "the model computes position",
        f"the write is outside the block of {runner.layout.size} bytes",
    ]
    assert value(runner, "position", step(runner)) == pytest.approx(0.025)


def test_connected_values_are_inputs_of_the_step() -> None:
    runner = ModelRunner(Belt)
    assert runner.inputs == ("speed", "stop", "drives/main", "raw")
    runner.connect({"speed": 2, "drives/main": 40})
    step(runner)
    assert (value(runner, "speed"), value(runner, "position"), value(runner, "drives/main")) == (2, 0.1, 41)
    runner.connect({"stop": True})
    step(runner, 2)
    assert (value(runner, "speed"), value(runner, "position")) == (2, 0.1)


@pytest.mark.parametrize(
    ("values", "error", "message"),
    [
        ({"position": 1}, PathError, "unknown input 'position' of model .*; valid: speed, stop, drives/main, raw"),
        ({"speed": "fast"}, ValueRangeError, "speed: REAL: expected a number, found 'fast'"),
        ({"drives/main": 1e6}, ValueRangeError, "drives/main: INT: 1000000.0 is out of range"),
        ({"speed": None}, ValueRangeError, "speed: REAL: expected a number, found None"),
    ],
)
def test_a_connection_that_does_not_fit_is_named(
    values: dict[str, object], error: type[ShmioError], message: str
) -> None:
    with pytest.raises(error, match=message):
        ModelRunner(Belt).connect(values)


def test_parameters_are_given_by_the_configuration() -> None:
    runner = ModelRunner(Belt, parameters={"length_m": 0.02})
    assert value(runner, "position", step(runner)) == pytest.approx(0.005)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"length": 1}, r"^parameters\.length: unknown parameter 'length' of model Belt; did you mean 'length_m'\?$"),
        ({"length_m": "long"}, r"^parameters.length_m: LREAL: expected a number, found 'long'$"),
        ({"speed": 1}, r"^parameters\.speed: unknown parameter 'speed' of model Belt"),
    ],
)
def test_a_wrong_parameter_is_named(given: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ModelRunner(Belt, parameters=given)


def film(seed: int) -> list[bytes]:
    runner = ModelRunner(Belt, parameters={"noise_m": 0.5}, seed=seed)
    images = [runner.begin()]
    for number in range(1, 50):
        if number % 7 == 0:
            set_to(runner, "speed", number / 10)
        images.append(step(runner, number))
    return images


def test_the_same_steps_and_seed_give_the_same_bytes() -> None:
    assert film(1) == film(1)
    assert film(1) != film(2)


class Fragile(Model):
    """A model that fails in the way that ``how`` names."""

    how = Input("INT")
    value = Output("INT", 5)
    row = Output("ARRAY[0..1] OF REAL")
    limit = Parameter("INT", 1)

    def step(self, time_s: float, dt_s: float) -> None:
        self.value = 6
        fail: dict[int, Callable[[], object]] = {
            1: lambda: 1 / 0,
            2: lambda: setattr(self, "value", 40_000),
            3: lambda: setattr(self, "how", 1),
            4: lambda: setattr(self, "limit", 1),
            5: lambda: self.row.__setitem__(0, 1.0),
            6: lambda: sys.exit(3),
            7: lambda: setattr(self, "row", [1.0]),
        }
        if self.how:
            fail[self.how]()


@pytest.mark.parametrize(
    ("how", "what"),
    [
        (1, "ZeroDivisionError: division by zero"),
        (2, "value: INT: 40000 is out of range -32768..32767"),
        (3, "AttributeError: how is an input, which a model can only read"),
        (4, "AttributeError: limit is a parameter, which a model can only read"),
        (5, "AttributeError: 'tuple' object has no attribute '__setitem__'"),
        (6, "SystemExit: 3"),
        (7, "row: expected a list of 2 elements, found 1"),
    ],
)
def test_a_failure_is_reported_with_name_and_line_and_changes_nothing(how: int, what: str) -> None:
    runner = ModelRunner(Fragile)
    before = runner.begin()
    runner.connect({"how": how})
    with pytest.raises(ModelError) as caught:
        step(runner)
    text = str(caught.value)
    assert text.startswith(f"model {__name__}:Fragile: {what} (test_runner.py, line ")
    assert runner.image == before
    runner.connect({"how": 0})
    assert value(runner, "value", step(runner, 2)) == 6


def test_a_failing_start_is_reported_likewise() -> None:
    class Broken(Model):
        value = Output("INT")

        def start(self) -> None:
            self.value = 3
            raise LookupError("no\ncalibration")

        def step(self, time_s: float, dt_s: float) -> None: ...

    runner = ModelRunner(Broken)
    with pytest.raises(ModelError, match=r"Broken: LookupError: no calibration \(test_runner.py, line \d+\)$"):
        runner.begin()
    assert value(runner, "value") == 0


class Counting(Model):
    """A model that continues its count from the image when it starts."""

    count = Output("DINT")
    given = Input("DINT")
    both = InOut("DINT")

    def start(self) -> None:
        self.next = self.count

    def step(self, time_s: float, dt_s: float) -> None:
        self.next += 1
        self.count = self.next
        self.both.shown = self.both.commanded


def test_a_new_runner_resumes_from_the_image() -> None:
    first = ModelRunner(Counting)
    first.connect({"given": 4, "both": 5})
    for number in range(1, 4):
        image = step(first, number)
    second = ModelRunner(Counting)
    second.resume(image)
    assert second.begin() == image
    step(second, 4)
    assert [value(second, path) for path in ("count", "given", "both")] == [4, 4, 5]
    with pytest.raises(LayoutError, match="the image has 11 bytes, but the block has 12"):
        second.resume(image[1:])


def test_a_layout_may_have_more_registers_and_other_offsets() -> None:
    (layout,) = compile_sources(
        [
            Source(
                "t.toml",
                b'''byte_order = "big"
[registers]
"more/a" = "INT"
both = "DINT"
given = { type = "DINT", initial = 3 }
lamp = "BOOL"
count = "DINT"''',
            )
        ]
    ).layouts
    runner = ModelRunner(Counting, layout)
    assert set_to(runner, "more/a", 77) == ""
    assert set_to(runner, "lamp", True) == ""
    assert value(runner, "more/a") == 0
    step(runner)
    assert [value(runner, path) for path in ("count", "given", "more/a", "lamp")] == [1, 3, 77, True]


def changed(**changes: Any) -> Layout:
    layout = layout_of(Counting)
    return replace(
        layout, registers=tuple(structs.replace(r, **changes) if r.path == "both" else r for r in layout.registers)
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"path": "none"}, r"^layout: model .*:Counting needs a register both, DINT: both: "),
        ({"type": "REAL"}, r"^layout: model .*:Counting needs both as DINT; in Counting it is REAL$"),
        ({"dims": ((0, 0),)}, r"^layout: .* needs both as DINT; in Counting it is ARRAY\[0..0\] OF DINT$"),
    ],
)
def test_a_layout_that_does_not_fit_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        ModelRunner(Counting, changed(**changes))


class Types(Model):
    """A model that sets its outputs to numpy values."""

    count = Output("INT")
    row = Output("ARRAY[0..1, 0..2] OF REAL")
    flag = Output("BOOL")

    def step(self, time_s: float, dt_s: float) -> None:
        self.count = self.random.integers(1, 2)
        self.row = np.arange(6, dtype=np.float32).reshape(2, 3)
        self.flag = np.float64(self.row[1][2]) > 4


def test_numpy_values_are_accepted() -> None:
    runner = ModelRunner(Types)
    step(runner)
    assert [value(runner, path) for path in ("count", "row", "flag")] == [1, [[0, 1, 2], [3, 4, 5]], True]
