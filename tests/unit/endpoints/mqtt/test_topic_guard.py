"""Messages that other clients publish on the bridge's topics: the bridge corrects them, at a limited rate."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from shmio.endpoints.mqtt.topic_guard import (
    AT_ONCE,
    BREAK,
    CALM_PAUSES,
    MAX_FOREIGN_MESSAGES,
    PAUSE,
    TopicGuard,
)
from shmio.segment import Segment
from shmio.testing.mosquitto import Mosquitto
from tests.unit.endpoints.harness import image
from tests.unit.endpoints.mqtt.harness import PREFIX, bridge, listening


def test_forged_messages_are_corrected_at_once(segment: Segment, broker: Mosquitto) -> None:
    segment.writer("cell").publish(image(step=7), cycle=1)
    with bridge(segment, broker.address) as running, listening(broker.address) as listener:
        listener.shown("cell/step/out", "7")
        truths = {"cell/step/out": "7", "status": "online", "cell/running/out": "false", "cell/frames": ""}
        truths |= dict.fromkeys(("cell/nowhere/out", "cell/step/in/result", "shmio/results/me", "simlog/step"), "")
        for payload in ("999", ""):
            for topic in truths:
                listener.publish(topic, payload, retain=True)
            while not all(
                payload in (heard := listener.values(topic)) and heard[-1] == truth for topic, truth in truths.items()
            ):
                listener.message()
        listener.publish("cell/step/out", "7", retain=True)
        listener.publish("cell/status", "{}", retain=True)
        while listener.json("cell/status").get("quality") != "good":
            pass
        with listening(broker.address, f"{PREFIX}/#") as later:
            later.until("cell/step/out", b"7")
            assert b"999" not in [payload for _, payload in later.heard]
        assert running.bridge.problem == ""


def test_two_bridges_of_one_prefix_do_not_answer_each_other_for_ever(
    segment: Segment, make_segment: Callable[[], Segment], broker: Mosquitto
) -> None:
    segment.writer("cell").publish(image(step=7), cycle=1)
    other = make_segment()
    other.writer("cell").publish(image(step=8), cycle=1)
    with bridge(segment, broker.address) as one, bridge(other, broker.address, client_id="other") as two:
        two.until(lambda: two.bridge.connection.up)
        with listening(broker.address) as listener:
            for _ in range(2):
                listener.until("cell/step/out", b"7")
                listener.until("cell/step/out", b"8")
        one.until(lambda: one.bridge._guard._pauses > 1)


class Owner:
    """Counts the calls of a guard."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.corrected: list[str] = []
        self.all = 0
        self.watching = 0
        self.guard = TopicGuard(self, lambda: self.now_s)
        self.guard.begin()

    def watch(self) -> None:
        self.watching += 1

    def unwatch(self) -> None:
        self.watching -= 1

    def correct(self, topic: str) -> None:
        self.corrected.append(topic)

    def correct_all(self) -> None:
        self.all += 1


def test_corrections_become_rarer_while_the_forging_continues() -> None:
    owner = Owner()
    for _ in range(100_000):
        owner.guard.report("status")
        owner.now_s += 0.001
        owner.guard.run_once()
    assert 20 < len(owner.corrected) < 40
    assert owner.guard.run_once() <= PAUSE.most_s
    owner.now_s += PAUSE.most_s
    owner.guard.run_once()
    owner.now_s += (CALM_PAUSES + 1) * PAUSE.most_s
    for _ in range(2):
        owner.guard.report("status")
        owner.guard.run_once()
        owner.now_s += PAUSE.first_s
    assert owner.corrected[-2:] == ["status", "status"]
    assert len(owner.corrected) < 45


def test_many_topics_are_corrected_in_portions_and_too_many_by_resending_all() -> None:
    owner = Owner()
    for number in range(AT_ONCE + 1):
        owner.guard.report(f"t{number}")
    assert owner.guard.run_once() == pytest.approx(PAUSE.first_s)
    assert len(owner.corrected) == AT_ONCE
    for number in range(1500):
        owner.guard.report(f"t{number}")
    owner.now_s += PAUSE.first_s
    owner.guard.run_once()
    assert (owner.all, len(owner.corrected)) == (1, AT_ONCE)


def test_during_a_flood_the_guard_stops_listening_and_then_resends_everything() -> None:
    owner = Owner()
    rests = []
    for _ in range(3):
        for _ in range(MAX_FOREIGN_MESSAGES + 1):
            owner.guard.report("status")
        assert owner.watching == 0
        owner.guard.report("status")
        owner.guard.begin()
        assert owner.watching == 0, "a new connection does not end the pause"
        rests.append(owner.guard.run_once())
        owner.now_s += rests[-1]
        told = owner.all
        owner.guard.run_once()
        assert owner.watching == 1
        owner.now_s += PAUSE.most_s
        owner.guard.run_once()
        assert owner.all == told + 1
    assert rests == [BREAK.first_s, 2 * BREAK.first_s, 4 * BREAK.first_s]
    assert not owner.corrected
