"""Decisions of the supervisor, tested with a simulated clock."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product
from typing import Final

import pytest

from shmio.local.status import assess
from shmio.realtime import ProcessorTime
from shmio.segment import Quality
from shmio.segment import State as InstanceState
from shmio.supervisor import policy
from shmio.supervisor.policy import GRAPH, Action, Event, Life, Limits, State

LIMITS = Limits()
S = 1_000_000_000


@dataclass
class World:
    """One process and the time. The test drives them as the supervisor does."""

    now_ns: int = 1000 * S
    life: Life = field(default_factory=Life)
    actions: list[Action] = field(default_factory=list)

    def happens(self, event: Event, note: str = "") -> None:
        self.life, action = policy.step(self.life, event, self.now_ns, LIMITS, note)
        if action is not None:
            self.actions.append(action)

    def state(self) -> State:
        return self.life.state

    def last_action(self) -> Action:
        return self.actions[-1]

    def passes(self, seconds: float, *, ready: bool = False, quiet_s: float = 0.0) -> Event | None:
        self.now_ns += round(seconds * S)
        event = policy.due(self.life, self.now_ns, ready=ready, quiet_ns=round(quiet_s * S), limits=LIMITS)
        if event is not None:
            self.happens(event)
        return event

    def starts_again_after(self) -> float:
        """Wait for the end of the back-off; return its length in seconds."""
        assert self.state() is State.BACKOFF
        assert self.life.due_ns is not None
        wait_s = (self.life.due_ns - self.now_ns) / S
        if wait_s:
            assert self.passes(wait_s - 0.001) is None
            self.now_ns += S // 1000
        assert self.passes(0) is Event.ELAPSED
        assert self.state() is State.STARTING
        assert self.last_action() is Action.SPAWN
        return wait_s


@pytest.fixture
def world() -> World:
    return World()


def started(world: World) -> World:
    world.happens(Event.START)
    assert world.passes(0.1, ready=True) is Event.READY
    assert world.state() is State.RUNNING
    return world


def test_every_state_and_event_follow_the_graph() -> None:
    for state, event in product(State, Event):
        life = Life(state, starts=1)
        after, action = policy.step(life, event, 5 * S, LIMITS, "why")
        if event in GRAPH[state]:
            assert (after.state, action) == GRAPH[state][event], (state, event)
            assert after.starts == life.starts + (action is Action.SPAWN), (state, event)
        else:
            assert (after, action) == (life, None), (state, event)


def test_the_first_crash_restarts_at_once_and_the_next_ones_back_off_to_a_limit(world: World) -> None:
    started(world)
    waits = []
    for _ in range(9):
        world.happens(Event.EXIT, "killed by SIGKILL")
        assert world.life.note == "killed by SIGKILL"
        waits.append(world.starts_again_after())
        assert world.life.note == "killed by SIGKILL", "the status gives the reason until the process is stable"
    world.happens(Event.READY)
    assert world.life.note == ""
    assert waits == [0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 10.0, 10.0, 10.0]
    assert world.life.restarts == 9


def test_a_stable_run_resets_the_back_off(world: World) -> None:
    started(world)
    for _ in range(3):
        world.happens(Event.EXIT)
        world.starts_again_after()
        world.passes(0.1, ready=True)
    assert world.life.crashes == 3
    world.passes(LIMITS.stable_s - 0.1)
    world.happens(Event.EXIT)
    assert world.life.crashes == 4, "not yet stable"
    world.starts_again_after()
    world.passes(0.1, ready=True)
    world.passes(LIMITS.stable_s)
    world.happens(Event.EXIT)
    assert world.starts_again_after() == 0.0


def test_a_long_start_does_not_count_as_a_stable_run(world: World) -> None:
    world.happens(Event.START)
    for crashes in (1, 2):
        world.passes(LIMITS.stable_s + 1)
        world.happens(Event.EXIT)
        assert world.life.crashes == crashes
        world.starts_again_after()


def test_a_process_that_does_not_report_in_time_has_crashed(world: World) -> None:
    world.happens(Event.START)
    assert world.passes(LIMITS.start_s - 0.001) is None
    assert world.passes(0.001) is Event.ELAPSED
    assert (world.state(), world.last_action()) == (State.HUNG, Action.KILL)
    world.happens(Event.EXIT, "killed by SIGKILL")
    assert world.life.note == "not ready 20 s after its start, killed by SIGKILL"
    assert world.life.crashes == 1


def test_a_start_does_not_fail_because_it_waits_for_a_processor(world: World) -> None:
    def after(seconds: float, waited_s: float) -> Event | None:
        world.now_ns = world.life.spawned_ns + round(seconds * S)
        used = ProcessorTime(0, round(waited_s * S))
        return policy.due(world.life, world.now_ns, ready=False, quiet_ns=0, limits=LIMITS, used=used)

    world.happens(Event.START)
    assert after(LIMITS.start_s, 0.0) is Event.ELAPSED, "it did not wait for a processor"
    assert after(LIMITS.start_s, 0.1) is None
    assert after(10 * LIMITS.start_s, 9 * LIMITS.start_s + 0.1) is None
    assert after(10 * LIMITS.start_s, 9 * LIMITS.start_s) is Event.ELAPSED
    assert world.passes(0, ready=True) is Event.READY


def test_a_missing_heartbeat_while_running_is_a_hang(world: World) -> None:
    started(world)
    assert world.passes(100, quiet_s=LIMITS.hang_s - 0.001) is None, "only a missing heartbeat counts, not time"
    assert world.passes(0, quiet_s=LIMITS.hang_s) is Event.HANG
    assert (world.state(), world.last_action()) == (State.HUNG, Action.KILL)
    assert world.passes(LIMITS.kill_s - 0.001, quiet_s=200) is None, "it is killed only once"
    world.happens(Event.EXIT, "killed by SIGKILL")
    assert world.life.note == "no heartbeat for 5 s, killed by SIGKILL"


def test_the_note_about_a_hang_has_the_evidence(world: World) -> None:
    started(world)
    world.happens(Event.HANG, "meanwhile its threads ran for 4.9 s")
    assert world.life.note == "no heartbeat for 5 s; meanwhile its threads ran for 4.9 s"
    world.happens(Event.EXIT, "killed by SIGKILL")
    assert world.life.note == "no heartbeat for 5 s; meanwhile its threads ran for 4.9 s, killed by SIGKILL"


OVERLOADED: Final = [
    (0.42, 0.0, 0.0),
    (2.73, 0.08, 2.26),
    (5.26, 0.15, 4.68),
    (9.68, 0.32, 8.94),
    (14.19, 0.51, 13.29),
    (20.73, 0.76, 19.54),
    (27.37, 0.99, 25.94),
    (31.9, 1.12, 30.39),
    (36.5, 1.22, 34.87),
]
"""How a process was scheduled beside 20 busy loops on two processors, while it computed 1.5 s without a heartbeat:
the time without one, and since it was late, for how long it ran and waited, in s. Recorded on Linux 6.18."""


def test_a_process_that_gets_no_processor_does_not_hang(world: World) -> None:
    def quiet(quiet_s: float, ran_s: float, waited_s: float) -> Event | None:
        used = ProcessorTime(round(ran_s * S), round(waited_s * S))
        quiet_ns = round(quiet_s * S)
        return policy.due(world.life, world.now_ns, ready=True, quiet_ns=quiet_ns, limits=LIMITS, used=used)

    started(world)
    for figures in OVERLOADED:
        assert quiet(*figures) is None, figures
    assert quiet(10 * LIMITS.hang_s, 0.0, 9 * LIMITS.hang_s + 0.1) is None
    assert quiet(10 * LIMITS.hang_s, LIMITS.hang_s, 9 * LIMITS.hang_s) is Event.HANG, "it computes without end"
    assert quiet(LIMITS.hang_s, 0.0, 0.0) is Event.HANG, "it waits for something else than a processor"


def test_a_missing_heartbeat_while_starting_is_ignored(world: World) -> None:
    world.happens(Event.START)
    assert world.passes(LIMITS.start_s - 1, quiet_s=LIMITS.start_s) is None


def test_a_refusal_is_fatal_until_a_restart_is_requested(world: World) -> None:
    started(world)
    world.happens(Event.REFUSAL, "no such program")
    assert (world.state(), world.life.note) == (State.FATAL, "no such program")
    assert world.passes(10_000) is None
    world.happens(Event.RESTART)
    assert (world.state(), world.last_action(), world.life.crashes) == (State.STARTING, Action.SPAWN, 0)


@pytest.mark.parametrize(("code", "event"), [(0, Event.EXIT), (1, Event.EXIT), (2, Event.REFUSAL), (-2, Event.EXIT)])
def test_the_event_of_an_exit_status(code: int, event: Event) -> None:
    assert policy.ended(code) is event


def test_a_process_that_does_not_stop_is_killed_after_its_grace(world: World) -> None:
    started(world)
    world.happens(Event.STOP)
    assert world.last_action() is Action.TERMINATE
    assert world.passes(LIMITS.grace_s - 0.001, quiet_s=60) is None
    assert world.passes(0.001) is Event.ELAPSED
    assert world.last_action() is Action.KILL
    assert world.passes(LIMITS.kill_s - 0.001) is None, "it is killed only once"
    world.happens(Event.EXIT)
    assert (world.state(), world.life.due_ns) == (State.STOPPED, None)


@pytest.mark.parametrize(
    ("asked", "after"), [(Event.STOP, State.STOPPED), (Event.RESTART, State.STARTING), (Event.HANG, State.BACKOFF)]
)
def test_a_process_that_sigkill_does_not_end_is_stuck_until_it_ends(world: World, asked: Event, after: State) -> None:
    started(world)
    world.happens(asked)
    if asked is not Event.HANG:
        assert world.passes(LIMITS.grace_s) is Event.ELAPSED
    assert (world.life.killed, world.life.stuck) == (True, False)
    world.now_ns += round(LIMITS.kill_s * S)
    world.happens(Event.ELAPSED, "pid 7 lives on")
    assert (world.life.stuck, world.life.note, world.last_action()) == (True, "pid 7 lives on", Action.KILL)
    assert world.passes(10_000) is None, "it is killed only once"
    world.happens(Event.EXIT)
    assert (world.state(), world.life.killed, world.life.stuck) == (after, False, False)


@pytest.mark.parametrize("late", [True, False])
def test_a_stuck_process_that_ends_is_reported_with_the_reason_of_its_hang(world: World, late: bool) -> None:
    for _ in range(2):  # the second crash is followed by a back-off
        if late:
            world.happens(Event.START)
            world.passes(LIMITS.start_s)
        else:
            started(world)
            world.passes(0, quiet_s=LIMITS.hang_s)
        why = "not ready 20 s after its start" if late else "no heartbeat for 5 s"
        assert (world.state(), world.life.note) == (State.HUNG, why)
        world.now_ns += round(LIMITS.kill_s * S)
        world.happens(Event.ELAPSED, "pid 7 lives on")
        world.happens(Event.EXIT, "killed by SIGKILL")
        assert (world.state(), world.life.note) == (State.BACKOFF, f"{why}, killed by SIGKILL")
        world.starts_again_after()


def test_a_stuck_process_does_not_delay_the_stop_of_others() -> None:
    stuck = Life(State.STOPPING, starts=1, killed=True, stuck=True)
    processes = [(1, Life(State.RUNNING, starts=1)), (2, stuck)]
    assert policy.to_stop(processes) == [0]
    assert policy.to_stop([(1, Life(State.STOPPED)), (2, stuck)]) == []
    assert not policy.all_gone([(1, Life(State.STOPPED)), (2, stuck)])
    assert policy.to_stop([(1, Life(State.RUNNING, starts=1)), (2, replace(stuck, state=State.HUNG))]) == [1]


def test_a_requested_restart_does_not_count_as_a_crash(world: World) -> None:
    started(world)
    for _ in range(3):
        world.happens(Event.EXIT)
        world.starts_again_after()
    world.passes(0.1, ready=True)
    world.happens(Event.RESTART)
    assert world.life.note == "restarting"
    world.happens(Event.EXIT)
    assert (world.state(), world.life.crashes, world.life.note) == (State.STARTING, 0, "")


def lives(*states: tuple[int, State, int]) -> list[tuple[int, Life]]:
    return [(rank, Life(state, starts=starts)) for rank, state, starts in states]


@pytest.mark.parametrize(
    ("processes", "turn"),
    [
        pytest.param(lives((2, State.STOPPED, 0), (0, State.STOPPED, 0), (0, State.STOPPED, 0)), [1, 2], id="lowest"),
        pytest.param(lives((0, State.STARTING, 1), (1, State.STOPPED, 0)), [], id="wait for the earlier one"),
        pytest.param(lives((0, State.RUNNING, 1), (1, State.STOPPED, 0)), [1], id="it runs"),
        pytest.param(lives((0, State.BACKOFF, 1), (1, State.STOPPED, 0)), [1], id="it failed"),
        pytest.param(lives((0, State.STARTING, 2), (1, State.STOPPED, 0)), [1], id="it tries again"),
        pytest.param(lives((0, State.STOPPED, 1), (1, State.RUNNING, 1)), [], id="all had their turn"),
        pytest.param([], [], id="none"),
    ],
)
def test_which_processes_are_started_next(processes: list[tuple[int, Life]], turn: list[int]) -> None:
    assert policy.to_start(processes) == turn


@pytest.mark.parametrize(
    ("processes", "turn", "gone"),
    [
        pytest.param(
            lives((0, State.RUNNING, 1), (2, State.RUNNING, 1), (2, State.FATAL, 1)), [1, 2], False, id="last"
        ),
        pytest.param(lives((0, State.RUNNING, 1), (2, State.STOPPING, 1)), [], False, id="wait for the earlier one"),
        pytest.param(lives((0, State.HUNG, 1), (2, State.STOPPED, 1)), [0], False, id="it is gone"),
        pytest.param(lives((0, State.STOPPED, 1), (2, State.STOPPED, 0)), [], True, id="all are gone"),
        pytest.param([], [], True, id="none"),
    ],
)
def test_which_processes_are_stopped_next(processes: list[tuple[int, Life]], turn: list[int], gone: bool) -> None:
    assert policy.to_stop(processes) == turn
    assert policy.all_gone(processes) is gone


def test_a_start_fails_by_refusal_or_repeated_crashes() -> None:
    assert policy.start_failure(Life(State.FATAL, note="bad key"), LIMITS) == "bad key"
    crashed = Life(State.BACKOFF, crashes=3, note="exit status 1")
    assert policy.start_failure(crashed, LIMITS) == "failed to start 3 times; exit status 1"
    assert policy.start_failure(replace(crashed, crashes=2), LIMITS) is None
    assert policy.start_failure(replace(crashed, ran=True), LIMITS) is None, "it was running before"


def test_a_start_is_over_when_all_run_and_the_sources_have_reported() -> None:
    ran, new = (0, Life(State.RUNNING, ran=True)), (1, Life(State.STARTING))
    assert not policy.start_over([ran, new], [], 0, 100 * S, LIMITS)
    assert policy.start_over([ran, ran], [Quality.GOOD, Quality.BAD], 100 * S, 100 * S, LIMITS)
    assert not policy.start_over([ran], [None], 100 * S, 103 * S - 1, LIMITS)
    assert policy.start_over([ran], [None], 100 * S, 103 * S, LIMITS)


@pytest.mark.parametrize(
    ("running", "qualities", "state"),
    [
        ([True, True], [Quality.GOOD], InstanceState.RUNNING),
        ([True], [Quality.UNCERTAIN], InstanceState.RUNNING),
        ([True, False], [Quality.GOOD], InstanceState.DEGRADED),
        ([True], [Quality.GOOD, Quality.BAD], InstanceState.DEGRADED),
        ([True], [None], InstanceState.DEGRADED),
        ([], [], InstanceState.RUNNING),
    ],
)
def test_the_state_of_an_instance(running: list[bool], qualities: list[Quality | None], state: InstanceState) -> None:
    assert assess(running, qualities) is state
