"""States of a supervised process, and all decisions about it, as functions of state and time.

This module does no I/O, and reads no clock. The graph of states is in
docs/reference/process-states.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Final

from shmio.backoff import Backoff
from shmio.realtime import ProcessorTime
from shmio.segment import Phase, Quality


class State(Enum):
    """The state of a process."""

    STOPPED = "stopped"
    STARTING = "starting"
    RUNNING = "running"
    STOPPING = "stopping"
    RESTARTING = "restarting"
    HUNG = "hung"
    BACKOFF = "backoff"
    FATAL = "fatal"


class Event(Enum):
    """Events that can change the state of a process. ELAPSED: the time limit of its state has passed."""

    START = "start"
    READY = "ready"
    EXIT = "exit"
    REFUSAL = "refusal"
    HANG = "hang"
    ELAPSED = "elapsed"
    RESTART = "restart"
    STOP = "stop"
    HASTEN = "hasten"


class Action(Enum):
    """What the supervisor must do after a change of a process's state."""

    SPAWN = "spawn"
    TERMINATE = "terminate"
    KILL = "kill"


Edge = tuple[State, Action | None]

GRAPH: Final[Mapping[State, Mapping[Event, Edge]]] = {
    State.STOPPED: {
        Event.START: (State.STARTING, Action.SPAWN),
        Event.RESTART: (State.STARTING, Action.SPAWN),
    },
    State.STARTING: {
        Event.READY: (State.RUNNING, None),
        Event.EXIT: (State.BACKOFF, None),
        Event.REFUSAL: (State.FATAL, None),
        Event.ELAPSED: (State.HUNG, Action.KILL),
        Event.RESTART: (State.RESTARTING, Action.TERMINATE),
        Event.STOP: (State.STOPPING, Action.TERMINATE),
        Event.HASTEN: (State.STOPPING, Action.KILL),
    },
    State.RUNNING: {
        Event.EXIT: (State.BACKOFF, None),
        Event.REFUSAL: (State.FATAL, None),
        Event.HANG: (State.HUNG, Action.KILL),
        Event.RESTART: (State.RESTARTING, Action.TERMINATE),
        Event.STOP: (State.STOPPING, Action.TERMINATE),
        Event.HASTEN: (State.STOPPING, Action.KILL),
    },
    State.STOPPING: {
        Event.EXIT: (State.STOPPED, None),
        Event.REFUSAL: (State.STOPPED, None),
        Event.ELAPSED: (State.STOPPING, Action.KILL),
        Event.HASTEN: (State.STOPPING, Action.KILL),
    },
    State.RESTARTING: {
        Event.EXIT: (State.STARTING, Action.SPAWN),
        Event.REFUSAL: (State.STARTING, Action.SPAWN),
        Event.ELAPSED: (State.RESTARTING, Action.KILL),
        Event.STOP: (State.STOPPING, Action.TERMINATE),
        Event.HASTEN: (State.STOPPING, Action.KILL),
    },
    State.HUNG: {
        Event.EXIT: (State.BACKOFF, None),
        Event.REFUSAL: (State.BACKOFF, None),
        Event.ELAPSED: (State.HUNG, Action.KILL),
        Event.RESTART: (State.RESTARTING, Action.KILL),
        Event.STOP: (State.STOPPING, Action.KILL),
        Event.HASTEN: (State.STOPPING, Action.KILL),
    },
    State.BACKOFF: {
        Event.ELAPSED: (State.STARTING, Action.SPAWN),
        Event.RESTART: (State.STARTING, Action.SPAWN),
        Event.STOP: (State.STOPPED, None),
        Event.HASTEN: (State.STOPPED, None),
    },
    State.FATAL: {
        Event.RESTART: (State.STARTING, Action.SPAWN),
        Event.STOP: (State.STOPPED, None),
        Event.HASTEN: (State.STOPPED, None),
    },
}
"""The next state for each state and event. An event that a state does not list has no effect."""

PHASES: Final[Mapping[State, Phase]] = {
    State.STOPPED: Phase.STOPPED,
    State.STARTING: Phase.STARTING,
    State.RUNNING: Phase.RUNNING,
    State.STOPPING: Phase.STOPPED,
    State.RESTARTING: Phase.STARTING,
    State.HUNG: Phase.BACKOFF,
    State.BACKOFF: Phase.BACKOFF,
    State.FATAL: Phase.FATAL,
}
"""The published phase for each state. For a state of transition, it is the phase that the process will reach."""

LIVING: Final = frozenset({State.STARTING, State.RUNNING, State.STOPPING, State.RESTARTING, State.HUNG})
"""States in which an operating-system process exists."""


NOT_LATE: Final = ProcessorTime()
REFUSED_STATUS = 2
"""Exit status of a process that can never work as configured."""
RESTART: Final = Backoff(0.5, 10.0)
"""The waiting times before restarts of a process, from its second crash on."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Time-outs and counts for the processes. All times are in s."""

    start_s: float = 20.0
    """Time-out from the start of a process until it reports that it runs, without waits for a processor."""
    hang_s: float = 5.0
    """Longest time without a heartbeat while a process runs, without waits for a processor; after that, it hangs."""
    grace_s: float = 5.0
    """Time from SIGTERM to SIGKILL."""
    kill_s: float = 5.0
    """Time from SIGKILL until a process that still exists counts as stuck."""
    stable_s: float = 5.0
    """Time after which a running process counts as stable, so that its earlier crashes no longer count."""
    backoff: Backoff = RESTART
    start_attempts: int = 3
    """Number of crashes after which a process that has never run makes the instance's start fail."""
    settle_s: float = 3.0
    """Longest time to wait for the sources' first frames before the instance counts as started."""
    plan_s: float = 60.0
    """Longest time that a reload may take to read the configuration and all files that it names."""


@dataclass(frozen=True, slots=True)
class Life:
    """The state of a process, and its history. Times are in ns of CLOCK_MONOTONIC."""

    state: State = State.STOPPED
    due_ns: int | None = None
    """When the time limit of the present state ends; None if the state has no limit."""
    spawned_ns: int = 0
    ready_ns: int | None = None
    """When the process reported that it runs; None from its start until then."""
    starts: int = 0
    crashes: int = 0
    """Number of consecutive crashes, which is reset when the process counts as stable."""
    ran: bool = False
    """True if the process has ever run."""
    note: str = ""
    """Why the process is not running; empty while it runs."""
    hang: str = ""
    """Why the supervisor last killed the process as hung. The note about its end includes this text."""
    killed: bool = False
    """True if the supervisor has sent SIGKILL to the process, which has not ended yet."""
    stuck: bool = False
    """True if the process has not ended in time after SIGKILL, because it waits in the kernel."""

    @property
    def restarts(self) -> int:
        """Number of starts of the process, for any reason, without the first start."""
        return max(0, self.starts - 1)


def step(life: Life, event: Event, now_ns: int, limits: Limits, note: str = "") -> tuple[Life, Action | None]:
    """Return the state of a process after an event, and the action to take; None if there is no action.

    ``note`` says how the process ended, or from what it is known that it hangs, if that is the event.
    """
    edge = GRAPH[life.state].get(event)
    if edge is None:
        return life, None
    state, action = edge
    killed = action is Action.KILL or (life.killed and event not in (Event.EXIT, Event.REFUSAL))
    stuck = killed and (life.stuck or (life.killed and event is Event.ELAPSED))
    if state is State.HUNG and life.state is not State.HUNG:
        life = replace(life, hang="; ".join(filter(None, (_hang(life, limits), note))))
    text = (note or life.note) if stuck else _note(life, state, note)
    crashes = _crashes(life, event, state, now_ns, limits)
    life = replace(life, crashes=crashes, note=text, killed=killed, stuck=stuck)
    if action is Action.SPAWN:
        life = replace(life, starts=life.starts + 1, spawned_ns=now_ns, ready_ns=None)
    elif event is Event.READY:
        life = replace(life, ran=True, ready_ns=now_ns)
    allowed_s = None if stuck else _allowed_s(state, action, life.crashes, limits)
    due_ns = None if allowed_s is None else now_ns + round(allowed_s * 1e9)
    return replace(life, state=state, due_ns=due_ns), action


def _crashes(life: Life, event: Event, to: State, now_ns: int, limits: Limits) -> int:
    if event is Event.RESTART:
        return 0
    if to not in (State.BACKOFF, State.FATAL):
        return life.crashes
    stable = life.ready_ns is not None and now_ns - life.ready_ns >= limits.stable_s * 1e9
    return 1 if stable else life.crashes + 1


def _hang(life: Life, limits: Limits) -> str:
    late = life.state is State.STARTING
    return f"not ready {limits.start_s:g} s after its start" if late else f"no heartbeat for {limits.hang_s:g} s"


def _note(life: Life, to: State, note: str) -> str:
    if to is State.HUNG:
        return life.hang
    if to is State.BACKOFF and life.state is State.HUNG:
        return f"{life.hang}, {note}"
    if to in (State.BACKOFF, State.FATAL):
        return note
    if to is State.STARTING and life.state is State.BACKOFF:
        return life.note  # the back-off may have been short; keep its reason visible
    return {State.STOPPING: "stopping", State.RESTARTING: "restarting"}.get(to, "")


def _allowed_s(state: State, action: Action | None, crashes: int, limits: Limits) -> float | None:
    if state is State.STARTING:
        return limits.start_s
    if state is State.BACKOFF:
        return backoff_s(crashes, limits)
    return {Action.TERMINATE: limits.grace_s, Action.KILL: limits.kill_s}.get(action) if action else None


def backoff_s(crashes: int, limits: Limits) -> float:
    """Return the waiting time in s before the next start; 0 after the first crash."""
    return limits.backoff.wait_s(crashes - 2) if crashes > 1 else 0.0


def due(
    life: Life, now_ns: int, *, ready: bool, quiet_ns: int, limits: Limits, used: ProcessorTime = NOT_LATE
) -> Event | None:
    """Return the event that the present time or the process's report causes; None if there is no event.

    A process that gets no processor does not hang, however long this takes: only the time counts in which
    it ran, or waited for something else.

    Args:
        life: The state of the process.
        now_ns: The present time, CLOCK_MONOTONIC.
        ready: True if the process has reported that it runs.
        quiet_ns: Time since the last heartbeat, in ns.
        limits: The limits that apply.
        used: How the process was scheduled since its start or, if it runs, during the time without a
            heartbeat.

    """
    if life.state is State.STARTING:
        if ready:
            return Event.READY
        if now_ns - life.spawned_ns - used.waited_ns < limits.start_s * 1e9:
            return None
    if life.state is State.RUNNING and quiet_ns - used.waited_ns >= limits.hang_s * 1e9:
        return Event.HANG
    if life.due_ns is not None and now_ns >= life.due_ns:
        return Event.ELAPSED
    return None


def adopted(spawned_ns: int, restarts: int) -> Life:
    """Return the state of an adopted process.

    The time of its start and its number of restarts are from the process table.
    """
    return Life(State.RUNNING, spawned_ns=spawned_ns, ready_ns=spawned_ns, starts=restarts + 1, ran=True)


def ended(returncode: int | None) -> Event:
    """Return the event for the end of a process; ``returncode`` is the exit code, or None if it is unknown."""
    return Event.REFUSAL if returncode == REFUSED_STATUS else Event.EXIT


Ranked = Sequence[tuple[int, Life]]
"""Rank and state of each process. Lower ranks start first and stop last."""


def to_start(processes: Ranked) -> list[int]:
    """Return the indices of the processes to start: all of the lowest rank that has not been started yet.

    Higher ranks wait until all processes of lower ranks have run for the first time, or have failed.
    """
    ranks = {rank for rank, life in processes if not life.starts}
    if not ranks or any(life.starts == 1 and life.state is State.STARTING for _, life in processes):
        return []
    next_rank = min(ranks)
    return [index for index, (rank, life) in enumerate(processes) if rank == next_rank and not life.starts]


def to_stop(processes: Ranked) -> list[int]:
    """Return the indices of the processes to stop: all of the highest rank that has not stopped yet.

    Stuck processes do not delay the stop of others.
    """
    there = [rank for rank, life in processes if not (life.state is State.STOPPED or _past_stopping(life))]
    next_rank = max(there, default=None)
    settled = (State.STOPPED, State.STOPPING)
    return [index for index, (rank, life) in enumerate(processes) if rank == next_rank and life.state not in settled]


def _past_stopping(life: Life) -> bool:
    return life.stuck and life.state is State.STOPPING


def all_gone(processes: Ranked) -> bool:
    """Return whether all processes have stopped."""
    return all(life.state is State.STOPPED for _, life in processes)


def start_failure(life: Life, limits: Limits) -> str | None:
    """Return why a process makes the start of the instance fail; None if it does not."""
    if life.ran:
        return None
    if life.state is State.FATAL or life.stuck:
        return life.note
    if life.state is State.BACKOFF and life.crashes >= limits.start_attempts:
        return f"failed to start {life.crashes} times; {life.note}"
    return None


def start_over(
    processes: Ranked, qualities: Sequence[Quality | None], since_ns: int, now_ns: int, limits: Limits
) -> bool:
    """Return whether the start is over: all processes have run, and all sources have a frame or are late.

    Args:
        processes: Rank and state of each process.
        qualities: The quality of each source; None for a source without a frame.
        since_ns: When the last process became ready, CLOCK_MONOTONIC. From then on, sources have
            ``settle_s`` to deliver a frame.
        now_ns: The present time, CLOCK_MONOTONIC.
        limits: The limits that apply.

    """
    if not all(life.ran for _, life in processes):
        return False
    return None not in qualities or now_ns - since_ns >= limits.settle_s * 1e9
