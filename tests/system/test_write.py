"""Writes through the A50 cell: another program sees them in the controller's output."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import grpc
import pytest

import shmio
from shmio.segment import Quality, Segment
from shmio.testing.cell import CONFIG, PATIENCE_S, Cell, kill, until
from shmio.wire.simlog_v1_pb2 import PubRequest, ROSMessage, TopicDescriptor
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub

ROOT = Path(__file__).parents[2]
WRITABLE = CONFIG.replace('connector = "s7"\n', 'connector = "s7"\nwritable = ["Outputs", "Robot_*/*"]\n')
PLACE = "cell/Outputs/100"  # the controller's program ignores bytes from here on


@pytest.fixture(scope="module")
def cell(make_shared_cell: Callable[..., Cell]) -> Cell:
    """Start the A50 cell with writable outputs, and wait until it is good. Each test writes to other places."""
    cell = make_shared_cell(config=WRITABLE)
    cell.up()
    until(lambda: cell.processes()["cell"]["quality"] == "good", "good quality")
    return cell


@contextmanager
def client(cell: Cell) -> Iterator[Any]:
    with grpc.insecure_channel(str(cell.grpc)) as channel:
        yield SimlogAPIStub(channel)  # type: ignore[no-untyped-call]


@contextmanager
def subscribed(stub: Any, path: str) -> Iterator[Any]:
    stream = stub.Subscribe(TopicDescriptor(path=path), timeout=PATIENCE_S, wait_for_ready=True)
    stream.initial_metadata()  # once it is here, no later value is missed
    try:
        yield stream
    finally:
        stream.cancel()


def message(path: str, value: str) -> PubRequest:
    return PubRequest(topic=TopicDescriptor(path=path), data=ROSMessage(type="double", value=value))


def counters(cell: Cell) -> dict[str, int]:
    with closing(Segment.open(cell.instance)) as segment:
        return segment.processes.find("grpc").counters


def counted(cell: Cell) -> int:
    found = counters(cell)
    return found["published"] + found["refused"]


def test_every_subscriber_sees_a_value_written_by_set(cell: Cell) -> None:
    with client(cell) as stub, subscribed(stub, PLACE) as out, subscribed(stub, f"{PLACE}/in") as into:
        assert next(out).value == "0"
        done = cell.run("shmio", "set", PLACE, "16#2A")
        assert (done.returncode, done.stdout, done.stderr) == (0, f"{PLACE}  written\n", "")
        assert next(out).value == "42"
        assert next(into).value == "42"
    assert json.loads(cell.output("shmio", "get", "--json", PLACE))[PLACE]["value"] == 42


def test_every_subscriber_sees_a_published_value(cell: Cell) -> None:
    before, place = counters(cell), "cell/Outputs/103"
    with client(cell) as stub, subscribed(stub, place) as out, shmio.attach(cell.instance) as local:
        assert next(out).value == "0"
        view = local.frame("cell")
        stub.Publish(iter([message("cell/nothing", "1"), message(f"{place}/in", "7.0")]), timeout=PATIENCE_S)
        assert next(out).value == "7"
        frames = local.stream("cell", timeout_s=PATIENCE_S)
        assert next(frames)["Outputs/103"] == 7
        assert view["Outputs/103"] == 0
    until(lambda: [counters(cell)[name] - before[name] for name in ("published", "refused")] == [1, 1], "both counted")
    assert "publish refused: cell/nothing: DB201 has no such register" in cell.logs()


def test_the_example_publishes(cell: Cell) -> None:
    example = [sys.executable, str(ROOT / "examples/publish.py"), str(cell.grpc)]
    words = ["cell/Outputs/104", "9", "cell/Outputs/101/in", "1.0E1"]
    done = subprocess.run([*example, *words], capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    with shmio.attach(cell.instance) as local:
        until(lambda: (local["cell/Outputs/104"], local["cell/Outputs/101"]) == (9, 10), "the values")
    wrong = subprocess.run([*example, "cell/no", "9"], capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert (wrong.returncode, wrong.stdout) == (1, "")
    assert "NOT_FOUND" in wrong.stderr


def test_a_command_register_controls_the_plant(cell: Cell) -> None:
    with shmio.attach(cell.instance, writable=True) as local:
        assert [outcome.done for outcome in local.write({"cell/Outputs/13": 1})] == [True]  # command: hold
        positions = (view["Robot_800/Axs1_Pos"] for view in local.stream("cell", timeout_s=PATIENCE_S))
        until(lambda: len(set(islice(positions, 5))) == 1, "the robots stop")
        assert local.write({"cell/Outputs/13": 0})[0].done
        until(lambda: len(set(islice(positions, 5))) == 5, "the robots move")
        positions.close()


def test_a_refused_write_gives_one_clear_line(cell: Cell) -> None:
    for path, value, message in [
        ("cell/Inputs/0", "1", "cell/Inputs/0 is not writable; name it in the source's"),
        ("cell/Outputs/100.%X8", "1", "Outputs/100.%X8: BYTE has bits 0 to 7"),
        ("cell/Robot_800/Axs7_Pos", "1", "did you mean 'cell/Robot_800/Axs6_Pos'"),
        ("cell/Outputs/100", "256", "cell/Outputs/100: BYTE: 256 is out of range"),
        ("cell/Outputs", "[1, 2]", "cell/Outputs: expected all of the array's 1100 elements, found 2"),
    ]:
        done = cell.run("shmio", "set", path, value)
        assert (done.returncode, done.stdout) == (1, "")
        assert message in done.stderr
        assert done.stderr.count("\n") == 1


def test_without_a_controller_writes_are_rejected_with_the_reason(make_cell: Callable[..., Cell]) -> None:
    before, _, rest = WRITABLE.partition("[[emulator]]")
    cell = make_cell(config=f"{before}[grpc]{rest.partition('[grpc]')[2]}")
    cell.up()
    until(lambda: "refused" in (cell.processes()["cell"]["note"] or ""), "no controller")
    done = cell.run("shmio", "set", PLACE, "5")
    assert (done.returncode, done.stdout) == (1, f"{PLACE}  rejected\n")
    assert done.stderr.startswith(
        f"{PLACE}: not written, because the source did not accept the command: the source is not connected"
    )
    assert "shmio-supervisor status" in done.stderr
    assert done.stderr.count("\n") == 1
    with client(cell) as stub:
        stub.Publish(iter([message(PLACE, "5")] * 3), timeout=PATIENCE_S)
    until(lambda: counters(cell)["refused"] == 3, "all counted")


def test_a_publish_stream_survives_a_killed_source(cell: Cell) -> None:
    sent, before = 0, counters(cell)

    def numbered(value: str | None = None) -> PubRequest:
        nonlocal sent
        sent += 1
        return message(PLACE, value or str(sent % 100))

    def values() -> Iterator[PubRequest]:
        source = cell.processes()["cell"]["pid"]
        while counters(cell)["published"] < before["published"] + 20:
            yield numbered()
        kill(source)
        while not _good_again(cell):
            yield numbered()
        yield numbered("200")

    with client(cell) as stub:
        stub.Publish(values(), timeout=4 * PATIENCE_S)
        with subscribed(stub, PLACE) as out:
            assert "200" in (value.value for value in out)
    until(lambda: counted(cell) - before["published"] - before["refused"] == sent, "every message counted")
    assert cell.processes()["grpc"]["restarts"] == 0


def _good_again(cell: Cell) -> bool:
    with shmio.attach(cell.instance) as local:
        view = local.frame("cell")
        return view.frame.incarnation > 1 and view.quality is Quality.GOOD
