"""The order of a mirror's messages: holes, requests, duplicates, restarted uplinks, and what is given up."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from shmio.connectors.fabric.order import (
    MAX_AHEAD,
    MAX_HELD_BYTES,
    PATIENCE_NS,
    REPEAT_NS,
    REQUEST_NS,
    Announced,
    Lost,
    MessageOrder,
    Missing,
    Received,
)
from shmio.fabric.messages import Header

S = 1_000_000_000


def message(number: int, *, stream: int = 7, at_ns: int = 0, size: int = 100) -> Received:
    return Received(Header(0, stream, number, bytes(8), number, 0), bytes(size), at_ns)


def numbers(found: list[Received | Lost]) -> list[int | tuple[int, int]]:
    return [one.header.number if isinstance(one, Received) else (one.first, one.last) for one in found]


def test_messages_begin_with_the_first_that_comes() -> None:
    order = MessageOrder()
    assert numbers(order.add(message(41))) == [41]
    assert numbers(order.add(message(42))) == [42]
    assert order.missing(9 * S) is None
    assert order.patience_ns(9 * S) is None


def test_messages_after_a_hole_wait_until_it_is_filled() -> None:
    order = MessageOrder()
    order.add(message(1))
    assert numbers(order.add(message(5, at_ns=S))) == []
    assert order.waiting
    assert numbers(order.add(message(2, at_ns=S))) == [2]
    assert numbers(order.add(message(4, at_ns=S))) == []
    assert numbers(order.add(message(3, at_ns=S))) == [3, 4, 5]
    assert not order.waiting


def test_a_message_is_delivered_once() -> None:
    order = MessageOrder()
    order.add(message(1))
    order.add(message(3))
    assert numbers(
        [*order.add(message(3)), *order.add(message(2)), *order.add(message(2)), *order.add(message(3))]
    ) == [
        2,
        3,
    ]


def test_missing_messages_are_requested_after_a_pause_and_again() -> None:
    order = MessageOrder()
    order.add(message(1))
    order.add(message(9, at_ns=S))
    assert order.missing(S + REQUEST_NS - 1) is None
    assert order.patience_ns(S) == REQUEST_NS
    assert order.missing(S + REQUEST_NS) == Missing(7, 2, 8)
    assert order.missing(S + REQUEST_NS + 1) is None
    assert order.missing(S + REQUEST_NS + REPEAT_NS) == Missing(7, 2, 8)


def test_nothing_is_requested_while_missing_messages_come() -> None:
    order = MessageOrder()
    order.add(message(1))
    order.add(message(100, at_ns=S))
    for number in range(2, 60):
        order.add(message(number, at_ns=S + number * REQUEST_NS // 2))
        assert order.missing(S + number * REQUEST_NS // 2 + 1) is None


def test_messages_that_the_owner_no_longer_has_are_given_up() -> None:
    order = MessageOrder()
    order.add(message(1))
    order.add(message(9, at_ns=S))
    missing = order.missing(2 * S)
    assert missing == Missing(7, 2, 8)
    order.add(message(6, at_ns=2 * S))
    order.add(message(7, at_ns=2 * S))
    assert numbers(order.answered(missing, 2 * S)) == [(2, 5), 6, 7]
    assert numbers(order.answered(missing, 2 * S)) == [(8, 8), 9]
    assert numbers(order.answered(missing, 2 * S)) == []


def test_a_hole_is_given_up_if_nobody_answers() -> None:
    order = MessageOrder()
    order.add(message(1))
    order.add(message(4, at_ns=S))
    assert order.expired(S + PATIENCE_NS - 1) == []
    assert numbers(order.expired(S + PATIENCE_NS)) == [(2, 3), 4]


def test_a_restarted_uplink_begins_a_new_stream_and_its_first_messages_are_missing() -> None:
    order = MessageOrder()
    order.add(message(50))
    order.add(message(52, at_ns=S))
    assert numbers(order.add(message(3, stream=8, at_ns=S))) == [(51, 51), 52]
    assert order.missing(S + REQUEST_NS) == Missing(8, 1, 2)
    assert order.add(message(51, at_ns=S)) == []  # of the old stream
    assert numbers([*order.add(message(1, stream=8)), *order.add(message(2, stream=8))]) == [1, 2, 3]


def test_messages_that_wait_are_bounded() -> None:
    order = MessageOrder()
    order.add(message(1))
    found: list[Received | Lost] = []
    for number in range(3, 40):
        found += order.add(message(number, size=MAX_HELD_BYTES // 16))
    assert numbers(found) == [(2, 2), *range(3, 40)]


def test_an_answer_about_filled_messages_gives_up_nothing() -> None:
    order = MessageOrder()
    order.add(message(1))
    order.add(message(3, at_ns=S))
    missing = order.missing(2 * S)
    assert missing is not None
    order.add(message(2, at_ns=2 * S))
    order.add(message(5, at_ns=2 * S))
    assert order.answered(missing, 2 * S) == []


@given(st.integers(0, 10_000), st.integers(1, 60), st.integers(0, 30))
def test_any_order_of_arrival_is_delivered_in_order_once_with_exact_losses(seed: int, count: int, lost: int) -> None:
    chance = random.Random(seed)
    arriving = list(range(2, count + 2))
    gone = set(chance.sample(arriving[:-1], min(lost, len(arriving) - 1)))
    kept = [number for number in arriving if number not in gone]
    chance.shuffle(kept)
    order = MessageOrder()
    found = order.add(message(1))
    for number in kept:
        found += order.add(message(number))
        if chance.random() < 0.2:
            found += order.add(message(chance.choice(kept[: kept.index(number) + 1])))
    for turn in range(1, count + 2):
        found += order.expired(turn * PATIENCE_NS)
    assert not order.waiting
    delivered: list[int] = []
    for one in numbers(found):
        delivered += [one] if isinstance(one, int) else range(one[0], one[1] + 1)
    assert delivered == list(range(1, count + 2))
    assert {one for one in numbers(found) if isinstance(one, int)} == {1, *kept}


def test_the_registry_names_the_owners_stream_before_its_first_message() -> None:
    order = MessageOrder()
    assert order.stream == 0
    order.add(message(9000))
    assert order.stream == 7
    order.announce(Announced(8, 0, 0))
    assert order.stream == 8


def test_an_entry_without_a_number_does_not_repeat_messages() -> None:
    order = MessageOrder()
    for turn in range(8):
        assert numbers(order.add(message(1 + turn, at_ns=turn * 2 * S))) == [1 + turn]
        order.announce(Announced(7, None, turn * 2 * S))
    assert order.add(message(1, at_ns=16 * S)) == []
    assert order.add(message(1 << 40, at_ns=16 * S)) == []  # nothing bounds the numbers


def test_a_message_of_a_stream_that_the_registry_does_not_name_is_ignored() -> None:
    order = MessageOrder()
    order.add(message(5))
    order.announce(Announced(7, 5, 0))
    assert order.add(message(1, stream=666)) == []
    assert numbers(order.add(message(6))) == [6]
    assert order.add(message(2, stream=8)) == []
    order.announce(Announced(8, 2, S))
    assert order.add(message(3, stream=8, at_ns=S)) == []
    assert order.missing(S + REQUEST_NS) == Missing(8, 1, 2)


def test_the_owners_stream_comes_back_after_a_false_one() -> None:
    """Until the registry has told its stream, any is followed."""
    order = MessageOrder()
    order.add(message(5))
    assert numbers(order.add(message(1, stream=666))) == [1]
    order.announce(Announced(7, 6, 0))
    assert numbers(order.add(message(6))) == [6]


def test_a_number_far_beyond_the_registrys_is_ignored() -> None:
    order = MessageOrder()
    order.add(message(5))
    order.announce(Announced(7, 5, 0))
    assert order.add(message(7 + MAX_AHEAD)) == []
    assert not order.waiting


def test_after_a_false_number_the_owners_messages_are_delivered_again() -> None:
    order = MessageOrder()
    order.add(message(5))
    order.add(message(1000))
    assert numbers(order.expired(PATIENCE_NS)) == [(6, 999), 1000]
    for turn in range(4):
        assert order.add(message(6 + turn)) == []
        order.announce(Announced(7, 6 + turn, PATIENCE_NS + turn * 2 * S))
    assert numbers(order.add(message(10))) == [10]


def test_an_entry_that_is_older_than_the_messages_changes_nothing() -> None:
    order = MessageOrder()
    order.add(message(1))
    for turn in range(1, 8):
        found = [one for number in range(10 * turn, 10 * turn + 10) for one in order.add(message(number - 8))]
        assert numbers(found) == list(range(10 * turn - 8, 10 * turn + 2))
        order.announce(Announced(7, 10 * turn - 4, turn * 2 * S))
