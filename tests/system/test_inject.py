"""Injections in the A50 cell, by command and by program, which end with their client."""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import grpc
import pytest
from google.protobuf.struct_pb2 import Value

import shmio
from shmio.errors import CommandError
from shmio.testing.cell import BIN, PATIENCE_S, Cell, kill, until
from shmio.wire.simlog_v1_pb2 import TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub
from shmio.wire.simlog_v2_pb2 import PubRequest, SimlogMessage
from shmio.wire.simlog_v2_pb2_grpc import SimlogAPIStub as SimlogV2Stub
from tests.system.armed import ARMED, UNARMED

MEMORY = """
[[source]]
name = "panel"
connector = "memory"
layout = "panel.toml"
writable = ["**"]
"""
PLACE = "cell/Outputs/100"  # the controller's program ignores it
POSITION = "cell/Robot_800/Axs1_Pos"


@pytest.fixture(scope="module")
def cell(make_shared_cell: Callable[..., Cell]) -> Cell:
    """Start the A50 cell with injections toward the controller, a second source without them, and a memory.

    Each test lifts its injections.
    """
    cell = make_shared_cell(config=ARMED + UNARMED + MEMORY)
    (cell.folder / "panel.toml").write_text('[registers]\nspeed = { type = "REAL", initial = 0.5 }\n')
    cell.up()
    until(lambda: all(cell.processes()[name]["quality"] == "good" for name in ("cell", "panel")), "good quality")
    return cell


@contextmanager
def injecting(cell: Cell, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    command = [str(BIN / "shmio"), "inject", *arguments]
    with subprocess.Popen(command, cwd=cell.folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as popen:
        try:
            assert popen.stdout is not None
            line = popen.stdout.readline()
            assert ": " in line, popen.communicate(timeout=PATIENCE_S)
            yield popen
        finally:
            popen.kill()


def get(cell: Cell, path: str) -> dict[str, object]:
    shown: dict[str, dict[str, object]] = json.loads(cell.output("shmio", "get", "--json", path))
    return shown[path]


def test_all_consumers_see_the_injected_value_until_the_command_ends(cell: Cell) -> None:
    with grpc.insecure_channel(str(cell.grpc)) as channel, shmio.attach(cell.instance) as local:
        stub = SimlogAPIStub(channel)  # type: ignore[no-untyped-call]
        stream = stub.Subscribe(TopicDescriptor(path=POSITION), timeout=PATIENCE_S, wait_for_ready=True)
        next(stream)
        with injecting(cell, POSITION, "-1.5", "panel/speed", "9", "--name", "test 7") as command:
            assert get(cell, POSITION)["value"] == -1.5
            assert get(cell, POSITION)["provenance"] == "injected"
            assert get(cell, "cell/Robot_800/Axs2_Pos")["provenance"] == "live"
            view = local.frame("cell")
            assert view["Robot_800/Axs1_Pos"] == -1.5
            assert view.original("Robot_800/Axs1_Pos") != -1.5
            assert local["panel/speed"] == 9
            until(lambda: next(stream).value == "-1.5", "the injected value at the subscriber")
            listed = cell.run("shmio", "inject")
            assert POSITION in listed.stdout
            assert "test 7" in listed.stdout
            command.send_signal(signal.SIGINT)
            assert command.wait(PATIENCE_S) == 0
        assert get(cell, POSITION)["value"] != -1.5
        assert get(cell, "panel/speed")["value"] == 0.5
        until(lambda: next(stream).value != "-1.5", "the original at the same subscriber")
        assert cell.output("shmio", "inject") == ""


def test_an_injection_on_in_intercepts_writes_before_the_device(cell: Cell) -> None:
    with injecting(cell, f"{PLACE}/in", "7"):
        until(lambda: get(cell, PLACE)["value"] == 7, "the device has the injected value")
        done = cell.run("shmio", "set", PLACE, "9")
        assert (done.returncode, done.stdout) == (0, f"{PLACE}  taken\n")
        assert get(cell, PLACE)["value"] == 7
    until(lambda: cell.run("shmio", "set", PLACE, "9").stdout == f"{PLACE}  written\n", "lifted")


def test_injections_end_with_their_client_but_survive_a_killed_source(cell: Cell) -> None:
    with injecting(cell, POSITION, "55.5") as command:
        pid = cell.processes()["cell"]["pid"]
        kill(pid)
        until(lambda: cell.processes()["cell"]["pid"] not in (pid, None), "another process")
        until(lambda: get(cell, POSITION)["quality"] == "good", "good again")
        assert get(cell, POSITION)["value"] == 55.5
        assert command.poll() is None, "it knows that its injection is still there"
        command.kill()
        command.wait()
        until(lambda: get(cell, POSITION)["value"] != 55.5, "lifted")


def test_keep_and_for_exclude_each_other(cell: Cell) -> None:
    both = cell.run("shmio", "inject", "--for", "1", "--keep", POSITION, "11")
    assert (both.returncode, both.stdout) == (2, "")
    assert "argument --keep: not allowed with argument --for" in both.stderr
    assert cell.output("shmio", "inject") == ""


def test_a_kept_injection_stays_until_it_is_lifted(cell: Cell) -> None:
    kept = cell.run("shmio", "inject", "--keep", POSITION, "11")
    assert kept.returncode == 0, kept.stderr
    number = kept.stdout.partition(":")[0]
    assert get(cell, POSITION)["value"] == 11
    assert json.loads(cell.output("shmio", "inject", "--json"))[0]["registers"] == [POSITION]
    assert cell.output("shmio", "inject", "--lift", number).startswith(f"{number}: lifted from cell")
    assert get(cell, POSITION)["value"] != 11
    again = cell.run("shmio", "inject", "--lift", number)
    assert (again.returncode, again.stderr) == (
        1,
        f"there is no injection {number}; shmio inject lists the injections\n",
    )
    cell.run("shmio", "inject", "--keep", POSITION, "11", "panel/speed", "2")
    assert len(cell.output("shmio", "inject", "--lift-all").splitlines()) == 2
    assert cell.output("shmio", "inject") == ""


def test_a_program_injects(cell: Cell) -> None:
    with shmio.attach(cell.instance, writable=True) as local:
        with local.inject("cell/Robot_800", "cell/Robot_825", priority=2) as shadow:
            held = local["cell/Robot_800/Axs1_Pos"]
            shadow.set({"cell/Robot_825/Axs2_Pos": 1.25})
            assert local["cell/Robot_825/Axs2_Pos"] == 1.25
            for _, view in zip(range(5), local.stream("cell", timeout_s=PATIENCE_S), strict=False):
                assert view["Robot_800/Axs1_Pos"] == held
        with pytest.raises(CommandError, match="there is no injection"):
            shadow.lift()


def test_a_source_that_is_not_armed_refuses_injections(cell: Cell) -> None:
    until(lambda: cell.processes()["unarmed"]["quality"] == "good", "good quality")
    refused = cell.run("shmio", "inject", "unarmed/Outputs/100/in", "7")
    assert refused.returncode == 1
    assert refused.stderr == (
        "unarmed: an injection toward a device needs `armed = true` in the configuration of source 'unarmed'\n"
    )


def test_an_intercepted_write_succeeds_for_its_publisher(cell: Cell) -> None:
    with grpc.insecure_channel(str(cell.grpc)) as channel, injecting(cell, f"{PLACE}/in", "7"):
        stub = SimlogV2Stub(channel)  # type: ignore[no-untyped-call]
        message = SimlogMessage(value=Value(number_value=9))
        stub.Write(PubRequest(topic=f"{PLACE}/in", data=message), timeout=PATIENCE_S, wait_for_ready=True)
        assert get(cell, PLACE)["value"] == 7
