"""FMUs as models: FMUs in C by FMI 2.0 and 3.0, and one in Python, next to FMPy's own simulation."""

from __future__ import annotations

import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shmio.errors import ConfigError, ModelError, ValueRangeError
from shmio.layout.topic import find
from shmio.layout.values.codec import codec
from shmio.layout.values.write import Write
from shmio.simulation import ModelRunner, load
from shmio.simulation.fmu import FmuOptions
from tests.fmus import build, build_oven, edited

MS = 1_000_000
STEPS = 200


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the FMUs."""
    made = tmp_path_factory.mktemp("fmus")
    build("tank2", made)
    build("plant3", made)
    return made


Runner = Callable[..., ModelRunner]


@pytest.fixture
def run(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Runner]:
    """Return a function that makes a runner of an FMU. At the end, no files remain."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    made: list[ModelRunner] = []

    def make(name: str, **parameters: object) -> ModelRunner:
        made.append(ModelRunner(load(f"{name}.fmu", folder), parameters=parameters))
        return made[-1]

    yield make
    for runner in made:
        runner.close()
    assert not list(tmp_path.glob("shmio-fmu-*"))


def value(runner: ModelRunner, path: str, image: bytes | None = None) -> Any:
    register = find(runner.layout, path)
    return codec(register, runner.layout.byte_order).decode(runner.image if image is None else image)


def simulated(file: Path, outputs: list[str], dt_ms: float = 20, steps: int = STEPS, **more: Any) -> Any:
    """Return FMPy's own results, with the start."""
    dt_s = dt_ms / 1e3
    return fmpy.simulate_fmu(str(file), stop_time=steps * dt_s, output_interval=dt_s, output=outputs, **more)


def test_variables_become_registers(run: Runner) -> None:
    runner = run("tank2")
    registers = {one.path: one for one in runner.layout.registers}
    assert {path: one.type for path, one in registers.items()} == {
        "pump.inflow": "LREAL",
        "level": "LREAL",
        "pulses": "DINT",
        "trouble": "DINT",
        "runs": "DINT",
        "step": "BOOL",
        "a%2Fb caption": "WSTRING[254]",
        "phase": "LREAL",
        "calls": "DINT",
    }
    assert runner.inputs == ("pump.inflow", "pulses", "trouble", "step")
    inflow = registers["pump.inflow"]
    assert (inflow.unit, inflow.comment, inflow.initial) == ("m3/s", "what flows in [m3/s]", "0.5")
    assert value(runner, "level") == 1.0


def test_arrays_and_all_types_of_fmi_3(run: Runner) -> None:
    runner = run("plant3", gain=[1.0, 2.0])
    assert find(runner.layout, "command").dims == ((0, 1), (0, 2))
    runner.connect(
        {
            "command": [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
            "small": 1.0,
            "bits": [True, False, True],
            "text": "naïve",
            "big": 2**64 - 2,
        }
    )
    image = runner.step(20 * MS, 20 * MS)
    shown = {one.path: value(runner, one.path, image) for one in runner.layout.registers}
    assert shown["position"][0] == pytest.approx([0.02, 0.08, 0.06])  # gain 1 and 2, by turns
    assert shown["position"][1] == pytest.approx([0.16, 0.1, 0.24])
    assert shown["small_out"] == pytest.approx(1 / 3, rel=1e-7)
    assert (shown["bits_out"], shown["big_out"], shown["byte"], shown["mode"]) == ([False, True, False], 1, 1, 2)
    assert shown["command"] == [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    # C has bytes of UTF-8
    assert shown["text_out"] == "<naïve>"


def test_texts_and_negative_zero_reach_the_fmu_and_come_back(run: Runner) -> None:
    runner = run("plant3")
    for number, (text, small) in enumerate([("", 0.0), ("ab", -0.0), ("ab", 0.0), ("ä", 3.0), ("", -3.0)], 1):
        runner.connect({"text": text, "small": small})
        image = runner.step(number * 20 * MS, 20 * MS)
        assert value(runner, "text_out", image) == f"<{text}>"
        assert str(value(runner, "small_out", image)) == str(small / 3)


def test_bytes_that_are_no_text_fail_each_step_until_they_are_replaced(run: Runner) -> None:
    """Otherwise, later steps would be good although the FMU has an older text than the register shows."""
    runner = run("plant3")
    at = find(runner.layout, "text").offset
    texts = [(1, "a", "<a>"), (255, "", ""), (3, "a\0b", ""), (1, "b", "<b>")]
    for number, (length, text, shown) in enumerate(texts):
        assert runner.write([Write(at, 0, struct.pack("<HH", 254, length) + text.encode("utf-16-le"))]) == [""]
        for step in (2 * number + 1, 2 * number + 2):
            if shown:
                assert value(runner, "text_out", runner.step(step * 20 * MS, 20 * MS)) == shown
            else:
                with pytest.raises(ModelError, match="text has bytes that are no text, or a text with a NUL"):
                    runner.step(step * 20 * MS, 20 * MS)


@pytest.mark.parametrize("dt_ms", [20, 10, 15.625, 7])
def test_results_equal_those_of_fmpy_bit_for_bit(run: Runner, folder: Path, dt_ms: float) -> None:
    dt_ns = round(dt_ms * MS)
    runner = run("tank2")
    theirs = simulated(folder / "tank2.fmu", ["level", "phase", "runs"], dt_ms)
    assert len(theirs) == STEPS + 1
    runner.begin()
    assert value(runner, "level") == theirs["level"][0]
    for number in range(1, STEPS + 1):
        runner.step(number * dt_ns, dt_ns)
        ours = tuple(value(runner, path) for path in ("level", "phase", "runs"))
        assert ours == tuple(theirs[number])[1:], number
    runner = run("plant3")
    theirs = simulated(folder / "plant3.fmu", ["position"], dt_ms)
    for number in range(1, STEPS + 1):
        runner.step(number * dt_ns, dt_ns)
        assert np.array_equal(value(runner, "position"), theirs["position"][number]), number


def test_inputs_and_parameters_reach_the_fmu_as_by_fmpy(run: Runner, folder: Path) -> None:
    dt_ns, period_s = 125 * MS, 0.125
    times = np.arange(0, STEPS + 1) * period_s
    flows = np.cos(times * 3) + 1
    signals = np.array(list(zip(times, flows, strict=True)), [("time", float), ("pump.inflow", float)])
    theirs = simulated(
        folder / "tank2.fmu",
        ["level", "a/b caption"],
        125,
        input=signals,
        start_values={"area": 3.5, "label": "large", "step": True},
    )
    runner = run("tank2", area=3.5, label="large")
    runner.connect({"step": True})
    assert theirs["level"][-1] != theirs["level"][0]
    for number in range(1, STEPS + 1):
        runner.connect({"pump.inflow": flows[number - 1]})
        runner.step(number * dt_ns, dt_ns)
        assert value(runner, "level") == theirs["level"][number], number
    assert value(runner, "a%2Fb caption") == "large tank"


def test_discarded_steps_are_repeated_as_by_fmpy(run: Runner, folder: Path) -> None:
    theirs = simulated(folder / "tank2.fmu", ["level", "phase"], start_values={"trouble": 5})
    done = np.unique(theirs, return_index=False)  # FMPy also samples each discarded step
    runner = run("tank2")
    runner.connect({"trouble": 5})
    for number in range(1, STEPS + 1):
        runner.step(number * 20 * MS, 20 * MS)
    assert value(runner, "calls") == 3 * STEPS, "each step was discarded twice"
    assert value(runner, "runs") == STEPS
    assert value(runner, "level") == done["level"][-1]


@pytest.mark.parametrize(("name", "trouble", "output"), [("tank2", 6, "level"), ("plant3", 2, "position")])
def test_a_step_that_is_too_long_for_the_fmu_is_made_in_parts(
    run: Runner, folder: Path, name: str, trouble: int, output: str
) -> None:
    runner = run(name)
    runner.connect({"trouble": trouble})
    for number in range(1, 9):
        runner.step(number * 16 * MS, 16 * MS)
    theirs = simulated(folder / f"{name}.fmu", [output], 4, 32)
    assert value(runner, output) == pytest.approx(theirs[output][-1], rel=1e-12)


def test_a_step_that_was_done_in_half_continues_from_there(run: Runner) -> None:
    runner, whole = run("tank2"), run("tank2")
    runner.connect({"trouble": 7})
    for number in range(1, 5):
        runner.step(number * 16 * MS, 16 * MS)
    for number in range(1, 17):
        whole.step(number * 4 * MS, 4 * MS)
    assert value(runner, "phase") == value(whole, "phase"), "it has reached the same time"
    assert value(runner, "runs") == 4 * 3


def test_an_early_return_continues_as_by_fmpy(run: Runner, folder: Path) -> None:
    theirs = simulated(
        folder / "plant3.fmu", ["position", "byte"], start_values={"trouble": 1}, early_return_allowed=True
    )
    runner = run("plant3")
    runner.connect({"trouble": 1})
    for number in range(1, STEPS + 1):
        runner.step(number * 20 * MS, 20 * MS)
    assert np.array_equal(value(runner, "position"), theirs["position"][-1])
    assert value(runner, "byte") == theirs["byte"][-1] == 4 * STEPS % 256


def test_an_fmu_with_steps_of_one_length_makes_several_of_them(folder: Path, tmp_path: Path) -> None:
    def fixed(xml: str) -> str:
        return xml.replace('canHandleVariableCommunicationStepSize="true"', "")

    runner = ModelRunner(load(str(build("tank2", tmp_path, fixed))))
    for time_ms, dt_ms in ((20, 20), (40, 20), (100, 60)):
        runner.step(time_ms * MS, dt_ms * MS)
    assert value(runner, "runs") == 5
    with pytest.raises(ModelError, match="steps of one length only, 20 ms as in its first step; 30 ms"):
        runner.step(130 * MS, 30 * MS)
    runner.step(140 * MS, 10 * MS)
    assert value(runner, "runs") == 7
    runner.close()


@pytest.mark.parametrize(
    ("name", "trouble", "message"),
    [
        (
            "tank2",
            3,
            "model tank2.fmu: fmi2DoStep failed with status error: the solver failed at 99.5%; the FMU starts",
        ),
        ("tank2", 4, "model tank2.fmu: it has ended its simulation at 0.02 s; the FMU starts again when its source"),
        ("plant3", 4, "model plant3.fmu: fmi3DoStep failed with status error: axis 2 is blocked; the FMU starts"),
        ("plant3", 3, "model plant3.fmu: it has ended its simulation at 0.02 s; the FMU starts again"),
    ],
)
def test_a_failure_is_named_and_lasts(run: Runner, name: str, trouble: int, message: str) -> None:
    runner = run(name)
    before = runner.step(20 * MS, 20 * MS)
    runner.connect({"trouble": trouble})
    with pytest.raises(ModelError) as first:
        runner.step(40 * MS, 20 * MS)
    assert str(first.value).startswith(message)
    runner.connect({"trouble": 0})
    with pytest.raises(ModelError) as second:
        runner.step(60 * MS, 20 * MS)
    assert str(second.value) == str(first.value)
    assert runner.image == before


def test_the_ranges_of_inputs_and_parameters_are_checked(run: Runner) -> None:
    runner = run("tank2")
    with pytest.raises(ValueRangeError, match=r"^pump\.inflow: 5\.5 is outside the limits of -1 to 5"):
        runner.connect({"pump.inflow": 5.5})
    place = find(runner.layout, "pulses").offset
    writes = [Write(place, 0, number.to_bytes(4, "little")) for number in (100, 101)]
    assert runner.write(writes) == ["", "101 is outside the limits of 0 to 100"]
    assert value(runner, "pulses", runner.step(20 * MS, 20 * MS)) == 100
    for parameters, message in (
        ({"area": 0.0}, r"^parameters\.area: 0 is outside the limits of 0\.1 to inf"),
        ({"aera": 1.0}, r"^parameters\.aera: unknown parameter 'aera' of .*; did you mean 'area'"),
        ({"area": "x"}, r"^parameters\.area: "),
    ):
        with pytest.raises(ConfigError, match=message):
            run("tank2", **parameters)
    with pytest.raises(ValueRangeError, match="101 is outside"):
        run("plant3").connect({"command": [[0.0, 0.0, 0.0], [0.0, 101.0, 0.0]]})


def test_the_fmu_ends_cleanly(run: Runner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TANK_ENDS", str(tmp_path / "ends"))
    runner = run("tank2")
    runner.begin()
    runner.close()
    runner.close()
    assert (tmp_path / "ends").read_text() == "terminate\nfree\n"


def test_an_fmu_that_cannot_be_created_fails_each_step_with_one_reason(tmp_path: Path) -> None:
    runner = ModelRunner(load(str(build("tank2", tmp_path, lambda xml: xml.replace("{tank-2}", "{other}")))))
    for number in (1, 2):
        with pytest.raises(ModelError, match=r"model tank2\.fmu: it cannot be loaded: .*; the FMU starts again"):
            runner.step(number * 20 * MS, 20 * MS)
    runner.close()


def test_an_fmu_of_pythonfmu3_equals_fmpy(tmp_path: Path) -> None:
    """In a process of its own: its library stays loaded, and finds Python in the process."""
    file = build_oven(tmp_path)
    theirs = simulated(file, ["temperature"], start_values={"power": 30.0})
    program = """
import sys
from shmio.simulation import ModelRunner, load
from shmio.simulation.fmu import FmuOptions
runner = ModelRunner(load(sys.argv[1]), parameters={"loss": 0.2})
runner.connect({"power": 30.0})
for number in range(1, 201):
    image = runner.step(number * 20_000_000, 20_000_000)
runner.close()
(place,) = (one.offset for one in runner.layout.registers if one.path == "temperature")
print(image[place:place + 8].hex())
"""
    done = subprocess.run([sys.executable, "-c", program, file], capture_output=True, text=True, check=True)
    theirs = simulated(file, ["temperature"], start_values={"power": 30.0, "loss": 0.2})
    assert done.stdout.strip().splitlines()[-1] == theirs["temperature"][-1].tobytes().hex()


XML = "modelDescription.xml"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda xml: xml.replace('fmiVersion="2.0"', 'fmiVersion="1.0"'), "FMI version '1.0'; expected 2.0 or 3.0"),
        (lambda xml: xml.replace("<CoSimulation", "<ModelExchange"), "invalid|not for co-simulation"),
        (lambda xml: xml.replace('"tank2"', '"../tank2"'), "not an identifier"),
        (lambda xml: xml.replace('"tank2"', '"tank4"'), "it has no library for .*; it has: "),
        (lambda xml: xml.replace("<fmi", '<!DOCTYPE a [<!ENTITY b "c">]><fmi', 1), "document type or entities"),
        (lambda xml: xml.replace('start="1"', 'start="one"'), "invalid"),
        (lambda xml: xml.replace("</ModelVariables>", ""), "modelDescription.xml: "),
        (lambda xml: xml.replace('declaredType="Flow"', 'declaredType="Flood"'), "invalid"),
    ],
)
def test_descriptions_that_do_not_work_are_refused(
    folder: Path, tmp_path: Path, change: Callable[[str], str], message: str
) -> None:
    file = edited(folder / "tank2.fmu", tmp_path / "x.fmu", change)
    with pytest.raises(ModelError, match=message) as caught:
        load("x.fmu", tmp_path)
    assert str(caught.value).startswith(f"{file}: ")


def test_a_default_export_of_pythonfmu_runs_with_a_warning(folder: Path, tmp_path: Path) -> None:
    """It states no variability, so that whole numbers, Booleans and texts are continuous, which is not allowed."""
    file = edited(folder / "tank2.fmu", tmp_path / "x.fmu", lambda xml: xml.replace('variability="discrete"', ""))
    (notice,) = load(str(file)).notices
    assert 'The variable "runs"' in notice
    assert "strict = true" in notice
    runner = ModelRunner(load(str(file)))
    runner.connect({"step": True})
    runner.step(20 * MS, 20 * MS)
    assert (value(runner, "runs"), value(runner, "a%2Fb caption")) == (1, "small tank")
    runner.close()
    with pytest.raises(ModelError, match=r'invalid: The variable "pulses" \(line .*must have variability'):
        load(str(file), None, FmuOptions(strict=True))


@settings(max_examples=60)
@given(st.data())
def test_damaged_descriptions_and_archives_are_refused(fuzzed: tuple[Path, bytes, bytes], data: st.DataObject) -> None:
    """Whatever is in the file: it is an FMU, or it is refused."""
    file, whole, xml = fuzzed
    if data.draw(st.booleans(), "damage the archive"):
        content = bytearray(whole)
        for place in data.draw(st.lists(st.integers(0, len(content) - 1), min_size=1, max_size=6)):
            content[place] = data.draw(st.integers(0, 255))
        file.write_bytes(content)
    else:
        text = bytearray(xml)
        for _ in range(data.draw(st.integers(1, 4))):
            start = data.draw(st.integers(0, len(text) - 1))
            odd = st.sampled_from([b"", b"99999999999", b"-1", b"1e999", b"nan", b"\x00", b"&lt;", b"<a/>"])
            text[start : start + data.draw(st.integers(0, 30))] = data.draw(odd | st.binary(max_size=4))
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr(XML, bytes(text))
            archive.writestr(f"binaries/{fmpy.platform_tuple}/plant3.so", b"")
    with suppress(ModelError, ConfigError):
        ModelRunner(load(str(file)))


@pytest.fixture(scope="module")
def fuzzed(folder: Path) -> tuple[Path, bytes, bytes]:
    """Return a file to overwrite, a small FMU, and its description."""
    with zipfile.ZipFile(folder / "plant3.fmu") as archive:
        xml = archive.read(XML)
    small = folder / "small.fmu"
    with zipfile.ZipFile(small, "w") as archive:
        archive.writestr(XML, xml)
        archive.writestr(f"binaries/{fmpy.platform_tuple}/plant3.so", b"")
    return folder / "fuzzed.fmu", small.read_bytes(), xml


def test_loading_runs_nothing_of_the_fmu(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "x.fmu"
    (tmp_path / "evil.c").write_text(
        f'#include <stdio.h>\n__attribute__((constructor)) void f(void) {{ fopen("{tmp_path}/ran", "w"); }}\n'
    )
    subprocess.run(["cc", "-shared", "-fPIC", "-o", tmp_path / "evil.so", tmp_path / "evil.c"], check=True)
    with zipfile.ZipFile(folder / "tank2.fmu") as old, zipfile.ZipFile(file, "w") as new:
        new.write(tmp_path / "evil.so", f"binaries/{fmpy.platform}/tank2.so")
        new.writestr(XML, old.read(XML))
    runner = ModelRunner(load("x.fmu", tmp_path))
    assert not (tmp_path / "ran").exists()
    with pytest.raises(ModelError):
        runner.begin()
    assert (tmp_path / "ran").exists()
    runner.close()
