"""Local and remote cells behave alike: each test runs on both, with one running cell."""

from __future__ import annotations

import re
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import pytest

import shmio
from shmio.errors import CommandError, NotRunningError, PathError, TimeError, ValueRangeError
from shmio.model.event import Event, EventKind
from shmio.model.values import OutcomeKind, Provenance, Quality
from shmio.testing.cell import CONFIG, Cell, kill, until
from shmio.testing.ports import reserved_port

LAYOUT = Path(__file__).parents[2] / "db201.db"
AT: Final = "cell/Outputs/100"
"""Path of a byte that the emulated controller's program does not write."""
DRIFT: Final = {"name": "drift", "target": AT, "operation": "set", "value": 5}

EXTRA: Final = """
[[source]]
name = "extra"
connector = "memory"
layout = "db201.db"
period_ms = 50
"""

Opens = Callable[[Cell], shmio.Cell]


def local(running: Cell) -> shmio.Cell:
    return shmio.attach(running.instance, writable=True)


def remote(running: Cell) -> shmio.Cell:
    return shmio.connect(str(running.grpc))


BOTH: Final = (local, remote)


@contextmanager
def started(folder: Path, instance: str) -> Iterator[Cell]:
    with reserved_port() as plc, reserved_port() as grpc:
        shutil.copy(LAYOUT, folder)
        config = CONFIG.format(instance=instance, period_ms=20, plc=plc, grpc=grpc)
        patient = "timeout = 20000\nstale_ms = 60000"  # no value turns bad because the host is busy
        config = config.replace("timeout = 1000", f'{patient}\nwritable = ["Outputs"]\narmed = true')
        (folder / "supervisor.toml").write_text(config)
        running = Cell(folder, instance, grpc)
        try:
            running.up()
            yield running
        finally:
            running.down()


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory, shared_instance: str) -> Iterator[Cell]:
    with started(tmp_path_factory.mktemp("cell"), shared_instance) as running:
        with remote(running) as connected:
            until(lambda: connected.get(AT)[0].quality is Quality.GOOD, "good values")
        yield running


@pytest.fixture(params=BOTH, ids=["local", "remote"])
def cell(request: pytest.FixtureRequest, running: Cell) -> Iterator[shmio.Cell]:
    opens: Opens = request.param
    with opens(running) as cell:
        yield cell
        cell.lift_all()
        cell.set({AT: 0, "cell/Outputs/101": 0})
        until(lambda: [one.value for one in cell.get(AT, "cell/Outputs/101")] == [0, 0], "the cell as it was")


def test_sources_and_layouts(cell: shmio.Cell) -> None:
    assert cell.sources == ["cell"]
    layout = cell.layouts("cell")["cell"]
    assert cell.layouts().keys() == {"cell"}
    outputs = layout.registers[layout.by_path["Outputs"]]
    assert (layout.name, layout.byte_order, outputs.type, outputs.dims) == ("DB201", "big", "BYTE", ((0, 1099),))
    assert cell.real_sources() == ["cell"]
    with pytest.raises(PathError, match="unknown source 'nix'"):
        cell.layouts("nix")


def test_get_returns_the_matches_in_the_order_of_the_patterns(cell: shmio.Cell) -> None:
    found = cell.get("cell/Robot_800/Axs*_Pos", "Outputs/101..102", AT, AT)
    axes = [f"cell/Robot_800/Axs{number}_Pos" for number in range(1, 7)]
    assert [one.path for one in found] == [*axes, "cell/Outputs/101", "cell/Outputs/102", AT]
    assert {type(one.value) for one in found[:6]} == {float}
    last = found[-1]
    assert (last.source, last.register.type, last.value) == ("cell", "BYTE", 0)
    assert (last.quality, last.reason, last.provenance) == (Quality.GOOD, "", str(Provenance.LIVE))
    assert {one.source_time for one in found} == {last.source_time}, "all values are of one frame"
    assert last.age_s is not None
    (array,) = cell.get("cell/Outputs")
    assert isinstance(array.value, list)
    assert len(array.value) == 1100
    assert cell.get() == []


@pytest.mark.parametrize("pattern", ["cell/nix", "nix/Outputs", "cell/x*", f"{AT}/in", "cell/Outputs/1100"])
def test_a_pattern_that_matches_nothing_is_refused(cell: shmio.Cell, pattern: str) -> None:
    with pytest.raises(PathError):
        cell.get(pattern)
    with cell.subscribe(pattern.removesuffix("/in") + "/nix") as updates, pytest.raises(PathError):
        next(updates)


@pytest.mark.parametrize(
    ("patterns", "options"),
    [((), {}), ((AT,), {"max_rate_hz": -1.0}), ((AT,), {"max_rate_hz": 5.0, "every_frame": True})],
)
def test_invalid_subscription_options_are_refused(
    cell: shmio.Cell, patterns: tuple[str, ...], options: dict[str, Any]
) -> None:
    with cell.subscribe(*patterns, **options) as updates, pytest.raises(ValueRangeError):
        next(updates)


def test_a_subscription_yields_the_current_values_and_then_changes(cell: shmio.Cell) -> None:
    with cell.subscribe(AT, "cell/Outputs/101") as updates:
        first = next(updates)
        assert [(one.path, one.value) for one in first.readings] == [(AT, 0), ("cell/Outputs/101", 0)]
        assert (first.source, first.quality, first.ended) == ("cell", Quality.GOOD, False)
        cell.set({AT: 7})
        change = next(updates)
        while not change.readings:
            change = next(updates)
        assert [(one.path, one.value, one.quality) for one in change.readings] == [(AT, 7, Quality.GOOD)]
        assert change.frame > first.frame
        assert change.cycle > first.cycle
        assert change.clock_ns > first.clock_ns
        assert change.source_ns > first.source_ns
        assert change.incarnation == first.incarnation
    assert list(updates) == []


def test_every_frame_comes_in_order_and_losses_are_counted(cell: shmio.Cell) -> None:
    with cell.subscribe(AT, every_frame=True) as updates:
        found = [next(updates) for _ in range(6)]
    assert all(new.frame == old.frame + 1 + new.missed for old, new in pairwise(found))


def test_closing_the_cell_ends_its_subscriptions(running: Cell) -> None:
    for opens in BOTH:
        cell = opens(running)
        updates = cell.subscribe(AT)
        events = cell.events()
        next(updates)
        cell.close()
        assert list(updates) == []
        assert list(events) == []


def until_kind(events: Iterator[Event], *kinds: str) -> Event:
    """Return the next event of one of these kinds."""
    return next(event for event in events if event.kind in kinds)


def test_a_write_is_reported_as_accepted_and_written_events(cell: shmio.Cell) -> None:
    with cell.events("cell") as events:
        cell.set({AT: 3, "Outputs/101": 4}, timeout_s=20)
        accepted = until_kind(events, "accepted")
        values = dict(accepted.values)
        while (event := next(events)).kind is EventKind.ACCEPTED:
            values |= event.values
        assert values in ({AT: 3, "cell/Outputs/101": 4}, {"cell/Outputs/100..101": [3, 4]})
        assert (event.kind, event.direction, event.values, event.text) == ("written", "in", {}, "")
        assert event.paths in ((AT, "cell/Outputs/101"), ("cell/Outputs/100..101",))
        assert (event.source, event.quality, event.missed, event.injection) == ("cell", Quality.GOOD, 0, 0)
        assert event.command == accepted.command > 0
        assert event.by == accepted.by
        assert re.fullmatch(r"grpc: \S+ \(\S+\)|local: uid [0-9]+ \(pid [0-9]+ \S+\)", event.by)
        assert event.number > accepted.number
        assert min(event.frame, event.cycle, event.incarnation, event.clock_ns, event.utc_ns) > 0
    assert list(events) == []


def test_injections_are_reported_as_events(cell: shmio.Cell) -> None:
    with cell.events() as events:
        with cell.inject(AT, name="test") as shadow:
            laid = until_kind(events, "injected")
            assert (laid.injection, laid.text, laid.paths, laid.direction) == (shadow.number, "test", (AT,), "out")
            shadow.set({AT: 9})
            shadowed = until_kind(events, "shadowed")
            assert (shadowed.values, shadowed.direction, shadowed.by) == ({AT: 9}, "out", laid.by)
        lifted = until_kind(events, "lifted")
        assert (lifted.injection, lifted.paths, lifted.direction) == (shadow.number, (AT,), "out")
        with cell.declare([DRIFT]) as campaign:
            found = [until_kind(events, "injected", "activated", "lifted") for _ in range(2)]
            assert [one.kind for one in found] == [EventKind.INJECTED, EventKind.ACTIVATED]
        found.append(until_kind(events, "lifted"))
        number = campaign.declared[0].number
        assert {(one.injection, one.direction) for one in found} == {(number, "out")}
        assert found[0].text == "drift"


def test_events_name_the_writer(cell: shmio.Cell, running: Cell) -> None:
    pytest.importorskip("shmio.local", reason="only a local program writes notes")
    with cell.events("cell") as events, shmio.attach(running.instance, writable=True) as other:
        other.note("gripper changed")
        noted = until_kind(events, "noted")
        assert (noted.text, noted.by.startswith("local: uid "), noted.paths) == ("gripper changed", True, ())


def test_events_of_an_unknown_source_are_refused_at_once(cell: shmio.Cell) -> None:
    with pytest.raises(PathError, match="unknown source 'nix'"):
        cell.events("cell", "nix")


def test_another_thread_can_close_the_event_iterator(cell: shmio.Cell) -> None:
    events = cell.events()
    threading.Timer(0.05, events.close).start()
    assert list(events) == []


def test_events_continue_after_the_sources_process_was_killed(cell: shmio.Cell, running: Cell) -> None:
    with cell.events() as events:
        kill(running.processes()["cell"]["pid"])
        started = until_kind(events, "started")
        assert (started.source, started.missed) == ("cell", 0)
        good = next(event for event in events if event.quality is Quality.GOOD)
        assert good.incarnation == started.incarnation > 1
    until(lambda: cell.get(AT)[0].quality is Quality.GOOD, "good values")


def test_set_returns_an_outcome_for_each_value(cell: shmio.Cell) -> None:
    outcomes = cell.set({AT: 3, "Outputs/101": 4}, timeout_s=20)
    assert [(one.path, one.kind, one.text, one.done) for one in outcomes] == [
        (AT, OutcomeKind.WRITTEN, "", True),
        ("Outputs/101", "written", "", True),
    ]
    until(lambda: [one.value for one in cell.get(AT, "cell/Outputs/101")] == [3, 4], "the values")


@pytest.mark.parametrize(
    ("values", "error"),
    [
        ({"cell/nix": 1}, PathError),
        ({"cell/Outputs/1100": 1}, PathError),
        ({"nix/Outputs": 1}, PathError),
        ({AT: 256}, ValueRangeError),
        ({AT: "x"}, ValueRangeError),
        ({AT: 1, "cell/Robot_800/Axs1_Pos": 1.0}, CommandError),
    ],
)
def test_one_invalid_value_makes_set_write_nothing(
    cell: shmio.Cell, values: Mapping[str, object], error: type[Exception]
) -> None:
    with pytest.raises(error):
        cell.set(values)
    assert cell.get(AT)[0].value == 0


def test_an_injection_is_in_effect_until_it_is_closed(cell: shmio.Cell) -> None:
    with cell.inject(AT, name="test", priority=3) as shadow:
        (outcome,) = shadow.set({AT: 9})
        assert (outcome.path, outcome.kind, outcome.done) == (AT, "shadowed", True)
        until(lambda: cell.get(AT)[0].value == 9, "the injected value")
        assert cell.get(AT)[0].provenance == "injected"
        (one,) = cell.injections("cell")
        assert (one.source, one.number, one.name, one.priority) == ("cell", shadow.number, "test", 3)
        assert (one.direction, one.keep, one.running) == ("out", False, None)
        layout = cell.layouts()["cell"]
        assert one.ranges == ((layout.registers[layout.by_path["Outputs"]].offset + 100, 1, 255),)
    assert cell.injections() == []
    until(lambda: cell.get(AT)[0].provenance == "live", "the source's value")


def test_an_injection_on_in_intercepts_writes(cell: shmio.Cell) -> None:
    with cell.inject(f"{AT}/in"):
        (outcome,) = cell.set({AT: 8})
        assert (outcome.kind, outcome.done) == (OutcomeKind.TAKEN, True)
    assert cell.get(AT)[0].value == 0


def test_any_client_may_lift_an_injection(cell: shmio.Cell) -> None:
    with cell.inject(AT, name="one") as shadow, cell.inject("cell/Outputs/101", name="other"):
        cell.lift("cell", shadow.number)
        assert [one.name for one in cell.injections()] == ["other"]
        assert [(one.source, one.name, one.failure) for one in cell.lift_all("cell")] == [("cell", "other", "")]
        assert cell.lift_all() == []
        with pytest.raises(PathError, match="there is no injection"):
            cell.lift("cell", shadow.number)
    with pytest.raises(PathError):
        cell.lift("nix", 1)
    with pytest.raises(PathError):
        cell.injections("nix")


def test_an_injection_whose_pattern_matches_nothing_is_refused(cell: shmio.Cell) -> None:
    for patterns in (("cell/nix",), (AT, "cell/Outputs/101/in"), ("nix/x",)):
        with pytest.raises(PathError):
            cell.inject(*patterns)
    assert cell.injections() == []


def test_declared_injections_and_their_events(cell: shmio.Cell) -> None:
    later = {"name": "later", "target": "cell/Outputs/101", "operation": "noise", "amplitude": 1, "start_s": 1e6}
    with cell.declare([DRIFT | {"seed": 7}, later]) as campaign:
        first, second = campaign.declared
        assert (first.source, first.name, first.seed, second.name) == ("cell", "drift", 7, "later")
        events = [next(campaign) for _ in range(3)]
        assert [(one.number, one.what, one.run) for one in events if one.number == first.number] == [
            (first.number, "injected", 0),
            (first.number, "activated", 1),
        ]
        until(lambda: cell.get(AT)[0].value == 5, "the declared value")
        running = {one.number: one.running for one in cell.injections()}[first.number]
        assert running is not None
        assert (running.state, running.seed, running.runs) == ("active", 7, 1)
        assert running.declaration["operation"] == "set"
        assert len(cell.lift_all()) == 2
        rest = list(campaign)
        assert [one.what for one in rest if one.number == second.number] == ["lifted"]
        assert all(one.text for one in rest if one.what == "lifted")
    with cell.declare([DRIFT]):
        assert len(cell.injections()) == 1
    assert cell.injections() == []


def test_one_invalid_declaration_refuses_all(cell: shmio.Cell) -> None:
    for wrong in ({"target": "cell/nix"}, {"operation": "melt"}, {"end_s": -1.0}):
        with pytest.raises(ValueRangeError, match="injection"):
            cell.declare([DRIFT, DRIFT | {"name": "wrong"} | wrong])
    assert cell.injections() == []


def test_time_is_stepped_played_and_released(cell: shmio.Cell) -> None:
    assert not cell.clock().virtual
    begun = cell.step(dt_s=0.01)
    assert begun.virtual
    now = cell.step(dt_s=0.01, count=3)
    assert (now.step, now.time_ns) == (begun.step + 3, begun.time_ns + 30_000_000)
    assert cell.clock().step == now.step
    assert cell.play(rate=10).playing
    until(lambda: cell.clock().step > now.step, "a step by itself")
    assert not cell.pause().playing
    with pytest.raises(ValueRangeError):
        cell.step(dt_s=-1)
    with pytest.raises(ValueRangeError, match="at least 1"):
        cell.step(count=0)
    assert not cell.release().virtual
    assert not cell.clock().virtual


def test_step_is_refused_while_another_program_plays_time(cell: shmio.Cell, running: Cell) -> None:
    with remote(running) as other:
        other.play()
        with pytest.raises(TimeError, match="play"):
            cell.step()
        other.release()
    assert not cell.clock().virtual


def test_replay_is_refused_if_no_source_plays_a_recording(cell: shmio.Cell) -> None:
    with pytest.raises(CommandError, match="plays no recording"):
        cell.replay()
    with pytest.raises(CommandError, match="plays no recording"):
        cell.replay(paused=True)


def test_events_continue_after_a_reload_and_report_removed_sources(tmp_path: Path, instance: str) -> None:
    with started(tmp_path, instance) as running, ExitStack() as stack:
        file = tmp_path / "supervisor.toml"
        config = file.read_text()
        file.write_text(config.replace("[[emulator]]", f"{EXTRA}\n[[emulator]]"))
        running.output("shmio-supervisor", "reload")
        cells = [stack.enter_context(opens(running)) for opens in BOTH]
        for cell in cells:
            until(lambda: set(cell.sources) == {"cell", "extra"}, "the new source")  # noqa: B023  called at once
        followed = [stack.enter_context(cell.events()) for cell in cells]
        file.write_text(config.replace("period_ms = 20", "period_ms = 40"))
        running.output("shmio-supervisor", "reload")
        texts = set()
        for events in followed:
            first = removed = None
            while not (first and removed):
                event = next(events)
                assert event.missed == 0
                if event.source == "cell" and event.number == 1:  # of the new block
                    first = event
                if event.kind is EventKind.REMOVED:
                    removed = event
            assert (first.kind, removed.source, removed.quality) == ("started", "extra", Quality.BAD)
            texts.add(removed.text)
        assert texts == {f"source 'extra' was removed from instance {instance!r} by a reload"}


def test_calls_fail_with_not_running_error_after_the_instance_has_ended(tmp_path: Path, instance: str) -> None:
    with ExitStack() as stack:
        with started(tmp_path, instance) as running:
            cells = [stack.enter_context(opens(running)) for opens in BOTH]
            subscriptions = [stack.enter_context(cell.subscribe(AT)) for cell in cells]
            for subscription in subscriptions:
                next(subscription)
        for cell, subscription in zip(cells, subscriptions, strict=True):
            with pytest.raises(NotRunningError):
                for _ in subscription:
                    pass
            calls: list[Callable[[], Any]] = [lambda: cell.get(AT), lambda: cell.set({AT: 1})]  # noqa: B023  called at once
            for call in calls:
                with pytest.raises(NotRunningError):
                    call()
