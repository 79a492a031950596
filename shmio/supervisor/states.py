"""The states of a supervised process as a graph (docs/reference/process-states.md)."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Final

from shmio.segment import Phase


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
    """The events of a process. ELAPSED: the time limit of its state is over."""

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
    """The actions of the supervisor."""

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
"""All edges. An event that a state does not list has no effect."""

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
"""The published phase of each state. A process in transition has the phase it is heading for."""

LIVING: Final = frozenset({State.STARTING, State.RUNNING, State.STOPPING, State.RESTARTING, State.HUNG})
"""The states in which an operating-system process exists."""
