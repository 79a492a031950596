"""Commands of programs on this host: their entries in the audit log, made from the sources' events."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from shmio.audit import trail
from shmio.audit.file import AuditSettings
from shmio.audit.reading import last_events
from shmio.layout.model import Layout, Register
from shmio.model.values import NO_WRITER
from shmio.segment import (
    Activity,
    BlockSpec,
    BlockWriter,
    EventKind,
    ProcessSpec,
    Record,
    Report,
    Segment,
)
from shmio.segment.block import Attributes
from shmio.segment.commands import first_number
from shmio.segment.events import EVENT_SLOTS
from shmio.supervisor.local_commands import RESTARTED, LocalCommands

LAYOUT = Layout("DB1", 1, 4, False, (
    Register("a", "INT", (), 0, None, 2, 1), Register("b", "INT", (), 2, None, 2, 1)
))  # fmt: skip
GUEST, GRPC, FABRIC = 0, 4, 7


class Case:
    """A source whose events a test writes, and the audit log that comes of them."""

    def __init__(self, segment: Segment, path: Path) -> None:
        self.segment = segment
        self.path = path
        self.writer: BlockWriter = segment.writer("cell")
        self.number = first_number(os.getpid())

    def accepted(self, item: int, value: int, writer: int = GUEST, **more: int) -> None:
        data = value.to_bytes(2, "big")
        number = more.get("number", self.number)
        self.writer.event(Record(EventKind.ACCEPTED, "", writer, number, item, 1, 2 * item, 0, 2, data))

    def ended(
        self, kind: EventKind, item: int, items: int = 1, text: str = "", writer: int = GUEST, **more: int
    ) -> None:
        number = more.get("number", self.number)
        self.writer.event(Record(kind, text, writer, number, item, items, 2 * item, 0, 2))

    def entries(self, after: dict[str, int] | None = None) -> list[dict[str, Any]]:
        """Return the entries that come of the events so far."""
        trail.open_trail(AuditSettings(str(self.path), 10**7, 2), self.segment.instance, "supervisor")
        LocalCommands(self.segment.instance, after).close()
        trail.close_trail()
        return [json.loads(line) for line in self.path.read_bytes().splitlines()]


@pytest.fixture
def case(instance: str, tmp_path: Path) -> Iterator[Case]:
    block = BlockSpec("cell", LAYOUT, 20_000_000, 10**9, 1 << 22)
    with Segment.create(instance, [block], [ProcessSpec("cell", "source"), ProcessSpec("grpc", "grpc")]) as segment:
        yield Case(segment, tmp_path / "audit.jsonl")
        segment.unlink()


def ended_pid() -> int:
    """Return the pid of a process that has ended."""
    done = subprocess.Popen([sys.executable, "-c", ""])
    done.wait()
    return done.pid


def test_a_write_has_its_values_program_and_worst_outcome(case: Case) -> None:
    case.accepted(0, 7)
    case.accepted(1, 8)
    case.ended(EventKind.WRITTEN, 0)
    case.ended(EventKind.REFUSED, 1, text="out of range")
    (entry,) = case.entries()
    assert (entry["kind"], entry["who"], entry["endpoint"]) == ("uid", str(os.getuid()), "local")
    assert entry["from"].startswith(f"pid {os.getpid()} ")
    assert (entry["action"], entry["what"]) == ("write", {"cell/a": 7, "cell/b": 8})
    assert (entry["outcome"], entry["reason"], entry["event"]) == ("refused", "out of range", 5)
    assert last_events(case.path, "") == {"cell": 5}


def test_a_program_that_has_ended_is_known_by_its_slot(case: Case) -> None:
    pid = ended_pid()
    case.segment.processes.external[0].report = Report(pid, Activity.RUNNING, 0, (4711,), "press.py")
    case.ended(EventKind.REJECTED, 0, 2, "not writable", number=first_number(pid))
    (entry,) = case.entries()
    assert (entry["who"], entry["from"]) == ("4711", f"pid {pid} press.py")
    assert (entry["outcome"], entry["reason"]) == ("rejected", "not writable")


@pytest.mark.parametrize("alive", [True, False])
def test_a_command_of_an_endpoint_has_an_entry_only_if_the_endpoint_was_killed(
    case: Case, alive: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    pid = os.getpid() if alive else ended_pid()
    number = first_number(pid)
    trail.open_trail(AuditSettings(str(case.path), 10**7, 2), case.segment.instance, "supervisor")
    local = LocalCommands(case.segment.instance, {})
    case.accepted(0, 7, GRPC, number=number)
    case.ended(EventKind.WRITTEN, 0, writer=GRPC, number=number)
    local.close()
    trail.close_trail()
    found = [json.loads(line) for line in case.path.read_bytes().splitlines()] if case.path.exists() else []
    if alive:
        assert found == []
    else:
        (entry,) = found
        assert (entry["kind"], entry["who"], entry["what"]) == ("process", "grpc", {"cell/a": 7})


@pytest.mark.parametrize("alive", [True, False])
def test_a_command_of_another_cell_has_an_entry_only_if_the_uplink_was_killed(
    instance: str, tmp_path: Path, *, alive: bool
) -> None:
    """Its number has a pid of another host, which is here that of a process that has ended."""
    block = BlockSpec("cell", LAYOUT, 20_000_000, 10**9, 1 << 22)
    processes = [ProcessSpec("cell", "source"), ProcessSpec("fabric", "fabric")]
    with Segment.create(instance, [block], processes) as segment:
        case = Case(segment, tmp_path / "audit.jsonl")
        uplink = os.getpid() if alive else ended_pid()
        slot = next(slot for slot in segment.processes if slot.name == "fabric")
        slot.report = Report(uplink, Activity.RUNNING)
        trail.open_trail(AuditSettings(str(case.path), 10**7, 2), instance, "supervisor")
        local = LocalCommands(instance, {})
        number = first_number(ended_pid())
        case.writer.event(Record(EventKind.LIFTED, "lifted", FABRIC, number, injection=7))
        local.close()
        trail.close_trail()
        segment.unlink()
    found = [json.loads(line) for line in case.path.read_bytes().splitlines()] if case.path.exists() else []
    if alive:
        assert found == []
    else:
        (entry,) = found
        assert (entry["kind"], entry["who"], entry["action"]) == ("process", "fabric", "lift")
        assert f"pid {uplink}," in entry["from"]


def test_the_next_supervisor_goes_on_where_the_last_one_ended(case: Case) -> None:
    case.ended(EventKind.REJECTED, 0, text="first")
    assert [entry["reason"] for entry in case.entries()] == ["first"]
    trail.open_trail(AuditSettings(str(case.path), 10**7, 2), case.segment.instance, "grpc")
    trail.record("write", {"cell/a": 1}, "written", "by an endpoint", event=99)  # says nothing about local programs
    trail.close_trail()
    case.ended(EventKind.REJECTED, 0, text="second", number=case.number + 1)
    known = last_events(case.path, "")
    assert [entry["reason"] for entry in case.entries(known)] == ["first", "by an endpoint", "second"]


@pytest.mark.parametrize("attributes", [Attributes("fabric"), Attributes("replay", replay=True), Attributes("memory")])
def test_what_happened_elsewhere_is_not_taken_for_an_act_of_a_local_program(
    instance: str, tmp_path: Path, attributes: Attributes
) -> None:
    block = BlockSpec("cell", LAYOUT, 20_000_000, 10**9, 1 << 22, attributes)
    with Segment.create(instance, [block], [ProcessSpec("cell", "source")]) as segment:
        case = Case(segment, tmp_path / "audit.jsonl")
        case.accepted(0, 7)
        case.accepted(0, 7, NO_WRITER, number=case.number + 1)  # the pid is that of a process of this host, too
        case.ended(EventKind.WRITTEN, 0, writer=NO_WRITER, number=case.number + 1)
        case.ended(EventKind.WRITTEN, 0)
        commands = {entry["command"] for entry in case.entries()}
        segment.unlink()
    delayed = {case.number + 1} if attributes.connector == "memory" else set()  # a write that an injection delayed
    assert commands == {case.number} | delayed


def test_injections_and_notes_have_what_they_are_about(case: Case) -> None:
    event = case.writer.event
    plain = {"direction": "out", "priority": 3, "keep": False, "ranges": [[2, 2, 0]] * 20}
    document = json.dumps(plain).encode()
    for at in range(0, len(document), 256):  # a long definition comes in parts
        part = document[at : at + 256]
        event(Record(EventKind.INJECTED, "mine", GUEST, case.number, 0, 1, at, 0, 0, part, case.number))
    event(Record(EventKind.SHADOWED, "mine", GUEST, case.number + 1, 0, 1, 2, 0, 2, b"\0\5", case.number))
    event(Record(EventKind.LIFTED, "lifted by a program", GUEST, case.number + 2, injection=case.number))
    declared = json.dumps({"name": "d", "target": "cell/a", "operation": "freeze"}).encode()
    event(Record(EventKind.INJECTED, "d", GUEST, case.number + 3, 0, 1, 0, 0, 0, declared, case.number + 3))
    event(Record(EventKind.NOTED, "hello", GUEST, case.number + 4))
    injected, fed, lifted, declared_one, noted = case.entries()
    assert (injected["action"], injected["outcome"]) == ("inject", "injected")
    assert (
        injected["what"].items()
        >= {"injection": case.number, "name": "mine", "priority": 3, "paths": ["cell/b"]}.items()
    )
    assert (fed["action"], fed["what"], fed["outcome"]) == ("feed", {"cell/b": 5}, "shadowed")
    assert fed["reason"] == ""
    assert (lifted["action"], lifted["what"]) == ("lift", {"source": "cell", "injection": case.number})
    assert (declared_one["action"], declared_one["what"]["operation"]) == ("declare", "freeze")
    assert (noted["action"], noted["what"]["note"]) == ("note", "hello")


def test_a_restart_of_the_source_ends_its_commands(case: Case) -> None:
    case.accepted(0, 7)
    case.segment.writer("cell")  # publishes STARTED
    (entry,) = case.entries()
    assert (entry["outcome"], entry["reason"]) == ("unknown", RESTARTED)


def test_overwritten_events_are_reported(case: Case) -> None:
    for _ in range(EVENT_SLOTS + 10):
        case.ended(EventKind.QUALITY, 0, number=0)
    case.ended(EventKind.REJECTED, 0, text="last")
    lost, last = case.entries()
    assert (lost["outcome"], lost["what"]["events"] >= 10) == ("lost", True)
    assert last["reason"] == "last"
