"""The states of a supervised process as one graph (docs/reference/process-states.md)."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Final

from shmio.segment import Phase


class State(Enum):
    """Where a process is in its life."""

    STOPPED = "stopped"
    STARTING = "starting"
    RUNNING = "running"
    STOPPING = "stopping"
    RESTARTING = "restarting"
    HUNG = "hung"
    BACKOFF = "backoff"
    FATAL = "fatal"


class Event(Enum):
    """What can happen to it. ELAPSED: the time that its state allows is over."""

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
    """What the supervisor does about it."""

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
"""Every edge there is; an event that a state does not list changes nothing."""

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
"""What others are told: a process on its way somewhere counts as there, its note says more."""

LIVING: Final = frozenset({State.STARTING, State.RUNNING, State.STOPPING, State.RESTARTING, State.HUNG})
"""States in which there is an operating-system process."""
