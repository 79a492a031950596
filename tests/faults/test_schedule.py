"""The schedule of faults depends on the seed, has all kinds, and no two faults on one target."""

from __future__ import annotations

from itertools import islice

from tests.faults.schedule import SUPERVISOR, WEIGHTS, rounds


def test_a_seed_determines_the_schedule() -> None:
    assert list(islice(rounds(1), 200)) == list(islice(rounds(1), 200))
    assert list(islice(rounds(1), 200)) != list(islice(rounds(2), 200))


def test_all_kinds_come() -> None:
    assert {fault.kind for turn in islice(rounds(3), 500) for fault in turn.faults} == set(WEIGHTS)


def test_no_target_is_hit_twice_in_a_round() -> None:
    for turn in islice(rounds(4), 500):
        targets = [fault.target for fault in turn.faults]
        assert len(targets) == len(set(targets))
        assert SUPERVISOR not in targets or len(targets) == 1
