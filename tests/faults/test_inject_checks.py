"""The checks of injections accept a correct history, and detect each kind of error."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from shmio.model.values import OutcomeKind
from tests.faults.checks import Source
from tests.faults.inject_checks import INNER, LIFTED_NS, OUTER, QUIET_NS, SHOWN_NS, ChainCheck, GuardCheck, LifeCheck
from tests.faults.truth import Truth

S = 1_000_000_000


@pytest.fixture
def found() -> list[str]:
    return []


@pytest.fixture
def source(tmp_path: Path) -> Iterator[Source]:
    guarded, given = (Truth(tmp_path / name, create=True) for name in ("guarded", "given"))
    yield Source("cell", 64, 1, 1, 1, True, guarded=guarded, given=given)
    guarded.close()
    given.close()


def check(source: Source, found: list[str]) -> GuardCheck:
    return GuardCheck(source, found.append)


def land(source: Source, value: int, now_ns: int) -> None:
    assert source.guarded is not None
    source.guarded.land(value, now_ns)


def give(source: Source, value: int, now_ns: int) -> None:
    assert source.given is not None
    source.given.land(value, now_ns)


def test_what_an_injection_takes_is_held_to_what_the_plc_got(source: Source, found: list[str]) -> None:
    guard = check(source, found)
    land(source, 2, 10)
    give(source, 5, 20)
    land(source, 5, 20)
    land(source, 8, 30)
    guard.written(2, OutcomeKind.WRITTEN, "", stood=False, free=True)
    guard.written(4, OutcomeKind.TAKEN, "", stood=True, free=False)
    guard.written(6, OutcomeKind.TAKEN, "", stood=False, free=False)  # the injection gave no replacement
    guard.written(8, OutcomeKind.UNKNOWN, "no answer", stood=True, free=False)
    guard.written(10, OutcomeKind.REJECTED, "not now", stood=False, free=True)
    for value in (2, 4, 6, 8, 10):
        guard.look(value)
    assert found == []
    assert (guard.counts.values, guard.counts.good) == (5, 2)


@pytest.mark.parametrize(
    ("kind", "stood", "free", "landed", "answered", "problem"),
    [
        (OutcomeKind.WRITTEN, True, False, True, False, "past the injection that covered"),
        (OutcomeKind.TAKEN, False, True, False, False, "there was no injection"),
        (OutcomeKind.ACCEPTED, False, False, False, False, "ended as ACCEPTED"),
        (OutcomeKind.TAKEN, True, False, True, False, "was TAKEN, but the PLC got it"),
        (OutcomeKind.WRITTEN, False, True, False, False, "the PLC never got it"),
        (OutcomeKind.TAKEN, True, False, False, True, "the PLC got 3, which no injection had given"),
    ],
)  # fmt: skip
def test_what_goes_past_one_is_found(
    source: Source, found: list[str], kind: OutcomeKind, stood: bool, free: bool, landed: bool, answered: bool,
    problem: str,
) -> None:  # fmt: skip
    guard = check(source, found)
    if landed:
        land(source, 2, 10)
    if answered:
        give(source, 3, 21)
        land(source, 3, 20)
    guard.written(2, kind, "", stood=stood, free=free)
    guard.look(2)
    assert len(found) == 1
    assert problem in found[0]


def test_one_that_nobody_keeps_goes_within_a_second(found: list[str]) -> None:
    life = LifeCheck("n1", keep=False, ended_ns=10 * S, complain=found.append)
    life.look(11 * S, stands=True, awake_since_ns=0, slack_ns=0)
    life.look(14 * S, stands=True, awake_since_ns=13 * S, slack_ns=0)  # the process that lifts it was paused
    life.look(16 * S, stands=True, awake_since_ns=13 * S, slack_ns=2 * S)
    life.look(20 * S, stands=True, awake_since_ns=0, slack_ns=0, renewed=True)
    life.look(30 * S, stands=False, awake_since_ns=0, slack_ns=0)
    assert found == []
    late_ns = 10 * S + LIFTED_NS + 1
    life.look(late_ns, stands=True, awake_since_ns=0, slack_ns=0)
    life.look(late_ns + 1, stands=True, awake_since_ns=0, slack_ns=0)
    assert found == ["the injection n1 still exists 1.0 s after its client's end"]


def test_one_that_is_kept_stays(found: list[str]) -> None:
    life = LifeCheck("n1", keep=True, ended_ns=10 * S, complain=found.append)
    life.look(20 * S, stands=True, awake_since_ns=0, slack_ns=0)
    life.look(20 * S, stands=False, awake_since_ns=0, slack_ns=0, renewed=True)
    assert found == []
    life.look(20 * S, stands=False, awake_since_ns=0, slack_ns=0)
    assert found == ["the injection n1 was to be kept, but is gone"]


BOTH = {INNER, OUTER}


def test_a_chain_shows_its_outermost(source: Source, found: list[str]) -> None:
    chain = ChainCheck(source, found.append)
    told = [
        chain.look(shown, now_ns, now_ns, present)
        for now_ns, (shown, present) in enumerate(
            [
                (0, set()),
                (8, {INNER}),
                (8, {INNER}),
                (8, BOTH),
                (8, BOTH),
                (9, BOTH),
                (13, BOTH),
                (13, None),
                (12, {INNER}),
            ]
        )
    ]
    assert told == [False] * 5 + [True] * 2 + [False] * 2
    chain.look(16, SHOWN_NS + 9, SHOWN_NS + 9, {INNER})
    chain.look(16, SHOWN_NS + 9, SHOWN_NS + 10, set())  # the frame is older than the change
    chain.look(0, 3 * SHOWN_NS, 3 * SHOWN_NS, set())
    assert found == []
    assert (chain.counts.values, chain.counts.good) == (5, 2)


@pytest.mark.parametrize(
    ("shown", "present", "problem"),
    [
        ((9, 12), BOTH, "shows 12, which the inner injection gives, past the outer one"),
        ((9, 0), BOTH, "shows 0, which the inner injection gives, past the outer one"),
        ((8, 9), {INNER}, "shows 9, which the outer injection gave"),
        ((0, 9), set(), "shows 9, but there is no injection"),
    ],
)
def test_a_chain_in_the_wrong_order_is_found(
    source: Source, found: list[str], shown: tuple[int, int], present: set[str], problem: str
) -> None:
    chain = ChainCheck(source, found.append)
    for turn, value in enumerate((0, *shown)):
        chain.look(value, turn * 2 * SHOWN_NS, turn * 2 * SHOWN_NS, present)
    assert len(found) == 1
    assert problem in found[0]


def test_one_of_a_chain_that_goes_without_its_clients_end_is_found(source: Source, found: list[str]) -> None:
    chain = ChainCheck(source, found.append)
    for now_ns in range(0, 10 * QUIET_NS, QUIET_NS):
        chain.stay({INNER}, BOTH, now_ns, 0)
        chain.stay(BOTH, {INNER}, now_ns, now_ns - 1)  # the process that keeps it has just been killed
        chain.stay({INNER}, {INNER}, now_ns, 0)
    assert found == []
    for now_ns in range(0, 4 * QUIET_NS, QUIET_NS):
        chain.stay(BOTH, {INNER}, now_ns, -2 * QUIET_NS)
    assert found == ["cell, chain: the outer injection is gone, but its client is alive"]
