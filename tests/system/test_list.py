"""Several instances on one host: listing them, and starting one several times at once."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

from shmio.segment import Segment
from shmio.testing.cell import BIN, PATIENCE_S, Cell
from shmio.testing.ports import reserved_port

MEMORY = """
[instance]
name = "{}"

[[source]]
name = "cell"
connector = "memory"
layout = "cell.toml"
period_ms = 20
"""


def test_list_shows_each_instance_with_file_state_and_addresses(make_cell: Callable[..., Cell], instance: str) -> None:
    cell = make_cell()
    cell.up()
    with Segment.create(f"{instance}-b", [], []) as silent:
        listed = {one["name"]: one for one in json.loads(cell.supervisor("list", "--json").stdout)}
        [row] = [line for line in cell.supervisor("list").stdout.splitlines() if line.split()[0] == instance]
        silent.unlink()
    file, plc = str(cell.folder.resolve() / "supervisor.toml"), cell.processes()["plc"]["pid"]
    assert plc is not None
    found = listed[instance]
    assert (found["file"], found["note"]) == (file, "")
    assert found["state"] in ("running", "degraded")
    assert found["listen"]["grpc"] == [str(cell.grpc)]
    assert list(found["listen"]) == ["plc", "grpc"]
    assert file in row
    assert f"grpc {cell.grpc}" in row
    other = listed[f"{instance}-b"]
    assert (other["file"], other["listen"]) == ("", {})
    assert "cannot be reached" in other["note"]


def test_of_five_simultaneous_starts_one_succeeds(tmp_path: Path, instance: str) -> None:
    (tmp_path / "cell.toml").write_text('[registers]\nMode = "INT"\n')
    (tmp_path / "supervisor.toml").write_text(MEMORY.format(instance))
    command = [str(BIN / "shmio-supervisor"), "up", "--detach"]
    racing = [
        subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        for _ in range(5)
    ]
    ended = [(process.communicate(timeout=PATIENCE_S)[1], process.returncode) for process in racing]
    with reserved_port() as address:
        Cell(tmp_path, instance, address).down()
    assert [status for _, status in ended].count(0) == 1, ended
    for error, status in ended:
        if status:
            assert (status, error.count("\n")) == (1, 1), error
            assert error.startswith(f"instance {instance!r} is already running"), error
