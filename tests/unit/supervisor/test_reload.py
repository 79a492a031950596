"""Reloads of a running instance, with real processes."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

import shmio
from shmio.control import Reload, Restart, Where
from shmio.errors import ControlError
from shmio.segment import Quality, Segment
from tests.unit.supervisor.harness import CELL, DEADLINE_S, Job, Launch, Launched, until

PRESS: Job = ("press", "source", ["good"])


def refused_later(cell: Launched) -> tuple[threading.Thread, list[str]]:
    """Request a reload in a thread; return the thread and the list for its errors."""
    outcomes: list[str] = []

    def reload() -> None:
        try:
            cell.reload(CELL)
        except ControlError as error:
            outcomes.append(str(error))

    asking = threading.Thread(target=reload)
    asking.start()
    return asking, outcomes


def test_a_reload_without_changes_changes_nothing(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    quiet: dict[str, Any] = {"warnings": [], "done": [], "problems": []}
    assert cell.reload(CELL) == {"ok": True, **quiet, "kept": ["plc", "cell", "grpc"]}
    assert cell.pids() == before


def test_warnings_are_reported_as_far_as_the_answer_has_room(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    assert cell.reload(CELL, warnings=["odd", "odder"])["warnings"] == ["odd", "odder"]
    told = cell.reload(CELL, warnings=["é" * 1000] * 1000)["warnings"]
    assert 0 < len(told) < 100
    assert told[-1] == f"… and {1000 - len(told) + 1} more warnings: shmio-supervisor check prints them"
    told = cell.reload(CELL, warnings=["\1" * 9000] * 60)["warnings"]
    assert told[0] == "\1" * 1999 + "…", "six bytes each in the answer"
    assert told[-1] == f"… and {60 - len(told) + 1} more warnings: shmio-supervisor check prints them"


def test_the_age_of_the_configuration_is_that_of_the_last_successful_reload(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    times = [cell.request(Where())["read_ns"]]
    cell.reload(CELL)
    times.append(cell.request(Where())["read_ns"])
    (cell.folder / "plan.json").write_text("{")
    with pytest.raises(ControlError, match="no JSON"):
        cell.request(Reload())
    assert times[0] < times[1] == cell.request(Where())["read_ns"]


def test_a_source_is_added_and_nothing_else_changes(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    with shmio.attach(cell.instance) as reader:
        assert cell.reload([*CELL, PRESS])["done"] == ["press: started"]
        after = cell.pids()
        assert after.pop("press") is not None
        assert after == before
        until(lambda: reader.read("press/a").quality is Quality.GOOD)
        assert cell.of("press").state == "running"
        assert cell.request(Restart("press")) == {"ok": True}


def test_a_source_is_removed_and_its_place_is_used_again(launch: Launch) -> None:
    cell = launch([*CELL, PRESS])
    cell.wait_state("running")
    before = cell.pids()
    gone = before.pop("press")
    with shmio.attach(cell.instance) as reader:
        held = reader.block("press")
        assert cell.reload(CELL)["done"] == ["press: stopped"]
        assert cell.pids() == before
        assert held.retired
        assert reader.sources == ["cell"]
    assert gone is not None
    assert not Path(f"/proc/{gone}").exists()
    with Segment.open(cell.instance) as segment:
        places = {slot.name: slot.index for slot in segment.processes}
    assert cell.reload([*CELL, ("robot", "source", ["good"])])["done"] == ["robot: started"]
    with Segment.open(cell.instance) as segment:
        assert segment.processes.find("robot").index not in places.values()
        assert segment.processes.find("robot").index == max(places.values()) + 1
        assert segment.processes.find("robot").supervised.restarts == 0
    assert [slot.name for slot in segment.processes.external] == ["guest-1", "guest-2", "guest-3", "guest-4"]


def test_other_processes_notice_a_new_process_that_has_no_block(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    with Segment.open(cell.instance) as segment:
        robot = ("robot", "emulator", ["good"])
        for jobs, names in (([*CELL, robot], {"robot"}), (CELL, set())):
            cell.reload(jobs)
            assert segment.refresh()
            assert {slot.name for slot in segment.processes} == {"plc", "cell", "grpc", *names}


def test_a_process_with_a_changed_configuration_is_replaced(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    changed = [CELL[0], CELL[1], ("grpc", "grpc", ["good", "good"])]
    answer = cell.reload(changed)
    assert answer["done"] == ["grpc: restarted, because its configuration has changed"]
    after = cell.pids()
    assert after.pop("grpc") != before.pop("grpc")
    assert after == before
    assert cell.reload(changed)["done"] == []


def test_another_layout_replaces_block_and_source_and_streams_continue(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    with shmio.attach(cell.instance) as reader:
        stream = reader.stream("cell", timeout_s=20)
        assert next(stream).layout.size == 2
        answer = cell.reload([CELL[0], (*CELL[1], "new"), CELL[2]])
        assert answer["done"] == [
            "cell: restarted, because its configuration has changed",
            "cell: registers: 1 added (b), 1 moved (a)",
        ]
        assert next(view for view in stream if view.layout.size == 4)["a"] == 0
    after = cell.pids()
    assert after.pop("cell") != before.pop("cell")
    assert after == before


def test_a_name_can_become_another_kind_of_process(launch: Launch) -> None:
    cell = launch([*CELL, PRESS])
    cell.wait_state("running")
    answer = cell.reload([*CELL, ("press", "emulator", ["good"])])
    assert answer["done"] == ["press: stopped", "press: started"]
    assert (cell.of("press").kind, cell.of("press").state) == ("emulator", "running")


def test_a_wrong_configuration_changes_nothing(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    (cell.folder / "plan.json").write_text("{")
    with Segment.open(cell.instance) as segment:
        generation = segment.generation
        with pytest.raises(ControlError, match=r"^plan.json: no JSON$"):
            cell.request(Reload())
        assert segment.generation == generation
    assert cell.pids() == before


def test_a_reload_that_fails_with_an_exception_changes_nothing(launch: Launch) -> None:
    """A connector of another package may raise such an exception."""
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    (cell.folder / "plan.json").write_text("{}")
    with pytest.raises(ControlError, match=r"^the reload failed: KeyError: 'jobs'$"):
        cell.request(Reload())
    assert "Traceback" in cell.log()
    assert cell.pids() == before
    assert cell.reload(CELL)["done"] == []


def test_removed_processes_are_stopped_in_the_order_of_a_stop(launch: Launch) -> None:
    cell = launch([*CELL, ("press", "source", ["stubborn"])], grace_s=3600)
    cell.wait_state("running")
    press = cell.pid("press")
    reloading = threading.Thread(target=cell.reload, args=(CELL[1:],))
    reloading.start()
    until(lambda: cell.of("press").note == "stopping")
    plc = cell.of("plc")
    assert (plc.state, plc.note) == ("running", ""), "emulators and recorders are stopped after the sources"
    os.kill(press, signal.SIGKILL)
    reloading.join()
    assert list(cell.pids()) == ["cell", "grpc"]


@pytest.mark.parametrize(
    ("others", "refused"),
    [
        ({"instance": "other"}, "instance.name"),
        ({"log_dir": "/elsewhere"}, "instance.log_dir"),
        ({"stepped": True}, "instance.clock"),
    ],
)
def test_a_key_that_cannot_change_is_named_in_the_refusal(launch: Launch, others: dict[str, Any], refused: str) -> None:
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    with pytest.raises(
        ControlError, match=rf"{refused}: this key cannot change .* while the instance runs.*down and up"
    ):
        cell.reload([*CELL, PRESS], **others)
    assert cell.pids() == before


def test_a_reload_without_room_changes_nothing(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    many = [(f"more-{i}", "source", ["good"]) for i in range(41)]
    with pytest.raises(ControlError, match="has room for 16 more processes, not for 40; restart the instance"):
        cell.reload([*CELL[1:], *many])
    emulators = [(f"more-{i}", "emulator", ["good"]) for i in range(17)]
    with pytest.raises(ControlError, match="room for 16 more processes, not for 17"):
        cell.reload([*CELL, *emulators])
    assert cell.pids() == before
    with Segment.open(cell.instance) as segment:
        assert list(segment.blocks) == ["cell"]


def test_without_free_blocks_the_instance_continues_unchanged(launch: Launch) -> None:
    """Each reload changes the layout of ten sources; an instance has room for four such reloads."""
    names = [f"cell-{i}" for i in range(10)]

    def jobs(layout: str) -> list[Any]:
        return [(name, "source", ["good"], layout) for name in names]

    cell = launch([(name, "source", ["good"]) for name in names])
    cell.wait_state("running")
    for layout in ("new", "old", "new", "old"):
        assert len([line for line in cell.reload(jobs(layout))["done"] if "restarted" in line]) == 10
    before = cell.pids()
    with Segment.open(cell.instance) as segment:
        size, generation = segment.shared.size, segment.generation
        with pytest.raises(ControlError, match=r"has room for [0-9] more blocks, not for 10 .*; restart the instance"):
            cell.reload(jobs("new"))
        assert (segment.shared.size, segment.generation) == (size, generation)
        cursor = segment.blocks[names[0]].cursor()
        assert cursor.next(20) is not None, "frames continue"
    assert cell.pids() == before
    assert cell.status().state == "running"
    assert cell.request(Restart(names[0])) == {"ok": True}
    assert cell.reload(jobs("old")[1:])["done"] == [f"{names[0]}: stopped"], "a change that needs no block is done"


def test_another_ring_size_replaces_only_affected_blocks(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    assert cell.reload(CELL, ring=1 << 24)["kept"] == ["plc", "cell", "grpc"], "the ring already had room for 8 s"
    with shmio.attach(cell.instance) as reader:
        old = reader.block("cell")
        stream = reader.stream("cell", timeout_s=20)
        next(stream)
        answer = cell.reload(CELL, ring=1 << 14)
        assert (answer["done"], answer["kept"]) == (
            ["cell: restarted, because its configuration has changed"],
            ["plc", "grpc"],
        )
        new = reader.block("cell")
        assert new.ring.slot_count < old.ring.slot_count
        while next(stream).section != new.section:
            pass
    after = cell.pids()
    assert after.pop("cell") != before.pop("cell")
    assert after == before


def test_a_new_process_that_does_not_run_is_reported_and_the_rest_continues(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    before = cell.pids()
    answer = cell.reload([*CELL, ("press", "source", ["unfit"])])
    assert answer["problems"] == ["press: started, but it is not running: no such thing here (exit status 2)"]
    assert cell.of("press").state == "fatal"
    assert cell.status().state == "degraded"
    assert {name: pid for name, pid in cell.pids().items() if name != "press"} == before
    answer = cell.reload([*CELL, PRESS])
    assert answer["done"] == ["press: started again, because it was not running"]
    assert cell.of("press").state == "running"


def test_the_supervisor_works_while_a_reload_is_planned(launch: Launch) -> None:
    """A reload compiles layouts, and a large layout takes seconds."""
    cell = launch()
    cell.wait_state("running")
    os.mkfifo(cell.folder / "slow")
    cell.plan([*CELL, PRESS])
    answers: list[dict[str, Any]] = []
    asking = threading.Thread(target=lambda: answers.append(cell.request(Reload())))
    asking.start()
    with (cell.folder / "slow").open("w"):  # planning is not done before this is closed
        with pytest.raises(ControlError, match="another reload is being prepared; try again when it is done"):
            cell.request(Reload())
        os.kill(cell.pid("cell"), signal.SIGKILL)
        until(lambda: cell.of("cell").restarts == 1 and cell.of("cell").state == "running")
        assert cell.request(Restart("grpc")) == {"ok": True}
        with Segment.open(cell.instance) as segment:
            beat_ns = segment.supervisor_heartbeat_ns
            until(lambda: segment.supervisor_heartbeat_ns > beat_ns)
        assert "press" not in cell.pids()
        (cell.folder / "slow").unlink()
    asking.join()
    assert answers[0]["done"] == ["press: started"]
    assert cell.of("press").state == "running"


def test_a_stop_does_not_wait_for_a_plan(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    os.mkfifo(cell.folder / "slow")
    asking, outcomes = refused_later(cell)
    with (cell.folder / "slow").open("w"):
        assert cell.stop() == 0
    asking.join()
    assert outcomes == ["the instance is stopping"]


def test_a_plan_that_takes_too_long_is_given_up_and_another_can_be_made(launch: Launch) -> None:
    cell = launch(plan_s=2)
    cell.wait_state("running")
    before = cell.pids()
    os.mkfifo(cell.folder / "slow")
    why = "the files that the configuration names could not be read within 2 s; nothing has changed"
    with pytest.raises(ControlError, match=f"^{why}; check whether a file system hangs, then reload again$"):
        cell.reload([*CELL, PRESS])
    assert cell.pids() == before
    (cell.folder / "slow").unlink()
    assert cell.reload([*CELL, ("robot", "source", ["good"])])["done"] == ["robot: started"]
    assert cell.stop() == 0


def test_a_stop_ends_a_reload_in_progress(launch: Launch) -> None:
    cell = launch([*CELL, ("press", "source", ["stubborn"])], grace_s=3600)
    cell.wait_state("running")
    asking, outcomes = refused_later(cell)
    until(lambda: cell.of("press").note == "stopping")
    with pytest.raises(ControlError, match="change of the instance is in progress"):
        cell.request(Restart("plc"))
    cell.process.send_signal(signal.SIGTERM)
    asking.join()
    assert outcomes == ["the instance is stopping"]
    cell.process.send_signal(signal.SIGTERM)
    assert cell.wait_end() == 0


def dry_run(cell: Launched, jobs: list[Any], **others: Any) -> dict[str, Any]:
    cell.plan(jobs, **others)
    return cell.request(Reload(dry_run=True))


def test_a_dry_run_says_what_a_reload_then_does(launch: Launch) -> None:
    cell = launch([*CELL, PRESS])
    cell.wait_state("running")
    before, log = cell.pids(), cell.log()
    none: dict[str, Any] = {
        key: [] for key in ("faults", "warnings", "stop", "start", "restart", "change", "injections")
    }
    names = ["plc", "cell", "grpc", "press"]
    assert dry_run(cell, [*CELL, PRESS]) == {"ok": True, **none, "reread": [], "keep": names}
    jobs = [CELL[0], (*CELL[1], "new"), ("grpc", "grpc", ["good", "good"]), ("robot", "source", ["good"])]
    found = dry_run(cell, jobs, warnings=["odd"])
    assert found == {
        "ok": True,
        "faults": [],
        "warnings": ["odd"],
        "stop": ["press"],
        "start": ["robot"],
        "restart": [
            "cell: registers: 1 added (b), 1 moved (a)",
            'grpc: behaviour: ["good","good"] instead of ["good"]',
        ],
        "change": [],
        "injections": [],
        "reread": [],
        "keep": ["plc"],
    }
    assert (cell.pids(), cell.log()) == (before, log)
    with shmio.attach(cell.instance) as reader:
        assert reader.sources == ["cell", "press"]
    answer = cell.reload(jobs)
    assert answer["done"] == [
        "press: stopped",
        "cell: restarted, because its configuration has changed",
        "grpc: restarted, because its configuration has changed",
        "robot: started",
        "cell: registers: 1 added (b), 1 moved (a)",
    ]
    assert answer["kept"] == found["keep"]


def test_a_dry_run_reports_faults_and_what_cannot_change(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    (cell.folder / "plan.json").write_text("{")
    assert cell.request(Reload(dry_run=True)) == {"ok": True, "faults": ["plan.json: no JSON"], "warnings": []}
    found = dry_run(cell, CELL, stepped=True)
    assert "instance.clock" in found["faults"][0]
    assert "keep" not in found


def opened(pipe: Path) -> list[int]:
    """Open a pipe for writing, if a process reads it."""
    with suppress(OSError):
        return [os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)]
    return []


def test_a_slow_dry_run_delays_no_reload_and_another_one_waits_for_its_own_plan(launch: Launch) -> None:
    cell = launch()
    cell.wait_state("running")
    cell.plan(CELL)
    pipe = cell.folder / "slow"
    os.mkfifo(pipe)
    with Segment.open(cell.instance) as segment:
        path = segment.header.control
    with socket.socket(socket.AF_UNIX) as first, socket.socket(socket.AF_UNIX) as second:
        for client in (first, second):
            client.settimeout(DEADLINE_S)
        first.connect(path)
        first.sendall(b'{"do": "reload", "dry_run": true}\n')
        held: list[int] = []

        def hold() -> bool:
            held.extend(opened(pipe))
            return bool(held)

        until(hold)
        pipe.unlink()
        assert cell.reload([*CELL, PRESS])["done"] == ["press: started"]
        second.connect(path)  # only now: a client that sends no request is disconnected
        second.sendall(b'{"do": "reload", "dry_run": true}\n')
        cell.request(Where())  # the supervisor has read what was sent before
        cell.plan(CELL)
        os.close(held[0])
        for client in (first, second):
            assert json.loads(client.recv(65536))["stop"] == ["press"]


def test_a_dry_run_that_hangs_is_given_up_and_no_other_is_begun(launch: Launch) -> None:
    cell = launch(plan_s=0.2)
    cell.wait_state("running")
    cell.plan(CELL)
    os.mkfifo(cell.folder / "slow")
    assert "could not be read within 0.2 s" in cell.request(Reload(dry_run=True))["faults"][0]
    with pytest.raises(ControlError, match="still cannot be read"):
        cell.request(Reload(dry_run=True))
    (cell.folder / "slow").write_bytes(b"")
    (cell.folder / "slow").unlink()
    until(lambda: "faults" in answered(cell))
    assert cell.request(Reload())["done"] == []


def answered(cell: Launched) -> dict[str, Any]:
    try:
        return cell.request(Reload(dry_run=True))
    except ControlError:
        return {}
