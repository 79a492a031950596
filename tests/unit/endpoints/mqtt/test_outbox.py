"""The queue to the broker: order, conflation, and the bounded backlog. No broker runs."""

from __future__ import annotations

from paho.mqtt.properties import Properties

from shmio.endpoints.mqtt.outbox import MAX_RESULTS, OVERHEAD_BYTES, TURN_MESSAGES, Outbox
from shmio.endpoints.mqtt.topics import Message


class FakeConnection:
    """A connection that accepts at most ``room`` messages."""

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
    """A topic whose payload is the counter's value when the message is sent."""

    def __init__(self, topic: str, *, keep: bool = True) -> None:
        self.topic = topic
        self.value = 0
        self._keep = keep

    def message(self, *, late: bool = False) -> Message:
        return Message(self.topic, str(self.value).encode(), 1, retain=not late, keep=self._keep)


def test_a_waiting_topic_keeps_its_place_and_gets_its_newest_value() -> None:
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


def test_a_turn_sends_a_limited_number_of_messages() -> None:
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


def test_nothing_is_kept_before_the_first_connection() -> None:
    connection = FakeConnection()
    connection.up = False
    outbox = Outbox(connection, connection, 10_000)
    outbox.mark(Counter("a"))
    assert not outbox.busy


def test_lost_and_waiting_messages_are_sent_before_new_ones() -> None:
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
    outbox.mark(a)  # while the backlog is being sent
    outbox.flush()
    assert connection.sent == ["a1!", "b3!", "a2!", "a3!", "a4!", "a4", "b3", "s0"]
    a.value = 5
    outbox.mark(a)
    outbox.flush()
    assert connection.sent[-1] == "a5"


def test_the_oldest_messages_are_dropped_when_the_backlog_is_full() -> None:
    connection = FakeConnection()
    connection.up = False
    outbox, a = Outbox(connection, connection, 3 * (OVERHEAD_BYTES + 1)), Counter("a")
    outbox.keeping = True
    for a.value in range(1, 8):
        outbox.mark(a)
    assert (outbox.backlog, outbox.dropped) == (3, 4)
    outbox.lose([Message("a", b"0", 1, retain=True, keep=True)])  # older than all others
    assert (outbox.backlog, outbox.dropped) == (3, 5)
    connection.up = True
    outbox.resend([a])
    outbox.flush()
    assert connection.sent == ["a5!", "a6!", "a7!", "a7"]


def test_a_backlog_that_is_full_at_reconnection_accepts_the_newest_value() -> None:
    """Values that change during the reconnection are conflated, not dropped."""
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


def test_results_are_bounded_and_delay_no_value() -> None:
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


def test_a_broker_slower_than_the_changes_still_catches_up() -> None:
    """Otherwise changes during the catch-up would stay in the backlog for ever."""
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


def test_the_first_state_is_sent_once() -> None:
    """A bridge connects before it has read the first frames, which change every topic."""
    connection = FakeConnection()
    outbox, channels = Outbox(connection, connection, 10_000), [Counter("a"), Counter("b")]
    outbox.keeping = True
    outbox.resend(channels)
    outbox.mark_all(channels)
    outbox.flush()
    assert connection.sent == ["a0", "b0"]


def test_a_change_after_the_resend_is_sent() -> None:
    """The backlog is sent without the retain flag, so the broker would retain an older value."""
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
