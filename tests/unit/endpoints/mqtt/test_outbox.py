"""What waits for the broker: order, conflation, and the bounded store for when it is away. No broker."""

from __future__ import annotations

from paho.mqtt.properties import Properties

from shmio.endpoints.mqtt.outbox import MAX_RESULTS, OVERHEAD_BYTES, TURN_MESSAGES, Outbox
from shmio.endpoints.mqtt.topics import Message


class FakeConnection:
    """Takes ``room`` messages."""

    def __init__(self) -> None:
        self.up = True
        self.room = 1_000_000
        self.sent: list[str] = []

    def push(self) -> None:
        pass

    def send(self, message: Message, properties: Properties | None = None) -> None:
        self.room -= 1
        self.sent.append(f"{message.topic}{message.payload.decode()}{'' if message.retain else '!'}")


class Counter:
    """A topic whose payload is how it stands when it is asked."""

    def __init__(self, topic: str, *, keep: bool = True) -> None:
        self.topic = topic
        self.value = 0
        self._keep = keep

    def message(self, *, late: bool = False) -> Message:
        return Message(self.topic, str(self.value).encode(), 1, retain=not late, keep=self._keep)


def test_a_topic_that_waits_keeps_its_place_and_has_its_newest_value() -> None:
    connection = FakeConnection()
    outbox, a, b = Outbox(connection, connection, 10_000), Counter("a"), Counter("b")
    connection.room = 0
    for channel in (a, b, a):
        channel.value += 1
        outbox.mark(channel)
    outbox.flush()
    assert (connection.sent, outbox.waiting) == ([], 2)
    connection.room = 10
    outbox.flush()
    assert connection.sent == ["a2", "b1"]


def test_no_turn_is_longer_than_others_can_wait() -> None:
    connection = FakeConnection()
    outbox = Outbox(connection, connection, 0)
    outbox.mark_all(Counter(str(number)) for number in range(2 * TURN_MESSAGES + 1))
    outbox.flush()
    assert len(connection.sent) == TURN_MESSAGES
    assert outbox.can_send
    outbox.flush()
    outbox.flush()
    assert len(connection.sent) == 2 * TURN_MESSAGES + 1
    assert not outbox.can_send


def test_nothing_is_kept_before_there_was_anything_to_wait_for() -> None:
    connection = FakeConnection()
    connection.up = False
    outbox = Outbox(connection, connection, 10_000)
    outbox.mark(Counter("a"))
    assert not outbox.busy


def test_what_was_lost_and_what_waited_comes_before_what_is_new() -> None:
    connection = FakeConnection()
    outbox, a, b, status = Outbox(connection, connection, 10_000), Counter("a"), Counter("b"), Counter("s", keep=False)
    outbox.keeping = True
    connection.room = 0
    b.value = 3
    outbox.mark_all([b, status])
    connection.up = False
    outbox.lose([Message("a", b"1", 1, retain=True, keep=True), Message("s", b"1", 1, retain=True)])
    for a.value in (2, 3):
        outbox.mark(a)
    connection.up, connection.room = True, 100
    outbox.resend([a, b, status])
    a.value = 4
    outbox.mark(a)  # while what was kept is still on its way
    outbox.flush()
    assert connection.sent == ["a1!", "b3!", "a2!", "a3!", "a4!", "a4", "b3", "s0"]
    a.value = 5
    outbox.mark(a)
    outbox.flush()
    assert connection.sent[-1] == "a5"


def test_the_oldest_go_when_there_is_no_room() -> None:
    connection = FakeConnection()
    connection.up = False
    outbox, a = Outbox(connection, connection, 3 * (OVERHEAD_BYTES + 1)), Counter("a")
    outbox.keeping = True
    for a.value in range(1, 8):
        outbox.mark(a)
    assert (outbox.backlog, outbox.dropped) == (3, 4)
    outbox.lose([Message("a", b"0", 1, retain=True, keep=True)])  # older than all of them
    assert (outbox.backlog, outbox.dropped) == (3, 5)
    connection.up = True
    outbox.resend([a])
    outbox.flush()
    assert connection.sent == ["a5!", "a6!", "a7!", "a7"]


def test_a_store_that_is_full_when_the_broker_is_back_makes_place_for_the_newest_value() -> None:
    """What comes then is conflated, not dropped."""
    connection = FakeConnection()
    connection.up = False
    outbox, a = Outbox(connection, connection, OVERHEAD_BYTES + 1), Counter("a")
    outbox.keeping = True
    a.value = 1
    outbox.mark(a)
    connection.up = True
    outbox.resend([a])
    for a.value in (2, 3):
        outbox.mark(a)
    outbox.flush()
    assert (connection.sent, outbox.dropped) == (["a1!", "a3"], 0)


def test_results_are_bounded_and_hold_up_no_value() -> None:
    values, results = FakeConnection(), FakeConnection()
    outbox = Outbox(values, results, 0)
    results.room = 0
    outbox.mark(Counter("a"))
    for number in range(MAX_RESULTS + 2):
        outbox.queue_result(Message("r", str(number).encode(), 0, retain=True), None)
    assert outbox.dropped == 2
    outbox.flush()
    assert values.sent == ["a0"]
    results.room = 1_000_000
    while outbox.can_send:
        outbox.flush()
    assert results.sent == [f"r{number}" for number in range(2, MAX_RESULTS + 2)]


def test_results_and_values_wait_for_their_own_connection() -> None:
    values, results = FakeConnection(), FakeConnection()
    outbox, a = Outbox(values, results, 0), Counter("a")
    values.room = results.room = 0
    outbox.mark(a)
    outbox.queue_result(Message("r", b"0", 0, retain=True), None)
    outbox.flush()
    assert not outbox.can_send
    results.room = 1
    outbox.flush()
    assert (values.sent, results.sent) == ([], ["r0"])
    outbox.queue_result(Message("r", b"1", 0, retain=True), None)
    values.room = 1
    outbox.flush()
    assert (values.sent, results.sent) == (["a0"], ["r0"])
    results.up = False
    outbox.flush()
    results.up, results.room = True, 1
    outbox.flush()
    assert results.sent == ["r0"]
    assert not outbox.busy


def test_a_broker_that_takes_less_than_there_is_comes_back_to_the_present() -> None:
    """Else what changes while the past is told would be put behind it for ever."""
    connection = FakeConnection()
    connection.up = False
    outbox, topics = Outbox(connection, connection, 10_000), [Counter(name) for name in "abc"]
    outbox.keeping = True
    outbox.mark_all(topics)
    connection.up, connection.room = True, 0
    outbox.resend(topics)
    for number in range(1000):
        for topic in topics:
            topic.value = number
            outbox.mark(topic)
        connection.room = 1
        outbox.flush()
    assert outbox.backlog == 0
    assert not any(one.endswith("!") for one in connection.sent[-3:])
    assert outbox.dropped == 0


def test_what_changes_after_it_was_shown_is_shown_again() -> None:
    """What is kept is sent without the retain flag: the broker would go on telling the value before."""
    connection = FakeConnection()
    outbox, a, b = Outbox(connection, connection, 10_000), Counter("a"), Counter("b")
    connection.room = 1
    outbox.resend([a, b])
    outbox.flush()
    a.value = 7
    outbox.mark(a)
    connection.room = 10
    outbox.flush()
    assert connection.sent[0] == "a0"
    assert "a7" in connection.sent
    assert "b0" in connection.sent
