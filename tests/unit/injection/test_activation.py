"""The times and conditions at which a declared injection is active."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from shmio.injection.activation import Activation, State, Window

A, W, O = State.ACTIVE, State.WAITING, State.OVER  # noqa: E741


def states(window: Window, conditions: str, step_ns: int = 10) -> list[State]:
    """Return the states at times 0, ``step_ns`` and so on. A ``#`` in ``conditions`` is a true condition."""
    activation = Activation(window)
    found = []
    for cycle, mark in enumerate(conditions):
        activation.advance(cycle * step_ns, cycle, holds=mark == "#")
        found.append(activation.state)
    return found


def test_between_two_times() -> None:
    assert states(Window(20, 40), "######") == [W, W, A, A, O, O]
    assert states(Window(), "###") == [A, A, A]


def test_while_a_condition_holds() -> None:
    assert states(Window(), ".##.#.") == [W, A, A, W, A, W]
    assert states(Window(20, 50), "###.###") == [W, W, A, W, A, O, O]


def test_limited_time_after_a_condition_became_true() -> None:
    assert states(Window(for_ns=20), ".#....#####") == [W, A, A, W, W, W, A, A, W, W, W]
    assert states(Window(for_ns=20), "#..#.") == [A, A, W, A, A]
    assert states(Window(0, 30, for_ns=100), "######") == [A, A, A, O, O, O]


def test_limited_number_of_activations() -> None:
    assert states(Window(times=2), "#.#.#.") == [A, W, A, O, O, O]
    assert states(Window(for_ns=10, times=1), "##.#") == [A, O, O, O]


def test_restored_activation_continues() -> None:
    activation = Activation(Window(for_ns=20), State.WAITING, runs=1)
    activation.advance(100, 10, holds=True)
    assert activation.state is W
    activation.advance(110, 11, holds=False)
    activation.advance(120, 12, holds=True)
    assert (activation.state, activation.runs, activation.cycle, activation.time_ns) == (A, 2, 12, 120)
    activation = Activation(Window(for_ns=20), State.ACTIVE, 2, 12, 120)
    activation.advance(139, 14, holds=False)
    assert activation.state is A
    activation.advance(140, 15, holds=False)
    assert activation.state is W


times = st.none() | st.integers(0, 300)


@given(
    st.integers(0, 200),
    times,
    st.none() | st.integers(1, 80),
    st.none() | st.integers(1, 3),
    st.text("#.", max_size=40),
)
def test_invariants(start: int, end: int | None, for_ns: int | None, most: int | None, marks: str) -> None:
    window = Window(start, end, for_ns, most)
    activation = Activation(window)
    before = activation.state
    for cycle, mark in enumerate(marks):
        time_ns = 10 * cycle
        changed = activation.advance(time_ns, cycle, holds=mark == "#")
        assert changed == (activation.state is not before)
        if activation.state is State.ACTIVE:
            assert start <= time_ns
            assert end is None or time_ns < end
            if for_ns is None:
                assert mark == "#"
            else:
                assert time_ns < activation.time_ns + for_ns
        if before is State.OVER:
            assert activation.state is State.OVER
        assert most is None or activation.runs <= most
        before = activation.state


def test_an_activation_is_steady_until_its_window_begins_or_ends() -> None:
    steady_until = Activation(Window(100, 200, None, None)).steady_until
    assert [steady_until(time_ns) for time_ns in (0, 100, 200)] == [100, 200, math.inf]


@given(
    st.builds(Window, st.integers(0, 200), times, times, st.none() | st.integers(1, 3)),
    st.lists(st.tuples(st.booleans(), st.integers(1, 4), st.integers(1, 40)), max_size=12),
)
def test_a_steady_activation_needs_no_further_calls(window: Window, phases: list[tuple[bool, int, int]]) -> None:
    """Leaving out the calls that ``steady_until`` allows to leave out changes nothing."""
    every, some = Activation(window), Activation(window)
    time_ns = cycle = 0
    steady: tuple[bool, float] = False, -1.0
    for holds, count, step_ns in phases:
        for _ in range(count):
            time_ns, cycle = time_ns + step_ns, cycle + 1
            every.advance(time_ns, cycle, holds=holds)
            if holds is not steady[0] or time_ns >= steady[1]:
                met = some.met
                changed = some.advance(time_ns, cycle, holds=holds)
                quiet = not changed and some.met is met
                steady = holds, some.steady_until(time_ns) if quiet else -1.0
            assert some == every
