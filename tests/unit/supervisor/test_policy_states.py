"""The state graph of processes: as documented, and consistent on every path."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from shmio.supervisor.policy import GRAPH, LIVING, PHASES, Action, Event, State

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "process-states.md"
EDGE = re.compile(r"^ +(\w+) --> (\w+): (\w+)(?: / (\w+))?$", re.MULTILINE)

EDGES = [(state, event, *edge) for state, edges in GRAPH.items() for event, edge in edges.items()]


def test_the_graph_is_as_documented() -> None:
    documented = [
        (State(source), Event(event), State(target), Action(action) if action else None)
        for source, target, event, action in EDGE.findall(PAGE.read_text())
    ]
    assert len(documented) == len(set(documented))
    assert set(documented) == set(EDGES)


@pytest.mark.parametrize(("state", "event", "target", "action"), EDGES)
def test_edges_start_and_signal_processes_consistently(
    state: State, event: Event, target: State, action: Action | None
) -> None:
    alive = state in LIVING and event not in (Event.EXIT, Event.REFUSAL)
    if action is Action.SPAWN:
        assert not alive, "it would start a second process"
        alive = True
    elif action is not None:
        assert alive, "it would signal without a process"
    assert alive == (target in LIVING)


@pytest.mark.parametrize("state", State)
def test_every_state_with_a_process_handles_its_end(state: State) -> None:
    for event in (Event.EXIT, Event.REFUSAL):
        assert (event in GRAPH[state]) == (state in LIVING)


@pytest.mark.parametrize("state", State)
def test_a_stop_in_any_state_ends_in_stopped(state: State) -> None:
    for event in (Event.STOP, Event.HASTEN):
        reached, _ = GRAPH[state].get(event, (state, None))
        if reached in LIVING:
            assert reached is State.STOPPING
            assert {GRAPH[reached][end][0] for end in (Event.EXIT, Event.REFUSAL)} == {State.STOPPED}
        else:
            assert reached is State.STOPPED
    assert all(target is State.STOPPING for event, (target, _) in GRAPH[State.STOPPING].items() if target in LIVING)


@pytest.mark.parametrize("state", [state for state in State if state is not State.STOPPING])
def test_a_restart_in_any_state_ends_in_starting(state: State) -> None:
    reached, _ = GRAPH[state].get(Event.RESTART, (state, None))
    if reached is State.RESTARTING:
        assert GRAPH[reached][Event.EXIT] == (State.STARTING, Action.SPAWN)
    else:
        assert reached is State.STARTING


def test_every_state_is_reachable_and_published() -> None:
    reached = {State.STOPPED} | {target for _, _, target, _ in EDGES}
    assert reached == set(State) == set(PHASES)
