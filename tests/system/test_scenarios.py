"""The three scenarios of examples/, started by their scripts, and used as their pages say."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

import pytest

import shmio
from shmio.model.values import Quality
from shmio.testing.cell import PATIENCE_S, until
from shmio.testing.ports import reserved_port
from tests.system.page import environment, shell

pytest.importorskip("fmpy")
pytest.importorskip("uvicorn")

ROOT: Final = Path(__file__).parents[2]
MADE: Final = ("logs", "__pycache__", "*.fmu", "*.mem", "what-if.html")
"""Files in the examples' folders that their scripts have made."""
BLOCK: Final = re.compile(r"^```sh\n(.*?)^```\n\n^```text\n(.*?)^```$", re.DOTALL | re.MULTILINE)
PLACE: Final = re.compile(r"127\.0\.0\.1:\d+")
NUMBER: Final = re.compile(r"-?\d+(\.\d+)?(e-?\d+)?|true|false")


class Example:
    """A copy of an example, with an instance name and ports of this test."""

    def __init__(self, name: str, folder: Path, instance: str, stack: ExitStack) -> None:
        self.name, self.instance = name, instance
        self.folder = folder / "examples" / name
        shutil.copytree(ROOT / "examples" / name, self.folder, ignore=shutil.ignore_patterns(*MADE))
        for beside in ("db201.db", "scene.toml", "examples/remote.py"):
            (folder / beside).symlink_to(ROOT / beside)
        (folder / ".venv").symlink_to(sys.prefix)
        (folder / "scripts").mkdir()
        (folder / "scripts/install-missing").symlink_to(ROOT / "scripts/install-missing")
        install = folder / "scripts/install"  # all libraries are there: the script asks for none
        install.write_text('#!/bin/sh\n[ $# = 0 ] || { echo "missing: $*" >&2; exit 1; }\n')
        install.chmod(0o755)
        text = (self.folder / "supervisor.toml").read_text()
        ports = {"127.0.0.1:" + port for port in re.findall(r"port = (\d+)", text)} | set(PLACE.findall(text))
        self.own = {old: str(stack.enter_context(reserved_port())) for old in sorted(ports)}
        for file in self.folder.rglob("*"):
            if file.suffix in (".toml", ".py"):
                text = re.sub(
                    rf'^(name|INSTANCE) = "{name}"', rf'\1 = "{instance}"', file.read_text(), flags=re.MULTILINE
                )
                for old, new in self.own.items():
                    text = text.replace(old, new).replace(f"port = {old[10:]}", f"port = {new[10:]}")
                file.write_text(text)

    @contextmanager
    def running(self, *, kill: bool = False) -> Iterator[str]:
        """Start the example as its user does; at the end press Ctrl-C, or kill the script. Yield what it has printed.

        At the end, all its processes have ended: each of them has the pipe that is read to its end.
        """
        with subprocess.Popen(
            [self.folder / "run"],
            env=environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            process_group=0,
        ) as script:
            try:
                assert script.stdout is not None
                printed = ""
                for line in script.stdout:
                    printed += line
                    if "in a browser" in line:
                        break
                assert "the instance is running" in printed, printed
                yield printed
            finally:
                if kill:
                    script.terminate()
                else:
                    os.killpg(script.pid, signal.SIGINT)
                rest, _ = script.communicate(timeout=PATIENCE_S)
        assert script.returncode == (-signal.SIGTERM if kill else 0), rest

    def shown(self, commands: str) -> str:
        """Return what a terminal shows, with the names and ports of the page."""
        for old, new in self.own.items():
            commands = commands.replace(old, new)
        text = shell(f"{{ set +e; {commands}}} 2>&1", self.folder).stdout
        for old, new in self.own.items():
            text = text.replace(new, old)
        return text.replace(self.instance, self.name)


def shape(text: str) -> str:
    """Return a text without its numbers, truth values and columns, which vary."""
    return re.sub(" +", " ", NUMBER.sub("#", text))


def blocks(page: str) -> list[tuple[str, str]]:
    """Return the commands of a page that it shows with their output."""
    found = BLOCK.findall((ROOT / "docs/how-to" / page).read_text())
    assert found
    return found


pytestmark = pytest.mark.timeout(300)  # on a busy host


@pytest.fixture
def example(tmp_path: Path, instance: str, request: pytest.FixtureRequest) -> Iterator[Example]:
    with ExitStack() as stack:
        yield Example(request.param, tmp_path, instance, stack)


@pytest.mark.parametrize("example", ["commissioning"], indirect=True)
def test_signals_of_the_plc_and_the_plant_flow_in_both_directions(example: Example) -> None:
    with example.running(), shmio.attach(example.instance, writable=True) as cell:

        def shows(path: str, *values: object) -> bool:
            (reading,) = cell.get(path)
            return reading.value in values

        def value(path: str) -> float:
            return float(str(cell.get(path)[0].value))

        until(lambda: shows("robot_800/at", 2, 3), "PLC to robot")
        until(lambda: shows("plc/Outputs/Step", 30), "robot to PLC")
        until(lambda: value("motor/speed") > 2000, "PLC to FMU")
        cell.set({"motor/ambient": 95.0})
        until(lambda: value("plc/Inputs/Temperature") > 30, "FMU to PLC")
        for commands, output in blocks("commission-a-cell.md"):
            if "--lab" not in commands:
                assert shape(example.shown(commands)) == shape(output)
        until(lambda: shows("plc/Outputs/Alarm", True) or shows("plc/Outputs/Cooling", True), "the restarted PLC", 30)


@pytest.mark.parametrize("example", ["commissioning"], indirect=True)
def test_the_program_meets_its_requirements_in_virtual_time(example: Example) -> None:
    example.shown("../../.venv/bin/python motor/build.py\n")
    ((commands, output),) = [block for block in blocks("commission-a-cell.md") if "--lab" in block[0]]
    assert example.shown(commands) == output
    program = example.folder / "station.py"
    program.write_text(program.read_text().replace("else 60.0", "else 85.0"))
    late = example.shown(f"{commands.strip()} --for 15; echo $?\n")
    assert re.search(r"^failed +cool", late, re.MULTILINE)
    assert late.endswith("\n1\n")


@pytest.mark.parametrize("example", ["commissioning"], indirect=True)
def test_no_process_survives_a_killed_script(example: Example) -> None:
    with example.running(kill=True):
        pass


@pytest.mark.parametrize("example", ["twin"], indirect=True)
def test_nothing_flows_back_to_the_controller_unless_named(example: Example) -> None:
    with example.running(), shmio.attach(example.instance) as cell:
        until(lambda: cell.get("cell/Robot_825/Axs1_Pos")[0].quality is Quality.GOOD, "the controller publishes")
        until(lambda: cell.get("guard/axis")[0].value not in (0.0, None), "the guard reads")
        file = example.folder / "supervisor.toml"
        for commands, output in blocks("follow-a-cell.md"):
            if "reload" in commands:
                assert cell["cell/Outputs/13"] == 0
                file.write_text(file.read_text().replace("writable = []", 'writable = ["Outputs/13"]'))
            trips = cell["guard/trips"]
            shown = example.shown(commands)
            if "remote.py" in commands or "trips" in commands:
                assert shape(shown) == shape(output)
            else:
                assert shown == output
            assert "trips" not in commands or int(str(cell["guard/trips"])) >= int(str(trips)) + 2


@pytest.mark.parametrize("example", ["replay"], indirect=True)
def test_a_replay_is_judged_and_then_stepped(example: Example) -> None:
    with example.running() as printed:
        verdicts = re.findall(r"^(passed|failed) +(\w+)", printed, re.MULTILINE)
        assert verdicts[1:] == [("passed", "closes"), ("passed", "clear"), ("passed", "closes"), ("failed", "clear")]
        commands, output = blocks("analyse-a-replay.md")[0]
        assert shape(example.shown(commands)) == shape(output)
    report = (example.folder / "what-if.html").read_text()
    assert "stuck-switch" in report
    assert "failed at 1.520 s" in report


@pytest.mark.parametrize("example", ["replay"], indirect=True)
def test_the_counterfactual_repeats_until_the_control_is_repaired(example: Example) -> None:
    file = example.folder / "supervisor.toml"
    file.write_text(file.read_text().partition("[web]")[0])  # nobody looks
    example.shown("shmio-campaign run plant/record.toml --lab --record plant.mem\n")
    for commands, output in blocks("analyse-a-replay.md")[1:]:
        if "--seed" in commands:
            model = 'model = "door:Door"\n'
            file.write_text(file.read_text().replace(model, f"{model}parameters = {{ checked = true }}\n"))
        assert example.shown(commands) == output
