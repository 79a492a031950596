"""Injection campaigns in the A50 cell: by a file or the configuration, repeatable, recorded."""

from __future__ import annotations

import json
import re
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import shmio
from shmio.local.attach import Attachment
from shmio.segment import Cursor, Event, EventKind
from shmio.testing.cell import BIN, PATIENCE_S, Cell, until
from tests.system.armed import ARMED

RECORDER = """
[recorder]
directory = "dumps"
"""
CONFIGURED = """
[[injection]]
name = "blind"
target = "cell/Outputs/98"
operation = "set"
value = 77
when = "cell/Outputs/99.%X7"
"""
# The controller's program ignores bytes from 90 on.
CAMPAIGN = """
[[injection]]
name = "noise"
target = "cell/Outputs/100..101"
operation = "noise"
amplitude = 20
when = "cell/Outputs/99 == 1"
for_s = 0.6
times = 1

[[injection]]
name = "doubled"
target = "cell/Outputs/98/in"
operation = "scale"
value = 2
"""


STEPPED = """
[instance]
name = "{instance}"
clock = "stepped"

[[source]]
name = "sim"
connector = "simulation"
model = "shmio.simulation.loopback:Loopback"
writable = ["**"]
"""
OF_STEPS = """
[[injection]]
name = "noise"
target = "sim/joints/Kuka.j1/R"
operation = "noise"
amplitude = 0.25
start_s = 0.2
end_s = 0.7

[[injection]]
name = "stuck"
target = "sim/joints/Kuka.j2/R"
operation = "freeze"
when = "sim/joints/Kuka.j1/R > 100"
"""


@pytest.fixture
def cell(make_cell: Callable[..., Cell], tmp_path: Path) -> Cell:
    (tmp_path / "campaign.toml").write_text(CAMPAIGN)
    return make_cell(config=ARMED + RECORDER)


def start(cell: Cell) -> None:
    cell.up()
    until(lambda: cell.processes()["cell"]["quality"] == "good", "good quality")


@contextmanager
def campaign(cell: Cell, *options: str) -> Iterator[list[str]]:
    """Run ``shmio inject --file``. Yield its first lines in a list, which has all its lines after the context ends."""
    command = [str(BIN / "shmio"), "inject", "--file", "campaign.toml", *options]
    with subprocess.Popen(command, cwd=cell.folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as popen:
        try:
            assert popen.stdout is not None
            told = [popen.stdout.readline() for _ in range(3)]
            assert all(told), popen.communicate(timeout=PATIENCE_S)
            yield told
            popen.send_signal(signal.SIGINT)
            rest, errors = popen.communicate(timeout=PATIENCE_S)
            assert popen.returncode == 0, errors
            told += rest.splitlines(keepends=True)
        finally:
            popen.kill()


def event(events: Cursor[Event], kind: EventKind, name: str = "noise") -> Event:
    while (found := events.next(PATIENCE_S)) is not None:
        if found.kind == kind and found.text == name:
            return found
    raise AssertionError(f"no event {kind} of {name} has arrived")


def noise_of(cell: Cell, local: Attachment, seed: int) -> dict[int, tuple[object, object]]:
    """Return what consumers see in a run of the campaign, by number of cycles since its noise began."""
    local.write({"cell/Outputs/98": 0, "cell/Outputs/99": 0, "cell/Outputs/100": 100, "cell/Outputs/101": 100})
    block = local.block("cell")
    frames, events = block.cursor(), block.events.cursor()
    with campaign(cell, "--seed", str(seed)) as told:
        assert told[0] == f"seed {seed}: --seed {seed} repeats this run\n"
        event(events, EventKind.ACTIVATED, "doubled")
        (outcome,) = local.write({"cell/Outputs/98": 21})
        assert outcome.done
        until(lambda: local["cell/Outputs/98"] == 42, "the device has twice what was written")
        local.write({"cell/Outputs/99": 1})
        begin, end = event(events, EventKind.ACTIVATED), event(events, EventKind.DEACTIVATED)
    seen: dict[int, tuple[object, object]] = {}
    at = block.layout.registers[block.layout.by_path["Outputs"]].offset + 100
    while (frame := frames.next(PATIENCE_S)) is not None and frame.cycle < end.cycle:
        assert frame.raw[at : at + 2] == b"\x64\x64", "the device's own values are in the frame, too"
        if frame.cycle >= begin.cycle:
            seen[frame.cycle - begin.cycle] = (frame.image[at], frame.image[at + 1])
    assert any(re.search(rf"cycle {begin.cycle}  {begin.injection} activated: noise", line) for line in told), told
    assert local.injections("cell") == []
    return seen


def test_a_seed_repeats_a_campaign_and_is_recorded(cell: Cell) -> None:
    start(cell)
    with shmio.attach(cell.instance, writable=True) as local:
        first, second, other = (noise_of(cell, local, seed) for seed in (7, 7, 8))
    common = first.keys() & second.keys()
    assert len(common) > 10, "both runs have cycles in common"
    assert {place: first[place] for place in common} == {place: second[place] for place in common}
    assert any(first[place] != other[place] for place in first.keys() & other.keys())
    assert all(80 <= value <= 120 for pair in first.values() for value in pair if isinstance(value, int))
    cell.down()
    (file,) = (cell.folder / "dumps").glob("*.mem")
    recorded = cell.output("shmio-dump", "cat", "--json", str(file), "cell/Outputs/99")
    events = [line for line in map(json.loads, recorded.splitlines()) if line.get("text") == "noise"]
    assert [line["kind"] for line in events].count("activated") == 3, events[:5]
    seeds = [line["laid"]["seed"] for line in events if line["laid"]]
    assert seeds == [7, 7, 8], "the seeds that repeat the runs"


def test_a_campaign_derived_from_a_recording_repeats_it(make_cell: Callable[..., Cell], tmp_path: Path) -> None:
    cell = make_cell(config=STEPPED + RECORDER)
    (tmp_path / "campaign.toml").write_text(OF_STEPS)

    def run(file: str) -> Path:
        before = set((cell.folder / "dumps").glob("*.mem"))
        cell.up()
        until(lambda: cell.processes()["sim"]["quality"] == "good", "good quality")
        for command in (["inject", "--file", file, "--keep"], ["step", "--count", "50", "--dt-ms", "20"]):
            done = cell.run("shmio", *command)
            assert done.returncode == 0, done.stderr
        past = cell.run("shmio", "inject", "--file", file)
        assert (past.returncode, past.stdout) == (1, "")
        assert past.stderr.startswith(
            "the time of injection 'noise' has passed: its end_s is 0.7, but the instance's clock is at "
        )
        cell.down()
        (made,) = set((cell.folder / "dumps").glob("*.mem")) - before
        return made

    first = run("campaign.toml")
    derived = cell.run("shmio-dump", "campaign", str(first), "-o", "again.toml")
    assert derived.returncode == 0, derived.stderr
    second = run("again.toml")
    found = cell.run("shmio-dump", "diff", str(first), str(second), "--ignore", "times")
    assert found.returncode == 0, found.stdout
    told = cell.output("shmio-dump", "cat", str(second))
    assert " activated" in told
    assert " deactivated" in told


def test_a_reload_changes_configured_injections_without_a_restart(cell: Cell) -> None:
    file = cell.folder / "supervisor.toml"
    plain = file.read_text()
    file.write_text(plain + CONFIGURED)
    checked = cell.supervisor("check")
    assert "injection blind: set over source cell /out" in checked.stdout
    start(cell)
    pid = cell.processes()["cell"]["pid"]
    with shmio.attach(cell.instance, writable=True) as local:
        local.write({"cell/Outputs/98": 5, "cell/Outputs/99": 0x80})
        until(lambda: local["cell/Outputs/98"] == 77, "injected")
        assert local.read("cell/Outputs/98").provenance == "injected"
        listed = cell.output("shmio", "inject", "--list")
        assert re.search(r"cell/Outputs/98 /out, .*supervisor.toml, .*set, seed \d+: active.*blind", listed), listed
        file.write_text(plain + CONFIGURED.replace("77", "78"))
        assert "injection blind: changed at cell" in cell.supervisor("reload").stdout
        until(lambda: local["cell/Outputs/98"] == 78, "changed")
        assert cell.run("shmio", "inject", "--lift-all").returncode == 0
        until(lambda: local["cell/Outputs/98"] == 5, "lifted by lift-all")
        file.write_text(plain)
        assert "injection blind: lifted at cell" in cell.supervisor("reload").stdout
        until(lambda: local.injections("cell") == [], "the end of the injection")
    assert cell.processes()["cell"]["pid"] == pid
    file.write_text(plain + CONFIGURED.replace("cell/Outputs/98", "cell/Outputs/9800"))
    refused = cell.supervisor("reload")
    assert refused.returncode == 1
    assert "injection[0].target: cell/Outputs: index [9800] is outside" in refused.stderr
    assert '(injection "blind")' in refused.stderr
