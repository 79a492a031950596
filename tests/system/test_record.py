"""A cell is recorded, killed and inspected, all by commands."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from shmio.testing.cell import CONFIG, Cell, kill, until

RECORDED = CONFIG + '\n[recorder]\ndirectory = "dumps"\n'
AXIS = "cell/Robot_800/Axs1_Pos"


def info(cell: Cell, file: Path) -> dict[str, Any]:
    """Return ``info --json`` of one of the cell's files."""
    found: dict[str, Any] = json.loads(cell.output("shmio-dump", "info", "--json", str(file)))
    return found


def values(cell: Cell, file: Path) -> list[dict[str, Any]]:
    lines = cell.output("shmio-dump", "cat", "--json", str(file), AXIS).splitlines()
    return [line for line in map(json.loads, lines) if "frame" in line]


def test_log_mode_records_everything_though_its_recorder_is_killed(make_cell: Callable[..., Cell]) -> None:
    cell = make_cell(config=RECORDED)
    up = cell.supervisor("up", "--detach", "--mode", "log")
    assert up.returncode == 0, up.stderr
    assert cell.status()["mode"] == "log"
    assert list(cell.processes()) == ["plc", "cell", "recorder"]
    until(lambda: cell.processes()["recorder"]["counters"]["frames"] >= 100, "frames")
    before = cell.processes()
    [first] = (cell.folder / "dumps").iterdir()
    assert before["recorder"]["note"] == f"to {first.name}"
    kill(before["recorder"]["pid"])
    until(
        lambda: (
            (now := cell.processes()["recorder"])["pid"] not in (None, before["recorder"]["pid"])
            and now["counters"]["frames"] >= 50
        ),
        "another recorder, at work",
    )
    assert cell.processes()["cell"]["pid"] == before["cell"]["pid"]
    cell.down()
    [second] = set((cell.folder / "dumps").iterdir()) - {first}
    killed, whole = info(cell, first), info(cell, second)
    assert (killed["closed"], whole["closed"]) == (True, True), cell.logs()
    [old], [new] = killed["blocks"], whole["blocks"]
    assert (old["first_frame"], old["frames"]) == (1, old["last_frame"]), "from the source's first frame"
    missed = whole["missed_frames"]
    assert new["first_frame"] == old["last_frame"] + 1 + missed
    assert new["frames"] == new["last_frame"] - new["first_frame"] + 1
    assert {"config/supervisor.toml", "sources/cell/1/db201.db"} < set(whole["attachments"])
    checked = cell.run("shmio-dump", "verify", str(first), str(second))
    assert (checked.returncode, checked.stdout.count("no damage")) == (0, 2), checked.stdout
    assert len(values(cell, second)) > 1
    events = [json.loads(line) for line in cell.output("shmio-dump", "cat", "--json", str(second)).splitlines()]
    assert [event for event in events if "source" in event][-1]["kind"] == "stopped", "up to the source's last event"
    assert values(cell, second)[-1]["quality"] == "bad"


def test_a_live_cell_is_recorded_from_outside(cell: Cell) -> None:
    done = cell.run("shmio-dump", "record", "--for", "2", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    [file] = (cell.folder / "dumps").iterdir()
    begun, ended = (json.loads(line) for line in done.stdout.splitlines())
    name = f"dumps/{file.name}"
    assert begun == {"what": "recording", "instance": cell.instance, "sources": ["cell"], "file": name}
    assert (ended["what"], ended["file"], ended["missed"], ended["whole"]) == ("ended", name, 0, True)
    found = info(cell, file)
    assert (found["closed"], found["missed_frames"], found["recorder"]) == (True, 0, "shmio-dump")
    assert "config/supervisor.toml" in found["attachments"], done.stderr
    [block] = found["blocks"]
    assert block["frames"] == block["last_frame"] - block["first_frame"] + 1 == ended["frames"] > 1
    assert len({line["values"][AXIS.removeprefix("cell/")] for line in values(cell, file)}) > 1


def test_a_reload_is_recorded_in_the_same_file(make_cell: Callable[..., Cell]) -> None:
    """One source is added, and the layout of the other changes; the recorder keeps running."""
    cell = make_cell(config=RECORDED)
    cell.up()
    recorder = cell.processes()["recorder"]["pid"]
    file = cell.folder / "supervisor.toml"
    text = file.read_text()
    begin = text.index("[[source]]")
    section = text[begin : text.index("[[emulator]]")]
    layout = cell.folder / "db201.db"
    (cell.folder / "second.db").write_text(layout.read_text())
    layout.write_text(layout.read_text().replace("Axs1_Pos", "Axis1"))
    second = section.replace('"cell"', '"second"')
    file.write_text(text[:begin] + section + (second + text[begin + len(section) :]).replace("db201", "second"))
    done = cell.supervisor("reload")
    assert done.returncode == 0, done.stderr
    [recording] = (cell.folder / "dumps").iterdir()
    until(
        lambda: (
            {(block["source"], block["block"]) for block in info(cell, recording)["blocks"] if block["frames"] > 9}
            == {("cell", 1), ("cell", 2), ("second", 3)}
        ),
        "frames of all blocks",
    )
    assert cell.processes()["recorder"]["pid"] == recorder
    cell.down()
    found = info(cell, recording)
    assert (found["closed"], found["gap_count"]) == (True, 0)
    assert {"sources/cell/1/db201.db", "sources/cell/2/db201.db", "sources/second/3/second.db"} < set(
        found["attachments"]
    )
    old, new, second = found["blocks"]
    assert old["layout_hash"] == second["layout_hash"] != new["layout_hash"]
    lines = cell.output("shmio-dump", "cat", "--json", str(recording), "cell/Robot_800/Axis1", "--from", "0")
    assert all(
        set(line["values"]) == {"Robot_800/Axis1"} for line in map(json.loads, lines.splitlines()) if "frame" in line
    )


def test_notes_and_process_deaths_are_recorded(make_cell: Callable[..., Cell]) -> None:
    cell = make_cell(config=RECORDED)
    cell.up()
    done = cell.run("shmio-dump", "note", "Greifer getauscht")
    assert (done.returncode, done.stderr) == (0, ""), cell.logs()
    for arguments, message in (
        (["x" * 257], "a note must have 1 to 256 bytes in UTF-8, but this one has 257"),
        ([""], "a note must have 1 to 256 bytes in UTF-8, but this one has 0"),
        (["Greifer \udce4b"], "a note must be UTF-8 text, but character 9 is not"),
        (["x", "--source", "press"], "unknown source 'press'; valid: cell"),
    ):
        failed = cell.run("shmio-dump", "note", *arguments)
        assert (failed.returncode, message in failed.stderr) == (1, True), failed.stderr
        assert failed.stderr.count("\n") == 1
    longest = "\x1b[2J" + "ö" * 126
    assert cell.run("shmio-dump", "note", longest).returncode == 0
    pid = cell.processes()["cell"]["pid"]
    kill(pid)
    until(lambda: cell.processes()["cell"]["state"] == "running" and cell.processes()["cell"]["pid"] != pid, "its end")
    cell.down()
    [file] = (cell.folder / "dumps").iterdir()
    printed = cell.output("shmio-dump", "cat", str(file))
    assert f"process cell died, pid {pid}: killed by SIGKILL" in printed
    assert "process recorder is, pid" in printed
    notes = re.findall(r": noted by local: uid \d+ \(pid \d+ shmio-dump\): (.*)", printed)
    assert notes == ["Greifer getauscht", rf"\x1b[2J{'ö' * 126}"], "complete, with control characters escaped"
