"""What FMUs of other tools have: formal defects, structural parameters, aliases, enumerations, events, long texts."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from shmio.connectors.models.simulation import Simulation
from shmio.errors import ConfigError, ModelError, ValueRangeError
from shmio.layout.tags import place_tags
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.layout.values.write import encode
from shmio.plan.sources import describe
from shmio.simulation import ModelRunner, load
from shmio.simulation.fmu import FmuOptions
from tests.fmus import build, edited

MS = 1_000_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("fmus")
    build("line3", made)
    return made


Runner = Callable[..., ModelRunner]


@pytest.fixture
def run(folder: Path) -> Iterator[Runner]:
    made: list[ModelRunner] = []

    def make(**parameters: object) -> ModelRunner:
        made.append(ModelRunner(load("line3.fmu", folder), parameters=parameters))
        return made[-1]

    yield make
    for runner in made:
        runner.close()


def value(runner: ModelRunner, path: str) -> Any:
    return codec(find(runner.layout, path), runner.layout.byte_order).decode(runner.image)


def test_variables_that_become_nothing_are_named(folder: Path) -> None:
    (notice,) = load("line3.fmu", folder).notices
    assert notice == (
        "shmio leaves out the variables of type Binary: blob; the variables of type Clock: tick; the variables that "
        "are other names of parameters: pace"
    )
    options = msgspec.convert({"model": "line3.fmu", "folder": str(folder)}, Simulation.Options)
    _, inputs, notices = describe("source[0]", options, None)
    assert inputs == ("mode", "level", "name")
    assert "blob" in notices[0]


def test_structural_parameters_and_matrices(run: Runner) -> None:
    factors = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]]
    for parameters, sums in (
        ({}, [6.0, 15.0]), ({"size": 2}, [6.0, 15.0]), ({"size": 3}, [6.0, 15.0, 24.0]),
        ({"size": 3, "factors": [[2.0 * one for one in row] for row in factors]}, [12.0, 30.0, 48.0]),
        ({"factors": "2 2 2 3 3 3"}, [6.0, 9.0]), ({"factors": [1, 1, 1, 0, 0, 0]}, [3.0, 0.0]),
        ({"factors": [[1, 1, 1], [0, 0, 0]]}, [3.0, 0.0]), ({"size": 1, "factors": [[5, 5, 5]]}, [15.0]),
    ):  # fmt: skip
        runner = run(**parameters)
        runner.step(20 * MS, 20 * MS)
        assert value(runner, "sums") == value(runner, "totals") == sums, parameters
        assert value(runner, "calls").startswith("configure " if parameters.get("size", 2) != 2 else "initialise ")
    for wrong, words in (
        ({"size": 11}, "outside the limits"), ({"size": "3"}, "whole number"), ({"factors": [1, 2, 3]}, "2 elements"),
        ({"factors": "1 2 3 4 5"}, "list of 2"), ({"factors": [[1, 2], [3, 4], [5, 6]]}, "list of 2"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=rf"^parameters\.(size|factors): .*{words}"):
            run(**wrong)
    for many in (0, 1 << 60):
        with pytest.raises(ModelError, match="variable factors: an array of"):
            run(size=many)


def test_a_value_that_is_no_item_is_refused_and_the_fmu_goes_on(run: Runner) -> None:
    runner = run()
    register = find(runner.layout, "mode")
    assert register.comment == "(1: off, 2: on, 7: clean)"
    for number in (3, 0, 8):
        (write,) = encode(register, number, runner.layout.byte_order)
        assert runner.write([write]) == [
            f"{number} is not an item of the enumeration; expected one of 1 (off), 2 (on), 7 (clean)"
        ]
        with pytest.raises(ValueRangeError, match=f"mode: {number} is not an item"):
            runner.connect({"mode": number})
    runner.step(20 * MS, 20 * MS)
    assert value(runner, "mode_out") == value(runner, "order") == 2
    runner.connect({"mode": 1})
    runner.step(40 * MS, 20 * MS)
    assert (value(runner, "mode_out"), value(runner, "order")) == (1, 1)
    assert "order" not in runner.inputs
    with pytest.raises(ValueRangeError, match="201 is outside the limits"):
        runner.connect({"level": 201})


def test_a_value_that_the_fmu_discards_fails_the_steps_until_it_is_replaced(run: Runner) -> None:
    runner = run()
    for number, (level, works) in enumerate(((1, True), (150, False), (150, False), (2, True)), 1):
        runner.connect({"level": level})
        if works:
            runner.step(number * 20 * MS, 20 * MS)
            assert value(runner, "sums") == [6.0 + level, 15.0 + level]
        else:
            with pytest.raises(ModelError, match="fmi3SetUInt8: the FMU refuses a value of level"):
                runner.step(number * 20 * MS, 20 * MS)


def test_events(run: Runner) -> None:
    """Discrete inputs change in the event mode; after an event in a step, the discrete states are updated."""
    runner = run()
    runner.step(20 * MS, 20 * MS)
    assert value(runner, "calls") == "initialise update update steps"
    runner.step(40 * MS, 20 * MS)
    assert value(runner, "calls") == "initialise update update steps"
    runner.connect({"mode": 7})
    runner.step(60 * MS, 20 * MS)
    assert value(runner, "calls") == "initialise update update steps event update update steps event update steps"


def test_an_fmu_that_cannot_use_the_event_mode_that_it_states(
    run: Runner, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """An FMU of the reference FMUs (Roberts) states it, and refuses it."""
    monkeypatch.setenv("LINE_WITHOUT_EVENTS", "1")
    runner = run()
    runner.connect({"mode": 7})
    runner.step(20 * MS, 20 * MS)
    assert (value(runner, "mode_out"), value(runner, "calls")) == (7, "initialise")
    assert "event mode that it states" in caplog.text


def test_a_text_that_is_not_utf_8_is_logged(run: Runner, caplog: pytest.LogCaptureFixture) -> None:
    runner = run()
    runner.connect({"name": "Latin"})
    runner.step(20 * MS, 20 * MS)
    assert value(runner, "name_out") == "caf�"
    assert "not UTF-8 for one of name_out" in caplog.text


def test_texts_of_any_length_and_all_characters(run: Runner, folder: Path, tmp_path: Path) -> None:
    runner = run()
    assert find(runner.layout, "name").type == "WSTRING[254]"
    for number, text in enumerate(("Straße ✓", "漢字 😀", "", "x" * 254), 1):
        if number > 1:
            runner.connect({"name": text})
        runner.step(number * 20 * MS, 20 * MS)
        assert value(runner, "name_out") == text
    long = "1000 Zeichen… " * 100
    file = edited(folder / "line3.fmu", tmp_path / "long.fmu", lambda xml: xml.replace("Straße ✓", long))
    assert find(ModelRunner(load(str(file))).layout, "name").type == f"WSTRING[{len(long)}]"
    tags: dict[str, Any] = {
        one.path: {"type": "WSTRING[3000]" if "name" in one.path else one.type}
        | ({"type": f"ARRAY[0..1] OF {one.type}"} if one.dims else {})
        for one in runner.layout.registers
    }
    with pytest.raises(ConfigError, match=r"layout: mode: 0 is not an item .*; give the register an initial value"):
        ModelRunner(load("line3.fmu", folder), place_tags("cell", tags))
    tags["mode"] |= {"initial": 2}
    longer = ModelRunner(load("line3.fmu", folder), place_tags("cell", tags))
    longer.connect({"name": "✓" * 1200})
    longer.step(20 * MS, 20 * MS)
    assert value(longer, "name_out") == "✓" * 1200
    longer.close()
    sized = ModelRunner(load("line3.fmu", folder, FmuOptions(text_length=300)), parameters={"size": 3})
    sized.connect({"name": "✓" * 300})
    sized.step(20 * MS, 20 * MS)
    assert value(sized, "name_out") == "✓" * 300
    sized.close()


def test_a_text_that_is_too_long_fails_the_step_with_the_remedy(run: Runner) -> None:
    runner = run()
    runner.connect({"mode": 7})  # each step adds to its calls
    reasons = []
    for number in range(1, 30):
        try:
            runner.step(number * 20 * MS, 20 * MS)
        except ModelError as error:
            reasons.append(str(error))
    assert re.search(r"calls: WSTRING\[254\]: .*; the source needs text_length = \d{3}", reasons[0])


PLAIN = 'variability="continuous"'


def test_formal_defects_that_touch_no_value_are_warnings(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "x.fmu"
    for edit in (
        # What PythonFMU writes: outputs without a variability are continuous, which only Reals can be.
        lambda xml: xml.replace('name="mode"', f'name="mode" {PLAIN}').replace('"calls"', f'"calls" {PLAIN}'),
        lambda xml: xml.replace('<Float64 name="time"', '<!-- --><Float64 name="t"').replace("independent", "local"),
        lambda xml: xml.replace('start="0" max="200"', 'start="0" max="200" quirk="1"'),
        lambda xml: xml.replace('name="sums"', 'name="sums" unit="furlong"'),
        lambda xml: xml.replace("<ModelStructure>", "<ModelStructure><Odd/>"),
        lambda xml: xml.replace('modelName="Line"', 'modelName="Line" odd="1"'),
    ):
        edited(folder / "line3.fmu", file, edit)
        (defect, _) = load(str(file)).notices
        assert defect.startswith("modelDescription.xml breaks the standard, but no value depends on it: "), edit
        with pytest.raises(ModelError, match="is invalid"):
            load(str(file), None, FmuOptions(strict=True))
        runner = ModelRunner(load(str(file)))
        runner.step(20 * MS, 20 * MS)
        assert value(runner, "sums") == [6.0, 15.0]
        runner.close()


def test_defects_that_touch_a_value_are_refused(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "x.fmu"
    for edit in (
        lambda xml: xml.replace('name="mode_out"', 'name="mode"'),
        lambda xml: xml.replace('name="mode_out" declaredType="Mode" valueReference="4"',
                                'name="mode_out" declaredType="Mode" valueReference="3"'),
        lambda xml: xml.replace('start="1 2 3 4 5 6"', 'start="1 2 3 4 5"'),
        lambda xml: xml.replace('start="1 2 3 4 5 6"', 'start="1 2 3 4 5 x"'),
        lambda xml: xml.replace('valueReference="5"', 'valueReference="-5"'),
        lambda xml: xml.replace('valueReference="5"', ""),
        lambda xml: xml.replace('max="200"', 'max="many"'),
        lambda xml: xml.replace('causality="input" start="0"', 'causality="inputs" start="0"'),
        lambda xml: xml.replace(' value="7"', ""),
        lambda xml: xml.replace("<ModelVariables>", '<DefaultExperiment startTime="soon"/><ModelVariables>'),
        lambda xml: xml.replace('instantiationToken="{line-3}"', ""),
        lambda xml: xml.replace('<Dimension start="3"/>', '<Dimension start="0"/>'),
    ):  # fmt: skip
        edited(folder / "line3.fmu", file, edit)
        with pytest.raises(ModelError, match=r"modelDescription\.xml"):
            load(str(file))


def test_only_fmus_are_read_strictly() -> None:
    with pytest.raises(ConfigError, match="only for FMUs"):
        load("shmio.simulation.loopback:Loopback", None, FmuOptions(strict=True))
