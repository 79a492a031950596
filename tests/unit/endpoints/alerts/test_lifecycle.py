"""When an alert is active, and which changes give a notice."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from shmio.endpoints.alerts.lifecycle import Change, Lifecycle, Progress

Seen = list[tuple[int, Change, int]]


def run(lifecycle: Lifecycle, *values: tuple[int, bool | None]) -> Seen:
    """Observe values at times; return each notice with its time and the number of suppressed activations."""
    return [
        (now, change, lifecycle.progress.suppressed)
        for now, holds in values
        for change in lifecycle.observe(holds, now)
    ]


def lifecycle(
    for_ns: int = 0, every_ns: int = 1, *, resolved: bool = True, progress: Progress | None = None
) -> Lifecycle:
    return Lifecycle(for_ns, every_ns, resolved, progress or Progress())


def test_each_edge_gives_one_notice() -> None:
    seen = run(lifecycle(), (1, False), (2, True), (3, True), (4, True), (5, False), (6, False), (7, True))
    assert seen == [(2, Change.ACTIVE, 0), (5, Change.RESOLVED, 0), (7, Change.ACTIVE, 0)]


def test_the_end_gives_a_notice_only_on_request() -> None:
    assert run(lifecycle(resolved=False), (1, True), (2, False)) == [(1, Change.ACTIVE, 0)]


def test_unknown_is_no_edge() -> None:
    assert run(lifecycle(), (1, True), (2, None), (3, True), (4, None), (5, False)) == [
        (1, Change.ACTIVE, 0),
        (5, Change.RESOLVED, 0),
    ]
    assert run(lifecycle(), (1, None), (2, False), (3, None)) == []


def test_a_condition_must_be_true_without_interruption() -> None:
    one = lifecycle(for_ns=10)
    assert run(one, (0, True), (9, False), (10, True), (15, None), (16, True), (25, True)) == []
    assert one.due_ns == 26
    assert list(one.advance(26)) == [Change.ACTIVE], "without another frame"


def test_a_late_evaluation_sees_what_was_due_before() -> None:
    assert run(lifecycle(for_ns=10), (0, True), (50, False)) == [(50, Change.ACTIVE, 0), (50, Change.RESOLVED, 0)]


def test_notices_are_rate_limited() -> None:
    one = lifecycle(every_ns=100)
    assert run(
        one, (0, True), (10, False), (20, True), (30, False), (40, True), (50, False), (60, True), (99, True)
    ) == [
        (0, Change.ACTIVE, 0),
        (10, Change.RESOLVED, 0),
    ], "an end without its beginning is not reported"
    assert one.due_ns == 100
    assert run(one, (100, True), (101, False)) == [(100, Change.ACTIVE, 2), (101, Change.RESOLVED, 0)]


def test_a_restart_continues() -> None:
    first = lifecycle(every_ns=100)
    run(first, (0, True))
    assert run(lifecycle(every_ns=100, progress=first.progress), (1, None), (2, True), (3, False), (4, True)) == [
        (3, Change.RESOLVED, 0)
    ]


@given(
    st.lists(st.tuples(st.integers(1, 50), st.sampled_from([True, False, None])), max_size=60),
    st.integers(0, 30),
    st.integers(1, 100),
)
def test_notices_alternate_and_keep_their_distance(
    values: list[tuple[int, bool | None]], for_ns: int, every_ns: int
) -> None:
    now, steps = 0, []
    for gap, holds in values:
        now += gap
        steps.append((now, holds))
    seen = run(lifecycle(for_ns, every_ns), *steps)
    assert [change for _, change, _ in seen] == [Change.ACTIVE, Change.RESOLVED] * (len(seen) // 2) + [
        Change.ACTIVE
    ] * (len(seen) % 2)
    times = [at for at, change, _ in seen if change is Change.ACTIVE]
    assert all(later - earlier >= every_ns for earlier, later in pairwise(times))
