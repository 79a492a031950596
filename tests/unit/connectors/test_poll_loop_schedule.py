"""The schedule of cycles, at multiples of the period."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from shmio.connectors.poll_loop import Schedule


def test_cycles_are_due_at_multiples_of_the_period_from_the_start() -> None:
    schedule = Schedule(start_ns=1000, period_ns=20)
    assert schedule.next(1005) == (1, 1020, 0)
    assert schedule.next(1021) == (2, 1040, 0)


def test_a_late_cycle_still_runs_and_the_next_ones_are_on_time_again() -> None:
    schedule = Schedule(0, 20)
    schedule.next(0)
    assert schedule.next(45) == (2, 40, 0)  # cycle 1 took 25: the next begins late
    assert schedule.next(50) == (3, 60, 0)


def test_cycles_that_are_wholly_past_are_overruns() -> None:
    schedule = Schedule(0, 20)
    schedule.next(0)
    assert schedule.next(105) == (5, 100, 3)


def test_an_outage_is_no_overrun() -> None:
    schedule = Schedule(0, 20)
    schedule.next(0)
    schedule.restart()
    assert schedule.next(1_000_005) == (50_001, 1_000_020, 0)


@given(st.integers(0, 10**15), st.integers(1, 10**9), st.lists(st.integers(0, 10**10), min_size=1, max_size=50))
def test_every_cycle_is_run_or_counted_whatever_the_delays(start: int, period: int, delays: list[int]) -> None:
    schedule = Schedule(start, period)
    now, previous, skipped = start, None, 0
    for delay in delays:
        due = schedule.next(now)
        assert due.due_ns == start + due.cycle * period
        assert due.due_ns + period > now  # no cycle begins after its whole period has passed
        if previous is not None:
            assert due.cycle - previous - 1 == due.skipped
        previous, skipped = due.cycle, skipped + due.skipped
        now = max(now, due.due_ns) + delay
