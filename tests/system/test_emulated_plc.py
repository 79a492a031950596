"""The pages on emulated controllers, followed step by step: files, commands and output."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

import shmio
from shmio.segment import Quality
from shmio.testing.cell import PATIENCE_S, until
from shmio.testing.ports import reserved_port
from tests.system.page import printed, shell

PAGES = Path(__file__).parents[2] / "docs/how-to"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


class Reader:
    """Follows a page, with another port and other instance names."""

    def __init__(self, page: str, folder: Path, instance: str, port: int) -> None:
        text = (PAGES / page).read_text().replace("127.0.0.1:1102", f"127.0.0.1:{port}").replace(" 1102", f" {port}")
        text = re.sub(
            '^name = "(?:press|door)(-plc)?"\n(?!connector)', rf'name = "{instance}\1"\n', text, flags=re.MULTILINE
        )
        self.blocks = [(match[1], match[2]) for match in BLOCK.finditer(text)]
        self.folder, self.instance = folder, instance

    def all(self, kind: str) -> list[str]:
        return [text for found, text in self.blocks if found == kind]

    def write(self, name: str, text: str) -> None:
        (self.folder / name).write_text(text)

    def steps(self) -> Iterator[tuple[str, str]]:
        """Yield each block of commands with the output that the page shows for it, if any."""
        for at, (kind, text) in enumerate(self.blocks):
            if kind == "sh":
                following, shown = self.blocks[at + 1] if at + 1 < len(self.blocks) else ("", "")
                yield text, shown if following == "text" else ""

    def run(self, commands: str) -> subprocess.CompletedProcess[str]:
        return shell(commands, self.folder)

    def follow(self, commands: str, shown: str) -> None:
        """Run commands; repeat those that only read until they print what the page shows."""
        if shown:
            until(lambda: self.run(commands).stdout == shown, f"{commands}{shown}", 2 * PATIENCE_S)
            return
        printed(commands, self.folder)


@pytest.fixture
def reader(request: pytest.FixtureRequest, tmp_path: Path, instance: str) -> Iterator[Reader]:
    with ExitStack() as stack:
        address = stack.enter_context(reserved_port())
        reader = Reader(request.param, tmp_path, instance, address.port)
        yield reader
        for file in tmp_path.glob("*.toml"):
            reader.run(f"shmio-supervisor down -c {file.name}")


@pytest.mark.parametrize("reader", ["emulate-an-s7-plc.md"], indirect=True)
def test_the_page_on_emulated_controllers_runs_as_shown(reader: Reader) -> None:
    (source,), (configuration, apart, _) = reader.all("scl"), reader.all("toml")  # the last has a profile
    reader.write("my.db", source)
    reader.write("supervisor.toml", configuration)
    *steps, (unplug, nothing) = reader.steps()
    assert len(steps) > 10
    assert "kill -STOP" in unplug
    assert not nothing
    for commands, shown in steps:
        if commands.startswith("shmio-supervisor reload"):
            before, _, emulator = configuration.partition("[[emulator]]")
            assert re.sub(" *#.*", "", emulator) == apart.partition("[[emulator]]")[2]
            reader.write("supervisor.toml", before)
            reader.write("plc.toml", apart)
        reader.follow(commands, shown)
    with shmio.attach(reader.instance) as press:
        reader.follow(unplug, "")
        until(lambda: press.read("press/Fault").reason.startswith("no answer within 1000 ms"), "the reason")
        assert json.loads(reader.run("shmio-supervisor status --json").stdout)["state"] == "degraded"
        until(lambda: press.read("press/Fault").quality is Quality.GOOD, "another process")


@pytest.mark.parametrize("reader", ["emulate-a-tag-table.md"], indirect=True)
def test_the_page_on_emulated_tag_tables_runs_as_shown(reader: Reader) -> None:
    table, configuration, program, _ = reader.all("toml")  # the last is examples/five-sources in short
    reader.write("press.toml", table)
    reader.write("supervisor.toml", configuration)
    for commands, shown in reader.steps():
        reader.follow(commands, shown)
    reader.write("supervisor.toml", configuration + program)
    reader.follow("shmio-supervisor reload", "")
    with shmio.attach(reader.instance) as press:
        until(lambda: press.read("press/Temperature").quality is Quality.GOOD, "the emulator with its program")
        seen: set[object] = set()
        for view in press.stream("press", timeout_s=PATIENCE_S):
            seen.add(view["Temperature"])
            assert view["Speed"] == 12.5
            if len(seen) > 5:
                break


@pytest.mark.parametrize("reader", ["write-a-plc-program.md"], indirect=True)
def test_the_page_on_plc_programs_runs_as_shown(reader: Reader) -> None:
    (program,), (block,), (configuration,) = reader.all("python"), reader.all("scl"), reader.all("toml")
    reader.write("interlock.py", program)
    reader.write("door.db", block)
    reader.write("supervisor.toml", configuration)
    for commands, shown in reader.steps():
        reader.follow(commands, shown)
