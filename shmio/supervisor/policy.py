"""All decisions of the supervisor, as functions of what is known and the time. No I/O, no clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from shmio.segment import Quality
from shmio.supervisor.states import GRAPH, Action, Event, State

REFUSED_STATUS = 2
"""Exit status by which a worker says that it can never work as configured."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Times and counts by which processes are judged; times in s."""

    start_s: float = 20.0
    """From its start until it must report that it runs."""
    hang_s: float = 5.0
    """Without a heartbeat while running."""
    grace_s: float = 5.0
    """From SIGTERM to SIGKILL."""
    kill_s: float = 5.0
    """From SIGKILL until a process that still is there counts as stuck."""
    stable_s: float = 5.0
    """Running this long, it has put its crashes behind it."""
    backoff_first_s: float = 0.5
    backoff_most_s: float = 10.0
    start_attempts: int = 3
    """Crashes of a process that never ran, after which the start of the instance has failed."""
    settle_s: float = 3.0
    """Time for the sources' first frames before the instance's start counts as over."""
    plan_s: float = 60.0
    """For a reload to read the configuration and all that it names."""


@dataclass(frozen=True, slots=True)
class Life:
    """All that is remembered about a process. Times are CLOCK_MONOTONIC ns."""

    state: State = State.STOPPED
    due_ns: int | None = None
    """When the state's time is over."""
    spawned_ns: int = 0
    ready_ns: int | None = None
    """Since when it has been running; None before, and again from its next start."""
    starts: int = 0
    crashes: int = 0
    """In a row; forgotten once it runs stably."""
    ran: bool = False
    """Whether it has been running at any time."""
    note: str = ""
    """Why it is not running."""
    hang: str = ""
    """Why it was last killed as one that hangs; its end is told together with this."""
    killed: bool = False
    """Whether it was sent SIGKILL, and has not ended yet."""
    stuck: bool = False
    """Whether it should have ended by then: it waits in the kernel."""

    @property
    def restarts(self) -> int:
        """How often it was started again, for whatever reason."""
        return max(0, self.starts - 1)


def step(life: Life, event: Event, now_ns: int, limits: Limits, note: str = "") -> tuple[Life, Action | None]:
    """Take one edge of the graph; (what is then known, what is to be done). ``note`` tells how a process ended."""
    edge = GRAPH[life.state].get(event)
    if edge is None:
        return life, None
    state, action = edge
    killed = action is Action.KILL or (life.killed and event not in (Event.EXIT, Event.REFUSAL))
    stuck = killed and (life.stuck or (life.killed and event is Event.ELAPSED))
    if state is State.HUNG and life.state is not State.HUNG:
        life = replace(life, hang=_hang(life, limits))
    told = (note or life.note) if stuck else _note(life, state, note)
    crashes = _crashes(life, event, state, now_ns, limits)
    life = replace(life, crashes=crashes, note=told, killed=killed, stuck=stuck)
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
    return f"not running {limits.start_s:g} s after its start" if late else f"no heartbeat for {limits.hang_s:g} s"


def _note(life: Life, to: State, note: str) -> str:
    if to is State.HUNG:
        return life.hang
    if to is State.BACKOFF and life.state is State.HUNG:
        return f"{life.hang}, {note}"
    if to in (State.BACKOFF, State.FATAL):
        return note
    if to is State.STARTING and life.state is State.BACKOFF:
        return life.note  # that may have lasted for a moment only; whoever looks is to see why
    return {State.STOPPING: "stopping", State.RESTARTING: "restarting"}.get(to, "")


def _allowed_s(state: State, action: Action | None, crashes: int, limits: Limits) -> float | None:
    if state is State.STARTING:
        return limits.start_s
    if state is State.BACKOFF:
        return backoff_s(crashes, limits)
    return {Action.TERMINATE: limits.grace_s, Action.KILL: limits.kill_s}.get(action) if action else None


def backoff_s(crashes: int, limits: Limits) -> float:
    """Wait before the next start: none after the first crash, then doubling up to the limit."""
    if crashes <= 1:
        return 0.0
    doublings = min(crashes - 2, 32)  # beyond that a float could overflow
    return float(min(limits.backoff_most_s, limits.backoff_first_s * 2**doublings))


def due(life: Life, now_ns: int, *, ready: bool, quiet_ns: int, limits: Limits) -> Event | None:
    """What time or the worker's report has brought about, if anything.

    ``ready``: it has reported that it runs. ``quiet_ns``: time without a heartbeat.
    """
    if life.state is State.STARTING and ready:
        return Event.READY
    if life.state is State.RUNNING and quiet_ns >= limits.hang_s * 1e9:
        return Event.HANG
    if life.due_ns is not None and now_ns >= life.due_ns:
        return Event.ELAPSED
    return None


def adopted(spawned_ns: int, restarts: int) -> Life:
    """The life of a process that runs, as far as its former supervisor has told of it."""
    return Life(State.RUNNING, spawned_ns=spawned_ns, ready_ns=spawned_ns, starts=restarts + 1, ran=True)


def ended(returncode: int | None) -> Event:
    """What the end of a process means; None: its exit status is not known."""
    return Event.REFUSAL if returncode == REFUSED_STATUS else Event.EXIT


Ranked = Sequence[tuple[int, Life]]
"""The rank of each process and its life: a rank starts after those before it and stops before them."""


def to_start(processes: Ranked) -> list[int]:
    """Indices of the processes whose turn has come: the lowest rank not yet started, once those below had their chance.

    A process that fails does not hold up the others, one that is still at its first start does.
    """
    ranks = {rank for rank, life in processes if not life.starts}
    if not ranks or any(life.starts == 1 and life.state is State.STARTING for _, life in processes):
        return []
    turn = min(ranks)
    return [index for index, (rank, life) in enumerate(processes) if rank == turn and not life.starts]


def to_stop(processes: Ranked) -> list[int]:
    """Indices of the processes whose turn to stop has come: those of the highest rank that is not gone yet.

    One that is stuck is not waited for.
    """
    there = [rank for rank, life in processes if not (life.state is State.STOPPED or _past_stopping(life))]
    turn = max(there, default=None)
    settled = (State.STOPPED, State.STOPPING)
    return [index for index, (rank, life) in enumerate(processes) if rank == turn and life.state not in settled]


def _past_stopping(life: Life) -> bool:
    return life.stuck and life.state is State.STOPPING


def all_gone(processes: Ranked) -> bool:
    """Whether a stop is complete."""
    return all(life.state is State.STOPPED for _, life in processes)


def start_failure(life: Life, limits: Limits) -> str | None:
    """Why the start of the instance has failed at this process; None when it has not."""
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
    """Whether the instance's start is over: all processes have run, and the sources have told how they fare.

    ``qualities``: of the sources, None for one without a frame; those are given ``settle_s`` from ``since_ns``, when
    the last process became ready.
    """
    if not all(life.ran for _, life in processes):
        return False
    return None not in qualities or now_ns - since_ns >= limits.settle_s * 1e9
