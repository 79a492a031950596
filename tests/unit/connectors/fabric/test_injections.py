"""Injections into a mirror: what the owner gets, and what programs of the mirror's host see."""

from __future__ import annotations

import threading
from typing import Any, Final

import msgspec
import pytest

from shmio.config import Declaration
from shmio.connectors.fabric import injections
from shmio.fabric.messages import CommandReply, CommandRequest, InjectionRequest, SourceState
from shmio.local.writer import PendingCommand, SourceWriter
from shmio.model.clock import ClockMode
from shmio.model.injection import Running
from shmio.model.values import NO_WRITER
from shmio.segment import CommandKind, Event, EventKind, Write
from shmio.segment.commands import Direction
from shmio.segment.header import LIST_SIZE
from shmio.segment.injection_list import InjectionEntry
from tests.unit.connectors.fabric.harness import PATIENCE_S, Mirroring, S, frame

WRITER: Final = 0
OTHER: Final = [Write(2, 0, b"\xff\xff")]
OWNERS: Final = {"writer": 3, "pid": 99}
"""The process of the uplink, in the owner's list and events."""
RUNNING: Final = Running(Declaration(name="b", target="a50/count", operation="flip", start_s=1.0), "active", 1)


def entry(number: int, **more: Any) -> InjectionEntry:
    """Return an injection as it is in the owner's list."""
    values: dict[str, Any] = {"direction": "out", "priority": 0, "keep": False, "name": "one", **OWNERS}
    return InjectionEntry(number, **{**values, "ranges": ((2, 2, 255),), **more})


def event(kind: EventKind, command: int, text: str = "", injection: int = 0) -> Event:
    """Return an event of the owner."""
    return Event(
        7,
        kind,
        3,
        42,
        S,
        S,
        S,
        1,
        frame(1, 1).quality,
        OWNERS["writer"],
        command,
        0,
        1,
        0,
        0,
        0,
        b"{}",
        text,
        injection,
    )


def writer_of(mirroring: Mirroring) -> SourceWriter:
    """Return the writer of a program, once the mirror knows the owner."""
    mirroring.send(frame(7, 1))
    mirroring.next()
    return SourceWriter(mirroring.block, WRITER)


def sent(mirroring: Mirroring, kind: str) -> InjectionRequest:
    """Return the next command of a kind that the owner gets."""
    while True:
        assert mirroring.link.sent.acquire(timeout=PATIENCE_S), f"no command {kind}"
        request: CommandRequest = mirroring.link.commands.pop(0)
        assert request.injection is not None
        if request.injection.kind == kind:
            return request.injection


def state(*entries: InjectionEntry, clock_ns: int = S, virtual: bool = False) -> SourceState:
    return SourceState(entries, clock_ns, virtual)


def injected(mirroring: Mirroring, writer: SourceWriter, **options: Any) -> PendingCommand:
    """Create an injection at the owner."""
    mirroring.link.reply = CommandReply(["injected"], [""])
    ticket = writer.ask_to_inject(OTHER, **options)
    assert sent(mirroring, "inject").number == ticket.number
    mirroring.link.send(mirroring.link.state(state(entry(ticket.number, keep=options.get("keep", False)))))
    mirroring.send(event(EventKind.INJECTED, ticket.number, "one", ticket.number))
    assert mirroring.event(EventKind.INJECTED).injection == ticket.number
    return ticket


def test_an_injection_of_a_program_is_made_by_the_owner(mirroring: Mirroring) -> None:
    writer = writer_of(mirroring)
    mirroring.link.reply = CommandReply(["injected"], [""])
    ticket = writer.ask_to_inject(OTHER, priority=3, keep=True, name="one")
    request = sent(mirroring, "inject")
    assert (request.number, request.priority, request.keep, request.name) == (ticket.number, 3, True, "one")
    assert [(one.offset, one.data) for one in request.items] == [(2, b"\xff\xff")]
    assert mirroring.block.injections.read() == ()
    mirroring.link.send(mirroring.link.state(state(entry(ticket.number))))
    mirroring.send(event(EventKind.INJECTED, ticket.number, "one", ticket.number))
    found = mirroring.event(EventKind.INJECTED)
    assert (found.writer, found.command, found.injection) == (WRITER, ticket.number, ticket.number)
    [one] = mirroring.block.injections.read()
    assert (one.number, one.writer, one.cell) == (ticket.number, WRITER, "")
    mirroring.send(event(EventKind.ACTIVATED, ticket.number, "", ticket.number))
    assert mirroring.event(EventKind.ACTIVATED).writer == WRITER, "as on the owner's host"


def test_values_and_the_end_go_to_the_owner(mirroring: Mirroring) -> None:
    writer = writer_of(mirroring)
    number = injected(mirroring, writer).number
    mirroring.link.reply = CommandReply(["shadowed"], [""])
    ticket = writer.give(number, [Write(2, 0, b"\0\5")])
    request = sent(mirroring, "shadow")
    assert (request.injection, request.items[0].data) == (number, b"\0\5")
    mirroring.send(event(EventKind.SHADOWED, ticket.number, "", number))
    assert mirroring.event(EventKind.SHADOWED).command == ticket.number
    mirroring.link.reply = CommandReply(["lifted"], [""])
    ticket = writer.ask_to_lift(number)
    assert sent(mirroring, "lift").injection == number
    mirroring.link.send(mirroring.link.state(state()))
    mirroring.send(event(EventKind.LIFTED, ticket.number, "lifted", number))
    found = mirroring.event(EventKind.LIFTED)
    assert (found.writer, found.command, found.injection) == (WRITER, ticket.number, number)
    assert mirroring.block.injections.read() == ()


@pytest.mark.parametrize("outcome", ["rejected", "expired", "unknown"])
def test_a_failure_is_reported_once(mirroring: Mirroring, outcome: str) -> None:
    writer = writer_of(mirroring)
    mirroring.link.reply = CommandReply([outcome], ["because"])
    ticket = writer.ask_to_inject(OTHER)
    found = mirroring.event(EventKind[outcome.upper()])
    assert (found.writer, found.command, found.text) == (WRITER, ticket.number, "because")
    mirroring.send(event(EventKind.REJECTED, ticket.number, "again"), event(EventKind.NOTED, 0, "after"))
    next_one = mirroring.events.next(PATIENCE_S)
    assert next_one is not None
    assert next_one.text == "after"


def test_a_lift_by_others_names_the_owner(mirroring: Mirroring) -> None:
    number = injected(mirroring, writer_of(mirroring)).number
    mirroring.send(event(EventKind.LIFTED, number + (1 << 41), "lifted", number))
    assert mirroring.event(EventKind.LIFTED).text == "lifted in cell plant1.line3.a50 on host near.example"


def test_a_rejection_by_the_owner_names_its_cell_and_host(mirroring: Mirroring) -> None:
    ticket = writer_of(mirroring).ask_to_inject(OTHER)
    sent(mirroring, "inject")
    mirroring.send(event(EventKind.REJECTED, ticket.number, "because"))
    assert mirroring.event(EventKind.REJECTED).text == "cell plant1.line3.a50 on host near.example: because"


def test_an_outcome_whose_event_was_lost_is_reported_nevertheless(
    mirroring: Mirroring, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(injections, "FOLLOW_NS", S // 5)
    writer = writer_of(mirroring)
    mirroring.link.reply = CommandReply(["injected"], [""])
    ticket = writer.ask_to_inject(OTHER)
    found = mirroring.event(EventKind.INJECTED)
    assert (found.writer, found.injection) == (WRITER, ticket.number)


def test_nothing_is_sent_to_an_owner_that_is_not_known(mirroring: Mirroring) -> None:
    SourceWriter(mirroring.block, WRITER).ask_to_inject(OTHER)
    assert "plant1.line3.a50" in mirroring.event(EventKind.REJECTED).text
    assert mirroring.link.commands == []


def test_an_injection_toward_the_device_needs_armed_here_too(mirroring: Mirroring) -> None:
    writer_of(mirroring).ask_to_inject(OTHER, direction=Direction.IN)
    assert "armed" in mirroring.event(EventKind.REJECTED).text
    assert mirroring.link.commands == []


def test_injections_are_renewed_until_their_program_ends(mirroring: Mirroring, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(injections, "RENEW_NS", 0)
    writer = writer_of(mirroring)
    number = injected(mirroring, writer).number
    assert sent(mirroring, "renew").renewed == [number]
    mirroring.gone.add(WRITER)
    assert sent(mirroring, "lift").injection == number
    other = injected(mirroring, SourceWriter(mirroring.block, 1)).number
    for _ in range(2):
        assert sent(mirroring, "renew").renewed == [other]


def test_refused_renewals_are_reported_once(
    mirroring: Mirroring, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(injections, "RENEW_NS", 0)
    number = injected(mirroring, writer_of(mirroring)).number
    mirroring.link.reply = CommandReply(["rejected"], ["the role is missing"])
    for _ in range(2):
        assert sent(mirroring, "renew").renewed == [number]
    assert sent(mirroring, "renew").renewed == [number]  # the second reply was evaluated
    assert ["the role is missing" in one for one in caplog.messages].count(True) == 1
    mirroring.link.reply = CommandReply(["rejected"], ["the cell is read-only"])
    for _ in range(3):
        sent(mirroring, "renew")
    assert ["the cell is read-only" in one for one in caplog.messages].count(True) == 1


def test_an_injection_that_stays_is_neither_renewed_nor_lifted(
    mirroring: Mirroring, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(injections, "RENEW_NS", 0)
    kept = injected(mirroring, writer_of(mirroring), keep=True).number
    mirroring.gone.add(WRITER)
    number = injected(mirroring, SourceWriter(mirroring.block, 1)).number
    for _ in range(2):
        assert sent(mirroring, "renew").renewed == [number]
    requests = [one.injection for one in mirroring.link.all if one.injection is not None]
    assert all(kept not in (one.injection, *one.renewed) for one in requests)


@pytest.mark.parametrize("ending", [False, True])
def test_the_end_of_the_instance_lifts_its_injections_at_once(mirroring: Mirroring, *, ending: bool) -> None:
    """A restart of the source alone does not: the programs that hold them still run."""
    injected(mirroring, writer_of(mirroring), keep=True)
    number = injected(mirroring, SourceWriter(mirroring.block, 1)).number
    mirroring.ending = ending
    mirroring.stop()
    requests = [one.injection for one in mirroring.link.all if one.injection is not None]
    assert [one.injection for one in requests if one.kind == "lift"] == ([number] if ending else [])


def test_the_end_of_the_instance_does_not_wait_long_for_an_owner_that_is_gone(
    mirroring: Mirroring, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(injections, "LEAVE_S", 0.01)
    injected(mirroring, writer_of(mirroring))
    mirroring.ending = mirroring.link.silent = True
    stopping = threading.Thread(target=mirroring.stop)
    stopping.start()
    stopping.join(5.0)
    assert not stopping.is_alive()
    assert sent(mirroring, "lift")


def test_an_injection_that_the_owner_no_longer_has_is_over(
    mirroring: Mirroring, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The owner may have been started again, so that no event comes."""
    monkeypatch.setattr(injections, "GONE_NS", S // 10)
    number = injected(mirroring, writer_of(mirroring)).number
    mirroring.link.send(mirroring.link.state(state()))
    found = mirroring.event(EventKind.LIFTED)
    assert (found.injection, found.writer, "plant1.line3.a50" in found.text) == (number, WRITER, True)


def test_the_list_has_the_injections_of_all_cells(mirroring: Mirroring) -> None:
    foreign = entry(5, cell="plant1.line3.other", ranges=((2, 2, 255), (1 << 40, 1, 255), (3, 1, 999)))
    running = Running(Declaration(name="b", target="a50/count", operation="freeze"), "waiting", 1)
    configured = entry(6, writer=NO_WRITER, pid=0, running=running)
    mirroring.link.send(mirroring.link.state(state(foreign, configured)))
    mirroring.send(frame(7, 1))
    mirroring.next()
    first, second = mirroring.block.injections.read()
    assert (first.number, first.cell, first.ranges) == (5, "plant1.line3.other", ((2, 2, 255),))
    assert first.pid == 0, "its pid at the owner is that of the owner's uplink"
    assert (second.number, second.cell, second.configured) == (6, "plant1.line3.a50", True)


def test_as_many_injections_as_fit_are_shown(mirroring: Mirroring, caplog: pytest.LogCaptureFixture) -> None:
    many = [entry(number, name="n" * 500) for number in range(5, 105)]
    for _ in range(2):
        mirroring.link.send(mirroring.link.state(state(*many)))
    mirroring.send(frame(7, 1))
    mirroring.next()
    found = mirroring.block.injections.read()
    assert [one.number for one in found] == list(range(5, 5 + len(found)))
    assert len(msgspec.json.encode(found)) <= LIST_SIZE < len(msgspec.json.encode([*found, found[0]]))
    reported = f"only {len(found)} of 100 injections"
    assert [reported in one for one in caplog.messages].count(True) == 1
    for entries in (many[:1], many):
        mirroring.link.send(mirroring.link.state(state(*entries)))
    mirroring.send(frame(8, 1))
    mirroring.next()
    assert [reported in one for one in caplog.messages].count(True) == 2, "the list had fitted in between"


def test_a_number_is_sent_once(mirroring: Mirroring) -> None:
    writer = writer_of(mirroring)
    ticket = writer.ask_to_inject(OTHER)
    sent(mirroring, "inject")
    writer.forward(ticket.number, CommandKind.INJECT, OTHER, 1.0)
    found = mirroring.event(EventKind.REJECTED)
    assert (found.command, "another number" in found.text) == (ticket.number, True)


def test_the_state_is_asked_for_until_it_comes(mirroring: Mirroring, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.connectors.fabric.loop.STATE_NS", 0)
    writer_of(mirroring)
    for number in range(8, 10):
        mirroring.link.states_asked.clear()
        mirroring.send(frame(number, 1))
        assert mirroring.link.states_asked.wait(PATIENCE_S)
    mirroring.link.send(mirroring.link.state(state()))
    mirroring.send(frame(10, 1), skip=1)
    assert mirroring.link.asked.wait(PATIENCE_S)
    mirroring.link.states_asked.clear()
    mirroring.link.answered(mirroring.link.requests[0])
    assert mirroring.link.states_asked.wait(PATIENCE_S), "a change of the state may be among the lost messages"


def declared(**more: Any) -> Declaration:
    """Return a declaration as a faulty owner may send it."""
    return msgspec.structs.replace(RUNNING.declaration, **more)


def declare(mirroring: Mirroring, **more: Any) -> SourceWriter:
    writer = writer_of(mirroring)
    values = {"name": "one", "target": "other", "operation": "set", "value": 5} | more
    writer.ask_to_declare(msgspec.convert(values, Declaration))
    return writer


def test_times_are_on_the_owners_clock(mirroring: Mirroring) -> None:
    mirroring.link.send(mirroring.link.state(state(clock_ns=1000 * S)))
    own_s = mirroring.segment.clock.present_ns() / 1e9
    declare(mirroring, start_s=own_s + 5, end_s=own_s + 6, when="cell/count > 3")
    declaration = msgspec.json.decode(sent(mirroring, "declare").declaration, type=Declaration)
    assert declaration.start_s == pytest.approx(1005, abs=0.5)
    assert declaration.end_s is not None
    assert declaration.start_s is not None
    assert declaration.end_s - declaration.start_s == pytest.approx(1)
    assert declaration.target == "cell/other"


@pytest.mark.parametrize("own", [True, False])
def test_times_are_rejected_if_one_clock_is_virtual(mirroring: Mirroring, *, own: bool) -> None:
    mirroring.link.send(mirroring.link.state(state(virtual=not own)))
    if own:
        clock = mirroring.segment.clock
        clock.write(clock.read()._replace(mode=ClockMode.VIRTUAL))
    declare(mirroring, start_s=1.0)
    found = mirroring.event(EventKind.REJECTED)
    assert found.text.startswith("start_s: this instance" if own else "start_s: cell plant1.line3.a50")
    assert mirroring.link.commands == []


@pytest.mark.parametrize(
    ("faulty", "words"),
    [({"target": "nothing"}, "nothing"), ({"when": "cell/count >"}, "when"), ({"value": None}, "value")],
)
def test_a_faulty_declaration_is_rejected_here(mirroring: Mirroring, faulty: dict[str, Any], words: str) -> None:
    declare(mirroring, **faulty)
    assert words in mirroring.event(EventKind.REJECTED).text
    assert mirroring.link.commands == []


@pytest.mark.parametrize(
    "faulty",
    [
        {"number": 1 << 64},
        {"writer": 1 << 32},
        {"pid": -1},
        {"priority": 1 << 31},
        {"direction": "up"},
        {"running": msgspec.structs.replace(RUNNING, state="unheard of")},
        {"running": msgspec.structs.replace(RUNNING, runs=10**400)},
        {"running": msgspec.structs.replace(RUNNING, time_ns=1 << 63)},
        {"running": msgspec.structs.replace(RUNNING, declaration=declared(times=10**400))},
        {"running": msgspec.structs.replace(RUNNING, declaration=declared(bits=[1 << 32]))},
        {"clock_ns": 10**400},
    ],
    ids=["number", "writer", "pid", "priority", "direction", "state", "runs", "time_ns", "times", "bits", "clock_ns"],
)
def test_a_state_with_a_number_that_is_too_large_changes_nothing(mirroring: Mirroring, faulty: dict[str, Any]) -> None:
    more: dict[str, Any] = {"number": 5, "running": RUNNING, "clock_ns": S} | faulty
    clock_ns, number = more.pop("clock_ns"), more.pop("number")
    one = entry(number, **more)
    mirroring.link.send(mirroring.link.state(state(one, clock_ns=clock_ns)))
    mirroring.send(frame(7, 1))
    assert mirroring.next().cycle == 1007
    assert mirroring.block.injections.read() == ()


def test_a_clock_far_away_gives_times_that_the_list_can_have(mirroring: Mirroring) -> None:
    running = msgspec.structs.replace(RUNNING, time_ns=(1 << 63) - 1)
    mirroring.link.send(mirroring.link.state(state(entry(5, running=running), clock_ns=-(1 << 63))))
    mirroring.send(frame(7, 1))
    mirroring.next()
    [found] = mirroring.block.injections.read()
    assert found.running is not None
    assert (found.running.declaration.start_s, found.running.time_ns) == (1e9, (1 << 63) - 1)


def test_a_malformed_state_changes_nothing(mirroring: Mirroring) -> None:
    mirroring.link.send(mirroring.link.state(state(entry(5)))[:-3])
    mirroring.link.send(mirroring.link.state(state(entry(5))).replace(b'"id":5', b'"id":"x"'))
    mirroring.send(frame(7, 1))
    assert mirroring.next().cycle == 1007
    assert mirroring.block.injections.read() == ()
