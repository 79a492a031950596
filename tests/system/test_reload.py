"""A cell whose configuration changes while it runs and has clients."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import grpc
import pytest

import shmio
from shmio.segment import Quality
from shmio.testing.cell import PATIENCE_S, Cell, until
from shmio.wire.simlog_v1_pb2 import TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub

PATH = "Robot_800/Axs1_Pos"
SECOND = """
[[source]]
name = "second"
connector = "s7"
layout = "db201.db"
period_ms = 50
host = "127.0.0.1"
port = {port}
timeout = 1000
"""


def edit(cell: Cell, old: str, new: str) -> None:
    file = cell.folder / "supervisor.toml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def add_second(cell: Cell) -> None:
    text = (cell.folder / "supervisor.toml").read_text()
    port = re.search(r"port = (\d+)", text)
    assert port is not None
    edit(cell, "[[emulator]]", SECOND.format(port=port[1]) + "\n[[emulator]]")


def remove_second(cell: Cell) -> None:
    text = (cell.folder / "supervisor.toml").read_text()
    begin, end = text.index('[[source]]\nname = "second"'), text.index("[[emulator]]")
    (cell.folder / "supervisor.toml").write_text(text[:begin] + text[end:])


@pytest.fixture
def stub(cell: Cell) -> Iterator[SimlogAPIStub]:
    with grpc.insecure_channel(str(cell.grpc)) as channel:
        yield SimlogAPIStub(channel)  # type: ignore[no-untyped-call]


def test_adding_and_removing_a_source_leaves_other_streams_alone(cell: Cell, stub: SimlogAPIStub) -> None:
    stream = stub.Subscribe(TopicDescriptor(path=f"cell/{PATH}"), timeout=4 * PATIENCE_S, wait_for_ready=True)
    next(stream)
    pids = {name: process["pid"] for name, process in cell.processes().items()}
    assert cell.run("shmio", "get", PATH).returncode == 0
    error = "no source 'x' and no register 'x/y' in source 'cell'\n"
    assert cell.run("shmio", "get", "x/y").stderr == error
    add_second(cell)
    done = cell.supervisor("reload")
    assert (done.returncode, done.stderr) == (0, "")
    error = f"{PATH}: 'Robot_800' is not one of the 2 sources; begin the path with cell/… or second/…\n"
    assert cell.run("shmio", "get", PATH).stderr == error
    assert done.stdout.splitlines() == ["second: started", f"{cell.instance}: 3 processes kept as they were"]
    until(lambda: cell.processes()["second"]["quality"] == "good", "the new source is good")
    assert {name: process["pid"] for name, process in cell.processes().items() if name in pids} == pids
    second = stub.Subscribe(TopicDescriptor(path=f"second/{PATH}"), timeout=4 * PATIENCE_S)
    assert next(second).value
    assert next(stream).value, "the stream of the other source continues"
    with shmio.attach(cell.instance) as reader:
        assert reader.read(f"second/{PATH}").quality is Quality.GOOD
        assert set(reader.sources) == {"cell", "second"}
        remove_second(cell)
        done = cell.supervisor("reload")
        assert done.stdout.splitlines()[0] == "second: stopped", done.stderr
        assert reader.sources == ["cell"]
    with pytest.raises(grpc.RpcError) as caught:
        for _ in second:
            pass
    assert caught.value.code() is grpc.StatusCode.NOT_FOUND
    assert "source second was removed by a reload" in str(caught.value.details())
    assert next(stream).value
    assert {name: process["pid"] for name, process in cell.processes().items()} == pids
    stream.cancel()


def test_a_new_layout_keeps_the_streams_of_registers_that_remain(cell: Cell, stub: SimlogAPIStub) -> None:
    kept = stub.Subscribe(TopicDescriptor(path=f"cell/{PATH}"), timeout=4 * PATIENCE_S, wait_for_ready=True)
    ended = stub.Subscribe(TopicDescriptor(path="cell/Inputs/3"), timeout=4 * PATIENCE_S)
    next(kept), next(ended)
    grpc_pid = cell.processes()["grpc"]["pid"]
    own = (cell.folder / "db201.db").read_text().replace("Inputs", "Entries")
    (cell.folder / "own.db").write_text(own)
    edit(cell, 'connector = "s7"\nlayout = "db201.db"', 'connector = "s7"\nlayout = "own.db"')
    done = cell.supervisor("reload")
    assert done.stderr == ""
    assert "cell: changed, and keeps its connection" in done.stdout
    with pytest.raises(grpc.RpcError) as caught:
        for _ in ended:
            pass
    assert caught.value.code() is grpc.StatusCode.NOT_FOUND
    heard = [next(kept).value for _ in range(100)]
    assert len(set(heard)) > 1
    assert cell.processes()["grpc"]["pid"] == grpc_pid
    kept.cancel()


def test_reload_prints_the_same_warnings_as_check(cell: Cell) -> None:
    edit(cell, "period_ms = 20", 'period_ms = 20\nwritable = ["Outpts"]')
    file = cell.folder / "supervisor.toml"
    line = 1 + file.read_text().splitlines().index('writable = ["Outpts"]')
    warning = (
        f"{file}:{line}: warning: source[0].writable: 'Outpts' matches no register of DB201; did you mean 'Outputs'?"
    )
    dry = cell.supervisor("reload", "--dry-run")
    assert (dry.returncode, dry.stderr) == (0, f"{warning}\n")
    assert dry.stdout.splitlines() == [
        'would keep the connection of cell: writable: ["Outpts"] instead of []',
        f"{cell.instance}: 2 processes would be kept; nothing was changed",
    ]
    done = cell.supervisor("reload")
    assert (done.returncode, done.stderr) == (0, f"{warning}\n")
    assert "cell: changed, and keeps its connection" in done.stdout
    assert warning in cell.supervisor("check", "-c", str(file)).stdout.splitlines()
    found = json.loads(cell.supervisor("reload", "--json").stdout)
    kept = sorted(cell.processes())
    assert {**found, "kept": sorted(found["kept"])} == {
        "instance": cell.instance, "done": [], "kept": kept, "warnings": [warning], "problems": []
    }  # fmt: skip


def test_an_error_in_the_configuration_changes_nothing(cell: Cell) -> None:
    before = cell.processes()
    edit(cell, "period_ms = 20", "period_ms = -1")
    done = cell.supervisor("reload")
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert "period_ms" in line
    assert json.loads(cell.supervisor("reload", "--json").stdout) == {"error": line}
    dry = cell.supervisor("reload", "--dry-run", "--json")
    assert (dry.returncode, json.loads(dry.stdout)["faults"]) == (1, [line])
    edit(cell, "period_ms = -1", "period_ms = 20")
    edit(cell, "[grpc]", f'[recorder]\ndirectory = "{"x" * 300}"\n\n[grpc]')
    done = cell.supervisor("reload")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "recorder.directory: " in done.stderr
    assert "File name too long" in done.stderr
    edit(cell, f'[recorder]\ndirectory = "{"x" * 300}"\n\n[grpc]', "[grpc]")
    edit(cell, "[instance]", '[instance]\nlog_dir = "elsewhere"')
    done = cell.supervisor("reload")
    assert done.returncode == 1
    assert "instance.log_dir" in done.stderr
    assert "down and up" in done.stderr
    assert done.stderr.count("\n") == 1
    after = cell.processes()
    assert {n: p["pid"] for n, p in after.items()} == {n: p["pid"] for n, p in before.items()}
